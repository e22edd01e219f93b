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
from scipy.interpolate import BSpline
from scipy.special import ndtr

from benchsim.bench.model import Camera
from benchsim.trace.band import interpolate
from benchsim.trace.lens import distort, undistort

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_BLACK, _CONTRAST, _SLOPE, _BLUR, _KURTOSIS = range(5)  # columns of a shape: light, light, light per px, log px, 1
_PARAMETERS = 6  # offset, tilt, and those of the shape but the kurtosis

OUTLIER_SIGMA = 5.0
"""Pixels this far off are no noise: of 3 million, noise alone puts one there."""

KURTOSIS_RANGE = (-1.2, 2.0)
"""Excess kurtosis from a box to a Laplace distribution: sharper or flatter blurs are none of a lens."""

BLUR_SPREAD = 0.1
"""Relative spread of the blur over a picture that lets a short edge, which measures its own badly, keep to the mean."""

KURTOSIS_REACH = 3.0
"""Blurs of black that an edge must show for its kurtosis to be told from the light behind the border."""

CELLS = 8
"""Cells along the black square of an AprilTag 36h11: 6 of data and a black border of one."""

BEND_KNOTS = 0.25
"""Knots of the common step's own shape [px]: a pixel's response has its corners half a pixel apart."""

BEND_REACH = 4.0
"""Blurs from the edge beyond which the series holds."""

BEND = 0.03
"""1 sigma of the prior on its coefficients, in units of the contrast: what few edges do not show is not made up."""

_PRIOR_PIXELS = 30
"""Weight of the picture's typical scatter against an edge's own, in pixels: short edges measure theirs badly."""


@dataclass(frozen=True)
class Edges:
    """Approximate edges and what is known about their surroundings, undistorted pixels; four in a row are a mark's.

    Attributes
    ----------
    corners : (n, 4, 2) px
        Clockwise in the picture; edge k of a mark runs from corner k to corner k + 1, white lies to its left.
    inner : (4 n, 8) bool
        Which of the eight cells behind the black ones, from start to end, are white.
    """

    corners: Array
    inner: Mask

    @property
    def start(self) -> Array:
        """(4 n, 2) px"""
        return self.corners.reshape(-1, 2)

    @property
    def end(self) -> Array:
        """(4 n, 2) px"""
        return np.roll(self.corners, -1, axis=1).reshape(-1, 2)

    def borders(self) -> Array:
        """Corners of the eight cells behind each edge's black ones that face the edge, (4 n, 9, 2) px.

        By the projective map of the unit square to the mark (Heckbert 1989, Fundamentals of Texture Mapping, 2.2.3).
        """
        quad = np.stack([np.roll(self.corners, -k, axis=1) for k in range(4)], axis=1).reshape(-1, 4, 2)
        p0, p1, p2, p3 = np.moveaxis(quad, 1, 0)
        total, d1, d2 = p0 - p1 + p2 - p3, p1 - p2, p3 - p2
        determinant = d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]
        g = ((total[:, 0] * d2[:, 1] - total[:, 1] * d2[:, 0]) / determinant)[:, None]
        h = ((d1[:, 0] * total[:, 1] - d1[:, 1] * total[:, 0]) / determinant)[:, None]
        x, y = (np.arange(CELLS + 1) / CELLS)[:, None], 1 / CELLS
        above = ((p1 - p0 + g * p1)[:, None] * x) + ((p3 - p0 + h * p3) * y + p0)[:, None]
        return above / (g[:, None] * x + (h * y + 1)[:, None])

    def line(self) -> _Line:
        """The edges as lines."""
        length = np.linalg.norm(self.end - self.start, axis=1)
        return _Line((self.start + self.end) / 2, (self.end - self.start) / length[:, None], length)


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
    band = _band(light, saturated, camera, line, -0.8 * wide, wide, np.minimum(2.0, line.length / 6), floor)
    fitted = _iterate(band, edges, line, _first_shape(band, line), 6)
    edges = _with_corners_of(edges, fitted.line)
    line = edges.line()
    length, cell = line.length, line.cell(edges)
    typical = np.median(fitted.shape[:, _BLUR])
    fitted.shape[:, _BLUR] = np.clip(fitted.shape[:, _BLUR], typical - np.log(2), typical + np.log(2))

    blur = np.exp(fitted.shape[:, _BLUR])
    # Two blurs in front of the cells behind the border little of their light is left, and that is predicted.
    inside = np.minimum(np.maximum(cell - blur, 0.75 * cell), 5 * blur + 1)
    outside = np.minimum(np.maximum(cell, 2.0), 5 * blur + 1)
    margin = np.minimum(3 * blur, length / 4)
    band = _band(light, saturated, camera, line, -inside, outside, margin, floor)
    fitted = _iterate(band, edges, line, fitted.shape, 2)
    band = _without_other_light(band, edges, fitted, floor)
    common = _common_blur(band, fitted)
    fitted = _iterate(band, edges, fitted.line, fitted.shape, 1, common_blur=common, fit_kurtosis=True)
    fitted.shape[:, _KURTOSIS] = _common_kurtosis(band, fitted)
    fitted = _iterate(band, edges, fitted.line, fitted.shape, 2, common_blur=_common_blur(band, fitted))
    for _ in range(2):
        bend = _common_bend(band, edges, fitted)
        fitted = _iterate(band, edges, fitted.line, fitted.shape, 2, common_blur=_common_blur(band, fitted), bend=bend)
    line, shape = fitted.line, fitted.shape
    variance = np.maximum(fitted.variance, floor)
    scatter = variance / np.maximum(shape[:, _CONTRAST], 1e-6) ** 2
    typical = np.median(scatter) * shape[:, _CONTRAST] ** 2
    pooled = (variance * fitted.freedom + typical * _PRIOR_PIXELS) / (fitted.freedom + _PRIOR_PIXELS)
    return EdgeFit(
        point=line.middle,
        along=line.along,
        normal=line.normal,
        covariance=fitted.covariance[:, :2, :2] * pooled[:, None, None],
        black=shape[:, _BLACK],
        contrast=shape[:, _CONTRAST],
        blur=np.exp(shape[:, _BLUR]),
        used=_used(band, line, shape, fitted.weight, margin),
        scatter=np.sqrt(scatter),
    )


@dataclass(frozen=True)
class _Line:
    """Lines while they are being fitted, undistorted pixels."""

    middle: Array
    along: Array
    length: Array

    @property
    def normal(self) -> Array:
        return np.stack([self.along[:, 1], -self.along[:, 0]], axis=1)

    def coordinates(self, points: Array) -> tuple[Array, Array]:
        """Of points (e, p, 2): along from the middle, and across towards white."""
        u, v = points[..., 0] - self.middle[:, :1], points[..., 1] - self.middle[:, 1:]
        (au, av), (nu, nv) = self.along.T[:, :, None], self.normal.T[:, :, None]
        return u * au + v * av, u * nu + v * nv

    def cell(self, edges: Edges) -> Array:
        """Smallest distance from each line to the cells behind it [px]."""
        _, across = self.coordinates(edges.borders())
        return -across.max(axis=1)

    def moved(self, offset: Array, tilt: Array) -> _Line:
        along = self.along + tilt[:, None] * self.normal
        return _Line(
            self.middle + offset[:, None] * self.normal,
            along / np.linalg.norm(along, axis=1, keepdims=True),
            self.length,
        )


@dataclass(frozen=True)
class _Band:
    """Pixels near each edge, one row per edge, padded: undistorted place (e, p, 2), light, whether used."""

    place: Array
    light: Array
    use: Mask

    def coordinates(self, line: _Line) -> tuple[Array, Array]:
        """Along from the middle, and across towards white."""
        return line.coordinates(self.place)


def _band(
    light: NDArray[np.float32],
    saturated: Mask,
    camera: Camera,
    line: _Line,
    low: Array,
    high: Array,
    margin: Array,
    floor: float,
) -> _Band:
    """Pixels with ``low <= across <= high``, ``margin`` away from both ends, where no other light crosses the edge."""
    h, w = light.shape
    half = line.along * line.length[:, None] / 2
    ends = distort(camera, np.stack([line.middle - half, line.middle + half], axis=1))
    run = np.abs(ends[:, 1] - ends[:, 0])
    upright = run[:, 1] > run[:, 0]
    turned = np.where(upright[:, None, None], ends[..., ::-1], ends)
    count = int(np.ceil(run.max())) + 1
    reach = int(np.ceil(np.sqrt(2) * max(high.max(), -low.min()))) + 1
    major = np.floor(turned[..., 0].min(axis=1))[:, None] + np.arange(count)
    slope = (turned[:, 1, 1] - turned[:, 0, 1]) / (turned[:, 1, 0] - turned[:, 0, 0])
    middle = np.rint(turned[:, :1, 1] + slope[:, None] * (major - turned[:, :1, 0]))
    minor = middle[:, :, None] + np.arange(-reach, reach + 1)
    major = np.broadcast_to(major[:, :, None], minor.shape)
    u = np.where(upright[:, None, None], minor, major)
    v = np.where(upright[:, None, None], major, minor)
    # Within the lens's bend of an edge, some 0.01 px, the pixels are chosen as if there were none.
    (au, av), (pu, pv) = line_direction(ends), ends.mean(axis=1).T
    x, y = u - pu[:, None, None], v - pv[:, None, None]
    s = x * au[:, None, None] + y * av[:, None, None]
    d = x * av[:, None, None] - y * au[:, None, None]
    use = (d >= low[:, None, None]) & (d <= high[:, None, None])
    use &= (np.abs(s) <= (line.length / 2 - margin)[:, None, None]) & (u >= 0) & (u < w) & (v >= 0) & (v < h)
    iu, iv = np.clip(u, 0, w - 1).astype(np.intp), np.clip(v, 0, h - 1).astype(np.intp)
    values = light[iv, iu]
    use &= ~_crossed(values, use, d > 0.6 * high[:, None, None], floor)[:, :, None]
    use &= ~saturated[iv, iu]

    use = use.reshape(len(use), -1)
    kept = use.sum(axis=1)
    order = np.argsort(~use, axis=1, kind="stable")[:, : max(int(kept.max()), 1)]
    u, v, values = (np.take_along_axis(a.reshape(use.shape), order, axis=1) for a in (u, v, values))
    place = undistort(camera, np.stack([u, v], axis=-1))
    inside = np.arange(order.shape[1]) < kept[:, None]
    return _Band(place, values.astype(float), inside)


def _with_corners_of(edges: Edges, line: _Line) -> Edges:
    """Corners from lines; those of a mark stay where they moved by more than a cell, on lines that went astray."""
    corners, _ = intersections(*(x.reshape(edges.corners.shape) for x in (line.middle, line.along)))
    moved = np.linalg.norm(corners - edges.corners, axis=-1).max(axis=1)
    side = np.linalg.norm(np.roll(edges.corners, -1, axis=1) - edges.corners, axis=-1).min(axis=1)
    kept = moved < np.maximum(side / CELLS, 2.0)
    return replace(edges, corners=np.where(kept[:, None, None], corners, edges.corners))


def intersections(point: Array, along: Array) -> tuple[Array, Array]:
    """Corner k where edges k − 1 and k of a mark meet, and how it moves with the place across of these two.

    Parameters
    ----------
    point, along : (n, 4, 2)
        A point on each edge [px], and its direction.

    Returns
    -------
    corners : (n, 4, 2) px; nan where edges are parallel
    by_place : (n, 4, 2, 2)
        [..., 0] by a shift of edge k − 1 along its normal (a_v, −a_u), [..., 1] by that of edge k.
    """
    normal = np.stack([along[..., 1], -along[..., 0]], axis=-1)
    place = (normal * point).sum(axis=-1)
    (a, b), (c, d) = np.moveaxis(np.stack([np.roll(normal, 1, axis=1), normal], axis=2), (2, 3), (0, 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.stack([np.stack([d, -b], axis=-1), np.stack([-c, a], axis=-1)], axis=-2)
        inverse = inverse / (a * d - b * c)[..., None, None]
    return (inverse @ np.stack([np.roll(place, 1, axis=1), place], axis=-1)[..., None])[..., 0], inverse


def line_direction(ends: Array) -> Array:
    """Unit vectors from the first to the second of (e, 2, 2) points, (2, e)."""
    run = ends[:, 1] - ends[:, 0]
    return (run / np.linalg.norm(run, axis=1, keepdims=True)).T


def _crossed(light: NDArray[np.float32], use: Mask, white: Mask, floor: float) -> Mask:
    """Steps along the edges, (e, count), at which something brighter than the mark's white lies across the edge.

    The white is the median over all four edges of a mark, which a line of light across it does not move.
    """
    side = use & white
    level = _masked_median(_by_mark(light), _by_mark(side))
    scatter = 1.4826 * _masked_median(np.abs(_by_mark(light) - level[:, None]), _by_mark(side))
    level, scatter = np.repeat(level, 4)[:, None], OUTLIER_SIGMA * np.repeat(np.sqrt(scatter**2 + floor), 4)[:, None]
    bright = use & (light > (level + scatter)[:, :, None])
    return _widened(np.any(bright, axis=2))


def _widened(steps: Mask) -> Mask:
    """One step more on either side."""
    out = steps.copy()
    out[:, 1:] |= steps[:, :-1]
    out[:, :-1] |= steps[:, 1:]
    return out


def _without_other_light(band: _Band, edges: Edges, fitted: _Fitted, floor: float) -> _Band:
    """Leave out steps along an edge where black or white is brighter than the mark's other edges have it.

    Compared are means over the pixels of one step that lie two blurs off the edge, one side at a time: a weak glow on
    the black border alone moves an edge by tenths of a pixel.
    """
    shape = fitted.shape.copy()
    for level in (_BLACK, _CONTRAST):
        shape[:, level] = np.repeat(np.median(shape[:, level].reshape(-1, 4), axis=1), 4)
    shape[:, _SLOPE] = 0.0
    shape[:, _BLUR] = np.median(shape[:, _BLUR])
    light, _, _ = _model(band, fitted.line, shape, _behind(band, edges, fitted.line, shape))
    residual = band.light - light
    s, d = band.coordinates(fitted.line)
    steps = int(np.ceil(fitted.line.length.max())) + 1
    step = np.clip(np.floor(s + fitted.line.length[:, None] / 2), 0, steps - 1).astype(np.intp)
    index = step + np.arange(len(s))[:, None] * steps
    bright = np.zeros(len(s) * steps, bool)
    for side in (d < -2 * np.exp(shape[:, _BLUR, None]), d > 2 * np.exp(shape[:, _BLUR, None])):
        side = side & band.use
        scatter = 1.4826 * _masked_median(np.abs(_by_mark(residual)), _by_mark(side))
        limit = OUTLIER_SIGMA * np.repeat(np.repeat(np.sqrt(scatter**2 + floor), 4), steps)
        count = np.bincount(index[side], minlength=len(bright))
        total = np.bincount(index[side], residual[side], minlength=len(bright))
        bright |= total > limit * np.sqrt(np.maximum(count, 1))
    out = _widened(bright.reshape(-1, steps)).ravel()
    return replace(band, use=band.use & ~out[index])


def _by_mark(values: NDArray) -> NDArray:
    return values.reshape(len(values) // 4, -1)


def _first_shape(band: _Band, line: _Line) -> Array:
    """Levels from the pixels that lie clearly on one side; blur one pixel."""
    _, d = band.coordinates(line)
    black = _masked_median(band.light, band.use & (d < -1))
    white = _masked_median(band.light, band.use & (d > 1))
    shape = np.zeros((len(black), 5))
    shape[:, _BLACK] = black
    shape[:, _CONTRAST] = np.maximum(white - black, 1e-3 * np.abs(white) + 1e-6)
    return shape


def _masked_median(values: NDArray, use: Mask) -> Array:
    """Median of each row's used values; 0 where none is used."""
    count = use.sum(axis=1)
    ordered = np.sort(np.where(use, values, np.inf), axis=1)
    rows = np.arange(len(values))
    median = (
        ordered[rows, np.maximum(count - 1, 0) // 2] + ordered[rows, np.minimum(count // 2, len(ordered[0]) - 1)]
    ) / 2
    return np.where(count > 0, median, 0.0)


@dataclass(frozen=True)
class _Bend:
    """What the picture's own step adds to the series: odd in the distance, zero from ``reach`` [px] on."""

    reach: float
    table: Array

    def at(self, d: Array) -> tuple[Array, Array]:
        """Value, and slope per px, at distances d [px]."""
        both = interpolate(self.table, np.abs(d) / self.reach * (len(self.table) - 1))
        return np.sign(d) * both[..., 0], both[..., 1]


_STRAIGHT = _Bend(1.0, np.zeros((2, 2)))


def _common_bend(band: _Band, edges: Edges, fitted: _Fitted) -> _Bend:
    """The odd part of what the series leaves, from the pixels of all edges; behind the border is other light."""
    line, shape = fitted.line, fitted.shape
    behind = _behind(band, edges, line, shape)
    light, _, _ = _model(band, line, shape, behind, _STRAIGHT)
    _, d = band.coordinates(line)
    reach = BEND_REACH * float(np.exp(np.median(shape[:, _BLUR])))
    own = (fitted.weight > 0) & (np.abs(d) < reach) & (behind < 1e-3)
    residual = ((band.light - light) / np.maximum(shape[:, _CONTRAST, None], 1e-6))[own]
    pieces = max(4, round(reach / BEND_KNOTS))
    knots = np.concatenate([[0.0] * 3, np.linspace(0.0, reach, pieces + 1), [reach] * 3])
    # Zero at the edge, level with the series at the reach.
    free = slice(1, -2)
    design = BSpline.design_matrix(np.abs(d[own]), knots, 3)[:, free]
    odd = np.sign(d[own]) * residual
    right = design.T @ odd
    normal = (design.T @ design).toarray()
    variance = float(np.mean(odd**2)) if len(odd) else 1.0
    coefficients = np.zeros(len(knots) - 4)
    coefficients[free] = np.linalg.solve(normal + variance / BEND**2 * np.eye(len(normal)), right)
    spline, grid = BSpline(knots, coefficients, 3), np.linspace(0.0, reach, 32 * pieces + 1)
    return _Bend(reach, np.stack([spline(grid), spline(grid, 1)], axis=1))


def _model(
    band: _Band, line: _Line, shape: Array, behind: Array, bend: _Bend = _STRAIGHT
) -> tuple[Array, list[Array], Array]:
    """Model's light, its derivatives by the seven parameters, and the step 0 … 1 from black to white."""
    s, d = band.coordinates(line)
    black, contrast, slope, log_blur, kurtosis = (shape[:, i, None] for i in range(5))
    blur = np.exp(log_blur)
    step, bell, by_kurtosis = _blurred_step(d / blur, kurtosis)
    white = contrast + slope * s
    bent, by_place = bend.at(d)
    step = step + bent
    gradient = white * (bell / blur + by_place)
    by_blur = -white * bell / blur * d
    derivative = [-gradient, -gradient * s, np.ones_like(s), step, step * s, by_blur, white * by_kurtosis]
    light = black + white * (step + behind)
    return light, derivative, step


def _blurred_step(q: Array, kurtosis: Array) -> tuple[Array, Array, Array]:
    """Blurred step of unit width, its derivatives by place and by kurtosis: Edgeworth's series to the fourth order."""
    bell = np.exp(-0.5 * q * q) * 0.3989422804014327
    q2 = q * q
    by_kurtosis = q * (3 - q2) * bell / 24
    return ndtr(q) + kurtosis * by_kurtosis, bell * (1 + kurtosis / 24 * (3 + q2 * (q2 - 6))), by_kurtosis


def _behind(band: _Band, edges: Edges, line: _Line, shape: Array) -> Array:
    """Light of the white cells behind the border, as a fraction of the contrast, where it is more than 1e-4."""
    s, d = band.coordinates(line)
    blur = np.exp(shape[:, _BLUR, None])
    at, depth = line.coordinates(edges.borders())
    slope = (depth[:, 8:] - depth[:, :1]) / (at[:, 8:] - at[:, :1])
    q = -(d - depth[:, :1] - slope * (s - at[:, :1])) / blur
    out = np.zeros_like(s)
    e, p = np.nonzero(band.use & (q > -3.7))
    changes = np.diff(edges.inner.astype(float), axis=1, prepend=0.0)[e]
    steps = ndtr((s[e, p, None] - at[e, :CELLS]) / blur[e])
    border, _, _ = _blurred_step(q[e, p], shape[e, _KURTOSIS])
    out[e, p] = border * (steps * changes).sum(axis=1)
    return out


@dataclass(frozen=True)
class _Fitted:
    """What the last Gauss–Newton step left."""

    line: _Line
    shape: Array
    covariance: Array
    variance: Array
    freedom: Array
    weight: Array


def _iterate(
    band: _Band,
    edges: Edges,
    line: _Line,
    shape: Array,
    steps: int,
    *,
    common_blur: float | None = None,
    fit_kurtosis: bool = False,
    bend: _Bend = _STRAIGHT,
) -> _Fitted:
    """Gauss–Newton steps; ``covariance`` of all parameters for pixels of unit variance, ``variance`` the residuals'."""
    shape = shape.copy()
    count = _PARAMETERS + fit_kurtosis
    for i in range(steps):
        if i % 3 == 0:
            behind = _behind(band, edges, line, shape)
        light, derivative, step = _model(band, line, shape, behind, bend)
        residual = band.light - light
        weight = _weights(residual, band.use, band.use & (np.abs(step - 0.5) < 0.45))
        columns = np.stack([*derivative[:count], residual], axis=1)
        product = (columns[:, :count] * weight[:, None]) @ columns.transpose(0, 2, 1)
        normal, right = product[..., :count], product[..., count]
        freedom = np.maximum(weight.sum(axis=1) - count, 1)
        variance = (weight * residual**2).sum(axis=1) / freedom
        if common_blur is not None:
            normal[:, 5, 5] += variance / BLUR_SPREAD**2
            right[:, 5] += variance / BLUR_SPREAD**2 * (common_blur - shape[:, _BLUR])
        size = np.sqrt(np.einsum("eii->ei", normal)) + 1e-30
        normal = normal / (size[:, :, None] * size[:, None, :])
        inverse = np.linalg.inv(normal + 1e-9 * np.eye(count))
        change = np.einsum("eij,ej->ei", inverse, right / size) / size
        covariance = inverse / (size[:, :, None] * size[:, None, :])
        line = line.moved(np.clip(change[:, 0], -1, 1), np.clip(change[:, 1], -2 / line.length, 2 / line.length))
        shape[:, :3] += change[:, 2:5]
        shape[:, _BLUR] = np.clip(shape[:, _BLUR] + np.clip(change[:, 5], -0.3, 0.3), np.log(0.25), np.log(8.0))
        if fit_kurtosis:
            shape[:, _KURTOSIS] += np.clip(change[:, 6], -1, 1)
    return _Fitted(line, shape, covariance, variance, freedom, weight)


def _common_blur(band: _Band, fitted: _Fitted) -> float:
    """Mean log of the blur of all edges, each weighted by how well it is determined."""
    precision = 1 / np.maximum(fitted.covariance[:, 5, 5] * fitted.variance, 1e-30)
    precision = np.where(band.use.any(axis=1), np.minimum(precision, 4 * np.median(precision)), 0.0)
    return float(np.average(fitted.shape[:, _BLUR], weights=precision)) if precision.any() else 0.0


def _common_kurtosis(band: _Band, fitted: _Fitted) -> float:
    """Mean kurtosis of the edges that show enough black to tell it; 0 if there is none."""
    _, d = band.coordinates(fitted.line)
    reach = -np.where(band.use, d, 0.0).min(axis=1) / np.exp(fitted.shape[:, _BLUR])
    precision = 1 / np.maximum(fitted.covariance[:, 6, 6] * fitted.variance, 1e-30)
    precision = np.where(reach > KURTOSIS_REACH, np.minimum(precision, 4 * np.median(precision)), 0.0)
    if not precision.any():
        return 0.0
    return float(np.clip(np.average(fitted.shape[:, _KURTOSIS], weights=precision), *KURTOSIS_RANGE))


def _weights(residual: Array, use: Mask, near: Mask) -> Array:
    """1, or 0 where a pixel stands out; all pixels alike otherwise.

    Weights that follow the noise, or a biweight, would treat the black and the white side of the step differently, and
    every misfit of its shape, which is antisymmetric, would then move the edge (0.004 px on photographs of other code).
    """
    scatter = 1.4826 * _masked_median(np.abs(residual), near)[:, None]
    return np.where(use & (np.abs(residual) <= np.maximum(OUTLIER_SIGMA * scatter, 1e-6)), 1.0, 0.0)


def _used(band: _Band, line: _Line, shape: Array, weight: Array, margin: Array) -> Array:
    """Weight within 1.5 blurs of the line on the poorer side, as a fraction of the pixels (one per px²) there."""
    _, d = band.coordinates(line)
    reach = 1.5 * np.exp(shape[:, _BLUR])
    area = reach * (line.length - 2 * margin)
    black = (weight * ((d < 0) & (d > -reach[:, None]))).sum(axis=1)
    white = (weight * ((d > 0) & (d < reach[:, None]))).sum(axis=1)
    return np.minimum(black, white) / area
