"""Recordings and benches written as TOML, every file under a temporary name first."""

from __future__ import annotations

import csv
import io
import math
import os
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import tomlkit

from benchsim.bench import schema
from benchsim.bench.errors import BenchsimError
from benchsim.bench.fields import FORMS
from benchsim.bench.marks import MARKS_HEADER
from benchsim.bench.model import Marks, Recording
from benchsim.bench.names import cell
from benchsim.bench.staging import permit, staged


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file under a temporary name, then move it into place, so that it is never half there."""
    with staged(path, folder=False) as staging:
        staging.write_bytes(data)
        permit(staging, 0o666)
        os.replace(staging, path)


def write_text(path: Path, text: str) -> None:
    """`write_bytes` of a text in UTF-8."""
    write_bytes(path, text.encode())


def write_csv(path: Path, header: Sequence[str], rows: Iterable[Iterable[Any]], digits: int | None = None) -> None:
    """Write a table: texts as `names.cell` has them, floats with so many significant digits or all, None empty."""

    def shown(value: Any) -> Any:
        if isinstance(value, str):
            return cell(value)
        return f"{value:.{digits}g}" if digits is not None and isinstance(value, float) else value

    out = io.StringIO()
    table = csv.writer(out, lineterminator="\n")
    table.writerow(header)
    table.writerows(map(shown, row) for row in rows)
    write_text(path, out.getvalue())


def write_marks(path: Path, marks: Marks) -> None:
    """Write ``marks.csv``, as `marks.read_marks` reads it."""
    rows = [",".join(MARKS_HEADER)]
    for tag, (y, z), side in zip(marks.ids, marks.centres, marks.sides, strict=True):
        rows.append(f"{tag},{_plain(y)},{_plain(z)},{_plain(side)}")
    write_text(path, "\n".join(rows) + "\n")


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
        write_marks(path.parent / "marks.csv", recording.screen.marks)
    write_text(path, tomlkit.dumps(_document(recording, render)))


def save(recording: Recording, folder: Path) -> Recording:
    """Write a recording with its images, or a bench, into a new or empty folder; returns it as it lies there.

    Raises
    ------
    BenchsimError
        If the folder holds something, or cannot be written.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise BenchsimError(f"{folder}: is there and not empty; choose another")
    exposures = [
        replace(e, image=_at_home(e.image, f"{i:03d}"), dark=_at_home(e.dark, f"{i:03d}-dark"))
        for i, e in enumerate(recording.exposures, 1)
    ]
    moved = replace(recording, exposures=tuple(exposures), path=folder / "recording.toml")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with staged(folder) as staging:
        for e, there in zip(recording.exposures, exposures, strict=True):
            for name, new in ((e.image, there.image), (e.dark, there.dark)):
                if name and new:
                    (staging / new).parent.mkdir(parents=True, exist_ok=True)
                    shutil.copyfile(recording.folder / name, staging / new)
        write(moved, staging / "recording.toml", render=all(e.image is None for e in exposures))
        permit(staging, 0o777)
        if folder.exists():
            folder.rmdir()
        staging.rename(folder)
    return moved


def _at_home(name: str | None, otherwise: str) -> str | None:
    """A picture's name, or another where it leads out of the recording's folder."""
    if name is None or not (Path(name).is_absolute() or ".." in Path(name).parts):
        return name
    return otherwise + Path(name).suffix


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

    put(
        "laser",
        {
            "wavelength_nm": r.laser.wavelength * 1e6,
            "beam_diameter_mm": r.laser.beam_diameter,
            "divergence_mrad": r.laser.divergence / mrad,
            "incoherent_divergence_mrad": r.laser.incoherent_divergence / mrad,
        },
    )
    put(
        "mirror",
        {
            "shape": r.mirror.shape,
            "facets": r.mirror.facets,
            "diameter_mm": r.mirror.diameter,
            "height_mm": r.mirror.height,
            "stands_for": r.mirror.stands_for,
        },
    )
    put("screen", {"size_mm": r.screen.size, "reflectance": r.screen.reflectance, "marks": "marks.csv"})
    cameras = tomlkit.table(is_super_table=True)
    for name, c in r.cameras.items():
        put(
            name,
            {
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
            },
            cameras,
        )
    doc["cameras"] = cameras
    put("physics", {"facets": r.physics.facets, "beam": r.physics.beam, "diffraction": r.physics.diffraction})
    u = r.uncertainty
    put(
        "uncertainty",
        {
            "mirror_position_mm": u.mirror_position,
            "mirror_axis_mrad": u.mirror_axis / mrad,
            "laser_direction_mrad": u.laser_direction / mrad,
            "screen_position_mm": u.screen_position,
            "screen_angle_mrad": u.screen_angle / mrad,
            "beam_diameter_fraction": u.beam_diameter_fraction,
            "divergence_fraction": u.divergence_fraction,
            "intrinsics_sigma": u.intrinsics_sigma,
        },
    )
    if r.effects:
        effects = tomlkit.table(is_super_table=True)
        for name, parameters in r.effects.items():
            put(name, dict(parameters), effects)
        doc["effects"] = effects
    if r.fields:
        fields = tomlkit.table(is_super_table=True)
        for name, f in r.fields.items():
            form = FORMS[name]
            table: dict[str, Any] = {}
            for (key, factor), knots in zip(form.coordinates, f.knots, strict=True):
                table[key] = [x / factor for x in knots]
            for (key, factor), values in zip(form.components, f.table(), strict=True):
                table[key] = [
                    _plain(x) if isinstance(x, float) else [_plain(v) for v in x] for x in (values / factor).tolist()
                ]
            put(name, table, fields)
        doc["fields"] = fields
    if r.expander is not None:
        e = r.expander
        put(
            "expander",
            {
                "surfaces": [[s.radius, s.thickness, s.glass, s.semi_diameter] for s in e.surfaces],
                "defocus_mm": e.defocus,
                "decentre_mm": e.decentre,
                "tilt_mrad": e.tilt / mrad,
            },
        )
    if render:
        put("render", dict(vars(r.render)))
    exposures = tomlkit.aot()
    for x in r.exposures:
        holder: dict[str, Any] = {}
        put(
            "e",
            {
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
            },
            holder,
        )
        exposures.append(holder["e"])
    doc["exposure"] = exposures
    return doc
