"""Edges to be fitted, and the raw pixels about them that are free of other light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.model import Camera
from benchsim.trace.lens import distort, undistort

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

OUTLIER_SIGMA = 5.0
"""Pixels this far off are no noise: of 3 million, noise alone puts one there."""

CELLS = 8
"""Cells along the black square of an AprilTag 36h11: 6 of data and a black border of one."""


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

    def line(self) -> Line:
        """The edges as lines."""
        length = np.linalg.norm(self.end - self.start, axis=1)
        return Line((self.start + self.end) / 2, (self.end - self.start) / length[:, None], length)


@dataclass(frozen=True)
class Line:
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

    def moved(self, offset: Array, tilt: Array) -> Line:
        along = self.along + tilt[:, None] * self.normal
        return Line(
            self.middle + offset[:, None] * self.normal,
            along / np.linalg.norm(along, axis=1, keepdims=True),
            self.length,
        )


@dataclass(frozen=True)
class Band:
    """Pixels near each edge, one row per edge, padded: undistorted place (e, p, 2), light, whether used."""

    place: Array
    light: Array
    use: Mask

    def coordinates(self, line: Line) -> tuple[Array, Array]:
        """Along from the middle, and across towards white."""
        return line.coordinates(self.place)


def gathered(
    light: NDArray[np.float32],
    saturated: Mask,
    camera: Camera,
    line: Line,
    low: Array,
    high: Array,
    margin: Array,
    floor: float,
) -> Band:
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
    return Band(place, values.astype(float), inside)


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
    level = masked_median(by_mark(light), by_mark(side))
    scatter = 1.4826 * masked_median(np.abs(by_mark(light) - level[:, None]), by_mark(side))
    level, scatter = np.repeat(level, 4)[:, None], OUTLIER_SIGMA * np.repeat(np.sqrt(scatter**2 + floor), 4)[:, None]
    bright = use & (light > (level + scatter)[:, :, None])
    return widened(np.any(bright, axis=2))


def widened(steps: Mask) -> Mask:
    """One step more on either side."""
    out = steps.copy()
    out[:, 1:] |= steps[:, :-1]
    out[:, :-1] |= steps[:, 1:]
    return out


def by_mark(values: NDArray) -> NDArray:
    return values.reshape(len(values) // 4, -1)


def masked_median(values: NDArray, use: Mask) -> Array:
    """Median of each row's used values; 0 where none is used."""
    count = use.sum(axis=1)
    ordered = np.sort(np.where(use, values, np.inf), axis=1)
    rows = np.arange(len(values))
    median = (
        ordered[rows, np.maximum(count - 1, 0) // 2] + ordered[rows, np.minimum(count // 2, len(ordered[0]) - 1)]
    ) / 2
    return np.where(count > 0, median, 0.0)
