"""Recordings and benches as TOML files: read, checked, written.

A recording is a folder with ``recording.toml`` and its images; a bench file is the same file without images.
Every complaint is one sentence with file, key and mend.
"""

from __future__ import annotations

import csv
import difflib
import math
import os
import tempfile
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import tomlkit
from pydantic import BaseModel, ValidationError

from benchsim.bench import schema
from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import (
    Camera,
    Expander,
    Exposure,
    Laser,
    Marks,
    Mirror,
    Physics,
    Recording,
    RenderOptions,
    Screen,
    Surface,
    Uncertainty,
)
from benchsim.bench.place import aim

MARKS_HEADER = ["id", "y_mm", "z_mm", "side_mm"]
TAGS_36H11 = 587
"""Number of tags in the family 36h11; ids run from 0."""

_TABLE_MODELS: dict[str, type[BaseModel]] = {
    "laser": schema.LaserTable,
    "mirror": schema.MirrorTable,
    "screen": schema.ScreenTable,
    "cameras": schema.CameraTable,
    "physics": schema.PhysicsTable,
    "uncertainty": schema.UncertaintyTable,
    "expander": schema.ExpanderTable,
    "render": schema.RenderTable,
    "exposure": schema.ExposureTable,
}


def read(path: str | Path, *, images: bool | None = None) -> Recording:
    """Read and check a recording folder, or a recording or bench file.

    Parameters
    ----------
    path : path
        Folder with ``recording.toml``, or the TOML file itself.
    images : bool, optional
        True: every exposure must name an image that exists. False: images are ignored (a bench to be rendered).
        Default: images are optional, those named must exist.

    Returns
    -------
    Recording
        In mm, rad, s; ``defaults_used`` lists every default that was taken, as ``key = value``.

    Raises
    ------
    BenchsimError
        One sentence that names file, key and mend.
    """
    file = _toml_path(Path(path))
    data = _load_toml(file)
    for table in data.get("exposure", []) if isinstance(data.get("exposure"), list) else []:
        if images is False and isinstance(table, dict):
            table.pop("image", None)
            table.pop("dark", None)
    try:
        checked = schema.RecordingFile.model_validate(data)
    except ValidationError as error:
        raise BenchsimError(f"{file.name}: {_first_complaint(error, data)}") from None
    recording = replace(_convert(checked, file), defaults_used=tuple(_defaults(checked)))
    _check(recording, file, images)
    return recording


def _toml_path(path: Path) -> Path:
    if path.is_dir():
        file = path / "recording.toml"
        if not file.is_file():
            raise BenchsimError(f"{path}: no recording.toml in this folder; name a recording's folder or a bench file (.toml)")
        return file
    if not path.exists():
        raise BenchsimError(f"{path}: no such file or folder; check the path")
    return path


def _load_toml(file: Path) -> dict[str, Any]:
    try:
        text = file.read_bytes().decode("utf-8")
    except OSError as error:
        raise BenchsimError(f"{file}: cannot be read ({error.strerror}); check the path and its permissions") from None
    except UnicodeDecodeError:
        raise BenchsimError(f"{file}: not a text file in UTF-8; a recording or bench is a TOML file") from None
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise BenchsimError(f"{file.name}: not valid TOML: {error}; mend that line") from None


def _first_complaint(error: ValidationError, data: dict[str, Any]) -> str:
    """Turn pydantic's first error into one sentence with key and mend; unknown keys first, they explain the rest."""
    errors = sorted(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
    first = errors[0]
    loc = [part for part in first["loc"] if part not in ("float", "constrained-float", "function-wrap") and not _is_union_tag(part)]
    key = _key_name(loc)
    kind, value = first["type"], first.get("input")
    if kind == "extra_forbidden":
        return f"{key}: unknown key; {_suggestion(loc)}"
    if kind == "missing":
        return f"{key}: required and missing; add it"
    return f"{key}: {_mend(kind, first, value)}"


def _is_union_tag(part: Any) -> bool:
    return isinstance(part, str) and (part.startswith(("literal[", "constrained")) or part in {"int", "str", "none"})


def _key_name(loc: list[Any]) -> str:
    name = ""
    for part in loc:
        name += f"[{part + 1}]" if isinstance(part, int) else f".{part}" if name else str(part)
    return name


def _suggestion(loc: list[Any]) -> str:
    known = list(schema.RecordingFile.model_fields)
    if len(loc) > 1:
        model = _TABLE_MODELS.get(str(loc[0]))
        known = list(model.model_fields) if model else known
    close = difflib.get_close_matches(str(loc[-1]), known, n=1, cutoff=0.6)
    return f"did you mean '{close[0]}'?" if close else f"remove it, known keys are {', '.join(known)}"


def _mend(kind: str, first: Any, value: Any) -> str:
    ctx = first.get("ctx", {})
    shown = repr(value) if len(repr(value)) < 60 else repr(value)[:57] + "…"
    if kind in ("float_type", "int_type", "float_parsing"):
        what = "a whole number" if kind == "int_type" else "a number"
        return f"{shown} is not {what}; write {what} in the key's own unit, without quotes"
    if kind == "finite_number":
        return f"{shown} is not finite; give a finite number"
    if kind in ("too_short", "too_long"):
        want = ctx.get("min_length", ctx.get("max_length"))
        return f"{shown} has {ctx.get('actual_length')} entries; {'at least ' if kind == 'too_short' else ''}{want} needed"
    if kind == "list_type":
        return f"{shown} is not a list; write it in brackets"
    if kind == "literal_error":
        return f"{shown} is not known; use {ctx.get('expected')}"
    if kind in ("greater_than", "greater_than_equal", "less_than", "less_than_equal"):
        word = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most"}
        limits = ", ".join(f"{word[k]} {v:g}" for k, v in ctx.items() if k in word)
        return f"{shown} is out of range; it must be {limits} (check the unit in the key)"
    if kind == "bool_type":
        return f"{shown} is neither true nor false; write true or false without quotes"
    if kind == "string_type":
        return f"{shown} is not text; put it in quotes"
    if kind in ("model_type", "dict_type", "model_attributes_type"):
        return f"{shown} is not a table; write it as a [table]"
    return f"{shown}: {first['msg'][0].lower()}{first['msg'][1:]}; mend that value"


def _convert(f: schema.RecordingFile, file: Path) -> Recording:
    mrad, deg = 1e-3, math.pi / 180
    u = f.uncertainty
    if f.mirror.shape == "cylinder" and f.physics.facets and "facets" in f.physics.model_fields_set:
        raise BenchsimError(f"{file.name}: physics.facets: true contradicts mirror.shape = \"cylinder\"; set it to false")
    physics = Physics(f.physics.facets and f.mirror.shape == "polygon", f.physics.beam, f.physics.diffraction)
    return Recording(
        title=f.title,
        laser=Laser(
            f.laser.wavelength_nm * 1e-6,
            f.laser.beam_diameter_mm,
            f.laser.divergence_mrad * mrad,
            f.laser.incoherent_divergence_mrad * mrad,
        ),
        mirror=Mirror(f.mirror.shape, f.mirror.facets, f.mirror.diameter_mm, f.mirror.height_mm, f.mirror.stands_for),
        screen=Screen(_pair(f.screen.size_mm), f.screen.reflectance, read_marks(file.parent / f.screen.marks)),
        cameras={name: _camera(name, c) for name, c in f.cameras.items()},
        physics=physics,
        uncertainty=Uncertainty(
            u.mirror_position_mm,
            u.mirror_axis_mrad * mrad,
            u.laser_direction_mrad * mrad,
            u.screen_position_mm,
            u.screen_angle_mrad * mrad,
            u.beam_diameter_fraction,
            u.divergence_fraction,
            _triple(u.intrinsics_sigma),
        ),
        effects=f.effects,
        expander=_expander(f.expander, file) if f.expander else None,
        render=RenderOptions(**f.render.model_dump()),
        exposures=tuple(
            Exposure(
                camera=e.camera,
                setting=e.setting,
                laser_azimuth=e.laser_azimuth_deg * deg,
                laser_elevation=e.laser_elevation_deg * deg,
                mirror_position=_triple(e.mirror_position_mm),
                screen_shift=e.screen_shift_mm,
                screen_roll=e.screen_roll_deg * deg,
                time=e.time_s,
                facet=e.facet,
                image=e.image,
                dark=e.dark,
            )
            for e in f.exposure
        ),
        path=file,
    )


def _pair(v: list[float]) -> tuple[float, float]:
    return (float(v[0]), float(v[1]))


def _triple(v: list[float]) -> tuple[float, float, float]:
    return (float(v[0]), float(v[1]), float(v[2]))


def _camera(name: str, c: schema.CameraTable) -> Camera:
    k = c.distortion
    return Camera(
        name,
        (c.resolution_px[0], c.resolution_px[1]),
        c.focal_px,
        _pair(c.principal_point_px),
        (k[0], k[1], k[2], k[3], k[4]),
        _triple(c.position_mm),
        _triple(c.look_at_mm),
        c.bit_depth,
        c.gamma,
        c.black_level,
        float(2**c.bit_depth - 1) if c.saturation_level is None else c.saturation_level,
    )


def _expander(e: schema.ExpanderTable, file: Path) -> Expander:
    surfaces = []
    for i, row in enumerate(e.surfaces, 1):
        ok = len(row) == 4 and isinstance(row[2], str) and all(isinstance(row[k], (int, float)) for k in (0, 1, 3))
        if not ok:
            raise BenchsimError(
                f"{file.name}: expander.surfaces[{i}]: write [radius_mm, thickness_mm, \"glass\", semi_diameter_mm]"
            )
        radius, thickness, glass, semi = float(row[0]), float(row[1]), str(row[2]), float(row[3])
        if math.isnan(radius) or radius == 0 or not math.isfinite(thickness) or thickness < 0 or not semi > 0:
            raise BenchsimError(
                f"{file.name}: expander.surfaces[{i}]: the radius must not be 0 (inf is flat), the thickness not "
                "negative and the semi-diameter positive; mend that row"
            )
        surfaces.append(Surface(radius, thickness, glass, semi))
    return Expander(tuple(surfaces), e.defocus_mm, e.decentre_mm, e.tilt_mrad * 1e-3)


def _defaults(f: schema.RecordingFile) -> list[str]:
    """Every default that was taken, as ``table.key = value``; ``[render]`` is not physics and is left out."""
    out = []

    def walk(prefix: str, table: BaseModel) -> None:
        for key in type(table).model_fields:
            value = getattr(table, key)
            if isinstance(value, BaseModel):
                walk(f"{prefix}{key}.", value)
            elif key not in table.model_fields_set and value is not None and key != "effects":
                out.append(f"{prefix}{key} = {value!r}".replace("'", '"'))

    for name in ("laser", "mirror", "screen", "physics", "uncertainty"):
        walk(f"{name}.", getattr(f, name))
    for name, camera in f.cameras.items():
        walk(f"cameras.{name}.", camera)
        if camera.saturation_level is None:
            out.append(f"cameras.{name}.saturation_level = {2**camera.bit_depth - 1}")
    for i, exposure in enumerate(f.exposure, 1):
        walk(f"exposure[{i}].", exposure)
    return out


def _check(recording: Recording, file: Path, images: bool | None) -> None:
    for name, camera in recording.cameras.items():
        key = f"{file.name}: cameras.{name}"
        if camera.saturation_level <= camera.black_level:
            raise BenchsimError(f"{key}.saturation_level: not above black_level; mend one of them (counts)")
        if camera.saturation_level > 2**camera.bit_depth - 1:
            raise BenchsimError(f"{key}.saturation_level: more than {camera.bit_depth} bits hold; mend it or bit_depth")
        forward = [a - b for a, b in zip(camera.look_at, camera.position, strict=True)]
        if math.hypot(forward[0], forward[1]) < 1e-6 * max(1.0, abs(forward[2])):
            raise BenchsimError(f"{key}.look_at_mm: straight above, below or at the camera; move one of them")
        if camera.position[0] <= 0:
            raise BenchsimError(f"{key}.position_mm: x must be above 0, on the mirror's side of the screen, to see it")
    _check_effects(recording, file)
    seen: set[str] = set()
    for i, e in enumerate(recording.exposures, 1):
        key = f"{file.name}: exposure[{i}]"
        if e.camera not in recording.cameras:
            known = ", ".join(recording.cameras)
            raise BenchsimError(f"{key}.camera: '{e.camera}' is not among the cameras ({known}); add it or mend the name")
        if e.facet is not None and e.facet >= recording.mirror.facets:
            raise BenchsimError(f"{key}.facet: {e.facet} but the mirror has facets 0 … {recording.mirror.facets - 1}")
        if e.facet is not None and recording.mirror.shape == "cylinder":
            raise BenchsimError(f"{key}.facet: a cylinder has no facets; remove the key")
        if images and e.image is None:
            raise BenchsimError(f"{key}.image: required and missing; name the photograph, or run 'benchsim render' first")
        if e.dark is not None and e.image is None:
            raise BenchsimError(f"{key}.dark: given without an image; add image")
        for kind in ("image", "dark"):
            _check_image_path(getattr(e, kind), f"{key}.{kind}", recording.folder)
        if e.image is not None:
            if e.image in seen:
                raise BenchsimError(f"{key}.image: '{e.image}' is already another exposure's; name each image once")
            seen.add(e.image)
        _check_setting(recording.mirror, e, key)


def _check_effects(recording: Recording, file: Path) -> None:
    for name, parameters in recording.effects.items():
        if not parameters:
            raise BenchsimError(f"{file.name}: effects.{name}: empty; give its parameters or remove the table")


def _check_image_path(name: str | None, key: str, folder: Path) -> None:
    if name is None:
        return
    path = folder / name
    if not path.exists():
        raise BenchsimError(f"{key}: '{name}' is not there (looked in {folder}); add the file or mend the name")
    if not path.is_file():
        raise BenchsimError(f"{key}: '{name}' is not a file; name a PNG, TIFF or JPEG")


def _check_setting(mirror: Mirror, e: Exposure, key: str) -> None:
    if e.laser_elevation <= 0:
        raise BenchsimError(
            f"{key}.laser_elevation_deg: {math.degrees(e.laser_elevation):g}, the laser is below the horizon; "
            "give an elevation above 0"
        )
    if e.mirror_position[0] - e.screen_shift <= mirror.radius:
        raise BenchsimError(
            f"{key}.mirror_position_mm: x = {e.mirror_position[0]:g} is behind or in the screen; the mirror stands at x > 0"
        )
    try:
        a = aim(mirror, e)
    except BenchsimError as error:
        raise BenchsimError(f"{key}: {error}") from None
    # Grazing light beyond 89 degrees of incidence never reaches a facet of finite width in practice.
    if float(a.source @ a.normal) < math.cos(math.radians(89.0)):
        raise BenchsimError(
            f"{key}.laser_azimuth_deg: the laser stands behind the mirror as seen from the screen and cannot be "
            "reflected to it; mend the laser's angles or the mirror's position"
        )


def read_marks(path: Path) -> Marks:
    """Read ``marks.csv``: header ``id,y_mm,z_mm,side_mm``, one AprilTag 36h11 a row.

    Raises
    ------
    BenchsimError
        Naming file and line.
    """
    try:
        with path.open(newline="", encoding="utf-8") as handle:
            rows = [row for row in csv.reader(handle) if row]
    except FileNotFoundError:
        raise BenchsimError(f"{path.name}: not there (looked in {path.parent}); add it, or mend screen.marks") from None
    except (OSError, UnicodeDecodeError):
        raise BenchsimError(f"{path.name}: cannot be read as a CSV file; check it and its permissions") from None
    if not rows or [c.strip() for c in rows[0]] != MARKS_HEADER:
        raise BenchsimError(f"{path.name}: line 1 must read {','.join(MARKS_HEADER)}")
    ids, centres, sides = [], [], []
    for n, row in enumerate(rows[1:], 2):
        try:
            tag, y, z, side = int(row[0]), float(row[1]), float(row[2]), float(row[3])
            good = len(row) == 4 and all(map(math.isfinite, (y, z, side))) and side > 0 and 0 <= tag < TAGS_36H11
        except (ValueError, IndexError):
            good = False
        if not good:
            raise BenchsimError(
                f"{path.name}: line {n}: '{','.join(row)}' is not id (0 … {TAGS_36H11 - 1}), y, z and a positive side in mm"
            )
        if tag in ids:
            raise BenchsimError(f"{path.name}: line {n}: id {tag} stands twice; each mark has its own id")
        ids.append(tag)
        centres.append((y, z))
        sides.append(side)
    if not ids:
        raise BenchsimError(f"{path.name}: no marks in it; list the board's AprilTags")
    return Marks(tuple(ids), tuple(centres), tuple(sides))


def write_text(path: Path, text: str) -> None:
    """Write a text file under a temporary name, then move it into place, so that it is never half there."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}-")
    try:
        with os.fdopen(handle, "w", encoding="utf-8", newline="\n") as out:
            out.write(text)
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(name, 0o666 & ~mask)
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def _plain(x: float) -> float:
    """Round away the last bits that the change of unit left, so that files read as they were written."""
    return float(f"{x:.12g}")


def write(recording: Recording, path: str | Path, *, render: bool = False) -> None:
    """Write a recording (or, with ``render``, a bench file with its ``[render]``) and its marks beside it.

    Image names are written as they stand; images are not copied. ``[expander]`` is written where there is one.

    Parameters
    ----------
    recording : Recording
    path : path
        The TOML file to write; ``marks.csv`` is written into the same folder.
    render : bool
        Whether ``[render]`` is written: it is never copied into a recording.
    """
    path = Path(path)
    if recording.screen.marks is not None:
        rows = [",".join(MARKS_HEADER)]
        marks = recording.screen.marks
        for tag, (y, z), side in zip(marks.ids, marks.centres, marks.sides, strict=True):
            rows.append(f"{tag},{_plain(y)},{_plain(z)},{_plain(side)}")
        write_text(path.parent / "marks.csv", "\n".join(rows) + "\n")
    write_text(path, tomlkit.dumps(_document(recording, render)))


def _document(r: Recording, render: bool) -> tomlkit.TOMLDocument:
    mrad, deg = 1e-3, math.pi / 180
    doc = tomlkit.document()
    doc["format"] = get_args(schema.RecordingFile.model_fields["format"].annotation)[0]
    doc["title"] = r.title

    def put(name: str, values: dict[str, Any], parent: Any = doc) -> None:
        table = tomlkit.table()
        for key, value in values.items():
            if isinstance(value, float):
                value = _plain(value)
            elif isinstance(value, (tuple, list)):
                value = [_plain(v) if isinstance(v, float) else v for v in value]
            if value is not None:
                table[key] = value
        parent[name] = table

    put("laser", {
        "wavelength_nm": r.laser.wavelength * 1e6,
        "beam_diameter_mm": r.laser.beam_diameter,
        "divergence_mrad": r.laser.divergence / mrad,
        "incoherent_divergence_mrad": r.laser.incoherent_divergence / mrad,
    })
    put("mirror", {
        "shape": r.mirror.shape,
        "facets": r.mirror.facets,
        "diameter_mm": r.mirror.diameter,
        "height_mm": r.mirror.height,
        "stands_for": r.mirror.stands_for,
    })
    put("screen", {"size_mm": r.screen.size, "reflectance": r.screen.reflectance, "marks": "marks.csv"})
    cameras = tomlkit.table(is_super_table=True)
    for name, c in r.cameras.items():
        put(name, {
            "resolution_px": list(c.resolution),
            "focal_px": c.focal,
            "principal_point_px": c.principal_point,
            "distortion": c.distortion,
            "position_mm": c.position,
            "look_at_mm": c.look_at,
            "bit_depth": c.bit_depth,
            "gamma": c.gamma,
            "black_level": c.black_level,
            "saturation_level": c.saturation_level,
        }, cameras)
    doc["cameras"] = cameras
    put("physics", {"facets": r.physics.facets, "beam": r.physics.beam, "diffraction": r.physics.diffraction})
    u = r.uncertainty
    put("uncertainty", {
        "mirror_position_mm": u.mirror_position,
        "mirror_axis_mrad": u.mirror_axis / mrad,
        "laser_direction_mrad": u.laser_direction / mrad,
        "screen_position_mm": u.screen_position,
        "screen_angle_mrad": u.screen_angle / mrad,
        "beam_diameter_fraction": u.beam_diameter_fraction,
        "divergence_fraction": u.divergence_fraction,
        "intrinsics_sigma": u.intrinsics_sigma,
    })
    if r.effects:
        effects = tomlkit.table(is_super_table=True)
        for name, parameters in r.effects.items():
            put(name, dict(parameters), effects)
        doc["effects"] = effects
    if r.expander is not None:
        e = r.expander
        put("expander", {
            "surfaces": [[s.radius, s.thickness, s.glass, s.semi_diameter] for s in e.surfaces],
            "defocus_mm": e.defocus,
            "decentre_mm": e.decentre,
            "tilt_mrad": e.tilt / mrad,
        })
    if render:
        put("render", dict(vars(r.render)))
    exposures = tomlkit.aot()
    for x in r.exposures:
        holder: dict[str, Any] = {}
        put("e", {
            "image": x.image,
            "dark": x.dark,
            "camera": x.camera,
            "setting": x.setting,
            "laser_azimuth_deg": x.laser_azimuth / deg,
            "laser_elevation_deg": x.laser_elevation / deg,
            "mirror_position_mm": x.mirror_position,
            "screen_shift_mm": x.screen_shift,
            "screen_roll_deg": x.screen_roll / deg,
            "time_s": x.time,
            "facet": x.facet,
        }, holder)
        exposures.append(holder["e"])
    doc["exposure"] = exposures
    return doc
