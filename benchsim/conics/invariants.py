"""What is known of a fitted conic's kind, axes, centre, foci and angles: profile-likelihood intervals.

Derivation. In the fit's frame the coefficients are normally distributed, c = ĉ + L z with z ~ N(0, 1) of dimension
at most 5: on this bench a change of the curve by its own sigma changes |∇f| by 0.1 %. Eccentricity or centre are far
from linear in c (± 49 % on an arc of 650 mm, and a centre may pass through infinity), so their variances mean nothing.
The profile likelihood interval of a quantity g at level p is the set of values that g takes where Δχ² ≤ χ²₁(p), that
is on the ball |z| ≤ √χ²₁(p) (Student's t where sigma was estimated): its least and largest value there, found by ascent
from many starts, all quantities at once. It does not depend on how the conic is parametrised.

Quantities that pass through infinity at a parabola are searched as smooth reciprocals: 1/a with the sign of A C − B²/4,
1/b² likewise. Their intervals are then half-open: at least 3 m, no upper bound. Where the circle, at which the axis
turns anyhow, lies within the region (two conditions: of χ²₂(p)), e reaches down to 0 and axis and vertex are unbounded.

When it fails: on arcs hardly deeper than their noise the ball reaches conics of another topology (line pairs, the
other branch); quantities that do not exist all over the ball are reported as unbounded. Where a quantity has a
turning point within the ball its interval covers too often (b and the centre: 0.77 and 0.84 for 0.68), never too
rarely. Fits with ``shallow`` say nothing but the radius of curvature.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from benchsim.bench import conic
from benchsim.conics.fitted import Fitted

Array = NDArray[np.float64]

# An invariant counts as determined if half its 95 % interval is below this fraction of its value; for a place (centre,
# focus, vertex) of its distance from the middle of the points; for an angle, this many radians.
DETERMINED = 0.25


@dataclass(frozen=True)
class Invariant:
    """One property with its 95 % interval.

    Attributes
    ----------
    value : float, str or None
        Of the most likely conic; None where that has none (the asymptotes of an ellipse).
    low, high : float or None
        Ends of the interval; None where it is unbounded on that side.
    determined : bool
        The interval is bounded and its half-width below ``DETERMINED``.
    """

    value: float | str | None
    low: float | None
    high: float | None
    determined: bool


# columns of _quantities; the names of the finite ones are the invariants' own
_COLUMNS = (
    "discriminant", "inverse_a", "inverse_b2", "eccentricity^4", "semi_latus_rectum_mm", "centre_y_mm", "centre_z_mm",
    "near_focus_y_mm", "near_focus_z_mm", "far_focus_y_mm", "far_focus_z_mm", "vertex_y_mm", "vertex_z_mm",
    "axis_angle_rad", "curvature",
)  # fmt: skip


def _quantities(
    c: Array, to_local: Array, origin: Array, length: float, direction: Array | None, middle: Array
) -> Array:
    """All columns (…, 15) of coefficients (…, 6) in the frame; nan where a quantity does not exist.

    ``to_local`` takes coefficients to coordinates (x − origin)/length; ``direction`` is the best fit's, which tells
    the two vertices, foci and senses of the axis apart all over the ball; ``middle`` (local) is where curvature is
    taken.
    """
    local = c @ to_local.T
    g = conic.geometry(local)
    d = g.direction
    if direction is not None:
        turned = (d @ direction < 0)[..., None]
        near_focus = np.where(turned, g.foci[..., 1, :], g.foci[..., 0, :])
        far_focus = np.where(turned, g.foci[..., 0, :], g.foci[..., 1, :])
        vertex = np.where(turned, g.vertices[..., 1, :], g.vertices[..., 0, :])
        d = np.where(turned, -d, d)
        across = np.array([-direction[1], direction[0]])
        angle = np.arctan2(direction[1], direction[0]) + np.arctan2(d @ across, d @ direction)
    else:
        near_focus, far_focus, vertex = g.foci[..., 0, :], g.foci[..., 1, :], g.vertices[..., 0, :]
        angle = np.arctan2(d[..., 1], d[..., 0])
    a, b, cc, dd, ee, _ = np.moveaxis(local, -1, 0)
    norm = np.linalg.norm(local, axis=-1)
    delta = (a * cc - b * b / 4) / norm**2
    sign = np.where(g.kind == "ellipse", 1.0, -1.0)
    gy = 2 * a * middle[0] + b * middle[1] + dd
    gz = b * middle[0] + 2 * cc * middle[1] + ee
    with np.errstate(all="ignore"):
        curvature = 2 * (cc * gy * gy - b * gy * gz + a * gz * gz) / np.hypot(gy, gz) ** 3 / length
        inverse_a = sign / (length * g.semi_axes[..., 0])
        inverse_b2 = sign / (length * g.semi_axes[..., 1]) ** 2
    places = [length * p[..., i] + origin[i] for p in (g.centre, near_focus, far_focus, vertex) for i in (0, 1)]
    latus = length * g.semi_latus_rectum
    return np.stack([delta, inverse_a, inverse_b2, g.eccentricity**4, latus, *places, angle, curvature], axis=-1)


def _best_in_ball(gradient: Array, hessian: Array, at: Array, radius: float) -> Array:
    """Where quadratic models (m) have their largest value in |x| ≤ radius: x = (ν − H)⁻¹ (g − H z), ν by bisection."""
    values, vectors = np.linalg.eigh(hessian)
    linear = np.einsum("mji,mj->mi", vectors, gradient - np.einsum("mij,mj->mi", hessian, at))
    low = np.maximum(values[:, -1], 0.0)
    high = low + np.linalg.norm(linear, axis=1) / radius + 1e-300

    def solve(nu: Array) -> Array:
        gap = nu[:, None] - values
        return np.asarray(linear / np.where(gap > 0, gap, 1e-300))

    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(60):
            nu = (low + high) / 2
            out = np.linalg.norm(solve(nu), axis=1) > radius
            low, high = np.where(out, nu, low), np.where(out, high, nu)
        x = np.einsum("mij,mj->mi", vectors, solve(high))
    return np.where(np.isfinite(x), x, at)


def _ball_extremes(
    function: Callable[[Array], Array], dimension: int, radius: float, starts: Array, rounds: int = 25
) -> tuple[Array, Array, Array]:
    """Least and largest value of every column of ``function`` (m, dimension) → (m, q) on a ball, and if all is finite.

    From ``starts``, the centre, the axes and 400 seeded points, each end of each column climbs by Newton steps on its
    quadratic model in the ball, and along its gradient where that fails. Every end takes over the best point that
    any other has met.
    """
    rng = np.random.default_rng(20190101)
    z = rng.normal(size=(400, dimension))
    z *= radius / np.linalg.norm(z, axis=1, keepdims=True)
    z[200:] *= rng.uniform(size=(200, 1)) ** (1 / dimension)
    eye = np.eye(dimension)
    z = np.vstack([np.zeros((1, dimension)), radius * eye, -radius * eye, z, starts])
    values = function(z)
    everywhere = np.all(np.isfinite(values), axis=0)
    q = values.shape[1]
    target, sense = np.tile(np.arange(q), 2), np.repeat([-1.0, 1.0], q)
    at, best = np.zeros((2 * q, dimension)), np.full(2 * q, -np.inf)

    def take_over(points: Array, got: Array) -> Array:
        score = np.where(np.isfinite(got), got, np.nan)[:, target] * sense
        score = np.where(np.isnan(score), -np.inf, score)
        index = np.argmax(score, axis=0)
        new = score[index, np.arange(2 * q)]
        better = new > best
        with np.errstate(invalid="ignore"):
            gain = np.where(better, new - best, 0.0)
        at[better], best[better] = points[index[better]], new[better]
        return np.asarray(gain)

    take_over(z, values)
    h = 1e-3 * radius
    i, j = np.triu_indices(dimension, 1)
    around = h * np.vstack([np.zeros((1, dimension)), eye, -eye, eye[i] + eye[j], -eye[i] - eye[j]])
    shrink = 4.0 ** -np.arange(5)
    live = np.isfinite(best)
    for _ in range(rounds):
        rows = np.flatnonzero(live)
        if not len(rows):
            break
        m = len(rows)
        f = function((at[rows, None, :] + around).reshape(-1, dimension)).reshape(m, len(around), q)
        f = sense[rows, None] * np.take_along_axis(f, target[rows, None, None], axis=2)[..., 0]
        f = np.where(np.isfinite(f), f, best[rows, None])
        up, down = f[:, 1 : dimension + 1], f[:, dimension + 1 : 2 * dimension + 1]
        mixed = f[:, 2 * dimension + 1 :]
        gradient = (up - down) / (2 * h)
        hessian = np.zeros((m, dimension, dimension))
        hessian[:, np.arange(dimension), np.arange(dimension)] = (up + down - 2 * f[:, :1]) / h**2
        cross = (
            mixed[:, : len(i)] + mixed[:, len(i) :] + 2 * f[:, :1] - up[:, i] - down[:, i] - up[:, j] - down[:, j]
        ) / (2 * h**2)
        hessian[:, i, j] = hessian[:, j, i] = cross
        newton = _best_in_ball(gradient, hessian, at[rows], radius) - at[rows]
        length = np.linalg.norm(gradient, axis=1, keepdims=True)
        steepest = radius * gradient / np.where(length > 0, length, 1.0)
        trial = np.concatenate([at[rows] + t * d for t in shrink for d in (newton, steepest)])
        norm = np.linalg.norm(trial, axis=-1, keepdims=True)
        trial = np.where(norm > radius, trial * (radius / np.maximum(norm, 1e-300)), trial)
        gain = take_over(trial, function(trial))
        live = gain > 1e-7 * np.abs(best)
    return -best[:q], best[q:], everywhere


def _bounded(low: float, high: float) -> tuple[float | None, float | None]:
    return (float(low) if math.isfinite(low) else None), (float(high) if math.isfinite(high) else None)


def _length_interval(low: float, high: float, power: float) -> tuple[float | None, float | None]:
    """Interval of |1/q|**power from that of q, which may pass through zero (the length: through infinity)."""
    if not (math.isfinite(low) and math.isfinite(high)):
        return None, None
    least, largest = (0.0, max(-low, high)) if low <= 0 <= high else sorted((abs(low), abs(high)))
    return (float(largest**-power) if largest > 0 else None), (float(least**-power) if least > 0 else None)


def invariants(fitted: Fitted, level: float = 0.95) -> dict[str, Invariant]:
    """Kind and invariants of a fitted conic with their profile-likelihood intervals.

    Parameters
    ----------
    fitted : ConicFit or SectionFit
    level : float
        Of the intervals.

    Returns
    -------
    dict of Invariant
        ``kind`` (value "ellipse", "hyperbola" or "not determined"; no interval), ``eccentricity``, ``semi_axis_a_mm``
        (major or transverse), ``semi_axis_b_mm``, ``semi_latus_rectum_mm``, ``centre_y_mm``, ``centre_z_mm``,
        ``near_focus_y_mm``, … (inside the branch that the points are on, nearer to them along the axis),
        ``far_focus_y_mm``, …, ``vertex_y_mm``, … (beside the near focus), ``axis_angle_rad`` (of the major or
        transverse axis from +y toward +z, modulo π), ``asymptote_half_angle_rad`` (from the transverse axis),
        ``radius_of_curvature_mm`` (at the middle of the points, no sign; if straight, its lower bound alone).
    """
    origin = fitted.frame.origin
    length = float(np.sqrt(np.mean(np.sum((fitted.points - origin) ** 2, axis=1))))
    to_local = conic.transform_matrix(np.linalg.inv(length * fitted.frame.matrix))
    nearest = np.argmin(np.linalg.norm(fitted.feet - origin, axis=1))
    middle = (fitted.feet[nearest] - origin) / length
    values, vectors = np.linalg.eigh(fitted.covariance)
    keep = values > 1e-12 * values[-1]
    root = vectors[:, keep] * np.sqrt(values[keep])

    best = fitted.coefficients
    best_direction = conic.geometry(best @ to_local.T).direction
    direction = best_direction if np.all(np.isfinite(best_direction)) else None
    value = dict(zip(_COLUMNS, _quantities(best, to_local, origin, length, direction, middle).tolist(), strict=True))
    half = 0.5 + level / 2
    radius = float(stats.t.ppf(half, fitted.dof) if fitted.sigma_estimated else stats.norm.ppf(half))

    def function(z: Array) -> Array:
        return _quantities(best + z @ root.T, to_local, origin, length, direction, middle)

    # the circle nearest to the fit: B = 0 and A = C are linear in the coefficients
    round_ = to_local[[0, 1]] - np.stack([to_local[2], np.zeros(6)])
    to_circle = -np.linalg.pinv(round_ @ root) @ (round_ @ best)
    circle = float(np.linalg.norm(to_circle))
    low, high, finite = _ball_extremes(function, int(keep.sum()), radius, min(1.0, radius / circle) * to_circle[None])
    low = np.where(finite, low, -np.inf)
    high = np.where(finite, high, np.inf)
    lows, highs = dict(zip(_COLUMNS, low.tolist(), strict=True)), dict(zip(_COLUMNS, high.tolist(), strict=True))
    for table in (value, lows, highs):
        table["eccentricity"] = max(table["eccentricity^4"], 0.0) ** 0.25

    # a circle is two conditions at once, so it lies in a region of two degrees of freedom; it has no axis
    two = 2 * stats.f.ppf(level, 2, fitted.dof) if fitted.sigma_estimated else stats.chi2.ppf(level, 2)
    circular = circle**2 <= two
    if circular:
        lows["eccentricity"] = 0.0

    out: dict[str, Invariant] = {}
    one_kind = (
        lows["discriminant"] * highs["discriminant"] > 0 and not lows["eccentricity"] <= 1 <= highs["eccentricity"]
    )
    kind_known = not fitted.shallow and one_kind
    kind = ("ellipse" if value["discriminant"] > 0 else "hyperbola") if kind_known else "not determined"
    out["kind"] = Invariant(kind, None, None, kind_known)

    def add(name: str, v: float, interval: tuple[float | None, float | None], scale: float) -> None:
        lo, hi = (None, None) if fitted.shallow else interval
        known = lo is not None and hi is not None and (hi - lo) / 2 < DETERMINED * scale
        out[name] = Invariant(None if fitted.shallow or not math.isfinite(v) else v, lo, hi, bool(known))

    e = _bounded(lows["eccentricity"], highs["eccentricity"])
    add("eccentricity", value["eccentricity"], e, abs(value["eccentricity"]))
    for name, key, power in (("semi_axis_a_mm", "inverse_a", 1.0), ("semi_axis_b_mm", "inverse_b2", 0.5)):
        v = abs(value[key]) ** -power if value[key] else math.inf
        add(name, v, _length_interval(lows[key], highs[key], power), v)
    latus = value["semi_latus_rectum_mm"]
    add("semi_latus_rectum_mm", latus, _bounded(lows["semi_latus_rectum_mm"], highs["semi_latus_rectum_mm"]), latus)
    for place in ("centre", "near_focus", "far_focus", "vertex"):
        both = np.array([value[f"{place}_y_mm"], value[f"{place}_z_mm"]])
        distance = max(float(np.linalg.norm(both - origin)), length)
        nowhere = (not kind_known and place in ("centre", "far_focus")) or (circular and place == "vertex")
        for axis in "yz":
            key = f"{place}_{axis}_mm"
            add(key, value[key], (None, None) if nowhere else _bounded(lows[key], highs[key]), distance)
    turn = (None, None) if circular else _bounded(lows["axis_angle_rad"], highs["axis_angle_rad"])
    add("axis_angle_rad", value["axis_angle_rad"], turn, 1.0)
    to_angle = [None if x is None or x < 1 else math.acos(1 / x) for x in e]
    v = math.acos(1 / value["eccentricity"]) if value["eccentricity"] >= 1 else math.nan
    add("asymptote_half_angle_rad", v, (to_angle[0], to_angle[1]), 1.0)
    bend = _length_interval(lows["curvature"], highs["curvature"], 1.0)
    v = 1 / abs(value["curvature"]) if value["curvature"] else math.inf
    if fitted.straight:
        bend, v = (bend[0], None), math.inf
    known = bend[0] is not None and bend[1] is not None and (bend[1] - bend[0]) / 2 < DETERMINED * v
    out["radius_of_curvature_mm"] = Invariant(v if math.isfinite(v) else None, *bend, bool(known))
    return out
