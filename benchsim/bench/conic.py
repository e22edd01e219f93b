"""Geometry of a conic given by its six coefficients: kind, axes, foci, asymptotes, curvature, change of coordinates.

The curve is A y² + B y z + C z² + D y + E z + F = 0, coefficients in that order, any overall factor.

Derivation. With S the symmetric 3 × 3 matrix of the form, δ = A C − B²/4 (> 0 ellipse, < 0 hyperbola, 0 parabola) and
Δ = det S (0: degenerate). Turn the coordinates so that the quadratic part is diagonal, λ1 ≥ |λ2|, with the overall
sign that makes A + C ≥ 0: λ1 = (A + C)/2 + h, h = hypot((A − C)/2, B/2), and λ2 = δ/λ1, which loses no digits near a
parabola. Let t be the transverse (major) axis and c the other. Completing the square across gives
λc w² + λt u² + 2 gt u + Ft = 0, so that the vertices are the roots of the quadratic in u, its discriminant is
s² = −Δ/λc, and

    a = s/|λt|,  b = s/√|λt λc|,  semi-latus rectum l = s/|λc|,  e = √(2h/|λc|),  focus = vertex ± l/(1 + e) along t.

Written with l and e, the near vertex and focus stay exact while the centre goes to infinity. t is axis 2 unless
λ2 < 0 < Δ (a hyperbola wider than a right angle), where it is axis 1; λ1 > 0, λ2 > 0, Δ > 0 has no real points.

Limits. Coefficients are float64: rounding them moves a curve of size a at a distance R from the origin by about
1e-16 R²/a, whatever is done afterwards. Hold such a conic in coordinates near the curve (:func:`transform`), take its
geometry there, and move that (:meth:`ConicGeometry.moved`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchsim.bench.errors import BenchsimError

Array = NDArray[np.float64]

# 64 float64 roundings: what six rounded coefficients leave undecided in δ and Δ, relative to their largest terms
_UNDECIDED = 64 * np.finfo(np.float64).eps


@dataclass(frozen=True)
class ConicGeometry:
    """What a conic looks like. Lengths in the coordinates' unit; batches have leading dimensions, written … here.

    What does not exist is nan (foci of a degenerate conic, the centre of a parabola), what lies at infinity is inf.
    Vertex and focus 0 are those nearer to the origin of the coordinates, 1 the others (nan for a parabola).

    Attributes
    ----------
    kind : (…) str
        "ellipse", "hyperbola", "parabola", "degenerate" (lines, a point, or the two undecided within the rounding of
        the coefficients), or "imaginary" (no real points).
    centre : (…, 2)
    semi_axes : (…, 2)
        a along the major (ellipse) or transverse (hyperbola) axis, b across; inf for a parabola.
    direction : (…, 2)
        Unit vector of the major (transverse) axis, from vertex 0 to its concave side.
    eccentricity : (…)
    semi_latus_rectum : (…)
        b²/a, which is also the radius of curvature at the vertices.
    vertices : (…, 2, 2)
        On the major (transverse) axis.
    foci : (…, 2, 2)
    asymptote_directions : (…, 2, 2)
        Unit vectors of the two asymptotes, which pass through the centre; nan unless a hyperbola.
    """

    kind: NDArray[np.str_]
    centre: Array
    semi_axes: Array
    direction: Array
    eccentricity: Array
    semi_latus_rectum: Array
    vertices: Array
    foci: Array
    asymptote_directions: Array

    @property
    def axis_angle(self) -> Array:
        """Angle of the major (transverse) axis from +y toward +z, in (−π/2, π/2] [rad]."""
        angle = np.arctan2(self.direction[..., 1], self.direction[..., 0])
        return np.asarray(np.pi / 2 - np.mod(np.pi / 2 - angle, np.pi))

    @property
    def asymptote_half_angle(self) -> Array:
        """Angle between the transverse axis and either asymptote, acos(1/e) [rad]; nan unless a hyperbola."""
        with np.errstate(invalid="ignore"):
            return np.asarray(
                np.where(self.kind == "hyperbola", np.arctan2(self.semi_axes[..., 1], self.semi_axes[..., 0]), np.nan)
            )

    def moved(self, scale: float = 1.0, shift: ArrayLike = (0.0, 0.0)) -> ConicGeometry:
        """Same conic in coordinates x' = scale·x + shift, ``scale`` > 0; the order of foci and vertices is kept."""
        t = np.asarray(shift, float)
        return ConicGeometry(
            self.kind, scale * self.centre + t, scale * self.semi_axes, self.direction, self.eccentricity,
            scale * self.semi_latus_rectum, scale * self.vertices + t, scale * self.foci + t, self.asymptote_directions,
        )  # fmt: skip


def _six(coefficients: ArrayLike) -> Array:
    c = np.asarray(coefficients, float)
    if c.shape[-1:] != (6,) or not np.all(np.isfinite(c)):
        raise BenchsimError(
            f"a conic has six finite coefficients A, B, C, D, E, F, not an array of shape {c.shape}"
            f"{'' if c.shape[-1:] != (6,) else ' with nan or inf'}; check what was handed in"
        )
    return c


def geometry(coefficients: ArrayLike) -> ConicGeometry:
    """Geometry of conics; see the module's docstring for the derivation and its limits.

    Parameters
    ----------
    coefficients : (…, 6) array
        A, B, C, D, E, F.

    Returns
    -------
    ConicGeometry

    Raises
    ------
    BenchsimError
        If the coefficients are not finite or not six.
    """
    c = _six(coefficients)
    largest = np.max(np.abs(c), axis=-1, keepdims=True)
    # extended precision where the platform has it: the coefficients' own rounding is then the only loss
    x = (c / np.where(largest > 0, largest, 1.0)).astype(np.longdouble)
    x = np.where((x[..., 0] + x[..., 2] < 0)[..., None], -x, x)
    A, B, C, D, E, F = np.moveaxis(x, -1, 0)
    with np.errstate(all="ignore"):
        delta = A * C - B * B / 4
        delta = np.where(np.abs(delta) <= _UNDECIDED * (np.abs(A * C) + B * B / 4), 0.0, delta)
        terms = np.stack([A * C * F, B * D * E / 4, -A * E * E / 4, -C * D * D / 4, -F * B * B / 4])
        det = terms.sum(axis=0)
        h = np.hypot((A - C) / 2, B / 2)
        lam1 = (A + C) / 2 + h
        lam2 = delta / lam1
        degenerate = (np.abs(det) <= _UNDECIDED * np.abs(terms).sum(axis=0)) | (lam1 <= 0)
        kind = np.where(delta > 0, "ellipse", np.where(delta < 0, "hyperbola", "parabola"))
        kind = np.where((delta > 0) & (det > 0), "imaginary", kind)
        kind = np.where(degenerate, "degenerate", kind)
        real = ~np.isin(kind, ("degenerate", "imaginary"))

        theta = np.arctan2(B, A - C) / 2
        e1 = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
        e2 = np.stack([-np.sin(theta), np.cos(theta)], axis=-1)
        wide = (delta < 0) & (det > 0)
        et, ec = np.where(wide[..., None], e1, e2), np.where(wide[..., None], e2, e1)
        lt, lc = np.where(wide, lam1, lam2), np.where(wide, lam2, lam1)
        gt = (D * et[..., 0] + E * et[..., 1]) / 2
        gc = (D * ec[..., 0] + E * ec[..., 1]) / 2

        s = np.where(real, np.sqrt(-det / lc), np.nan)
        sign = np.where(gt < 0, -1.0, 1.0)
        root = -(gt + sign * s)
        w = -gc / lc
        parabola = kind == "parabola"
        u = np.stack([(F - gc * gc / lc) / root, np.where(parabola, np.nan, root / lt)], axis=-1)
        inward = np.sign(lc)[..., None] * np.stack([-sign, sign], axis=-1)
        latus, ecc = s / np.abs(lc), np.sqrt(2 * h / np.abs(lc))
        f = u + inward * (latus / (1 + ecc))[..., None]
        vertices = u[..., None] * et[..., None, :] + (w[..., None] * ec)[..., None, :]
        foci = f[..., None] * et[..., None, :] + (w[..., None] * ec)[..., None, :]
        a, b = s / np.abs(lt), s / np.sqrt(np.abs(lt * lc))
        centre = np.where((real & ~parabola)[..., None], (-gt / lt)[..., None] * et + w[..., None] * ec, np.nan)
        half = np.where(kind == "hyperbola", np.arctan2(b, a), np.nan)[..., None]
        asymptotes = np.stack([np.cos(half) * et + np.sin(half) * ec, np.cos(half) * et - np.sin(half) * ec], axis=-2)
    none = np.where(real, 1.0, np.nan)

    def out(v: ArrayLike) -> Array:
        return np.asarray(v, np.float64)

    return ConicGeometry(
        kind=np.asarray(kind), centre=out(centre), semi_axes=out(np.stack([a, b], axis=-1)),
        direction=out(et * (inward[..., 0] * none)[..., None]), eccentricity=out(ecc * none),
        semi_latus_rectum=out(latus), vertices=out(vertices), foci=out(foci), asymptote_directions=out(asymptotes),
    )  # fmt: skip


def from_axes(kind: str, centre: ArrayLike, semi_axes: ArrayLike, axis_angle: float) -> Array:
    """Coefficients of an ellipse or hyperbola, normalised.

    Parameters
    ----------
    kind : "ellipse" or "hyperbola"
    centre : (2,) array
    semi_axes : (2,) array
        Along and across the axis at ``axis_angle``, which is the transverse one of a hyperbola.
    axis_angle : float
        From +y toward +z [rad].

    Returns
    -------
    (6,) ndarray
    """
    a, b = np.asarray(semi_axes, float)
    if kind not in ("ellipse", "hyperbola") or not (a > 0 and b > 0):
        raise BenchsimError(
            f"a conic from axes is an ellipse or a hyperbola with positive semi-axes, not {kind!r} with {a}, {b}"
        )
    ca, sa = np.cos(axis_angle), np.sin(axis_angle)
    sign = 1.0 if kind == "ellipse" else -1.0
    frame = np.array([[ca, sa], [-sa, ca]])
    # in units of a the form stays of order one; transform() goes back to the coordinates' own unit and place
    unit = np.array([1.0, 0.0, sign * (a / b) ** 2, 0.0, 0.0, -1.0])
    return transform(unit, a * frame.T, centre)


def matrix(coefficients: ArrayLike) -> Array:
    """Symmetric (…, 3, 3) matrix S with (y, z, 1) S (y, z, 1)ᵀ = 0 on the curve."""
    A, B, C, D, E, F = np.moveaxis(np.asarray(coefficients, float), -1, 0)
    rows = [[A, B / 2, D / 2], [B / 2, C, E / 2], [D / 2, E / 2, F]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def from_matrix(s: ArrayLike) -> Array:
    """Coefficients (…, 6) of a symmetric (…, 3, 3) matrix."""
    m = np.asarray(s, float)
    return np.stack(
        [m[..., 0, 0], 2 * m[..., 0, 1], m[..., 1, 1], 2 * m[..., 0, 2], 2 * m[..., 1, 2], m[..., 2, 2]], axis=-1
    )


def normalise(coefficients: ArrayLike) -> Array:
    """Coefficients with unit Euclidean norm and A + C ≥ 0; zeros stay zeros."""
    c = np.asarray(coefficients, float)
    norm = np.linalg.norm(c, axis=-1, keepdims=True)
    sign = np.where(c[..., :1] + c[..., 2:3] < 0, -1.0, 1.0)
    return np.asarray(sign * c / np.where(norm > 0, norm, 1.0))


def transform_matrix(linear: ArrayLike, shift: ArrayLike = (0.0, 0.0)) -> Array:
    """(6, 6) matrix T with c' = T c for coordinates x' = linear·x + shift; T carries covariances too (T Σ Tᵀ).

    Parameters
    ----------
    linear : float or (2, 2) array
        Scale, or any invertible matrix (a rotation, a similarity, an affine change).
    shift : (2,) array
    """
    m = np.asarray(linear, float)
    inverse = np.eye(2) / m if m.ndim == 0 else np.linalg.inv(m)
    h = np.eye(3)
    h[:2, :2], h[:2, 2] = inverse, -inverse @ np.asarray(shift, float)
    return from_matrix(h.T @ matrix(np.eye(6)) @ h).T


def transform(coefficients: ArrayLike, linear: ArrayLike, shift: ArrayLike = (0.0, 0.0)) -> Array:
    """Coefficients of the same curve in the coordinates x' = linear·x + shift, normalised (:func:`normalise`).

    Parameters
    ----------
    coefficients : (…, 6) array
    linear : float or (2, 2) array
    shift : (2,) array
    """
    return normalise(np.asarray(coefficients, float) @ transform_matrix(linear, shift).T)


def monomials(points: ArrayLike) -> Array:
    """(…, 6) array y², y z, z², y, z, 1 of points (…, 2): the form is linear in its coefficients."""
    y, z = np.moveaxis(np.asarray(points, float), -1, 0)
    return np.stack([y * y, y * z, z * z, y, z, np.ones_like(y)], axis=-1)


def value(coefficients: ArrayLike, points: ArrayLike) -> Array:
    """A y² + B y z + C z² + D y + E z + F at points (…, 2)."""
    return np.asarray(monomials(points) @ np.asarray(coefficients, float))


def gradient(coefficients: ArrayLike, points: ArrayLike) -> Array:
    """Gradient (…, 2) of :func:`value` at points (…, 2)."""
    A, B, C, D, E, _ = np.asarray(coefficients, float)
    y, z = np.moveaxis(np.asarray(points, float), -1, 0)
    return np.stack([2 * A * y + B * z + D, B * y + 2 * C * z + E], axis=-1)


def curvature(coefficients: ArrayLike, points: ArrayLike) -> Array:
    """Curvature of the level line through points (…, 2) [1/unit]; on the curve, that of the conic.

    Positive where the centre of curvature lies on the side that :func:`gradient` points away from: a circle with
    A = C > 0 has +1/radius. Not defined (nan) where the gradient vanishes.
    """
    A, B, C, *_ = np.asarray(coefficients, float)
    g = gradient(coefficients, points)
    gy, gz = g[..., 0], g[..., 1]
    with np.errstate(all="ignore"):
        return np.asarray(2 * (C * gy * gy - B * gy * gz + A * gz * gz) / np.hypot(gy, gz) ** 3)
