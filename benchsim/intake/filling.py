"""The text of a ``recording.toml`` begun from photographs: what they say filled in, "?" where only a person knows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, get_args

import tomlkit

from benchsim.bench import schema
from benchsim.bench.errors import BenchsimError
from benchsim.bench.files import UNFILLED
from benchsim.bench.names import printable
from benchsim.calibration.record import CameraRecord
from benchsim.intake.photo import UPRIGHT, Photo

GUESSED_SIGMA = (0.03, 0.01, 0.05)
"""1 sigma of intrinsics that were never measured: focal length (fraction; EXIF rounds to whole mm of 35 mm film, and
phones crop), principal point (fraction of the width), k1."""

COMMENT_COLUMN = 34


@dataclass(frozen=True)
class Shot:
    """One exposure to be: its picture, its dark picture if there is one, and both as the recording names them."""

    photo: Photo
    image: str
    dark: str | None
    camera: str


def cameras_of(photos: Sequence[Photo], calibrated: CameraRecord | None) -> list[str]:
    """Name of the camera of every photograph: the calibrated one, or one for each lens, zoom and size.

    Raises
    ------
    BenchsimError
        If the calibration does not fit the photographs.
    """
    if calibrated is None:
        lenses = list(dict.fromkeys(p.lens for p in photos))
        return [_letters(lenses.index(p.lens)) for p in photos]
    w, h = calibrated.table["resolution_px"]
    for p in photos:
        if p.resolution != (w, h):
            raise BenchsimError(
                f"{p.path.name}: {p.resolution[0]} × {p.resolution[1]} pixels, but camera {calibrated.name} was "
                f"calibrated with {w} × {h}; give both as the camera writes them, neither turned nor scaled"
            )
        if p.lens != photos[0].lens:
            raise BenchsimError(
                f"{p.path.name}: taken with another lens or zoom than {photos[0].path.name}, so one calibration cannot "
                "hold for both; use one lens without zoom, or leave the picture out"
            )
    return [calibrated.name] * len(photos)


def _letters(i: int) -> str:
    """As spreadsheets count: A … Z, then AA."""
    return (_letters(i // 26 - 1) if i >= 26 else "") + chr(ord("A") + i % 26)


def recording_toml(
    title: str,
    shots: Sequence[Shot],
    calibrated: CameraRecord | None = None,
    marks: str | None = None,
    folder: str = "DIR",
) -> str:
    """The commented text.

    Parameters
    ----------
    title : str
    shots : sequence of Shot
        In the order in which they were taken.
    calibrated : CameraRecord, optional
        Its table is copied as it stands; otherwise the focal length is EXIF's.
    marks : str, optional
        Where ``marks.csv`` came from.
    folder : str
        As the next command has it.
    """
    return "\n".join(
        [
            f'format = "{_format()}"',
            f"title = {_toml(title)}",
            "",
            '# "?" stands where only you know the value. Fill in every one, then: benchsim check ' + printable(folder),
            "# Frame: x is the screen's normal toward the mirror, y to the right as seen from the mirror, z up; its",
            "# origin is the screen's centre.",
            *_LASER,
            *_MIRROR,
            *_screen(marks),
            *_cameras(shots, calibrated),
            *_uncertainty(shots, calibrated),
            *_exposures(shots),
            "",
        ]
    )


def alike(text: str, other: Mapping[str, Any], cameras: bool) -> str:
    """The text with "?" replaced by what another file of the same bench has there, and its uncertainty taken over.

    Parameters
    ----------
    text : str
        As `recording_toml` makes it.
    other : mapping
        What the other file holds.
    cameras : bool
        Whether its cameras are taken over too, those with the same name and as many pixels.
    """
    document = tomlkit.parse(text)

    def take(mine: Any, theirs: Any, *, all_of_it: bool) -> None:
        for key, value in (theirs or {}).items():
            if key in mine and (all_of_it or mine[key] == UNFILLED):
                mine[key] = value

    for name in ("laser", "mirror", "screen"):
        take(document[name], other.get(name), all_of_it=False)
    take(document["uncertainty"], other.get("uncertainty"), all_of_it=True)
    for name, camera in (other.get("cameras", {}) if cameras else {}).items():
        mine: Any = document["cameras"]
        if name in mine and mine[name]["resolution_px"] == camera.get("resolution_px"):
            take(mine[name], camera, all_of_it=True)
    return tomlkit.dumps(document)


def _format() -> str:
    return str(get_args(schema.RecordingFile.model_fields["format"].annotation)[0])


def _toml(value: Any) -> str:
    return tomlkit.item(value).as_string()


def _line(key: str, value: Any, comment: str = "") -> str:
    text = f"{key} = {_toml(value)}"
    return f"{text:<{COMMENT_COLUMN}}  # {printable(comment)}" if comment else text


_LASER = [
    "",
    "[laser]",
    _line("wavelength_nm", UNFILLED, "on its label: a red pointer 635 to 670, a He-Ne 632.8"),
    _line("beam_diameter_mm", UNFILLED, "between its 1/e² edges at the mirror, about the bright spot's width on paper"),
    _line("divergence_mrad", UNFILLED, "full angle: growth of that width / distance; a pointer 1 to 2"),
]

_MIRROR = [
    "",
    "[mirror]",
    _line("shape", UNFILLED, '"polygon" or "cylinder"'),
    _line("facets", UNFILLED, "of the polygon; remove the line for a cylinder"),
    _line("diameter_mm", UNFILLED, "over the polygon's corners, by caliper"),
    _line("height_mm", UNFILLED, "of a facet, along the axis of rotation"),
    _line(
        "stands_for", UNFILLED, '"elevation": its axis is level; "azimuth": it lies in the plane of z and the normal'
    ),
]


def _screen(marks: str | None) -> list[str]:
    return [
        "",
        "[screen]",
        _line("size_mm", UNFILLED, "[along y, along z] of the white board"),
        _line("marks", "marks.csv", f"copied from {marks}" if marks else "put the board's marks.csv beside this file"),
    ]


def _cameras(shots: Sequence[Shot], calibrated: CameraRecord | None) -> list[str]:
    out = []
    for name in dict.fromkeys(s.camera for s in shots):
        photo = next(s.photo for s in shots if s.camera == name)
        out += ["", f"[cameras.{_toml_key(name)}]" + (f"  # {photo.model}" if photo.model else "")]
        if calibrated is not None:
            table = dict(calibrated.table)
            out += ["# as calibrated", *(_line(key, value) for key, value in table.items())]
        else:
            table = _guessed(photo)
            out += [_line(key, value, comment) for key, (value, comment) in table.items()]
        if "bit_depth" not in table:
            out.append(_line("bit_depth", photo.bit_depth, "of the pictures"))
        if "gamma" not in table:
            value, why = ("unknown", "no phone states its curve; flux and width are then not used")
            if photo.bit_depth == 16:
                value, why = (UNFILLED, '1.0 for a raw sensor, "srgb", or "unknown": flux and width are then not used')
            out.append(_line("gamma", value, why))
    return out


def _toml_key(name: str) -> str:
    return tomlkit.key(name).as_string()


def _guessed(photo: Photo) -> dict[str, tuple[Any, str]]:
    w, h = photo.resolution
    focal = photo.focal_px
    return {
        "resolution_px": ([w, h], "of the pictures, as the sensor has them"),
        "focal_px": (
            (round(focal, 0), "from EXIF, good to some percent: benchsim calibrate")
            if focal
            else (UNFILLED, "benchsim calibrate; or the focal length in mm / the pixel's size in mm")
        ),
        "principal_point_px": ([(w - 1) / 2, (h - 1) / 2], "the picture's middle: benchsim calibrate"),
        "distortion": ([0.0, 0.0, 0.0, 0.0, 0.0], "not known: benchsim calibrate"),
    }


def _uncertainty(shots: Sequence[Shot], calibrated: CameraRecord | None) -> list[str]:
    u = schema.UncertaintyTable()
    width = shots[0].photo.resolution[0]
    if calibrated is not None:
        stated, why = list(calibrated.intrinsics_sigma), "focal (fraction), principal point (px), k1: as calibrated"
    else:
        stated = [GUESSED_SIGMA[0], round(GUESSED_SIGMA[1] * width, 1), GUESSED_SIGMA[2]]
        why = "focal (fraction), principal point (px), k1: not calibrated"
    return [
        "",
        "# 1 sigma of what you set by hand, the same for all settings. These are a careful bench's: put your own.",
        "[uncertainty]",
        _line("mirror_position_mm", u.mirror_position_mm, "of each coordinate of mirror_position_mm"),
        _line("mirror_axis_mrad", u.mirror_axis_mrad, "of the axis' direction; 1 mrad is 1 mm in 1 m"),
        _line("laser_direction_mrad", u.laser_direction_mrad, "of azimuth and elevation"),
        _line("screen_position_mm", u.screen_position_mm, "each time the screen is moved or rolled"),
        _line("screen_angle_mrad", u.screen_angle_mrad, "likewise"),
        _line("beam_diameter_fraction", u.beam_diameter_fraction),
        _line("divergence_fraction", u.divergence_fraction),
        _line("intrinsics_sigma", stated, why),
    ]


def _exposures(shots: Sequence[Shot]) -> list[str]:
    """Explained once, in the first."""
    begin = next((s.photo.time for s in shots if s.photo.time), None)
    out: list[str] = []
    for i, s in enumerate(shots):
        first = i == 0

        def explained(text: str, first: bool = first) -> str:
            return text if first else ""

        out += [
            "",
            f"[[exposure]]  # {_says(s.photo)}",
            _line("image", s.image),
            _line("dark", s.dark, explained("shows no laser")) if s.dark else "# no dark picture was found for it",
            _line("camera", s.camera),
            _line("setting", f"s{i + 1:02d}", explained("the same name where nothing was touched in between")),
            _line("laser_azimuth_deg", UNFILLED, explained("of the direction toward the laser, from +x toward -y")),
            _line("laser_elevation_deg", UNFILLED, explained("of the direction toward the laser, above the horizon")),
            _line("mirror_position_mm", UNFILLED, explained("[x, y, z] of the centre of rotation")),
            _line("screen_shift_mm", 0.0, explained("known shift of the screen along x")),
            _line("screen_roll_deg", 0.0, explained("known turn of the screen in its plane, y toward z")),
            _time_line(s.photo.time, begin, first),
        ]
    return out


def _time_line(time: datetime | None, begin: datetime | None, first: bool) -> str:
    if time is None or begin is None:
        return "# time_s: the picture does not say when it was taken; the order of this file counts"
    return _line("time_s", round((time - begin).total_seconds(), 3), "from EXIF" if first else "")


def _says(p: Photo) -> str:
    said = [p.time.isoformat(" ", "seconds")] if p.time else []
    if p.exposure:
        said.append(f"{p.exposure:g} s" if p.exposure >= 0.3 else f"1/{1 / p.exposure:.0f} s")
    if p.iso:
        said.append(f"ISO {p.iso:.0f}")
    said.append(UPRIGHT.get(p.orientation, "mirrored by EXIF"))
    return ", ".join(said)
