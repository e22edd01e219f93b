"""From a photograph's file to the trace on the board, or, without a recording, to a ridge in pixels."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Camera, Exposure, Recording, Screen
from benchsim.trace.counts import read_counts
from benchsim.trace.image import Photograph, photograph_of, read_image
from benchsim.trace.likeness import Likeness, likeness
from benchsim.trace.line import Line, measure_line
from benchsim.trace.marks import board_corners, find_marks
from benchsim.trace.motion import taken_back
from benchsim.trace.picture import (
    CROSSING,
    FAINT,
    KEPT,
    OFF_BOARD,
    OFF_PICTURE,
    ON_MARK,
    SATURATED,
    STATUS,
    Picture,
    Unmeasurable,
)
from benchsim.trace.pose import Pose, join, solve_pose, to_board, to_pixels
from benchsim.trace.ridge import best_curve, ridge_points
from benchsim.trace.table import RidgeNoise, Trace

Array = NDArray[np.float64]

MOST_RIDGES = 4

RETRIES = 3
"""Curves that may turn out to be no trace before the search gives up."""

MEND = {
    OFF_PICTURE: "aim the camera so that it sees the trace",
    OFF_BOARD: "move the screen so that the trace crosses it",
    ON_MARK: "move the marks or the trace apart",
    SATURATED: "expose shorter",
    FAINT: "expose longer, or show more of the trace",
}


def extract(recording: Recording, exposure: Exposure) -> Trace:
    """The trace of one exposure: image read, marks found, pose solved, ridges measured, put on the board.

    Parameters
    ----------
    recording : Recording
    exposure : Exposure
        One of the recording's, with an image.

    Returns
    -------
    Trace

    Raises
    ------
    BenchsimError
        The image cannot be read; marks or pose are not to be had; no trace, or too little of it. Names the image and
        the mend.
    """
    camera = recording.cameras[exposure.camera]
    photograph, dark = read_photographs(recording, exposure)
    marks = find_marks(photograph, recording.screen.marks, camera)
    if dark is not None:
        marks = join(marks, find_marks(dark, recording.screen.marks, camera))
    pose = solve_pose(camera, marks, recording.uncertainty.intrinsics_sigma)
    return measure(photograph, dark, pose, recording.screen, float(np.median(marks.blur)))


def read_photographs(recording: Recording, exposure: Exposure) -> tuple[Photograph, Photograph | None]:
    """The exposure's photograph and its dark picture, of the same channel, or None.

    Raises
    ------
    BenchsimError
        As `read_image`; or the exposure has no image.
    """
    if exposure.image is None:
        raise BenchsimError(
            f"{recording.path.name}: exposure of setting {exposure.setting} has no image; render the bench "
            "or add the key"
        )
    camera = recording.cameras[exposure.camera]
    photograph = read_image(recording.folder / exposure.image, camera)
    if exposure.dark is None:
        return photograph, None
    return photograph, read_image(recording.folder / exposure.dark, camera, dark=True, channel=photograph.channel)


def measure(
    photograph: Photograph,
    dark: Photograph | None,
    pose: Pose,
    screen: Screen,
    blur: float = 1.0,
    ridges: int = MOST_RIDGES,
    picture: Picture | None = None,
) -> Trace:
    """The ridges of a photograph whose pose is known, on the board.

    Profiles that cross marks or the board's edge are dropped. Further ridges are looked for outside of the first one's
    window; each must have `line.LEAST_PROFILES` profiles above five sigma.

    Parameters
    ----------
    photograph, dark : Photograph
        ``dark`` (or None) has the same room light and exposure time, and the same pose but for ``pose.motion``.
    pose : Pose
    screen : Screen
    blur : float
        1 sigma of the camera's blur [px]; marks and edges are avoided by four of it.
    ridges : int
        Most ridges looked for.
    picture : Picture, optional
        Of `picture_on`, where it is there already.

    Returns
    -------
    Trace

    Raises
    ------
    BenchsimError
        No trace, or too little of it.
    """
    picture = picture or picture_on(photograph, dark, pose, screen, blur)
    lines, dropped_status, dropped_px = _lines(photograph.name, picture, ridges)
    parts = [_on_board(line, pose, blur) for line in lines]
    columns = {key: np.concatenate([p[key] for p in parts]) for key in parts[0] if key not in ("shape_mm", "noise")}
    # Ridges have their own shapes: block columns.
    widths = [p["shape_mm"].shape[1] for p in parts]
    shape = np.zeros((len(columns["s_mm"]), sum(widths)))
    row = column = 0
    for part, width in zip(parts, widths, strict=True):
        shape[row : row + len(part["s_mm"]), column : column + width] = part["shape_mm"]
        row, column = row + len(part["s_mm"]), column + width
    if not photograph.linear:
        for key in ("width_mm", "flux", "skewness"):
            columns[key] = np.full(len(shape), np.nan)
    counts = Counter(STATUS[int(s)] for s in dropped_status)
    return Trace(
        exposure=photograph.name,
        ridge=np.concatenate([np.full(len(line.t), i) for i, line in enumerate(lines)]),
        shape_mm=shape,
        noise=tuple(p["noise"] for p in parts),
        dropped=dict(counts),
        dropped_px=dropped_px,
        linear=photograph.linear,
        pose=pose,
        **columns,
    )


def picture_on(photograph: Photograph, dark: Photograph | None, pose: Pose, screen: Screen, blur: float) -> Picture:
    """The laser's light on the board, with what is in its way; parameters as of `measure`."""
    if dark is not None and pose.motion is not None:
        dark = taken_back(dark, pose.motion)
    return _picture(photograph, dark, _blocked(photograph, pose, screen, blur))


@dataclass(frozen=True)
class PixelTrace:
    """A ridge in pixels, without marks and camera; (n,) each.

    ``s_px`` along it; ``u_px``, ``v_px`` centre; ``sigma_px`` 1 sigma across it of the trace noise alone; ``width_px``;
    ``flux`` [counts · px]; ``skewness``; ``saturated``; ``normal`` (n, 2) unit (u, v); ``shape_px`` (n, r) common
    error, as `Trace.shape_mm`. ``scale``, ``correlation``: as in `RidgeNoise`, steps of one pixel. ``likeness``: how
    much it looks like a line; ``light`` (h, w): the picture in which it was found.
    """

    name: str
    s_px: Array
    u_px: Array
    v_px: Array
    sigma_px: Array
    width_px: Array
    flux: Array
    skewness: Array
    saturated: Array
    normal: Array
    shape_px: Array
    scale: float
    correlation: Array
    likeness: Likeness
    light: NDArray


def extract_pixels(image: str | Path, dark: str | Path | None = None) -> PixelTrace:
    """The brightest smooth ridge of a single picture, in its pixels: no board, no lens, light taken as linear.

    Without marks to avoid and without the pose, print is recognised only by being darker than its surroundings, and
    what looks like a line brighter than the trace is taken for it; use a recording where there is one. Whatever is
    traced is returned: `Likeness` says how much it looks like a line.

    Parameters
    ----------
    image : path
    dark : path, optional
        The same picture with the laser off.

    Returns
    -------
    PixelTrace

    Raises
    ------
    BenchsimError
        As `extract`.
    """
    path = Path(image)
    raw, lossy = read_counts(path)
    bits = 16 if raw.dtype == np.uint16 else 8
    size = (raw.shape[1], raw.shape[0])
    camera = Camera("", size, float(max(size)), (0.0, 0.0), bit_depth=bits, saturation_level=float(2**bits - 1))
    photograph = photograph_of(path.name, raw, lossy, camera)
    ground = None if dark is None else read_image(Path(dark), camera, dark=True, channel=photograph.channel)
    picture = _picture(photograph, ground, np.zeros(photograph.shape, np.uint8))
    line = _lines(photograph.name, picture, 1)[0][0]
    return PixelTrace(
        photograph.name,
        line.t - line.t[0],
        line.uv[:, 0],
        line.uv[:, 1],
        line.sigma,
        line.width,
        line.flux,
        line.skewness,
        line.saturated,
        line.normal,
        line.shape_factor,
        line.noise.scale,
        line.noise.correlation,
        likeness(picture.signal, line),
        photograph.light,
    )


def _blocked(photograph: Photograph, pose: Pose, screen: Screen, blur: float) -> NDArray[np.uint8]:
    """Status by pixel: `KEPT` on the free board; grown by what blur carries over."""
    grow = int(np.ceil(4 * blur)) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * grow + 1, 2 * grow + 1))
    height, width = photograph.shape
    y, z = np.asarray(screen.size) / 2
    side = np.linspace(-1, 1, 41)[:-1]
    one = np.ones_like(side)
    ring = np.concatenate(
        [
            np.stack(p, axis=1)
            for p in ((y * side, -z * one), (y * one, z * side), (-y * side, z * one), (-y * one, -z * side))
        ]
    )
    board = np.zeros((height, width), np.uint8)
    _fill(board, to_pixels(pose, ring))
    eroded = cv2.erode(board, disc, borderType=cv2.BORDER_CONSTANT, borderValue=1)
    out = np.where(np.asarray(eroded) > 0, np.uint8(KEPT), np.uint8(OFF_BOARD)).astype(np.uint8)
    if screen.marks is not None and screen.marks.ids:
        corners = board_corners(screen.marks)
        centre = corners.mean(axis=1, keepdims=True)
        # The white margin is one module, an eighth of the square, wide; its print may reflect otherwise than the board.
        outline = to_pixels(pose, centre + (corners - centre) * (1 + 2 / 8))
        mark = np.zeros((height, width), np.uint8)
        for quad in outline:
            _fill(mark, quad)
        out[cv2.dilate(mark, disc) > 0] = ON_MARK
    return out


def _fill(mask: NDArray[np.uint8], polygon: Array) -> None:
    if np.isfinite(polygon).all() and np.abs(polygon).max() < 2**15:
        cv2.fillPoly(mask, [np.round(polygon * 16).astype(np.int32)], 1, shift=4)


def _picture(photograph: Photograph, dark: Photograph | None, blocked: NDArray[np.uint8]) -> Picture:
    clipped = photograph.saturated
    ceiling = float(photograph.light[clipped].min()) if clipped.any() else np.inf
    if dark is None:
        return Picture(photograph.light, np.zeros((), np.float32), blocked, clipped, ceiling, False)
    # Twice the room light: it is in both pictures, and so is its noise.
    pedestal = 2 * np.asarray(cv2.blur(dark.light, (9, 9)), np.float32)
    return Picture(photograph.light - dark.light, pedestal, blocked, clipped | dark.saturated, ceiling, True)


def _lines(name: str, picture: Picture, most: int) -> tuple[list[Line], NDArray[np.intp], Array]:
    """Ridges by falling flux; status and place of the profiles dropped from them."""
    lines: list[Line] = []
    refused: BenchsimError | None = None
    points = ridge_points(picture.signal, picture.blocked == KEPT)
    for _ in range(most + RETRIES):
        coarse = best_curve(points) if len(lines) < most else None
        if coarse is None:
            break
        try:
            line = measure_line(picture, coarse, 1.5 * points.reduction + 2.0)
        except Unmeasurable as error:
            if lines:
                break
            mend = MEND.get(error.status, "look at the picture and mend what is in its way")
            refused = refused or BenchsimError(f"{name}: the trace cannot be measured: {error}; {mend}")
            # Print or an edge that looked like a line: the trace may be what is left.
            path, width = coarse.points, 3.0 * points.reduction
        else:
            lines.append(line)
            path, width = line.curve(np.arange(line.span[0], line.span[1], 2.0)), 2 * line.core
        picture = replace(picture, blocked=_without(picture.blocked, path, width))
        points = points.where(picture.blocked == KEPT)
    if not lines:
        raise refused or BenchsimError(
            f"{name}: no trace found: it is absent, off the screen or too faint; check that the laser is on and the "
            "exposure long enough"
        )
    lines.sort(key=lambda x: -float(x.flux.sum()))
    return (
        lines,
        np.concatenate([x.dropped_status for x in lines]),
        np.concatenate([x.dropped_uv for x in lines]),
    )


def _without(blocked: NDArray[np.uint8], path: Array, width: float) -> NDArray[np.uint8]:
    """The board less a band about a path: twice a ridge's window to either side, so its side lobes are no ridges."""
    out = blocked.copy()
    band = np.zeros(blocked.shape, np.uint8)
    cv2.polylines(band, [np.round(path).astype(np.int32)], False, 1, thickness=2 * int(np.ceil(width)) + 1)
    out[(band > 0) & (out == KEPT)] = CROSSING
    return out


def _on_board(line: Line, pose: Pose, blur: float) -> dict:
    board, by_pixel, by_pose = to_board(pose, line.uv)
    along = np.einsum("nij,nj->ni", by_pixel, line.tangent)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    path = to_board(pose, line.curve(line.t))[0]
    reach = path[-1] - path[0]
    if reach[np.argmax(np.abs(reach))] < 0:
        along = -along
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    per_pixel = np.abs(np.einsum("ni,nij,nj->n", normal, by_pixel, line.normal))
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    number = np.round(line.t - line.t[0]).astype(np.intp)
    step = float(s[-1] / max(number[-1], 1))
    value, vector = np.linalg.eigh(pose.covariance)
    factor = vector * np.sqrt(np.maximum(value, 0.0))
    out = {
        "s_mm": s,
        "u_px": line.uv[:, 0],
        "v_px": line.uv[:, 1],
        "y_mm": board[:, 0],
        "z_mm": board[:, 1],
        "sigma_mm": line.sigma * per_pixel,
        "width_mm": line.width * per_pixel,
        "flux": line.flux * per_pixel,
        "skewness": line.skewness * _hand(line, by_pixel, normal),
        "saturated": line.saturated,
        "normal": normal,
        "profile": number,
        "pose_mm": np.einsum("ni,nip,pq->nq", normal, by_pose, factor),
        "shape_mm": line.shape_factor * (per_pixel * _hand(line, by_pixel, normal))[:, None],
    }
    if s[-1] > 0 and reach[np.argmax(np.abs(reach))] < 0:
        out = {key: a[::-1] for key, a in out.items()}
        out["s_mm"] = s[-1] - out["s_mm"]
        out["profile"] = number[-1] - out["profile"]
    out["noise"] = RidgeNoise(
        line.noise.scale,
        line.noise.scale_sigma,
        line.noise.correlation,
        line.noise.correlation_length * step,
        step,
        line.core * float(per_pixel.mean()),
        blur * float(per_pixel.mean()),
    )
    return out


def _hand(line: Line, by_pixel: Array, normal: Array) -> Array:
    """+1 where the picture's normal points to the board's, -1 where away from it."""
    return np.sign(np.einsum("ni,nij,nj->n", normal, by_pixel, line.normal))
