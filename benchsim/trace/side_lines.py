"""Light beside a trace: what each stretch of it shows across, and where lines lie that parted from the main one.

A ridge is measured in a window about its own centroid. Facets that lean differently draw lines of their own, whose
light lies in that window, across its edge or beyond, so that centre, width and flux are of part of the light. Here the
pixels on either side of the trace are averaged in stretches along it, and what they show is taken for a comb: copies of
one known line shape at unknown places, with shares of the light that are not negative (Lawson & Hanson 1974, ch. 23).
Places are found to a fraction of the line's width where it stands far above the noise. Mean and mean square offset of a
comb need no such resolution.

Not for a line that is merely broader than the shape: see `one_line`, which has to fail first.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import nnls

from benchsim.bench.curve import Curve, signed_distance
from benchsim.trace.picture import KEPT, Picture
from benchsim.trace.pose import Pose, to_board
from benchsim.trace.table import Trace

Array = NDArray[np.float64]

STRETCHES = 16
"""Along a trace: enough that neighbours tell the noise."""

REACH = 45.0
"""How far to either side light is looked for [mm]: facets that lean by 4 mrad, at 2 m."""

PIECES = 24
"""Of the main ridge, whose means carry the smooth curve that offsets are counted from."""

FEWEST = 6
"""Pixels in a bin of a stretch from which their scatter is known."""

WRONG = (0.02, 0.003)
"""1 sigma by which a line's shape may differ from the stated one: of the light at each place, and of the peak."""

CELLS = 0.2
"""Distance of a comb's cells over the line's full width at half maximum; two share a line between them, which adds at
most a quarter of the square of this to the mean square offset."""


@dataclass(frozen=True)
class Across:
    """Light across a trace in k stretches, in n bins.

    Attributes
    ----------
    s : (k,) mm
        Along the trace, as `Trace.s_mm`.
    points, normal : (k, 2) mm
        Of the smooth main ridge there; unit normal as `Trace.normal`.
    q : (k, n) mm
        Offsets along the normal.
    light, sigma : (k, n)
        Mean light and 1 sigma of it; sigma is infinite where no pixels are.
    """

    s: Array
    points: Array
    normal: Array
    q: Array
    light: Array
    sigma: Array

    def error(self, k: int) -> Array:
        """1 sigma with that of the line's shape, (n,)."""
        peak = np.max(self.light[k], where=np.isfinite(self.sigma[k]), initial=0.0)
        return np.sqrt(self.sigma[k] ** 2 + (WRONG[0] * self.light[k]) ** 2 + (WRONG[1] * peak) ** 2)


def light_across(picture: Picture, pose: Pose, line: Trace) -> Across:
    """Light on either side of a trace; marks, the board's edge and saturated pixels left out.

    Parameters
    ----------
    picture : Picture
        Of `extract.picture_on`.
    pose : Pose
    line : Trace
        The main ridge.
    """
    order = np.argsort(line.s_mm)
    base, arc = _smooth(line.points[order], line.s_mm[order])
    path = np.stack([line.u_px, line.v_px], axis=1)[order]
    chord = float(np.linalg.norm(np.diff(path[[0, -1]], axis=0)))
    per_px = float(np.ptp(line.s_mm)) / max(chord, 1.0)
    beside = np.zeros(picture.signal.shape, np.uint8)
    thickness = 2 * int(np.ceil(1.3 * REACH / per_px)) + 1
    cv2.polylines(beside, [np.round(path).astype(np.int32)], False, 1, thickness=thickness)
    v, u = np.nonzero((beside > 0) & (picture.blocked == KEPT) & ~picture.saturated)
    board = to_board(pose, np.stack([u, v], axis=1))[0]
    q, s = signed_distance(base, board)
    edges = np.linspace(arc[0], arc[-1], STRETCHES + 1)
    stretch = np.searchsorted(edges, s + arc[0]) - 1
    step = 0.5 * per_px
    half = int(REACH / step)
    column = np.round(q / step).astype(int) + half
    inside = (stretch >= 0) & (stretch < STRETCHES) & (column >= 0) & (column <= 2 * half)
    cell = (stretch * (2 * half + 1) + column)[inside]
    value, q, s = picture.signal[v, u][inside].astype(float), q[inside], s[inside]
    size = STRETCHES * (2 * half + 1)

    def mean(x: Array) -> Array:
        return np.bincount(cell, x, size).reshape(STRETCHES, -1) / np.maximum(count, 1)

    count = np.bincount(cell, minlength=size).reshape(STRETCHES, -1)
    light, places = mean(value), mean(q)
    scatter = np.sqrt(np.maximum(mean(value**2) - light**2, 0.0) * count / np.maximum(count - 1, 1))
    known = count >= FEWEST
    usual = np.array([np.median(x[k]) if k.any() else np.inf for x, k in zip(scatter, known, strict=True)])
    sigma = np.where(known, np.maximum(scatter, usual[:, None]) / np.sqrt(np.maximum(count, 1)), np.inf)
    core = np.abs(places) < 5.0
    along = (mean(s) * count * core).sum(axis=1) / np.maximum((count * core).sum(axis=1), 1)
    spline = CubicSpline(base.arc_length(), base.points)
    tangent = spline(along, 1) / np.linalg.norm(spline(along, 1), axis=1, keepdims=True)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    return Across(along + arc[0], spline(along), normal, places, light, sigma)


def _smooth(points: Array, s: Array) -> tuple[Curve, Array]:
    """A curve through the means of a ridge's pieces, and the arc lengths of its ends."""
    pieces = [c for c in np.array_split(np.arange(len(s)), min(PIECES, len(s) // 4))]
    means = np.array([points[c].mean(axis=0) for c in pieces])
    at = np.array([s[c].mean() for c in pieces])
    spline = CubicSpline(at, means)
    ends = np.linspace(s[0], s[-1], 2 * len(at))
    return Curve(spline(ends)), s[[0, -1]]


@dataclass(frozen=True)
class Comb:
    """Lines that a stretch shows.

    ``places`` (c,) [mm]; ``shares`` (c,) of the light, which add up to 1, with their ``covariance`` (c, c), of those
    that are not 0; ``chi2``.
    """

    places: Array
    shares: Array
    covariance: Array
    chi2: float

    @property
    def mean(self) -> float:
        """Of the light's offset [mm]."""
        return float(self.shares @ self.places)

    @property
    def parting(self) -> float:
        """Mean square of the light's offset about its mean, that of a line itself not included [mm²]."""
        return float(self.shares @ (self.places - self.mean) ** 2)

    @property
    def errors(self) -> tuple[float, float]:
        """1 sigma of mean [mm] and parting [mm²]."""
        off = self.places - self.mean
        by_share = np.stack([off, off**2 - self.parting])
        return tuple(np.sqrt(np.diag(by_share @ self.covariance @ by_share.T)).tolist())


def comb(q: Array, light: Array, sigma: Array, shape: tuple[Array, Array], cells: Array, least: float = 0.0) -> Comb:
    """Copies of a line at given places, with light ≥ 0, on a background that may slope.

    Parameters
    ----------
    q, light, sigma : (n,) array
        Offsets [mm], light at them and 1 sigma of it.
    shape : (places, light) of the line, whose mean is at 0
    cells : (c,) array [mm]
    least : float
        Cells with less than this share of the light within a line's full width at half maximum are left out: noise that
        cannot be negative would add to the parting.
    """
    if least:
        first = comb(q, light, sigma, shape, cells)
        places, line = shape
        wide = float(places[1] - places[0]) * float((line > 0.5 * line.max()).sum())
        near = np.abs(cells[:, None] - cells) < 0.5 * wide
        cells = cells[near @ first.shares > least]
    lines = np.stack([np.interp(q - x, *shape, left=0.0, right=0.0) for x in cells], axis=1)
    ground = np.stack([np.ones(len(q)), q / REACH], axis=1) * lines.max()
    design = np.concatenate([lines, ground, -ground], axis=1) / sigma[:, None]
    found, left = nnls(design, light / sigma, maxiter=50 * design.shape[1])
    shares, total = found[: len(cells)], max(float(found[: len(cells)].sum()), 1e-300)
    lit = np.flatnonzero(shares > 0)
    free = np.concatenate([lit, [len(cells), len(cells) + 1]])
    covariance = np.zeros((len(cells), len(cells)))
    inverse = np.linalg.pinv(design[:, free].T @ design[:, free], hermitian=True)
    # In ``sigma`` there may be what the shape is granted: what is left says how large errors are.
    scatter = float(left**2) / max(len(q) - len(free), 1)
    covariance[np.ix_(lit, lit)] = scatter * inverse[: len(lit), : len(lit)] / total**2
    return Comb(cells, shares / total, covariance, float(left**2))


def one_line(q: Array, light: Array, sigma: Array, shape: tuple[Array, Array]) -> float:
    """χ² of a single line, its place free, on a background that may slope."""
    best, place = np.inf, float(np.average(q, weights=np.maximum(light, 0.0) ** 2))
    for _ in range(6):
        here, there = (np.interp(q - place - d, *shape, left=0.0, right=0.0) for d in (-0.05, 0.05))
        design = np.stack([0.5 * (here + there), (there - here) / 0.1, np.ones(len(q)), q], axis=1) / sigma[:, None]
        solution, *_ = np.linalg.lstsq(design, light / sigma, rcond=None)
        best = min(best, float(np.sum((light / sigma - design @ solution) ** 2)))
        place += float(np.clip(solution[1] / max(solution[0], 1e-300), -2.0, 2.0))
    return best
