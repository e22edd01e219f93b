"""The sun's shape: radiance over the angle from its centre, and the circular Gaussian that stands for it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.special import j0

Array = NDArray[np.float64]

DISC = 4.65e-3
"""Half angle of the disc [rad]."""
AUREOLE = 43.6e-3
"""To where Buie's circumsolar light reaches [rad]."""

LADDER = (0.2, 0.28, 0.38, 1.4, 4.2)
"""Sigmas of the circular Gaussians whose sum stands for a shape, over the angle at which its radiance is half of the
centre's. Three narrow ones make a disc, by weights of either sign, two an aureole. One alone is 20 to 60 % off at the
centre of pillbox and Buie's shapes, four lose 2 to 4 % of the light to the aureole or keep it; each takes time."""

BLUR = 1.5e-3
"""What mirrors blur the shape by at least [rad]: finer detail of it is not asked for."""


@dataclass(frozen=True)
class SunShape:
    """Radiance by angle.

    Attributes
    ----------
    name : str
    angle, radiance : (k,)
        From the centre [rad], growing, and in any unit, straight between. One angle: a Gaussian of that sigma.
    """

    name: str
    angle: Array
    radiance: Array

    @cached_property
    def sigma(self) -> float:
        """Standard deviation in one direction [rad]: half of ⟨θ²⟩ over the solid angle, from the pieces' moments."""
        if len(self.angle) == 1:
            return float(self.angle[0])
        a, b = self.angle[:-1], self.angle[1:]
        slope = np.diff(self.radiance) / (b - a)
        start = self.radiance[:-1] - slope * a

        def moment(k: int) -> float:
            one, two = k + 1, k + 2
            return float(np.sum(start * (b**one - a**one) / one + slope * (b**two - a**two) / two))

        return float(np.sqrt(moment(3) / moment(1) / 2))

    @cached_property
    def half(self) -> float:
        """Largest angle at which the radiance is above half of its largest [rad]; a Gaussian's sigma."""
        fine = np.unique(np.r_[self.angle, np.linspace(self.angle[0], self.angle[-1], 10001)])
        radiance = np.interp(fine, self.angle, self.radiance)
        return float(fine[radiance > 0.5 * radiance.max()].max())

    @cached_property
    def gaussians(self) -> tuple[Array, Array]:
        """Weights, whose sum is 1, and sigmas [rad] of circular Gaussians whose sum stands for the shape, (m,) each.

        Least squares of the transform, as far as `BLUR` lets it be seen. Blurred by 1.5 mrad (1 sigma in one direction)
        pillbox and Buie's shapes are met to 0.7 % of their centre, by 2 mrad and more to 0.3 %; what lies within any
        angle to 0.9 % of the light. A Gaussian is itself.
        """
        if len(self.angle) == 1:
            return np.ones(1), self.angle
        fine = np.unique(np.r_[self.angle, np.linspace(self.angle[0], self.angle[-1], 1001)])
        ring = np.gradient(fine) * np.interp(fine, self.angle, self.radiance) * fine
        sigma = np.array(LADDER) * self.half
        frequency = np.linspace(0, 1.2 / BLUR, 801)[1:]
        seen = j0(2 * np.pi * frequency[:, None] * fine) @ (ring / ring.sum())
        each = np.exp(-2 * (np.pi * frequency[:, None] * sigma) ** 2)
        weight = (np.sqrt(frequency) * np.exp(-2 * (np.pi * frequency * BLUR) ** 2))[:, None]
        rest = np.linalg.lstsq(weight * (each[:, 1:] - each[:, :1]), weight[:, 0] * (seen - each[:, 0]), rcond=None)[0]
        return np.r_[1 - rest.sum(), rest], sigma

    def quantiles(self, count: int = 4096) -> Array:
        """Angles within which ``count`` even steps of the part of the light, 0 to 1, are reached [rad].

        A Gaussian's sigma alone, as `angle`. Pieces are cut finely enough that radiance times angle is straight there
        to 1e-4 of the light.
        """
        if len(self.angle) == 1:
            return self.angle
        fine = np.unique(np.concatenate([np.linspace(a, b, 33) for a, b in pairwise(self.angle)]))
        fine = np.unique(np.r_[fine, np.linspace(self.angle[0], self.angle[-1], 4 * count)])
        ring = np.interp(fine, self.angle, self.radiance) * fine
        power = np.r_[0.0, np.cumsum(np.diff(fine) * (ring[1:] + ring[:-1]) / 2)]
        lit = np.r_[True, np.diff(power) > 0]
        return np.interp(np.linspace(0, 1, count), power[lit] / power[-1], fine[lit])


def gaussian(sigma: float) -> SunShape:
    """A Gaussian of that standard deviation in one direction [rad]."""
    return SunShape("gaussian", np.array([sigma]), np.ones(1))


def pillbox(half: float = DISC) -> SunShape:
    """A disc evenly bright to its half angle [rad]."""
    return SunShape("pillbox", np.array([0.0, half]), np.ones(2))


def buie(csr: float) -> SunShape:
    """Disc and aureole by the circumsolar ratio: Buie et al. 2003, https://doi.org/10.1016/S0038-092X(03)00125-7.

    φ = cos(0.326 θ)/cos(0.308 θ) on the disc and e^κ θ^γ outside (θ in mrad), κ = 0.9 ln(13.5 χ) χ^−0.3,
    γ = 2.2 ln(0.52 χ) χ^0.43 − 0.1, with the stated ratio for χ: what the profile then has differs a little from it.
    """
    disc = np.linspace(0, DISC, 200)
    ring = np.geomspace(DISC * (1 + 1e-9), AUREOLE, 2000)
    kappa = 0.9 * np.log(13.5 * csr) * csr**-0.3
    gamma = 2.2 * np.log(0.52 * csr) * csr**0.43 - 0.1
    inside = np.cos(326 * disc) / np.cos(308 * disc)
    return SunShape("buie", np.r_[disc, ring], np.r_[inside, np.exp(kappa) * (1e3 * ring) ** gamma])
