"""Recordings and benches as TOML files: read and checked; ``writing`` writes them.

A recording is a folder with ``recording.toml`` and its images; a bench file is the same file without images.
Every complaint is one sentence with file, key and mend.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ValidationError

import benchsim
from benchsim.bench import schema
from benchsim.bench.complaints import UNFILLED, complaint, first
from benchsim.bench.errors import BenchsimError
from benchsim.bench.fields import FORMS, Field, field
from benchsim.bench.marks import read_marks
from benchsim.bench.model import (
    Camera,
    Expander,
    Exposure,
    Laser,
    Mirror,
    Physics,
    Recording,
    RenderOptions,
    Screen,
    Surface,
    Uncertainty,
)
from benchsim.bench.paths import inside
from benchsim.bench.place import aim
from benchsim.bench.reading import MOST_PIXELS
from benchsim.bench.toml_file import load_toml
from benchsim.bench.writing import write

__all__ = ["UNFILLED", "complaints", "read", "shipped", "sources", "write"]


def shipped(name: str) -> Recording:
    """A bench that comes with the package, by the name of its file in ``scenes/``."""
    package = Path(benchsim.__file__).parent
    for folder in (package / "scenes", package.parent / "scenes"):
        if (folder / name).is_file():
            return read(folder / name)
    raise BenchsimError(f"scenes/{name}: not found beside the package; install benchsim anew")


def read(path: str | Path, *, images: bool | None = None, allow_outside: bool = False) -> Recording:
    """Read and check a recording folder, or a recording or bench file.

    Parameters
    ----------
    path : path
        Folder with ``recording.toml``, or the TOML file itself.
    images : bool, optional
        True: every exposure must name an image that exists. False: images are ignored (a bench to be rendered).
        Default: images are optional, those named must exist.
    allow_outside : bool
        Whether marks and images may lie outside of the file's folder, see `paths.inside`.

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
    data = load_toml(file)
    for table in data.get("exposure", []) if isinstance(data.get("exposure"), list) else []:
        if images is False and isinstance(table, dict):
            table.pop("image", None)
            table.pop("dark", None)
    try:
        checked = schema.RecordingFile.model_validate(data)
    except ValidationError as error:
        raise BenchsimError(f"{file.name}: {first(error, schema.RecordingFile)}") from None
    marks = inside(file.parent, checked.screen.marks, f"{file.name}: screen.marks", allow_outside=allow_outside)
    recording = replace(_convert(checked, file, marks), defaults_used=tuple(_defaults(checked)))
    _check(recording, file, images, allow_outside)
    return recording


def given(source: Recording | str | Path, *, images: bool | None = None, allow_outside: bool = False) -> Recording:
    """What `read` makes of a path; or a recording in hand, checked the same way.

    Raises
    ------
    BenchsimError
        One sentence that names file, key and mend.
    """
    if not isinstance(source, Recording):
        return read(source, images=images, allow_outside=allow_outside)
    if images is False:
        source = replace(source, exposures=tuple(replace(e, image=None, dark=None) for e in source.exposures))
    _check(source, source.path, images, allow_outside)
    return source


def complaints(path: str | Path) -> list[tuple[str, str]]:
    """Everything that keeps a file from being read for its keys alone: (key, mend), in the order of the file.

    A value `UNFILLED` is one of them. What contradicts something else is told by `read`, and only if nothing is here.

    Raises
    ------
    BenchsimError
        If there is no such file, or it is not TOML.
    """
    data = load_toml(_toml_path(Path(path)))
    try:
        schema.RecordingFile.model_validate(data)
    except ValidationError as error:
        found: dict[str, str] = {}
        for one in error.errors():
            key, mend = complaint(one, schema.RecordingFile)
            found.setdefault(key, mend)
        return list(found.items())
    return []


def sources(recording: Recording) -> list[Path]:
    """Files that a recording stands on: its TOML file and marks, where it has been read from one, and pictures."""
    names = [name for e in recording.exposures for name in (e.image, e.dark) if name]
    pictures = [recording.folder / name for name in names]
    if not recording.path.is_file():
        return pictures
    screen = load_toml(recording.path).get("screen", {})
    marks = screen.get("marks", schema.ScreenTable.model_fields["marks"].default)
    return [recording.path, recording.folder / marks, *pictures]


def _toml_path(path: Path) -> Path:
    if path.is_dir():
        file = path / "recording.toml"
        if not file.is_file():
            raise BenchsimError(
                f"{path}: no recording.toml in this folder; name a recording's folder or a bench file (.toml)"
            )
        return file
    if not path.exists():
        raise BenchsimError(f"{path}: no such file or folder; check the path")
    return path


def _convert(f: schema.RecordingFile, file: Path, marks: Path) -> Recording:
    mrad, deg = 1e-3, math.pi / 180
    u = f.uncertainty
    if f.mirror.shape == "cylinder" and f.physics.facets and "facets" in f.physics.model_fields_set:
        raise BenchsimError(f'{file.name}: physics.facets: true contradicts mirror.shape = "cylinder"; set it to false')
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
        screen=Screen(_pair(f.screen.size_mm), f.screen.reflectance, read_marks(marks)),
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
        fields={name: _field(name, table, file) for name, table in f.fields.items()},
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


def _field(name: str, table: Mapping[str, Any], file: Path) -> Field:
    key = f"{file.name}: fields.{name}"
    if name not in FORMS:
        raise BenchsimError(f"{key}: no such field; known are {', '.join(FORMS)}")
    form = FORMS[name]
    wanted = [k for k, _ in form.coordinates + form.components]
    for k in (*wanted, *table):
        if k not in table or k not in wanted:
            raise BenchsimError(f"{key}.{k}: the table needs exactly {', '.join(wanted)}; mend it")
    knots = [np.array(table[k], float) * factor for k, factor in form.coordinates]
    for (k, _), x in zip(form.coordinates, knots, strict=True):
        if x.ndim != 1 or len(x) < 2 or not (np.diff(x) > 0).all():
            raise BenchsimError(f"{key}.{k}: give at least two growing numbers")
    shape = tuple(len(x) for x in knots)
    values = []
    for k, factor in form.components:
        try:
            value = np.array(table[k], float) * factor
        except ValueError:
            value = np.zeros(0)
        if value.shape != shape:
            raise BenchsimError(
                f"{key}.{k}: needs {' × '.join(map(str, shape))} numbers, as many as the knots; mend it"
            )
        values.append(value)
    return field(knots, values)


def _expander(e: schema.ExpanderTable, file: Path) -> Expander:
    surfaces = []
    for i, row in enumerate(e.surfaces, 1):
        ok = len(row) == 4 and isinstance(row[2], str) and all(isinstance(row[k], (int, float)) for k in (0, 1, 3))
        if not ok:
            raise BenchsimError(
                f'{file.name}: expander.surfaces[{i}]: write [radius_mm, thickness_mm, "glass", semi_diameter_mm]'
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
            elif key not in table.model_fields_set and value is not None and key not in ("effects", "fields"):
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


def _check(recording: Recording, file: Path, images: bool | None, allow_outside: bool) -> None:
    for name, camera in recording.cameras.items():
        key = f"{file.name}: cameras.{name}"
        if math.prod(camera.resolution) > MOST_PIXELS:
            raise BenchsimError(f"{key}.resolution_px: more than {MOST_PIXELS / 1e6:.0f} million pixels; mend it")
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
            raise BenchsimError(
                f"{key}.camera: '{e.camera}' is not among the cameras ({known}); add it or mend the name"
            )
        if e.facet is not None and e.facet >= recording.mirror.facets:
            raise BenchsimError(f"{key}.facet: {e.facet} but the mirror has facets 0 … {recording.mirror.facets - 1}")
        if e.facet is not None and recording.mirror.shape == "cylinder":
            raise BenchsimError(f"{key}.facet: a cylinder has no facets; remove the key")
        if images and e.image is None:
            raise BenchsimError(
                f"{key}.image: required and missing; name the photograph, or run 'benchsim render' first"
            )
        if e.dark is not None and e.image is None:
            raise BenchsimError(f"{key}.dark: given without an image; add image")
        for kind in ("image", "dark"):
            _check_image_path(getattr(e, kind), f"{key}.{kind}", recording.folder, allow_outside)
        if e.image is not None:
            if e.image in seen:
                raise BenchsimError(f"{key}.image: '{e.image}' is already another exposure's; name each image once")
            seen.add(e.image)
        _check_setting(recording.mirror, e, key)


def _check_effects(recording: Recording, file: Path) -> None:
    for name, parameters in recording.effects.items():
        if not parameters:
            raise BenchsimError(f"{file.name}: effects.{name}: empty; give its parameters or remove the table")


def _check_image_path(name: str | None, key: str, folder: Path, allow_outside: bool) -> None:
    if name is None:
        return
    path = inside(folder, name, key, allow_outside=allow_outside)
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
            f"{key}.mirror_position_mm: x = {e.mirror_position[0]:g} is behind or in the screen; "
            "the mirror stands at x > 0"
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
