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

import numpy as np
from numpy.typing import NDArray

from benchsim.rays.profile import interpolation
from benchsim.rays.sweep import Profiles

Array = NDArray[np.float64]


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
    legendre = np.polynomial.legendre
    along, half = nodes.q.shape[2], height / 2
    u, rule = legendre.leggauss(along)
    chirp = (2 * np.pi / wavelength) * nodes.chirp.mean(axis=2)
    # |Φ'| H/2 radians over half the rule's interval need about half as many nodes, and some to converge.
    reach = np.max(np.abs(q), initial=0.0) + np.max(np.abs(nodes.q), initial=0.0)
    fine, fine_weight = legendre.leggauss(16 + int(0.6 * half * np.max(np.abs(chirp)) * reach))
    per_height = np.maximum((nodes.weight / (half * rule)) @ interpolation(u, fine).T, 0.0)
    # The antiderivative of q(h), exact for the polynomial through the nodes.
    rise = legendre.legfit(u, np.moveaxis(nodes.q, 2, 0).reshape(along, -1), along - 1)
    bend = half * legendre.legval(fine, legendre.legint(rise)).reshape(*nodes.q.shape[:2], len(fine))
    still = np.sqrt(per_height) * (half * fine_weight) * np.exp(1j * chirp[..., None] * bend)
    out = np.zeros(q.shape)
    for t in range(still.shape[1]):
        field = np.einsum("pqh,ph->pq", np.exp((-1j * half) * (chirp[:, t, None] * q)[..., None] * fine), still[:, t])
        out += (np.abs(chirp[:, t, None]) / (2 * np.pi)) * (field.real**2 + field.imag**2)
    return out
