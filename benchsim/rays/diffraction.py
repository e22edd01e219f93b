"""Diffraction at the facet's height: the across-line profile by the one-dimensional Fresnel integral.

The 2 mm height is a slit of Fresnel number near 1. At a fixed position t along the facet the geometric hit is
q(h) ≈ q₀ + q₁ h, and light that goes to q instead leaves the mirror at an angle that adds the phase

    Φ(h; q) = k c ((q₀ − q) h + q₁ h²/2),      U(q) = ∫ A(h) exp(iΦ) dh,      A² the light per height,

k = 2π/λ and c the turn along the height per mm of q (1/distance, foreshortened). q₁ holds the wavefront's curvature.
Along the facet's width the rotation averages the phase away: nodes in t add as intensities. Goodman, Introduction to
Fourier Optics, section 4.2, with the chirp taken from the geometric ray map. The paraxial kernel limits it to
|q| well below the distance.

The profile's tails fall as 1/q², so its variance is infinite and its mean is the limit over symmetric windows, which
equals the geometric mean: diffraction does not move the centre line. Widths are therefore adaptive
(`profile.adaptive`).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from benchsim.rays.laser import cos_sin
from benchsim.rays.profile import Profiles, interpolation

Array = NDArray[np.float64]

EFFECTS: Mapping[str, tuple[str, ...]] = {"diffraction": ("fresnel", "size_mm")}
"""The amplitude of diffraction where the physics has none."""

LARGEST = 1_000_000
"""Most numbers of the kernel at a time."""

CACHED = 50_000
"""Numbers of a table that is read again and again."""


def effects(tables: Mapping[str, Mapping[str, float]]) -> float:
    """Amplitude of diffraction where the physics has none, of a recording's effects."""
    return tables.get("diffraction", {}).get("fresnel", 0.0)


def scales(nodes: Profiles, wavelength: float, height: float) -> tuple[Array, Array]:
    """Half width of the geometric light and the slit's diffraction scale λ/(c H), per profile, (profile,) [mm]."""
    geometric = 0.5 * np.ptp(nodes.q, axis=(1, 2))
    return geometric, wavelength / (np.abs(nodes.mean(nodes.chirp)) * height)


def fresnel_profile(nodes: Profiles, wavelength: float, height: float, q: Array) -> Array:
    """Irradiance across the trace with diffraction at the height.

    Parameters
    ----------
    nodes : Profiles
        Geometric profiles; at least three nodes in h.
    wavelength, height : float [mm]
        λ, and H of the facet.
    q : (profile, n) array [mm]
        Where to evaluate, on each profile's own line.

    Returns
    -------
    (profile, n) ndarray
        Light per mm² of the board; its integral over all q is the flux.
    """
    half = height / 2
    rule = int(rule_needed(nodes, wavelength, height, q)[0])
    chirp, fine, still = _still(nodes, wavelength, height, rule)
    out = np.empty(q.shape)
    some = max(1, LARGEST // max(1, q.shape[1] * len(fine)))
    for i in range(0, len(q), some):
        p = slice(i, i + some)
        turn = ((-half * chirp[p, None]) * q[p])[..., None] * fine
        c, s = cos_sin(turn)
        field = (c + 1j * s) @ still[p].transpose(0, 2, 1)
        out[p] = (np.abs(chirp[p, None]) / (2 * np.pi)) * (field.real**2 + field.imag**2).sum(axis=2)
    return out


def even_profile(
    nodes: Profiles, wavelength: float, height: float, middle: Array, reach: Array, count: int, rule: int
) -> Array:
    """`fresnel_profile` at evenly spaced offsets, a few times faster.

    Parameters
    ----------
    nodes, wavelength, height
        As there.
    middle, reach : (profile,) array [mm]
        Of the offsets: middle + reach j/count, j from −count to count.
    count : int
    rule : int
        Nodes over the height, at least `rule_needed`; even.

    Returns
    -------
    (profile, 2 count + 1) ndarray
    """
    chirp, fine, still = _still_parts(nodes, wavelength, height, rule, middle)
    per_mm = (0.5 * height * chirp)[:, None] * fine
    # The rule is even and symmetric: of nodes on either side the cosines are equal and the sines opposite.
    half = rule // 2
    upper, lower = still[..., half:], still[..., half - 1 :: -1]
    step = per_mm[:, half:] * (reach / count)[:, None]
    light = np.empty((len(step), 2 * count + 1))
    # A few profiles at a time: the tables of cos and sin then stay in the processor's cache.
    some = max(1, CACHED // ((count + 1) * half))
    for i in range(0, len(light), some):
        p = slice(i, i + some)
        light[p] = _even_light(step[p], upper[p] + lower[p], upper[p] - lower[p], count)
    return np.asarray((np.abs(chirp[:, None]) / (2 * np.pi)) * light)


def _even_light(step: Array, even: Array, odd: Array, count: int) -> Array:
    """Squares of the field at j steps of phase per node, j from −count to count, summed over t: (profile, j).

    Parameters
    ----------
    step : (profile, node) array [rad]
        Of the nodes above the middle.
    even, odd : (profile, 2 t, node) array
        Sum and difference of the field's amplitudes there and at their mirror images, real parts before imaginary ones.
    count : int
    """
    # cos and sin of j steps, from those of half as many by the addition theorem.
    table = np.empty((2, len(step), count + 1, step.shape[1]))
    (c, s), done = table, 1
    c[:, 0], s[:, 0] = 1.0, 0.0
    cos, sin = (x[:, None] for x in cos_sin(step))
    while done <= count:
        more = slice(done, min(2 * done, count + 1))
        here = slice(0, more.stop - done)
        np.subtract(c[:, here] * cos, s[:, here] * sin, out=c[:, more])
        np.add(s[:, here] * cos, c[:, here] * sin, out=s[:, more])
        cos, sin = cos * cos - sin * sin, 2 * sin * cos
        done *= 2
    even, odd = c @ even.transpose(0, 2, 1), s @ odd.transpose(0, 2, 1)
    n = even.shape[-1] // 2
    a, b, x, y = even[..., :n], even[..., n:], odd[..., :n], odd[..., n:]
    # exp(−iθ) (a + ib) on one side, exp(+iθ) on the other: |a + y|² + |b − x|² and |a − y|² + |b + x|².
    both = np.einsum("pjt,pjt->pj", even, even) + np.einsum("pjt,pjt->pj", odd, odd)
    apart = 2 * (np.einsum("pjt,pjt->pj", a, y) - np.einsum("pjt,pjt->pj", b, x))
    return np.asarray(np.concatenate([(both - apart)[:, :0:-1], both + apart], axis=1))


def rule_needed(nodes: Profiles, wavelength: float, height: float, reach: Array, benches: int = 1) -> NDArray[np.intp]:
    """Nodes over the height that the integral needs at offsets up to ``reach`` (profile,) [mm] from the curve.

    The profiles are those of one bench after another, as many of each; one number for each, (bench,).
    """

    def most(values: Array) -> Array:
        return np.asarray(np.abs(values).reshape(benches, -1).max(axis=1))

    # |Φ'| H/2 radians over half the rule's interval need about half as many nodes, and some to converge.
    need = 16 + 0.3 * height * most(_chirp(nodes, wavelength)) * (most(reach) + most(nodes.q))
    return 8 * (need.astype(np.intp) // 8 + 1)


def _chirp(nodes: Profiles, wavelength: float) -> Array:
    # The turn per mm hardly differs over a facet's width; one value per profile serves all its nodes.
    return np.asarray((2 * np.pi / wavelength) * nodes.chirp.mean(axis=(1, 2)))


def _still(nodes: Profiles, wavelength: float, height: float, rule: int) -> tuple[Array, Array, NDArray[np.complex128]]:
    """k c (profile,), the finer rule over the height, and A exp(iΦ) times its weights at q = 0, (profile, t, fine)."""
    chirp, fine, parts = _still_parts(nodes, wavelength, height, rule, np.zeros(len(nodes.q)))
    across = nodes.q.shape[1]
    return chirp, fine, parts[:, :across] + 1j * parts[:, across:]


def _still_parts(
    nodes: Profiles, wavelength: float, height: float, rule: int, middle: Array
) -> tuple[Array, Array, Array]:
    """`_still` at offsets q = middle (profile,), real parts before imaginary ones: (profile, 2 t, fine)."""
    half, chirp = height / 2, _chirp(nodes, wavelength)
    count, across, along = nodes.q.shape
    weight, fine, fine_weight, carry, rise = _rules(along, rule)
    size = ((nodes.weight / (half * weight)).reshape(-1, along) @ carry).reshape(count, across, rule)
    np.sqrt(np.maximum(size, 0.0, out=size), out=size)
    size *= half * fine_weight
    bend = ((chirp[:, None, None] * half) * nodes.q).reshape(-1, along) @ rise
    bend = bend.reshape(size.shape)
    bend -= (half * chirp * middle)[:, None, None] * fine
    parts = np.empty((count, 2, across, rule))
    for part, wave in zip((parts[:, 0], parts[:, 1]), cos_sin(bend), strict=True):
        np.multiply(wave, size, out=part)
    return chirp, fine, parts.reshape(count, 2 * across, rule)


@lru_cache(maxsize=64)
def _rules(along: int, count: int) -> tuple[Array, Array, Array, Array, Array]:
    """Weights of the nodes' rule, the finer rule, and the matrices that carry values at the nodes to it: the values of
    the polynomial through them, and of its antiderivative."""
    legendre = np.polynomial.legendre
    u, rule = legendre.leggauss(along)
    fine, fine_weight = legendre.leggauss(count)
    to_series = np.linalg.inv(legendre.legvander(u, along - 1))
    rise = legendre.legvander(fine, along) @ legendre.legint(np.eye(along)) @ to_series
    return rule, fine, fine_weight, interpolation(u, fine).T, rise.T
