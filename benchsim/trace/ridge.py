"""Find bright curves in a picture, coarsely and robustly: where the light's profiles are then measured.

A reduced picture is filtered for ridges at three scales; points on ridges above the noise are joined by random sampling
to the parabola that carries most light, which is then refined to a quartic. Good to about a pixel of the
reduced picture, which is all that `band` needs.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

REDUCED_SIZE = 500
"""Longest side of the reduced picture (px): keeps a line of 3 px in a 2000 px picture and costs 20 ms per scale."""

SCALES = (1.0, 2.0, 4.0)
"""Standard deviations of the ridge filter (reduced px)."""

FALSE_POINTS = 1.0
"""Ridge points that noise alone is expected to raise above the threshold in one picture."""

TRIALS = 1000
"""Random parabolas, each from two points drawn by strength: a trace that carries a tenth of the strength is drawn ten
times."""

POINTS = 1500
"""Points that vote on the parabolas; more are drawn from by strength."""

ANGLE = np.radians(20.0)
"""Largest angle between a ridge point's own direction and the curve's."""


@dataclass(frozen=True)
class RidgePoints:
    """Points on ridges, full-resolution pixels.

    ``uv`` (n, 2); ``direction`` (n, 2) unit, along the ridge; ``strength`` (n,) in units of the threshold.
    ``reduction``: pixels per reduced pixel.
    """

    uv: Array
    direction: Array
    strength: Array
    reduction: float

    def where(self, usable: Mask) -> RidgePoints:
        """Those on usable pixels (h, w)."""
        u, v = np.clip(np.round(self.uv).astype(int), 0, np.array(usable.shape)[::-1] - 1).T
        keep = usable[v, u]
        return RidgePoints(self.uv[keep], self.direction[keep], self.strength[keep], self.reduction)


def ridge_points(picture: NDArray[np.floating], usable: Mask | None = None) -> RidgePoints:
    """Points on bright ridges that noise does not explain.

    Second derivatives at three scales (Lindeberg 1998, IJCV 30, 117); a point is kept where the maximum across the
    ridge lies within its own pixel (Steger 1998, IEEE PAMI 20, 113).

    Parameters
    ----------
    picture : (h, w) array
        Light, background removed where possible: borders of marks are ridges too.
    usable : (h, w) mask, optional
        Pixels that may be looked at; the others are filled smoothly from their neighbours.

    Returns
    -------
    RidgePoints
    """
    h, w = picture.shape
    f = max(1, round(max(h, w) / REDUCED_SIZE))
    image = _reduced(picture, f)
    valid = np.ones(image.shape, bool)
    if usable is not None:
        valid = _reduced(usable, f) > 0.99
        image = _filled(image, valid)
    best = np.zeros(image.shape, np.float32)
    angle = np.zeros(image.shape, np.float32)
    offset = np.zeros((*image.shape, 2), np.float32)
    pixels = max(int(valid.sum()), 1)
    # Along any one direction the response is Gaussian; over all directions its tail is about 3 exp(-k²/2).
    k = np.sqrt(2 * np.log(3 * len(SCALES) * pixels / FALSE_POINTS))
    for sigma in SCALES:
        near = valid if valid.all() else ndimage.binary_erosion(valid, iterations=int(2 * sigma), border_value=1)
        # Beyond the picture's edge the filter sees its last row again, whose noise then counts more than once.
        inner = np.zeros_like(near)
        inner[(edge := int(3 * sigma)) : -edge, edge:-edge] = True
        near = near & inner
        if not near.any():
            continue
        rows, cols, cross, down, right = (
            ndimage.gaussian_filter(image, sigma, order=o, mode="nearest")
            for o in ((2, 0), (0, 2), (1, 1), (1, 0), (0, 1))
        )
        noise = 1.4826 * np.median(np.abs(cols[near] - np.median(cols[near])))
        noise = max(float(noise), 1e-7 * float(np.abs(cols).max()), 1e-30)
        half = np.hypot((cols - rows) / 2, cross)
        response = half - (cols + rows) / 2
        theta = 0.5 * np.arctan2(2 * cross, cols - rows)  # of the largest second derivative: along the ridge
        nu, nv = -np.sin(theta), np.cos(theta)
        step = (right * nu + down * nv) / np.maximum(response, 1e-30)
        peak = near & (np.abs(step * nu) <= 0.6) & (np.abs(step * nv) <= 0.6)
        score = np.where(peak, response / (k * noise), 0.0)
        better = score > best
        best[better], angle[better] = score[better], theta[better]
        offset[better] = np.stack([step * nu, step * nv], axis=-1)[better]
    v, u = np.nonzero(best > 1.0)
    if len(u) > 6000:
        strongest = np.argsort(best[v, u])[-6000:]
        v, u = v[strongest], u[strongest]
    uv = (np.stack([u, v], axis=1) + offset[v, u] + 0.5) * f - 0.5
    direction = np.stack([np.cos(angle[v, u]), np.sin(angle[v, u])], axis=1)
    return RidgePoints(uv.astype(float), direction.astype(float), best[v, u].astype(float), float(f))


def _reduced(image: NDArray, f: int) -> NDArray[np.float32]:
    """Means over f × f pixels; what does not fill a block is cut off."""
    h, w = image.shape[0] // f * f, image.shape[1] // f * f
    small = cv2.resize(image[:h, :w].astype(np.float32), (w // f, h // f), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float32)


def _filled(image: NDArray[np.float32], valid: Mask) -> NDArray[np.float32]:
    """Unusable pixels replaced by the weighted mean of usable ones nearby, at the smallest scale that has any."""
    out = np.where(valid, image, 0).astype(np.float32)
    known = valid.astype(np.float32)
    total = np.full(image.shape, image[valid].mean() if valid.any() else 0.0, np.float32)
    for sigma in (32.0, 8.0, 2.0):
        weight = cv2.GaussianBlur(known, (0, 0), sigma)
        total = np.where(weight > 0.02, cv2.GaussianBlur(out, (0, 0), sigma) / np.maximum(weight, 0.02), total)
    return np.where(valid, image, total).astype(np.float32)


@dataclass(frozen=True)
class CoarseCurve:
    """``points`` (n, 2): a polyline of one-pixel steps [px]; ``strength``: ridge strength that it collects."""

    points: Array
    strength: float


def best_curve(points: RidgePoints, seed: int = 0) -> CoarseCurve | None:
    """The smooth curve that collects most ridge strength; None if fewer than 8 points agree on one.

    Random parabolas through two points and along their directions (RANSAC, Fischler & Bolles 1981), then least squares
    up to a quartic in the frame of its chord, so the curve may turn by less than 90 degrees from its chord. Works while
    the trace carries at least a tenth of the strength of all ridge points, and more than any other curve.

    Parameters
    ----------
    points : RidgePoints
    seed : int
        Of the random draws.
    """
    n = len(points.uv)
    if n < 8:
        return None
    rng = np.random.default_rng(seed)
    share = points.strength / points.strength.sum()
    vote = rng.choice(n, size=POINTS, p=share, replace=False) if n > POINTS else np.arange(n)
    voters = RidgePoints(points.uv[vote], points.direction[vote], points.strength[vote], points.reduction)
    first, second = rng.choice(n, size=(2, TRIALS), p=share)
    tolerance = 1.5 * points.reduction + 2.0
    a, chord = points.uv[first], points.uv[second] - points.uv[first]
    length = np.maximum(np.linalg.norm(chord, axis=1), 1e-9)
    chord = chord / length[:, None]
    slope_a, slope_b = _slope(points.direction[first], chord), _slope(points.direction[second], chord)
    # In the frame of its chord a parabola leaves and arrives at opposite slopes.
    sound = (length > 8 * points.reduction) & (np.abs(slope_a + slope_b) < 2 * np.tan(ANGLE))
    bend = (slope_b - slope_a) / (2 * length)
    inside = _members(voters, a, chord, length, bend, tolerance) & sound
    best = int(np.argmax(voters.strength @ inside))
    one = slice(best, best + 1)
    members = _members(points, a[one], chord[one], length[one], bend[one], tolerance)[:, 0]
    return _refined(points, members, tolerance) if members.sum() >= 8 else None


def _slope(direction: Array, chord: Array) -> Array:
    """Slope of directions in the frames of chords; undirected, so the sign of either does not matter."""
    along = np.einsum("ij,ij->i", direction, chord)
    across = chord[:, 0] * direction[:, 1] - chord[:, 1] * direction[:, 0]
    return across / np.where(np.abs(along) < 0.05, np.copysign(0.05, along), along)


def _members(points: RidgePoints, start: Array, chord: Array, length: Array, bend: Array, tolerance: float) -> Mask:
    """Which points lie on which parabola, and along it, (points, parabolas)."""
    p, d = points.uv, points.direction
    x = p @ chord.T - np.einsum("ij,ij->i", start, chord)
    y = np.outer(p[:, 1], chord[:, 0]) - np.outer(p[:, 0], chord[:, 1])
    y -= chord[:, 0] * start[:, 1] - chord[:, 1] * start[:, 0]
    slope = bend * (2 * x - length)
    stretch = np.hypot(1, slope)
    across = np.outer(d[:, 1], chord[:, 0]) - np.outer(d[:, 0], chord[:, 1])
    turned = np.abs(across - slope * (d @ chord.T)) <= np.sin(ANGLE) * stretch
    return (np.abs(y - bend * x * (x - length)) <= tolerance * stretch) & turned


def _refined(points: RidgePoints, members: Mask, tolerance: float) -> CoarseCurve | None:
    """Least squares of growing degree in the frame of the members' own long axis, gaining members on the way."""
    p, strength = points.uv, points.strength
    for degree in (2, 2, 3, 4, 4):
        chosen = p[members]
        centre = chosen.mean(axis=0)
        axis = np.linalg.svd(chosen - centre, full_matrices=False)[2][0]
        x = (p - centre) @ axis
        y = axis[0] * (p - centre)[:, 1] - axis[1] * (p - centre)[:, 0]
        weight = np.sqrt(np.minimum(strength[members], 20.0))
        curve = np.polynomial.Chebyshev.fit(x[members], y[members], degree, w=weight)
        slope = curve.deriv()(x)
        across = points.direction[:, 1] * axis[0] - points.direction[:, 0] * axis[1]
        turned = np.abs(across - slope * (points.direction @ axis)) <= np.sin(ANGLE) * np.hypot(1, slope)
        # One chord length ahead a polynomial is no longer held by its data: grow by a tenth at a time.
        low, high = np.min(x[members]), np.max(x[members])
        reach = (x > low - 0.1 * (high - low)) & (x < high + 0.1 * (high - low))
        new = (np.abs(y - curve(x)) <= tolerance * np.hypot(1, slope)) & turned & reach
        if new.sum() < 8:
            return None
        members = new
    xs = np.sort(x[members])
    gap = max(0.15 * (xs[-1] - xs[0]), 20.0 * points.reduction)
    runs = np.split(xs, np.flatnonzero(np.diff(xs) > gap) + 1)
    run = max(runs, key=len)
    if len(run) < 8:
        return None
    keep = members & (x >= run[0]) & (x <= run[-1])
    grid = np.arange(run[0], run[-1] + 1.0)
    line = centre + np.outer(grid, axis) + np.outer(curve(grid), [-axis[1], axis[0]])
    return CoarseCurve(line, float(strength[keep].sum()))
