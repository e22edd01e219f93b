"""What arrays can tell of aligned heliostats, before anything is recorded: the lines expected, and the noise stated.

A prism's line at a detector is that of `response` with the power that sun, mirror and facets give it,

    z = E ρ A N/(2π) · w F(u) exp(−iNε)

(direct irradiance E, reflectance ρ, facet's area A, N facets; w, u, ε of `response.sight`). Its trace tells the *other*
angle, with the variance of a least-squares fit to one record in which the prism's power and phase are free. All prisms
of all heliostats are worked on at once, and only where light falls.

Inner products of lines and of their derivatives, over the noise, add over detectors: `Sums` keeps them by array, so
that a search for places computes each array once (`placing`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import RectBivariateSpline

from benchsim.arrays.crossings import THRESHOLD
from benchsim.arrays.fitting import STEP
from benchsim.arrays.plant import Assumptions, Beam, Plant
from benchsim.arrays.signals import flicker_density, white_level

Array = NDArray[np.float64]

_ALPHA = np.radians(np.linspace(8.0, 172.0, 83))
"""Half-angles of cones for which F is tabulated: prisms stand at 30 to 150° to the sun."""

_GAUSS = 0.5 / np.sqrt(3.0)
"""Of two nodes along a facet, in parts of its length."""


@dataclass(frozen=True, eq=False)
class Sums:
    """Inner products over the detectors of each array, of P prisms at A arrays.

    Attributes
    ----------
    hh, dd : (P, A)
        Of the line with itself, and of its derivative by the other angle [s, s/rad²], the noise diagonal.
    hd : (P, A) complex
        Of both [s/rad].
    bh, bd : (P, A) complex
        Of the flicker that all detectors share with either.
    bb : (A,)
    crosses : (P, A) of bool
        Whether the trace's middle goes through the array.
    common : (P,)
        Density of the shared flicker at the labels [1/Hz].
    """

    hh: Array
    dd: Array
    hd: NDArray[np.complex128]
    bh: NDArray[np.complex128]
    bd: NDArray[np.complex128]
    bb: Array
    crosses: NDArray[np.bool_]
    common: Array

    def gathered(self, groups: ArrayLike) -> Sums:
        """Of groups of arrays (G, k), each taken together."""
        pick = np.asarray(groups)
        hh, dd, hd, bh, bd = (x[:, pick].sum(axis=-1) for x in (self.hh, self.dd, self.hd, self.bh, self.bd))
        through = np.asarray(self.crosses[:, pick].any(axis=-1), bool)
        return Sums(hh, dd, hd, bh, bd, self.bb[pick].sum(axis=-1), through, self.common)

    def beside(self, other: Sums) -> Sums:
        """Of two sets of arrays, pair by pair; one of them may be a single array."""
        names = ("hh", "dd", "hd", "bh", "bd", "bb")
        hh, dd, hd, bh, bd, bb = (getattr(self, k) + getattr(other, k) for k in names)
        return Sums(hh, dd, hd, bh, bd, bb, np.logical_or(self.crosses, other.crosses), self.common)

    def only(self, array: int) -> Sums:
        """Of one array."""
        return self.gathered([[array]])

    def values(self) -> tuple[Array, Array]:
        """Variance of the other angle [rad² s] and strength [1/s], (P, A), by each array alone.

        Both for a record of a second: variance falls, and strength grows with its length.
        """
        common = self.common[:, None]
        share = common / (1 + common * self.bb)
        hh = self.hh - share * np.abs(self.bh) ** 2
        dd = self.dd - share * np.abs(self.bd) ** 2
        hd = self.hd - share * self.bh.conj() * self.bd
        with np.errstate(divide="ignore", invalid="ignore"):
            information = np.where(hh > 0, dd - np.abs(hd) ** 2 / hh, 0.0)
            return np.where(information > 1e-9 * dd, 1 / information, np.inf), hh


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """What one record tells of n aligned heliostats.

    Attributes
    ----------
    sigma : (n, 2)
        Of (ε, φ), elevation and azimuth [rad]; infinite without light.
    strength : (n, 2)
        χ² of the light of the prism that tells the angle.
    crosses : (n, 2) of bool
        Whether that prism's trace goes through an array.
    """

    sigma: Array
    strength: Array
    crosses: NDArray[np.bool_]

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(n,): both traces cross an array, with light above the noise."""
        return np.asarray((self.crosses & (self.strength > THRESHOLD)).all(axis=1))


def sensitivity(plant: Plant, assumptions: Assumptions, transmission: Array | None = None) -> Sensitivity:
    """What one record of a plant tells of its heliostats, were they aligned.

    Parameters
    ----------
    plant, assumptions
    transmission : (n,) array, optional
        Part of each heliostat's light that is neither shaded, blocked nor absorbed.
    """
    s = sums(plant, assumptions, transmission).gathered([np.arange(len(plant.arrays))])
    variance, strength = s.values()
    n = len(plant.heliostats)
    # The elevation prism comes first and tells the azimuth.
    sigma = np.sqrt(variance / plant.duration).reshape(n, 2)[:, ::-1]
    crosses = s.crosses.any(axis=1).reshape(n, 2)[:, ::-1]
    return Sensitivity(sigma, (strength * plant.duration).reshape(n, 2)[:, ::-1], crosses)


def sums(
    plant: Plant, assumptions: Assumptions, transmission: Array | None = None, goes_on: NDArray[np.bool_] | None = None
) -> Sums:
    """Inner products of all prisms' lines: of heliostats in turn, each one's elevation prism first.

    Detectors of one array have to follow one another. ``goes_on`` (A,): whether the next array is the same one's next
    part, so that a trace may cross between both.
    """
    a = assumptions
    frames, source = plant.frames, plant.source
    rates = plant.rates.ravel()
    axis = frames[:, 1:].reshape(-1, 3)
    normal = np.repeat(frames[:, 0], 2, axis=0)
    centre = np.repeat(plant.heliostats, 2, axis=0)
    alpha = np.arccos(np.clip(-axis @ source, -1, 1))
    place = plant.detectors[None] - centre[:, None]
    miss, _, _, distance = _sight(place, axis[:, None], normal[:, None], source, plant.prism_radius)
    spread = 0.5 * plant.prism_height / distance * np.sin(alpha)[:, None]
    prism, at = np.nonzero(np.abs(miss) < plant.beam.edge + spread + STEP)
    # The other angle turns a prism about the other prism's axis.
    other = frames[:, [2, 1]].reshape(-1, 3)[prism]
    line = [_line(plant, place[prism, at], axis[prism], normal[prism], other, t * STEP) for t in (-1, 0, 1)]
    power = a.direct_irradiance * a.reflectance * plant.facets / (2 * np.pi)
    power *= plant.prism_height * 2 * plant.prism_radius * np.tan(np.pi / plant.facets)
    gain = power * (1.0 if transmission is None else transmission[prism // 2])
    h, d = gain * line[1], gain * (line[2] - line[0]) / (2 * STEP)
    # Mean of 1/B² over detectors whose steady light B is spread evenly.
    steady = a.background * np.sqrt(1 - a.background_spread**2)
    own = white_level(a, steady) + steady**2 * flicker_density(a, a.flicker_local, rates[prism])
    own = own + (a.gain_spread * np.abs(h)) ** 2 * plant.duration
    count = len(plant.arrays)
    into = prism * count + plant.member[at]

    def total(x: NDArray[np.complex128]) -> NDArray[np.complex128]:
        size = len(rates) * count
        real = np.bincount(into, np.real(x) / own, size)
        return np.asarray((real + 1j * np.bincount(into, np.imag(x) / own, size)).reshape(-1, count))

    level = float(white_level(a, steady)) + steady**2 * float(
        np.mean(np.atleast_1d(flicker_density(a, a.flicker_local, rates)))
    )
    ends = np.flatnonzero(np.diff(plant.member, prepend=-1))
    turns = np.diff(np.sign(miss), axis=1) != 0
    turns[:, ends[1:][~(np.zeros(count, bool) if goes_on is None else goes_on)[:-1]] - 1] = False
    through = np.add.reduceat(np.concatenate([turns, np.zeros((len(turns), 1), bool)], axis=1), ends, axis=1) > 0
    return Sums(
        total(h * h.conj()).real,
        total(d * d.conj()).real,
        total(h.conj() * d),
        total(steady * h),
        total(steady * d),
        np.bincount(plant.member, minlength=count) * (steady**2 / level),
        through,
        flicker_density(a, a.flicker_common, rates),
    )


def _line(plant: Plant, place: Array, axis: Array, normal: Array, other: Array, angle: float) -> NDArray[np.complex128]:
    """Amplitudes (k,), up to the power, of prisms turned by a small angle about ``other``."""
    a, n = (v + angle * np.cross(other, v) for v in (axis, normal))
    a, n = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (a, n))
    miss, phase, weight, distance = _sight(place, a, n, plant.source, plant.prism_radius)
    alpha = np.arccos(np.clip(-a @ plant.source, -1, 1))
    half = plant.prism_height / distance * np.sin(alpha) * _GAUSS
    table, edge = _profiles(plant.beam, plant.facets), plant.beam.edge
    light = sum(
        np.where(np.abs(u) < edge, table.ev(alpha, np.clip(u, -edge, edge)), 0.0) for u in (miss - half, miss + half)
    )
    return np.asarray(weight * light / 2 * np.exp(-1j * plant.facets * phase))


def _sight(place: Array, axis: Array, normal: Array, source: Array, radius: float) -> tuple[Array, Array, Array, Array]:
    """`response.sight` of many prisms at once: u, ε, weight and D of ``place`` (..., 3), seen from their centres."""
    side = np.cross(axis, normal)
    y_n, y_side, y_a = ((place * v).sum(axis=-1) for v in (normal, side, axis))
    s_n, s_side, s_a = (v @ source for v in (normal, side, axis))
    sun = np.arctan2(s_side, s_n)
    phase = np.zeros_like(y_n)
    # Two steps of the four there: each gains a factor radius/distance.
    for _ in range(2):
        out_n, out_side = y_n - radius * np.cos(phase), y_side - radius * np.sin(phase)
        phase = sun + 0.5 * np.mod(np.arctan2(out_side, out_n) - sun + np.pi, 2 * np.pi) - 0.5 * np.pi
    across = np.hypot(out_n, out_side)
    distance = np.hypot(across, y_a)
    miss = np.arctan2(across, y_a) - np.arccos(np.clip(-s_a, -1, 1))
    on_facet = (np.cos(phase) * out_n + np.sin(phase) * out_side) / distance
    on_detector = -(out_n * normal[..., 0] + out_side * side[..., 0] + y_a * axis[..., 0]) / distance
    return miss, phase, np.maximum(on_facet, 0) * np.maximum(on_detector, 0) / distance**2, distance


@lru_cache(maxsize=4)
def _profiles(beam: Beam, facets: int) -> RectBivariateSpline:
    """F of `response.profile`, by the cone's half-angle and u."""
    u = beam.edge * np.linspace(-1, 1, 81)
    chord = np.linspace(-1, 1, 65)[1:-1]
    both = np.sin(_ALPHA)[:, None] * np.sin(_ALPHA[:, None] + u)
    longest = 2 * np.arcsin(np.minimum(np.sin(beam.edge / 2) / np.sqrt(both), 1.0))
    psi = longest[..., None] * chord
    square = 4 * (np.sin(u / 2)[:, None] ** 2 + both[..., None] * np.sin(psi / 2) ** 2)
    light = beam.radiance(square) * np.cos(0.5 * facets * psi)
    return RectBivariateSpline(_ALPHA, u, light.sum(axis=-1) * longest * (chord[1] - chord[0]))
