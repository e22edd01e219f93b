"""Where each trace crosses the arrays.

A prism's trace moves over an array as the heliostat's *other* angle goes wrong (``plant``), so its light on an array is
found by running one angle through its range and comparing the array's lines with what the vector model says of each
(matched filter), then by fitting that angle and the prism's factor to that array alone. The crossing is where u of
``response.sight`` vanishes along the array: where the vector model's trace, the sun's centre, goes through it. Power
and phase are free on each array, so nothing is assumed of how much light gets there.

What can come out, of a prism on an array, in words that :data:`STATES` explains.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from benchsim.arrays.fitting import Fit, Whitener, fit, whitener
from benchsim.arrays.labels import Lines, uneven
from benchsim.arrays.noise import Noise
from benchsim.arrays.plant import Plant, prism
from benchsim.arrays.response import profile, sight

Array = NDArray[np.float64]

STATES = {
    "crosses": "the trace's middle goes through the array between two of its detectors",
    "rim": "the array sees light of the prism, but the trace's middle lies beyond its end or runs along it",
    "dark": "no light of this label above the noise: the trace misses the array, or the prism is blocked or shaded",
    "unresolved": "another label is nearer than 1/T: the light of both is seen, and not whose it is",
}
"""What becomes of a prism on an array."""

RANGE = 15e-3
"""Misalignments are looked for within ± this [rad]."""

THRESHOLD = 36.0
"""χ² by which a template has to lower the misfit to count as light. Noise alone exceeds it with exp(−18) = 1.5e-8 per
independent template: with 200 prisms, two arrays and some 20 templates in 1e-4 of records."""

_GRID = np.linspace(-RANGE, RANGE, 41)

_VAGUE = 0.25
"""A crossing known worse than this fraction of the beam's width along the array is none: the trace runs along it."""


@dataclass(frozen=True)
class Crossing:
    """One prism's trace on one array.

    Attributes
    ----------
    heliostat, kind, array : int
        Indices; into ``KINDS``, into the plant's arrays.
    state : str
        Of :data:`STATES`.
    position, sigma : float
        Coordinate along the array at which the trace crosses it, 1 sigma [mm]; nan without light.
    angle : float
        The other angle that puts it there, all else aligned [rad].
    strength : float
        χ² by which light of this prism lowers the array's misfit.
    """

    heliostat: int
    kind: int
    array: int
    state: str
    position: float
    sigma: float
    angle: float
    strength: float


@dataclass(frozen=True, eq=False)
class Family:
    """How a prism's light moves with the other angle: u and ε at all detectors, quadratic in it.

    The second derivative is all that 15 mrad need: u is off by less than 2e-7 rad, the amplitudes by a common factor of
    1 %.
    """

    miss: Array
    phase: Array
    weight: Array
    profile: CubicSpline
    limit: float
    facets: int

    def misses(self, angle: Array | float) -> Array:
        """u (..., m) at angles (...) [rad]."""
        return _quadratic(self.miss, angle)

    def template(self, angle: Array | float) -> NDArray[np.complex128]:
        """Amplitudes (..., m) up to a factor."""
        u = self.misses(angle)
        height = np.where(np.abs(u) < self.limit, self.profile(np.clip(u, -self.limit, self.limit)), 0.0)
        return _quadratic(self.weight, angle) * height * np.exp(-1j * self.facets * _quadratic(self.phase, angle))


def _quadratic(values: Array, angle: Array | float) -> Array:
    """Parabola through values (3, m) at −RANGE, 0, RANGE."""
    t = np.asarray(angle, float)[..., None] / RANGE
    return values[1] + t * (values[2] - values[0]) / 2 + t * t * ((values[2] + values[0]) / 2 - values[1])


def family(plant: Plant, heliostat: int, kind: int) -> Family:
    """The prism's light as a function of the angle that moves its trace."""
    other = np.eye(2)[1 - kind]
    bodies = [prism(plant, heliostat, kind, t * RANGE * other) for t in (-1, 0, 1)]
    miss, phase, weight, distance = (
        np.array(v) for v in zip(*(sight(b, plant, plant.detectors) for b in bodies), strict=True)
    )
    alpha = float(np.arccos(np.clip(-plant.source @ bodies[1].axis, -1, 1)))
    edge = plant.beam.edge
    spread = 0.5 * plant.prism_height / distance[1].mean() * np.sin(alpha)
    integral = profile(alpha, plant).antiderivative()
    nodes = np.linspace(-edge - spread, edge + spread, 121)
    low, high = (integral(np.clip(nodes + k * spread, -edge, edge)) for k in (-1, 1))
    return Family(
        miss,
        np.unwrap(phase, axis=0),
        weight,
        CubicSpline(nodes, (high - low) / (2 * spread)),
        edge + spread,
        plant.facets,
    )


def crossings_of(plant: Plant, lines: Lines, noise: Noise, heliostat: int, kind: int) -> list[Crossing]:
    """What becomes of one prism on each array.

    Parameters
    ----------
    plant, lines, noise
    heliostat, kind : int
    """
    if not lines.resolved[heliostat, kind]:
        return [_none(heliostat, kind, array, "unresolved") for array in range(len(plant.arrays))]
    light = family(plant, heliostat, kind)
    density = noise.density(plant.rates[heliostat, kind], uneven(lines, plant, heliostat, kind))
    gain = float(lines.gain[heliostat, kind])
    out = []
    for array in range(len(plant.arrays)):
        on = np.flatnonzero(plant.member == array)
        white = whitener(density[np.ix_(on, on)], gain)
        data = white(lines.amplitude[heliostat, kind, on])
        strength = strengths(data, white(light.template(_GRID)[:, on]))
        best = int(np.argmax(strength))
        if strength[best] < THRESHOLD:
            out.append(_none(heliostat, kind, array, "dark", float(strength[best])))
            continue
        found = fit([data], partial(_on_array, light, white, on), _GRID[[best]], RANGE)
        out.append(_crossing(plant, light, found, heliostat, kind, array, on, float(strength[best])))
    return out


def _on_array(light: Family, white: Whitener, on: NDArray[np.int_], theta: Array) -> list[NDArray[np.complex128]]:
    """Whitened template of one array's detectors at an angle (1,)."""
    return [white(light.template(theta[0])[on])]


def strengths(data: NDArray[np.complex128], templates: NDArray[np.complex128]) -> Array:
    """χ² by which each template (g, m), freely scaled, lowers the misfit of whitened data (m,)."""
    norm = np.sum(np.abs(templates) ** 2, axis=1)
    return np.abs(templates.conj() @ data) ** 2 / np.where(norm > 0, norm, np.inf)


def _crossing(
    plant: Plant,
    light: Family,
    found: Fit,
    heliostat: int,
    kind: int,
    array: int,
    on: NDArray[np.int_],
    strength: float,
) -> Crossing:
    """The fitted angle as a place on the array."""
    angle, sigma = float(found.angles[0]), float(np.sqrt(found.covariance[0, 0]))
    along = plant.along[on]
    place, slope = zero(along, light.misses(angle)[on])
    step = 1e-4
    moved = [zero(along, light.misses(angle + t)[on])[0] for t in (-step, step)]
    spread = sigma * abs(moved[1] - moved[0]) / (2 * step)
    width = plant.beam.edge / abs(slope) if slope else np.inf
    inside = along[0] <= place <= along[-1]
    known = np.isfinite(spread) and spread < _VAGUE * width and abs(angle) < RANGE
    state = "crosses" if inside and known else "rim"
    return Crossing(heliostat, kind, array, state, place, float(spread), angle, strength)


def zero(along: Array, miss: Array) -> tuple[float, float]:
    """Where u vanishes along an array, and du/dalong there; beyond the ends by the last two detectors' line."""
    nearest = int(np.argmin(np.abs(miss)))
    changes = np.flatnonzero(miss[:-1] * miss[1:] <= 0)
    i = int(changes[np.argmin(np.abs(changes - nearest))]) if len(changes) else min(nearest, len(miss) - 2)
    slope = (miss[i + 1] - miss[i]) / (along[i + 1] - along[i])
    return (float(along[i] - miss[i] / slope), float(slope)) if slope else (np.nan, 0.0)


def _none(heliostat: int, kind: int, array: int, state: str, strength: float = np.nan) -> Crossing:
    nan = float("nan")
    return Crossing(heliostat, kind, array, state, nan, nan, nan, strength)
