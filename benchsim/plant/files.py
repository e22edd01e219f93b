"""``plant.toml`` and what it names, read and checked: every complaint is one sentence with file, key and mend."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError
from scipy.spatial import cKDTree

from benchsim.bench.complaints import complaint, first
from benchsim.bench.errors import BenchsimError
from benchsim.bench.paths import FILE, inside
from benchsim.bench.toml_file import load_toml
from benchsim.plant import schema, sensors, sunshape, tables
from benchsim.plant.model import ERRORS, Field, Optics, Plant, Receiver, Site
from benchsim.plant.tables import AIM, Rows

Array = NDArray[np.float64]

NAME = "plant.toml"

FAR = 20.0
"""Times as far as the median heliostat, from which on a place is doubted: no field of one tower is so deep."""

SMOOTH = 0.05e-3
"""Slope error [rad] below which it is doubted: the best facets have about 0.5 mrad."""

NEAREST = 0.5
"""Mirrors whose centres are nearer than this part of an edge stand within one another."""


def toml_path(path: Path) -> Path:
    """The file of a plant: itself, or `NAME` in a folder."""
    file = path / NAME if path.is_dir() else path
    if not file.exists():
        raise BenchsimError(
            f"{path}: no {NAME} there; name a plant's folder or its file"
            if path.is_dir()
            else f"{path}: no such file or folder; check the path"
        )
    return file


def recognises(path: Path) -> bool:
    """Whether a path is a plant's file, or a folder with one and no recording."""
    if path.is_dir():
        return (path / NAME).exists() and not (path / FILE).exists()
    try:
        return path.name == NAME or load_toml(path).get("format") == schema.FORMAT
    except BenchsimError:
        return False


def complaints(path: Path) -> list[tuple[str, str]]:
    """Everything that keeps a file from being read for its keys alone: (key, mend)."""
    try:
        schema.PlantFile.model_validate(load_toml(toml_path(path)))
    except ValidationError as error:
        return list(dict(complaint(one, schema.PlantFile) for one in error.errors()).items())
    return []


def read(path: Path | str, *, allow_outside: bool = False) -> Plant:
    """Read and check a plant.

    Parameters
    ----------
    path : path
        ``plant.toml``, or the folder that holds it.
    allow_outside : bool
        Whether the tables may lie outside of the file's folder, see `benchsim.bench.paths.inside`.

    Returns
    -------
    Plant

    Raises
    ------
    BenchsimError
        One sentence that names file, key or line, and mend.
    """
    file = toml_path(Path(path))
    try:
        f = schema.PlantFile.model_validate(load_toml(file))
    except ValidationError as error:
        raise BenchsimError(f"{file.name}: {first(error, schema.PlantFile)}") from None

    def named(name: str, key: str) -> Path:
        return inside(file.parent, name, f"{file.name}: {key}", allow_outside=allow_outside)

    site = _site(f.site, file)
    receivers = tuple(_receiver(r, k, file) for k, r in enumerate(f.receiver))
    names = [r.name for r in receivers]
    if len(set(names)) < len(names):
        raise BenchsimError(f"{file.name}: receiver: two have one name; name each of them differently")
    sun, sun_files = _sun(f.sun, file, named)
    optics = Optics(
        1e-3 * f.optics.slope_mrad, 1e-3 * f.optics.specularity_mrad, f.optics.reflectance, f.optics.soiling
    )
    rows = _rows(f.heliostats, named)
    field = _field(f, rows, receivers, site, file)
    files = [file, *sun_files, *rows.files]
    diagnosed, remarks = None, list(rows.remarks)
    if f.heliostats.diagnosed is not None:
        table = named(f.heliostats.diagnosed, "heliostats.diagnosed")
        errors, sigmas, said = tables.diagnosed_errors(table, field.ids, field.kinematics)
        diagnosed = (errors, sigmas)
        files.append(table)
        remarks += said
    plant = Plant(
        f.title, file, tuple(dict.fromkeys(files)), site, receivers, field, sun, optics, diagnosed, tuple(remarks),
        sensors.station(f.detector, receivers, field, file), sensors.prisms(f.prisms, file.name),
        sensors.drone(f.drone),
    )  # fmt: skip
    _check(plant, rows.files[0])
    return replace(plant, remarks=(*plant.remarks, *_doubts(plant)))


def _site(s: schema.SiteTable, file: Path) -> Site:
    try:
        zone = ZoneInfo(s.time_zone)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        raise BenchsimError(
            f'{file.name}: site.time_zone: {s.time_zone!r} is no time zone; write one of the IANA, like "Europe/Madrid"'
        ) from None
    return Site(math.radians(s.latitude_deg), math.radians(s.longitude_deg), s.elevation_m, zone, s.attenuation)


def _receiver(r: schema.ReceiverTable, k: int, file: Path) -> Receiver:
    key, other = ("diameter_m", "width_m") if r.kind == "cylinder" else ("width_m", "diameter_m")
    where = f"{file.name}: receiver[{k + 1}]"
    if getattr(r, key) is None or getattr(r, other) is not None:
        raise BenchsimError(f"{where}: a {r.kind} has {key} and no {other}; write it so")
    if r.kind == "cylinder" and {"azimuth_deg", "elevation_deg"} & r.model_fields_set:
        raise BenchsimError(
            f"{where}: a cylinder stands upright and looks all around; remove azimuth_deg and elevation_deg"
        )
    e, n, u = (1e3 * x for x in r.centre_m)
    width = 1e3 * getattr(r, key)
    return Receiver(
        r.name, r.kind, (e, n, u), width, 1e3 * r.height_m, math.radians(r.azimuth_deg), math.radians(r.elevation_deg),
        None if r.peak_limit_kw_m2 is None else 1e3 * r.peak_limit_kw_m2,
    )  # fmt: skip


def _sun(s: schema.SunTable, file: Path, named: Any) -> tuple[sunshape.SunShape, list[Path]]:
    needs = {"gaussian": "sigma_mrad", "buie": "csr", "table": "table", "pillbox": "half_angle_mrad"}[s.shape]
    for key in ("sigma_mrad", "half_angle_mrad", "csr", "table"):
        there = getattr(s, key) is not None
        if there != (key == needs) and not (s.shape == "pillbox" and key == needs):
            raise BenchsimError(
                f"{file.name}: sun.{key}: "
                + (f"the shape {s.shape} has none; remove it" if there else f"the shape {s.shape} needs it; add it")
            )
    if s.sigma_mrad is not None:
        return sunshape.gaussian(1e-3 * s.sigma_mrad), []
    if s.csr is not None:
        return sunshape.buie(s.csr), []
    if s.table is not None:
        path = named(s.table, "sun.table")
        return _measured(path), [path]
    return sunshape.pillbox(sunshape.DISC if s.half_angle_mrad is None else 1e-3 * s.half_angle_mrad), []


def _measured(path: Path) -> sunshape.SunShape:
    """A sun's shape as measured: columns ``angle_mrad`` from 0 and ``radiance`` in any unit."""
    table = tables.cells(path)
    places = tables.columns_of(table, ["angle_mrad", "radiance"], lambda n: n in ("angle_mrad", "radiance"))
    body = table.rows[1:]
    angle, radiance = (
        np.array([table.number(line, n, row[places[n]], 0.0, high) for line, row in body])
        for n, high in (("angle_mrad", 100.0), ("radiance", 1e12))
    )
    if (
        len(body) < 2
        or np.isnan(angle).any()
        or np.isnan(radiance).any()
        or angle[0] > 1
        or (np.diff(angle) < 1e-6).any()
    ):
        raise BenchsimError(
            f"{path}: angle_mrad: give two lines or more with angles that grow from 0, and a radiance in each"
        )
    shape = sunshape.SunShape("table", 1e-3 * angle, radiance)
    with np.errstate(all="ignore"):
        sigma = shape.sigma
    if not 1e-4 <= sigma <= 0.05:
        raise BenchsimError(
            f"{path}: radiance: no sun looks so, its light would spread by {1e3 * sigma:.3g} mrad; mend it"
        )
    return shape


def _rows(h: schema.HeliostatsTable, named: Any) -> Rows:
    path = named(h.table, "heliostats.table")
    if h.format == "paint":
        return tables.paint_tree(path, named(h.tower, "heliostats.tower") if h.tower else None)
    if h.format == "field":
        return tables.diagnosed_table(path)[0]
    return {"benchsim": tables.own, "solarpilot": tables.solarpilot, "soltrace": tables.soltrace}[h.format](path)


def _field(f: schema.PlantFile, rows: Rows, receivers: tuple[Receiver, ...], site: Site, file: Path) -> Field:
    h, n = f.heliostats, len(rows.ids)
    position = tables.placed(rows, site.place)

    def column(name: str, default: float | None) -> Array:
        """In the table's unit; what is empty there is as [heliostats] has it."""
        found = rows.columns.get(name, np.full(n, np.nan))
        return np.where(np.isnan(found), np.nan if default is None else default, found)

    sizes = {}
    for name, default in (("width_m", h.width_m), ("height_m", h.height_m)):
        sizes[name] = column(name, default)
        lacking = np.flatnonzero(np.isnan(sizes[name]))
        if len(lacking):
            raise BenchsimError(
                f"{file.name}: heliostats.{name}: required, as {rows.files[0].name} does not say it of "
                f"{rows.ids[lacking[0]]}; add it"
            )
    facets = np.stack([column("facets_across", h.facets[0]), column("facets_up", h.facets[1])], axis=1).round()
    receiver = _receivers_of(rows, h.receiver, position, receivers, file)
    aim = np.zeros((n, 3))
    for k, one in enumerate(receivers):
        aim[receiver == k] = one.aim(position[receiver == k])
    stated = 1e3 * np.stack([column(a, None) for a in AIM], axis=1)
    aim = np.where(np.isnan(stated).any(axis=1, keepdims=True), aim, stated)
    kinematics = h.kinematics or rows.kinematics
    errors, sigmas = _errors(f.errors, rows, kinematics, file)
    return Field(
        rows.ids, position, 1e3 * sizes["width_m"], 1e3 * sizes["height_m"], facets.astype(np.int64),
        1e3 * column("focal_m", h.focal_m), 1e3 * column("canting_m", h.canting_m), receiver, aim, kinematics, errors,
        sigmas,
    )  # fmt: skip


def _receivers_of(
    rows: Rows, default: str | None, position: Array, receivers: tuple[Receiver, ...], file: Path
) -> NDArray[np.int64]:
    """Index of every heliostat's receiver: as named, or the one that faces it most squarely."""
    names = [r.name for r in receivers]
    if default is not None and default not in names:
        raise BenchsimError(f"{file.name}: heliostats.receiver: {default!r} is none of {', '.join(names)}; mend it")
    out = np.argmax([r.faces(position) for r in receivers], axis=0)
    for k in range(len(rows.ids)):
        name = (rows.receiver[k] if rows.receiver else "") or default
        if name and name not in names:
            raise BenchsimError(
                f"{rows.files[0]}: receiver: {name[:60]!r} of {rows.ids[k]} is none of {', '.join(names)}; mend it"
            )
        if name:
            out[k] = names.index(name)
    return np.asarray(out, np.int64)


def _errors(
    stated: Mapping[str, float], rows: Rows, kinematics: str, file: Path
) -> tuple[dict[str, Array], dict[str, Array]]:
    """Errors of the mounts and their sigmas [rad], of [errors] and of the table's columns."""
    known = {f"{name}{s}_mrad": (name, s) for name in ERRORS[kinematics] for s in ("", "_sigma")}
    for key, value in stated.items():
        if key not in known:
            raise BenchsimError(
                f"{file.name}: errors.{key[:60]}: no error of an {kinematics} mount; known are {', '.join(known)}"
            )
        if known[key][1] and value < 0:
            raise BenchsimError(f"{file.name}: errors.{key}: {value:g} is below 0; give a standard deviation")
    out: tuple[dict[str, Array], dict[str, Array]] = ({}, {})
    n = len(rows.ids)
    for key in (*stated, *(c for c in rows.columns if c.endswith("_mrad") and c not in stated)):
        if key not in known:
            raise BenchsimError(
                f"{rows.files[0]}: {key}: no error of an {kinematics} mount; remove the column or mend "
                "heliostats.kinematics"
            )
        found = rows.columns.get(key, np.full(n, np.nan))
        name, sigma = known[key]
        out[bool(sigma)][name] = 1e-3 * np.where(np.isnan(found), stated.get(key, 0.0), found)
    return out


def _check(plant: Plant, table: Path) -> None:
    f, file = plant.field, plant.path.name
    # Apart from those at one place: of many such a tree makes as many steps as there are pairs.
    places = np.unique(f.position, axis=0, return_index=True)[1]
    near = np.zeros(len(f))
    near[places] = cKDTree(f.position[places]).query(f.position[places], k=2)[0][:, 1]
    k = int(np.argmin(near / np.minimum(f.width, f.height)))
    if near[k] < NEAREST * min(f.width[k], f.height[k]):
        raise BenchsimError(
            f"{table}: {f.ids[k]} and another stand {near[k] / 1e3:.3g} m apart, within one another; mend their places"
        )
    short = int(np.argmin(f.distance / np.hypot(f.width, f.height)))
    if f.distance[short] < np.hypot(f.width, f.height)[short]:
        raise BenchsimError(
            f"{table}: {f.ids[short]} stands {f.distance[short] / 1e3:.3g} m from where it aims, less than its own "
            "size; mend its place"
        )
    spread = plant.spread
    if not spread.max() < 0.1:
        k = int(spread.argmax())
        raise BenchsimError(
            f"{file}: heliostats: {f.ids[k]} of {table.name} spreads its light by {1e3 * spread[k]:.3g} mrad; mend "
            "slope_mrad, specularity_mrad, focal_m or canting_m"
        )
    for k, r in enumerate(plant.receivers):
        away = np.flatnonzero((f.receiver == k) & (r.faces(f.position) <= 0))
        if len(away):
            raise BenchsimError(
                f"{file}: receiver[{k + 1}]: {f.ids[away[0]]} of {table.name} aims at {r.name} and is behind "
                "it; mend azimuth_deg or the receiver that is aimed at"
            )


def _doubts(plant: Plant) -> list[str]:
    """What may be so, but is more often a slip of a unit or of a sign, one sentence each."""
    f, out = plant.field, []
    usual = float(np.median(f.distance))
    far = int(np.argmax(f.distance))
    if f.distance[far] > FAR * usual:
        out.append(
            f"{f.ids[far]} stands {f.distance[far] / 1e3:.4g} m from where it aims, half of the others within "
            f"{usual / 1e3:.4g} m: mend its place if that is a slip."
        )
    for k, r in enumerate(plant.receivers):
        if r.centre[2] < f.position[:, 2].min():
            out.append(f"receiver[{k + 1}] lies below all mirrors: mend centre_m if that is a slip.")
    if 0 < plant.optics.slope < SMOOTH:
        out.append(
            f"optics.slope_mrad = {1e3 * plant.optics.slope:g} is smoother than any heliostat: is it in another unit?"
        )
    return out
