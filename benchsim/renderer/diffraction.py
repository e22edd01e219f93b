"""Fresnel diffraction at the mirror's height, as a density to sample.

The mirror is 2 mm high and about 2 m from the board: its Fresnel number is near 1, and the line on the board is 2.0 mm
wide where geometric optics makes it 3.0 mm. For light reflected at the position t along the facet, the amplitude over
the height h is A(h) = exp(−α h² + β h) (the Gaussian beam), and the path from the virtual source over h to the board
differs by (s²/2)(κ + 1/D)(h − h')² from its extremum, where h' is the height at which the geometric ray to that place
of the board leaves the facet's plane, s the sine between ray and axis, κ the wavefront's curvature and D the distance
to the board. With ν = s² (κ + 1/D)/λ the density of light over h' is

    p(h') = ν |U|² / ∫A² dh,      U(h') = ∫ A(h) exp(iπν (h − h')²) dh   over |h| ≤ H/2

(Goodman, Introduction to Fourier Optics, 4.3; U has a closed form in the Faddeeva function). So diffraction is drawn
by tracing the geometric ray from (t, h'), h' from p instead of h from the facet. Far out p falls as 1/h'², fringes
averaged.

What bends the light beyond a curvature (coma, say) adds 2πγ h³/3 to the phase; U is then a quadrature (`bent`).

Not valid where the facet's ends or its neighbour matter across the trace (they act along it, where the sweep blurs
everything), nor for heights of a few wavelengths.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import wofz

Array = NDArray[np.float64]

REACH = 400.0
"""Largest |h'| that is sampled, in heights of the mirror; about 1e-4 of the light is diffracted farther."""


def amplitude(heights: Array, half: float, alpha: float, beta: Array, nu: Array) -> NDArray[np.complex128]:
    """U(h') of the module's head but for its phase exp(iπν h'²), in closed form.

    Parameters
    ----------
    heights : array [mm]
        h'.
    half : float
        H/2 [mm].
    alpha, beta : float, array
        Of the Gaussian amplitude over h [1/mm², 1/mm].
    nu : array
        ν > 0 [1/mm²].

    Returns
    -------
    ndarray
        [mm], of the broadcast shape of ``heights``, ``beta`` and ``nu``.
    """
    p = alpha - 1j * np.pi * nu
    q = beta - 2j * np.pi * nu * heights
    root = np.sqrt(p)

    def end(h: float) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
        # exp(q²/4p) erf(z) = sign exp(q²/4p) − sign exp(q h − p h²) w(sign i z), z = √p (h − q/2p); nothing overflows
        # with Re(sign z) ≥ 0.
        z = root * (h - q / (2 * p))
        sign = np.where(z.real >= 0, 1.0, -1.0)
        return -sign * np.exp(q * h - p * h * h) * wofz(1j * sign * z), sign

    upper, upper_sign = end(half)
    lower, lower_sign = end(-half)
    crossing = upper_sign - lower_sign
    inside = crossing * np.exp(np.where(crossing != 0, q * q / (4 * p), 0))
    return np.sqrt(np.pi) / (2 * root) * (upper - lower + inside)


def bent(heights: Array, half: float, alpha: float, beta: Array, nu: Array, gamma: Array) -> NDArray[np.complex128]:
    """U(h') as `amplitude` has it, but with the phase 2πγ h³/3 over the height: (ν, γ, β, h').

    ``heights``, ``beta``, ``nu`` and ``gamma`` [1/mm³] are one-dimensional. Gauss-Legendre quadrature, exact while
    the phase over the mirror turns by less than some tens of cycles.
    """
    turns = 2 * half * nu.max() * (np.abs(heights).max() + half)
    x, w = np.polynomial.legendre.leggauss(int(32 + 4 * turns))
    h = half * x
    source = half * w * np.exp(-alpha * h * h + beta[:, None] * h)
    bend = np.exp(2j * np.pi / 3 * gamma[:, None] * h**3)
    out = np.empty((len(nu), len(gamma), len(beta), len(heights)), complex)
    for k, v in enumerate(nu):
        wave = np.exp(1j * np.pi * v * h * (h - 2 * heights[:, None]))
        out[k] = ((bend[:, None, :] * source).reshape(-1, len(h)) @ wave.T).reshape(out.shape[1:])
    return out


@dataclass(frozen=True)
class Pattern:
    """Density over h' for a range of ν and β, ready to be sampled with weights.

    A uniform number v in cell i = ⌊v n⌋ stands for h' between ``edges[i]`` and ``edges[i + 1]``, uniform within, with
    the weight Σ_k ``weights[a, i, k]`` x^k at the nearest ``nu[a]``, where x runs from −1 to 1 over ``beta`` = (low,
    high). The mean weight over v is ∫A² dh / H with A(0) = 1. Nearest is enough, since ν changes little along a trace
    and moves no light sideways; β does move it. So does γ, between whose nodes the sampling chooses at random in
    proportion to their nearness: ``weights`` then run through all ``gamma`` for every ``nu``.
    """

    edges: Array
    weights: Array
    nu: Array
    beta: tuple[float, float]
    gamma: Array | None = None


BEND_STEP = 0.1
"""Distance of γ's nodes as phase at the mirror's edge [rad]; what is bent less than a hundredth of it is not bent."""

MOST_BENDS = 24
"""Nodes of γ at most."""


def pattern(
    height: float,
    alpha: float,
    nu_range: tuple[float, float],
    beta_range: tuple[float, float],
    cells: int = 1024,
    gamma_range: tuple[float, float] = (0.0, 0.0),
) -> Pattern:
    """Tabulate the diffraction of a mirror.

    Parameters
    ----------
    height : float
        H [mm].
    alpha : float
        Of the amplitude exp(−α h² + β h) [1/mm²].
    nu_range, beta_range : (low, high)
        Ranges along the trace [1/mm², 1/mm].
    cells : int
        Cells over h'.
    gamma_range : (low, high)
        Range of γ [1/mm³].

    Returns
    -------
    Pattern
    """
    half = height / 2
    nu = np.linspace(*nu_range, 16)
    x = np.cos(np.pi * (np.arange(8) + 0.5) / 8)
    beta = beta_range[0] + (x + 1) / 2 * (beta_range[1] - beta_range[0])
    edge_phase = 2 * np.pi / 3 * half**3
    gamma, nodes, bends = None, nu, np.zeros(len(nu))
    if max(abs(g) for g in gamma_range) * edge_phase > 0.01 * BEND_STEP:
        count = 2 + int((gamma_range[1] - gamma_range[0]) * edge_phase / BEND_STEP)
        gamma = np.linspace(*gamma_range, min(count, MOST_BENDS))
        nu = np.linspace(*nu_range, max(8, 16 // len(gamma)))
        nodes, nu, bends = nu, np.repeat(nu, len(gamma)), np.tile(gamma, len(nu))
    # A bent phase sends what leaves the two edges aside, both to the same side.
    aside = (bends / nu * half**2)[:, None, None]
    core = 3 * half + 3 / np.sqrt(nu[0]) + float(np.abs(aside).max())
    fine = np.linspace(-core, core, 4097)
    if gamma is not None:
        u = bent(fine, half, alpha, beta, nodes, gamma).reshape(-1, len(beta), len(fine))
    else:
        u = amplitude(fine, half, alpha, beta[:, None], nu[:, None, None])
    density = nu[:, None, None] * np.abs(u) ** 2

    # Beyond the core only the two edges are seen, A(±H/2)²/(4π²ν (h' ∓ H/2)²) each, fringes averaged.
    def edge(b: float) -> Array:
        return np.exp(2 * (-alpha * b * b + beta * b)) / (4 * np.pi**2 * nu[:, None])

    def beyond(h: Array, side: float) -> Array:
        """Light farther out than |h'| = h on one side."""
        return edge(half)[..., None] / (h - side * (half + aside)) + edge(-half)[..., None] / (
            h + side * (half - aside)
        )

    far = np.geomspace(core, REACH * height, 400)
    steps = np.diff(fine) * (density[..., 1:] + density[..., :-1]) / 2
    outer = beyond(far, 1.0)
    inner = beyond(far, -1.0)
    cumulative = np.concatenate(
        [
            inner[..., ::-1],
            inner[..., :1] + np.cumsum(steps, axis=-1),
            inner[..., :1] + steps.sum(axis=-1, keepdims=True) + outer[..., :1] - outer[..., 1:],
        ],
        axis=-1,
    )
    grid = np.concatenate([-far[::-1], fine[1:], far[1:]])
    g, w = np.polynomial.legendre.leggauss(32)
    power = half * (np.exp(2 * (-alpha * (half * g) ** 2 + beta[:, None] * half * g)) @ w)
    total = steps.sum(axis=-1) + outer[..., 0] + inner[..., 0]
    cumulative *= (power / (total * height))[..., None]

    # Cells of equal v, finer than their share of the light in the tails: they see little light but much of the board.
    mean = cumulative.mean(axis=(0, 1))
    v = np.linspace(0.0, 1.0, cells + 1)
    share = v * v * (3 - 2 * v)
    edges = np.interp(mean[0] + share * (mean[-1] - mean[0]), mean, grid)
    at_edges = np.apply_along_axis(lambda c: np.interp(edges, grid, c), -1, cumulative)
    weights = np.diff(at_edges, axis=-1) * cells
    for degree in (3, 7):
        fit = np.linalg.pinv(np.vander(x, degree + 1, increasing=True)) @ weights
        if np.abs(np.vander(x, degree + 1, increasing=True) @ fit - weights).max() < 1e-3 * weights.max():
            break
    return Pattern(edges, np.moveaxis(fit, 1, 2), nodes, beta_range, gamma)
