"""A photograph of a tower's target with a heliostat's beam on it: where the beam's centroid is, and how well known.

Marks → homography → the target rectified → background subtracted → the beam's contour at a twentieth of its peak →
the centroid of what is inside. Every choice on that way is also made otherwise; what that moves is in the error bar.

Plane of the target: (east, up) in mm from its centre, as the tower file gives it. PAINT's format: a photograph
``*-raw.png``, its ``*-calibration-properties.json``, the tower's ``tower-measurements.json``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchsim.bench.errors import BenchsimError
from benchsim.instruments.mount.beam_light import CONTOUR, ORDER, Beam, beam_on, linear
from benchsim.instruments.mount.geodesy import enu, geodetic
from benchsim.instruments.mount.json_values import load, triple, value
from benchsim.instruments.mount.mark_templates import read_templates
from benchsim.instruments.mount.paint import find_tower
from benchsim.instruments.mount.target_marks import (
    Marks,
    find_marks,
    homography_jacobian,
    inverse,
    to_plane,
)
from benchsim.trace.counts import read_counts

Array = NDArray[np.float64]
Image = NDArray[Any]
"""float32; OpenCV's type stubs know no dtype."""

UPPER, LOWER, MFT = "solar_tower_juelich_upper", "solar_tower_juelich_lower", "multi_focus_tower"
TOWER_MARKS = {
    "left_top": (UPPER, "upper_left"),
    "top_middle": (UPPER, "upper_middle"),
    "right_top": (UPPER, "upper_right"),
    "left_middle": (UPPER, "lower_left"),
    "right_middle": (UPPER, "lower_right"),
    "left_bottom": (LOWER, "lower_left"),
    "bottom_middle": (LOWER, "lower_middle"),
    "right_bottom": (LOWER, "lower_right"),
}
FAMILIES: dict[str, tuple[str, dict[str, tuple[str, str]]]] = {
    UPPER: ("stj", TOWER_MARKS),
    LOWER: ("stj", TOWER_MARKS),
    MFT: (
        "mft",
        {
            "left_top": (MFT, "upper_left"),
            "right_top": (MFT, "upper_right"),
            "left_bottom": (MFT, "lower_left"),
            "right_bottom": (MFT, "lower_right"),
        },
    ),
}
"""Target → prefix of its templates, and mark → (target, point) of the tower file. The solar tower's two targets lie
above each other on one wall and are rectified together."""
CELLS = 240
"""Pixels along the rectified target's longer side."""
OTHER_ORDERS = (ORDER - 1, ORDER + 1)
OTHER_CONTOUR = 4 * CONTOUR
CORNERS = ("upper_left", "upper_right", "lower_left", "lower_right")


@dataclass(frozen=True)
class Plane:
    """A target's plane.

    Attributes
    ----------
    place : (3,)
        The plant's reference: latitude, longitude [deg], height [m].
    origin : (3,) mm
        The target's centre, east-north-up from there.
    axes : (2, 3)
        Its east and up, unit vectors.
    extent : (4,) mm
        East least and most, up least and most, of its corners.
    marks : dict
        Name of a mark → (2,) (east, up) [mm].
    """

    place: Array
    origin: Array
    axes: Array
    extent: tuple[float, float, float, float]
    marks: dict[str, Array]


@dataclass(frozen=True)
class TargetPhotograph:
    """The beam's centroid on a target.

    Attributes
    ----------
    path : Path
    target : str
    centroid : (2,) mm
        (east, up) from the target's centre.
    covariance : (2, 2) mm²
        The sum of ``parts``.
    parts : dict
        (2, 2) mm² each: ``marks`` (their places, through the homography), ``mark point`` (outer edge or centre line of
        a bar, half of the difference), ``background`` (a degree less, a degree more), ``contour`` (four times its
        height: light lost below a contour lies lopsided), ``light`` (counts taken for light; the other colours),
        ``noise``.
    moves : dict
        (2,) mm each: by how much another choice moves the centroid.
    enu : (3,) mm
        From the plant's reference in the tower file: east, north, up.
    geodetic : (3,)
        Latitude, longitude [deg] and height [m].
    plane : Plane
    marks : Marks
    beam : Beam
        In the rectified map's pixels.
    light : (h, w) float32
        The rectified map, row 0 at the bottom.
    extent : (4,) mm
        East least and most, up least and most, of the map's outer edges.
    saturated : float
        Fraction of the beam's pixels at the end of the scale in the channel used.
    says : tuple of str
        What a reader has to know: clipped, a second beam, marks missing or set aside.
    """

    path: Path
    target: str
    centroid: Array
    covariance: Array
    parts: dict[str, Array]
    moves: dict[str, Array]
    enu: Array
    geodetic: Array
    plane: Plane
    marks: Marks
    beam: Beam
    light: Image
    extent: tuple[float, float, float, float]
    saturated: float
    says: tuple[str, ...]

    @property
    def sigma(self) -> Array:
        """1 σ of the centroid, east and up [mm]."""
        return np.sqrt(np.diag(self.covariance))


def measure_beam(
    photograph: str | Path,
    templates: str | Path,
    properties: str | Path | None = None,
    tower: str | Path | None = None,
) -> TargetPhotograph:
    """The beam's centroid on the target of a raw photograph.

    Parameters
    ----------
    photograph : path
        8-bit picture of the whole target, its marks included, upright within 15°.
    templates : path
        Folder of the marks' templates, ``stj_*.png`` or ``mft_*.png``.
    properties : path, optional
        Calibration properties; default: ``NAME-calibration-properties.json`` beside ``NAME-raw.png``.
    tower : path, optional
        Tower file; default: looked for in the photograph's folder, then its parents.

    Raises
    ------
    BenchsimError
        One of the files is missing or lacks what is needed; the marks or the beam are not found.

    Notes
    -----
    The counts are taken to be sRGB's. Cameras that tone-map (halos around the marks betray them) distort the profile;
    ``light`` in the error bar covers a wrong curve, not a compression that differs from place to place. Lens distortion
    is not modelled: the marks' residuals show it. Not for targets that are no plane, and not for a beam that fills the
    target.
    """
    photograph = Path(photograph)
    counts = _read_counts(photograph)
    name = _target(photograph, properties)
    plane = _survey(name, Path(tower) if tower else find_tower(photograph.parent))
    family, _ = FAMILIES[name]
    found = read_templates(Path(templates), family, tuple(plane.marks))
    try:
        marks = find_marks(cv2.cvtColor(counts, cv2.COLOR_BGR2GRAY).astype(np.float32), found, plane.marks)
        return _measured(photograph, name, counts, marks, plane)
    except BenchsimError as e:
        raise BenchsimError(f"{photograph.name}: {e}") from None


def _measured(path: Path, name: str, counts: NDArray[np.uint8], marks: Marks, plane: Plane) -> TargetPhotograph:
    grid = _Grid.over(plane.extent, marks.homography, counts.shape[:2])
    valid = grid.valid(marks.ink)
    green = grid.rectified(linear(counts[..., 1]))
    beam = beam_on(green, valid)
    centroid = grid.plane(beam.centroid)

    def moved(image: Image, order: int = ORDER, contour: float = CONTOUR) -> Array:
        return grid.plane(beam_on(image, valid, order, contour).centroid) - centroid

    moves = {
        "background": {f"degree {o}": moved(green, order=o) for o in OTHER_ORDERS},
        "contour": {f"contour at {OTHER_CONTOUR:.0%}": moved(green, contour=OTHER_CONTOUR)},
        "light": {
            "counts as light": moved(grid.rectified(counts[..., 1].astype(np.float32) / 255)),
            "blue": moved(grid.rectified(linear(counts[..., 0]))),
            "red": moved(grid.rectified(linear(counts[..., 2]))),
        },
    }
    used = marks.used
    pixel = to_plane(inverse(marks.homography), centroid)
    jacobian = homography_jacobian(marks.pixel[used], marks.plane[used], pixel)
    shift = jacobian @ marks.inset[used].ravel() / 2
    step = np.diag(grid.step)
    parts = {
        "marks": marks.sigma**2 * jacobian @ jacobian.T,
        "mark point": np.outer(shift, shift),
        **{k: np.mean([np.outer(m, m) for m in v.values()], axis=0) for k, v in moves.items()},
        "noise": step @ beam.noise @ step,
    }
    full = grid.rectified((counts[..., 1] >= 254).astype(np.float32)) > 0.5
    spot = plane.origin + centroid @ plane.axes
    return TargetPhotograph(
        path,
        name,
        centroid,
        sum(parts.values(), np.zeros((2, 2))),
        parts,
        {k: m for v in moves.values() for k, m in v.items()},
        spot,
        geodetic(spot, plane.place),
        plane,
        marks,
        beam,
        green,
        grid.extent,
        float(full[beam.inside].mean()),
        _remarks(marks, beam),
    )


def _remarks(marks: Marks, beam: Beam) -> tuple[str, ...]:
    says = []
    if beam.clipped:
        says.append(
            f"the beam reaches the target's edge at {beam.clipped:.0%} of its peak: the centroid is that of the part "
            "on the target, and the error bar does not cover the rest"
        )
    if beam.second > 0.05:
        says.append(f"a second patch of light holds {beam.second:.0%} of the beam's: it is left out")
    if beam.hidden > 0.02:
        says.append(f"marks hide {beam.hidden:.0%} of the beam")
    if marks.set_aside:
        says.append(f"set aside, contradicting the other marks: {', '.join(marks.set_aside)}")
    if marks.missing:
        says.append(f"not found or without a template: {', '.join(marks.missing)}")
    if marks.used.sum() == 4:
        says.append("four marks fit any homography: their error is assumed, not measured")
    return tuple(says)


@dataclass(frozen=True)
class _Grid:
    """The rectified map: row 0 at the least up, column 0 at the least east."""

    shape: tuple[int, int]
    extent: tuple[float, float, float, float]
    step: Array
    pixel_to_grid: Array
    blur: float

    @classmethod
    def over(cls, extent: tuple[float, float, float, float], homography: Array, photo: tuple[int, ...]) -> _Grid:
        width, height = extent[1] - extent[0], extent[3] - extent[2]
        n = CELLS / max(width, height)
        shape = (max(round(height * n), 8), max(round(width * n), 8))
        step = np.array([width / shape[1], height / shape[0]])
        scale = np.array(
            [[1 / step[0], 0, -extent[0] / step[0] - 0.5], [0, 1 / step[1], -extent[2] / step[1] - 0.5], [0, 0, 1]]
        )
        centre = np.array([(extent[0] + extent[1]) / 2, (extent[2] + extent[3]) / 2])
        a, b = to_plane(inverse(homography), np.array([centre, centre + np.array([step[0], 0])]))
        return cls(shape, extent, step, scale @ homography, 0.5 * float(np.linalg.norm(b - a)))

    def rectified(self, image: Image) -> Image:
        """Smoothed by half a cell first, so that no light falls between the samples."""
        smooth = cv2.GaussianBlur(image, (0, 0), self.blur) if self.blur > 0.4 else image
        return cv2.warpPerspective(smooth, self.pixel_to_grid, self.shape[::-1], flags=cv2.INTER_LINEAR)

    def valid(self, ink: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Cells on the picture, three pixels from its border, that show no mark."""
        free = (~ink).astype(np.uint8)
        free[:3] = free[-3:] = 0
        free[:, :3] = free[:, -3:] = 0
        warped = cv2.warpPerspective(free * 255, self.pixel_to_grid, self.shape[::-1], flags=cv2.INTER_LINEAR)
        return warped == 255

    def plane(self, cell: Array) -> Array:
        """(column, row) → (east, up) [mm]."""
        return np.array(self.extent)[[0, 2]] + (cell + 0.5) * self.step


def _read_counts(path: Path) -> NDArray[np.uint8]:
    if not path.is_file():
        raise BenchsimError(f"{path}: there is no such photograph; give the raw picture of the target")
    return np.asarray(read_counts(path, cv2.IMREAD_COLOR)[0], np.uint8)


def _target(photograph: Path, properties: str | Path | None) -> str:
    """The target that the calibration properties name."""
    beside = photograph.with_name(photograph.stem.removesuffix("-raw") + "-calibration-properties.json")
    path = Path(properties) if properties else beside
    name = value(path, load(path), "target_name")
    if name not in FAMILIES:
        raise BenchsimError(
            f"{path}: target_name: {name!r} is no target with printed marks; write one of {', '.join(FAMILIES)}"
        )
    return name


def _survey(name: str, path: Path) -> Plane:
    """The target's plane and marks from the tower file."""
    plant = load(path)
    place = triple(path, plant, "power_plant_properties.coordinates")
    points = {
        (t, k): enu(triple(path, plant, f"{t}.coordinates.{k}"), place)
        for t, k in {*FAMILIES[name][1].values(), *((name, c) for c in CORNERS)}
        if k in value(path, plant, f"{t}.coordinates")
    }
    normal = np.array(value(path, plant, f"{name}.normal_vector"), float)
    east = np.cross(normal, [0.0, 0.0, 1.0])
    if normal.shape != (3,) or not np.linalg.norm(east) > 0:
        raise BenchsimError(f"{path}: {name}.normal_vector: a target with marks stands upright; write its normal")
    east /= np.linalg.norm(east)
    up = np.cross(east, normal)
    axes = np.array([east, up / np.linalg.norm(up)])
    origin = enu(triple(path, plant, f"{name}.coordinates.center"), place)
    corners = np.array([axes @ (points[name, c] - origin) for c in CORNERS if (name, c) in points])
    if len(corners) < 4:
        raise BenchsimError(f"{path}: {name}.coordinates: {', '.join(CORNERS)} are needed; add them")
    (e0, u0), (e1, u1) = corners.min(axis=0), corners.max(axis=0)
    marks = {mark: axes @ (points[at] - origin) for mark, at in FAMILIES[name][1].items() if at in points}
    return Plane(place, origin, axes, (e0, e1, u0, u1), marks)


def on_target(found: TargetPhotograph, place: Array) -> Array:
    """(east, up) mm from the target's centre of (latitude, longitude deg, height m), dropped onto the plane."""
    return found.plane.axes @ (enu(np.asarray(place, float), found.plane.place) - found.plane.origin)


def rectified(found: TargetPhotograph, image: Image) -> Image:
    """Another channel, (h, w) of the photograph, on the map of ``found.light``."""
    return _Grid.over(found.extent, found.marks.homography, image.shape).rectified(image)
