"""Straight edges between black and white, fitted to the raw pixels around them.

Every pixel near an edge is used once and none is interpolated, so their noise is independent and the covariance is
honest. The model is a blurred step, I(d) = black + (contrast + slope s) Φ(d/σ), in coordinates where the lens'
distortion is undone; its place is where blur, being symmetric, leaves it. An edge that runs along the pixels is seen
at few distances d: what the step is not like Φ moves it by up to 0.02 px. All edges of a picture together are seen at
every distance, and show what the step is like.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.model import Camera
from benchsim.trace.edge_pixels import (
    CELLS,
    OUTLIER_SIGMA,
    Band,
    Edges,
    Line,
    by_mark,
    gathered,
    intersections,
    masked_median,
    widened,
)
from benchsim.trace.edge_step import (
    BLACK,
    BLUR,
    CONTRAST,
    KURTOSIS,
    SLOPE,
    Fitted,
    common_bend,
    common_blur,
    common_kurtosis,
    light_behind,
    light_of,
    refined,
)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_PRIOR_PIXELS = 30
"""Weight of the picture's typical scatter against an edge's own, in pixels: short edges measure theirs badly."""


@dataclass(frozen=True)
class EdgeFit:
    """Lines fitted to edges.

    Attributes
    ----------
    point : (e, 2) px
        Middle of each edge, undistorted pixels.
    along, normal : (e, 2)
        Unit; normal towards the white side.
    covariance : (e, 2, 2)
        Of the place across [px] at ``point`` and of the tilt [rad].
    black, contrast : (e,)
        Light at the edge's middle.
    blur : (e,) px
        Standard deviation of the step's blur, the pixel's own width included.
    used : (e,)
        Fraction of the pixels along the edge (without its ends) that the fit rests on, on the poorer side.
    scatter : (e,)
        rms of the residuals, as a fraction of the contrast.
    """

    point: Array
    along: Array
    normal: Array
    covariance: Array
    black: Array
    contrast: Array
    blur: Array
    used: Array
    scatter: Array


def fit_edges(light: NDArray[np.float32], saturated: Mask, camera: Camera, edges: Edges, floor: float = 0.0) -> EdgeFit:
    """Fit a line to every edge.

    Two passes: a wide window finds the edge and its blur from corners that may be 1.5 px off; a window of a few blurs
    then gives the place by Gauss–Newton. Steps along the edge where other light crosses it are left out; light from the
    white cells behind the black border is predicted from ``inner`` and taken off.

    Parameters
    ----------
    light : (h, w) float32
    saturated : (h, w) bool
        Not used for the fit.
    camera : Camera
        Its distortion is undone.
    edges : Edges
    floor : float
        Least variance of a pixel, that of its quantisation [light²].

    Returns
    -------
    EdgeFit

    Notes
    -----
    Fails, and says so by ``used`` and ``scatter``, where something else covers the edge. Where edges run along the
    pixels at a few distances, as on a board seen square on, 0.01 to 0.03 px of what the step is not like stay, which
    this covariance does not count; `marks` does. Where light is not linear in radiance (unknown gamma) all four edges
    of a mark move outward or inward by the same fraction of the blur.
    """
    line = edges.line()
    cell = line.cell(edges)
    wide = np.clip(cell, 1.5, 8.0)
    band = gathered(light, saturated, camera, line, -0.8 * wide, wide, np.minimum(2.0, line.length / 6), floor)
    fitted = refined(band, edges, line, _first_shape(band, line), 6)
    edges = _with_corners_of(edges, fitted.line)
    line = edges.line()
    length, cell = line.length, line.cell(edges)
    typical = np.median(fitted.shape[:, BLUR])
    fitted.shape[:, BLUR] = np.clip(fitted.shape[:, BLUR], typical - np.log(2), typical + np.log(2))

    blur = np.exp(fitted.shape[:, BLUR])
    # Two blurs in front of the cells behind the border little of their light is left, and that is predicted.
    inside = np.minimum(np.maximum(cell - blur, 0.75 * cell), 5 * blur + 1)
    outside = np.minimum(np.maximum(cell, 2.0), 5 * blur + 1)
    margin = np.minimum(3 * blur, length / 4)
    band = gathered(light, saturated, camera, line, -inside, outside, margin, floor)
    fitted = refined(band, edges, line, fitted.shape, 2)
    band = _without_other_light(band, edges, fitted, floor)
    common = common_blur(band, fitted)
    fitted = refined(band, edges, fitted.line, fitted.shape, 1, common_blur=common, fit_kurtosis=True)
    fitted.shape[:, KURTOSIS] = common_kurtosis(band, fitted)
    fitted = refined(band, edges, fitted.line, fitted.shape, 2, common_blur=common_blur(band, fitted))
    for _ in range(2):
        bend = common_bend(band, edges, fitted)
        fitted = refined(band, edges, fitted.line, fitted.shape, 2, common_blur=common_blur(band, fitted), bend=bend)
    line, shape = fitted.line, fitted.shape
    variance = np.maximum(fitted.variance, floor)
    scatter = variance / np.maximum(shape[:, CONTRAST], 1e-6) ** 2
    typical = np.median(scatter) * shape[:, CONTRAST] ** 2
    pooled = (variance * fitted.freedom + typical * _PRIOR_PIXELS) / (fitted.freedom + _PRIOR_PIXELS)
    return EdgeFit(
        point=line.middle,
        along=line.along,
        normal=line.normal,
        covariance=fitted.covariance[:, :2, :2] * pooled[:, None, None],
        black=shape[:, BLACK],
        contrast=shape[:, CONTRAST],
        blur=np.exp(shape[:, BLUR]),
        used=_used(band, line, shape, fitted.weight, margin),
        scatter=np.sqrt(scatter),
    )


def _with_corners_of(edges: Edges, line: Line) -> Edges:
    """Corners from lines; those of a mark stay where they moved by more than a cell, on lines that went astray."""
    corners, _ = intersections(*(x.reshape(edges.corners.shape) for x in (line.middle, line.along)))
    moved = np.linalg.norm(corners - edges.corners, axis=-1).max(axis=1)
    side = np.linalg.norm(np.roll(edges.corners, -1, axis=1) - edges.corners, axis=-1).min(axis=1)
    kept = moved < np.maximum(side / CELLS, 2.0)
    return replace(edges, corners=np.where(kept[:, None, None], corners, edges.corners))


def _without_other_light(band: Band, edges: Edges, fitted: Fitted, floor: float) -> Band:
    """Leave out steps along an edge where black or white is brighter than the mark's other edges have it.

    Compared are means over the pixels of one step that lie two blurs off the edge, one side at a time: a weak glow on
    the black border alone moves an edge by tenths of a pixel.
    """
    shape = fitted.shape.copy()
    for level in (BLACK, CONTRAST):
        shape[:, level] = np.repeat(np.median(shape[:, level].reshape(-1, 4), axis=1), 4)
    shape[:, SLOPE] = 0.0
    shape[:, BLUR] = np.median(shape[:, BLUR])
    light, _, _ = light_of(band, fitted.line, shape, light_behind(band, edges, fitted.line, shape))
    residual = band.light - light
    s, d = band.coordinates(fitted.line)
    steps = int(np.ceil(fitted.line.length.max())) + 1
    step = np.clip(np.floor(s + fitted.line.length[:, None] / 2), 0, steps - 1).astype(np.intp)
    index = step + np.arange(len(s))[:, None] * steps
    bright = np.zeros(len(s) * steps, bool)
    for side in (d < -2 * np.exp(shape[:, BLUR, None]), d > 2 * np.exp(shape[:, BLUR, None])):
        side = side & band.use
        scatter = 1.4826 * masked_median(np.abs(by_mark(residual)), by_mark(side))
        limit = OUTLIER_SIGMA * np.repeat(np.repeat(np.sqrt(scatter**2 + floor), 4), steps)
        count = np.bincount(index[side], minlength=len(bright))
        total = np.bincount(index[side], residual[side], minlength=len(bright))
        bright |= total > limit * np.sqrt(np.maximum(count, 1))
    out = widened(bright.reshape(-1, steps)).ravel()
    return replace(band, use=band.use & ~out[index])


def _first_shape(band: Band, line: Line) -> Array:
    """Levels from the pixels that lie clearly on one side; blur one pixel."""
    _, d = band.coordinates(line)
    black = masked_median(band.light, band.use & (d < -1))
    white = masked_median(band.light, band.use & (d > 1))
    shape = np.zeros((len(black), 5))
    shape[:, BLACK] = black
    shape[:, CONTRAST] = np.maximum(white - black, 1e-3 * np.abs(white) + 1e-6)
    return shape


def _used(band: Band, line: Line, shape: Array, weight: Array, margin: Array) -> Array:
    """Weight within 1.5 blurs of the line on the poorer side, as a fraction of the pixels (one per px²) there."""
    _, d = band.coordinates(line)
    reach = 1.5 * np.exp(shape[:, BLUR])
    area = reach * (line.length - 2 * margin)
    black = (weight * ((d < 0) & (d > -reach[:, None]))).sum(axis=1)
    white = (weight * ((d > 0) & (d < reach[:, None]))).sum(axis=1)
    return np.minimum(black, white) / area
