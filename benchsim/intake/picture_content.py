"""Does a picture show what it must: the board's marks, a line that is not flooded, and none in the dark picture?"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Camera, Screen
from benchsim.intake.finding import Finding, Kind
from benchsim.trace.image import Photograph, read_image
from benchsim.trace.marks import MarkObservations, board_corners, find_marks
from benchsim.trace.motion import motion, moved_by, taken_back
from benchsim.trace.pose import Pose, solve_pose, to_board, to_pixels

Array = NDArray[np.float64]

FEW_MARKS = 0.5
"""Share of the board's marks below which a picture shows too little of it to place the trace well."""

WIDE_BLUR = 3.0
"""Blur beyond which a picture is out of focus or shaken [px]."""

FLOODED = 0.8
"""Share of the line that may be saturated: beyond it the crest's shape cannot be known."""

LINE_SIGMA = 8.0
"""The line is what stands so many sigma of the background's noise above it."""

BRIGHT = 0.25
"""The line is brighter than this share of its brightest parts: light scattered about it is left out."""

FEWEST = 200
"""Pixels of a line [px]."""

MOST_POINTS = 400


@dataclass(frozen=True)
class Seen:
    """What one exposure shows: ``pose`` and ``line``, (n, 2) mm on the board, or None where there is none."""

    findings: tuple[Finding, ...]
    pose: Pose | None = None
    line: Array | None = None


def look(
    image: Path, dark: Path | None, camera: Camera, screen: Screen, intrinsics_sigma: tuple[float, float, float]
) -> Seen:
    """Look at one exposure's pictures, without measuring a trace.

    Parameters
    ----------
    image, dark : path
    camera : Camera
    screen : Screen
        With its marks.
    intrinsics_sigma : (focal as a fraction, principal point in px, k1)
        As for `solve_pose`.
    """
    found: list[Finding] = []
    assert screen.marks is not None
    try:
        photograph = read_image(image, camera)
        marks = find_marks(photograph, screen.marks, camera)
        pose = solve_pose(camera, marks, intrinsics_sigma)
    except BenchsimError as error:
        where, _, says = str(error).partition(": ")
        return Seen((Finding(Kind.inconsistent, where, says or where),))
    found += _marks(marks, len(screen.marks.ids))
    ground = None
    if dark is not None:
        ground, said = _ground(dark, camera, screen, photograph, marks)
        found += said
    at, clipped = _line(photograph, ground, pose, screen)
    if len(at) < FEWEST:
        says = "no line of light found on the board; check that the laser is on and the exposure long enough"
        if dark is not None and len(_line(photograph, None, pose, screen)[0]) >= FEWEST:
            says = f"its dark picture {dark.name} shows its line as well; switch the laser off and take both again"
        return Seen((*found, Finding(Kind.inconsistent, image.name, says)), pose)
    if clipped > FLOODED:
        says = (
            f"{100 * clipped:.0f} % of the line is saturated in every channel that shows it, so its shape is lost; "
            "expose shorter"
        )
        found.append(Finding(Kind.inconsistent, image.name, says))
    some = at[:: max(1, len(at) // MOST_POINTS)]
    board = to_board(pose, some)[0]
    return Seen(tuple(found), pose, board[np.isfinite(board).all(axis=1)])


def _marks(marks: MarkObservations, listed: int) -> list[Finding]:
    out = []
    if len(marks.ids) < FEW_MARKS * listed:
        says = f"{len(marks.ids)} of the board's {listed} marks are found; show all of the board, in focus"
        out.append(Finding(Kind.remark, marks.name, says))
    blur = float(np.median(marks.blur))
    if blur > WIDE_BLUR:
        says = f"blurred by {blur:.1f} px rms; focus on the board, and do not touch the camera while it exposes"
        out.append(Finding(Kind.remark, marks.name, says))
    if marks.unknown:
        ids = ", ".join(map(str, marks.unknown[:4]))
        says = f"shows marks that marks.csv does not list (id {ids}); give the marks.csv of this board"
        out.append(Finding(Kind.remark, marks.name, says))
    return out


def _ground(
    dark: Path, camera: Camera, screen: Screen, photograph: Photograph, marks: MarkObservations
) -> tuple[Photograph | None, list[Finding]]:
    """The dark picture, put where the photograph is if the camera moved, and what there is to say of it."""
    try:
        ground = read_image(dark, camera, dark=True, channel=photograph.channel)
    except BenchsimError as error:
        where, _, says = str(error).partition(": ")
        return None, [Finding(Kind.inconsistent, where, says or where)]
    try:
        there = find_marks(ground, screen.marks, camera)
    except BenchsimError:
        return ground, []
    moved = motion(marks, there)
    if moved is None:
        return ground, []
    far = moved_by(moved, marks.corners)
    says = f"the camera moved by {far:.1f} px since {photograph.name}; taken back, but clamp it better"
    return taken_back(ground, moved), [Finding(Kind.remark, dark.name, says)]


def _line(photograph: Photograph, ground: Photograph | None, pose: Pose, screen: Screen) -> tuple[Array, float]:
    """Pixels of the line on free board, (n, 2), and the share of its stretch that is saturated."""
    light = photograph.light if ground is None else photograph.light - ground.light
    # What is thin: a hat 31 px wide takes the room's light away, and the board's edge.
    thin = cv2.morphologyEx(light, cv2.MORPH_TOPHAT, np.ones((31, 31), np.uint8))
    free = _free(photograph.shape, pose, screen)
    inside = thin[free]
    if inside.size < FEWEST:
        return np.zeros((0, 2)), 0.0
    base = float(np.median(inside))
    noise = max(1.4826 * float(np.median(np.abs(inside - base))), 1.0)
    level = max(base + LINE_SIGMA * noise, BRIGHT * float(np.quantile(inside, 0.9995)))
    v, u = np.nonzero(free & (thin > level))
    if len(u) < FEWEST:
        return np.zeros((0, 2)), 0.0
    tile = (v // 32) * 10_000 + u // 32
    each, which = np.unique(tile, return_inverse=True)
    hit = np.bincount(which, photograph.saturated[v, u], len(each)) > 0
    return np.stack([u, v], axis=1).astype(float), float(hit.mean())


def _free(shape: tuple[int, int], pose: Pose, screen: Screen) -> NDArray[np.bool_]:
    """Pixels of the board that are neither mark nor near an edge."""
    mask = np.zeros(shape, np.uint8)
    y, z = np.asarray(screen.size) / 2 * 0.98
    _fill(mask, to_pixels(pose, np.array([[-y, -z], [y, -z], [y, z], [-y, z]])), 1)
    assert screen.marks is not None
    corners = board_corners(screen.marks)
    centre = corners.mean(axis=1, keepdims=True)
    for quad in to_pixels(pose, centre + 1.5 * (corners - centre)):
        _fill(mask, quad, 0)
    return np.asarray(mask > 0)


def _fill(mask: NDArray[np.uint8], polygon: Array, value: int) -> None:
    if np.isfinite(polygon).all() and np.abs(polygon).max() < 2**15:
        cv2.fillPoly(mask, [np.round(polygon).astype(np.int32)], value)
