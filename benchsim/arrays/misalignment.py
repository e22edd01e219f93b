"""A heliostat's misalignment from its two labels.

Two ways, of which the first is the paper's (section 4.3) and begins the second:

- :func:`from_crossings`: the (ε, φ) whose traces, by the vector model, cross the arrays where they were seen to cross;
- :func:`measure`: the (ε, φ) that make the vector model's light, as a whole, agree best with both prisms' lines at all
  detectors, with one power and one phase per prism. It uses what crossings leave out, a trace that runs along an array
  or beyond its end, and reaches the Cramér–Rao bound.

Both give the covariance of (ε, φ). What can come out is in :data:`OUTCOMES`: a heliostat that cannot be measured is an
outcome, never an exception, and says why.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from benchsim.arrays.crossings import RANGE, THRESHOLD, Crossing, Family, crossings_of, family, zero
from benchsim.arrays.fitting import fit, whitener
from benchsim.arrays.labels import Lines, separate, uneven
from benchsim.arrays.noise import Noise, fit_noise
from benchsim.arrays.plant import KINDS, Plant, prism
from benchsim.arrays.response import response, sight

Array = NDArray[np.float64]

OUTCOMES = {
    "measured": "both traces cross an array: both angles, with their covariance",
    "steered": "light of both, but a trace crosses no array or runs along one: both angles, one from its beam's rim",
    "one angle": "one trace crosses an array: the angle that moves it is known, the other is not",
    "unresolved": "a label is nearer than 1/T to another: measure longer, or turn one of the two prisms otherwise",
    "absent": "no light, where any misalignment within 10 mrad would give some: blocked, at rest, or further off",
    "dark": "no light: blocked, or off so that the traces miss, perhaps within 10 mrad; the arrays cannot tell which",
    "contradictory": "light of both, but the lines contradict the vector model: geometry or light is not as stated",
}
"""What can be said of a heliostat."""

STATED_RANGE = 10e-3
"""Misalignments that a heliostat may have before anything is measured [rad], for telling absent from missed."""

ALARM = 1e-6
"""Chance at which a heliostat that the model describes is called contradictory."""


FAINT = 0.05
"""Of the brightness that prisms have in the middle: what is fainter is others' light in a label (2 % at most where near
heliostats are blocked), and no prism is so soiled."""


@dataclass(frozen=True, eq=False)
class Measurement:
    """What the arrays say of one heliostat.

    Attributes
    ----------
    heliostat : int
    outcome : str
        Of :data:`OUTCOMES`.
    misalignment : (2,) ndarray
        (ε, φ), elevation and azimuth [rad]; nan where unknown.
    covariance : (2, 2) ndarray
        [rad²]; infinite on the diagonal where unknown.
    crossings : tuple of Crossing
        Of both prisms on both arrays.
    by_crossings : tuple of two arrays, or None
        Misalignment and covariance of :func:`from_crossings`.
    chi2, dof
        Of the lines against the vector model; nan and 0 if not fitted.
    says : str
        One sentence.
    """

    heliostat: int
    outcome: str
    misalignment: Array
    covariance: Array
    crossings: tuple[Crossing, ...]
    by_crossings: tuple[Array, Array] | None
    chi2: float
    dof: int
    says: str


def measure(samples: Array, plant: Plant) -> tuple[list[Measurement], Lines, Noise]:
    """Misalignments of all heliostats from one record.

    Parameters
    ----------
    samples : (m, samples) array
        Of all detectors [W/m², or any unit].
    plant : Plant
        Nominal geometry, labels, sampling.

    Returns
    -------
    measurements : list of Measurement
    lines : Lines
    noise : Noise

    Raises
    ------
    BenchsimError
        If the samples are not the plant's in number or not finite.
    """
    lines = separate(samples, plant)
    noise = fit_noise(lines, plant)
    found = [_one(plant, lines, noise, k) for k in range(len(plant.heliostats))]
    powers = [power for one, of in found if one.outcome != "contradictory" for power in of.values()]
    # all prisms are alike: where some are seen, how bright the others would be is known
    typical = float(np.median(powers)) if powers else 0.0
    for k, (one, of) in enumerate(found):
        faint = [kind for kind, power in of.items() if power < FAINT * typical]
        if faint and one.outcome != "contradictory":
            found[k] = _one(plant, lines, noise, k, faint)
    return [_absent(plant, lines, noise, one, typical) for one, _ in found], lines, noise


def _one(
    plant: Plant, lines: Lines, noise: Noise, k: int, dark: Sequence[int] = ()
) -> tuple[Measurement, dict[int, float]]:
    """One heliostat, and the powers of its prisms that are lit; those that are known to be ``dark`` are not."""
    per = [crossings_of(plant, lines, noise, k, kind) for kind in range(2)]
    crossings = (*per[0], *per[1])
    states = [_state(c) for c in per]
    nothing = Measurement(
        k, "dark", np.full(2, np.nan), np.diag([np.inf, np.inf]), crossings, None, np.nan, 0, OUTCOMES["dark"]
    )
    lit = [kind for kind in range(2) if states[kind] in ("crosses", "rim") and kind not in dark]
    if not lit:
        outcome = "unresolved" if "unresolved" in states else "dark"
        return replace(nothing, outcome=outcome, says=OUTCOMES[outcome]), {}
    start = np.zeros(2)
    for kind in lit:
        start[1 - kind] = _best(per[kind]).angle
    white = {
        kind: whitener(noise.density(plant.rates[k, kind], uneven(lines, plant, k, kind)), float(lines.gain[k, kind]))
        for kind in lit
    }
    data = [white[kind](lines.amplitude[k, kind]) for kind in lit]

    def model(theta: Array) -> list[NDArray[np.complex128]]:
        angles = np.zeros(2)
        angles[[1 - kind for kind in lit]] = theta
        return [white[kind](response(prism(plant, k, kind, angles), plant)) for kind in lit]

    # the trace of one prism moves with the other angle: with one prism that angle is fitted, the other held at zero
    free = [1 - kind for kind in lit]
    result = fit(data, model, start[free], RANGE)
    angles, covariance = np.full(2, np.nan), np.diag([np.inf, np.inf])
    angles[free] = result.angles
    covariance[np.ix_(free, free)] = result.covariance
    if len(lit) == 1:
        other = KINDS[1 - lit[0]]
        why = "has a label too near another's" if states[1 - lit[0]] == "unresolved" else "gives no light"
        outcome = "one angle"
        says = f"the {other} prism {why}: the {KINDS[free[0]]} misalignment alone is known"
        if states[lit[0]] == "rim":
            says += ", and that from the rim of its light"
    elif result.dof and chdtrc(result.dof, result.chi2) < ALARM:
        outcome = "contradictory"
        says = OUTCOMES[outcome]
    else:
        outcome = "measured" if states == ["crosses", "crosses"] else "steered"
        says = OUTCOMES[outcome]
    done = Measurement(
        k,
        outcome,
        angles,
        covariance,
        crossings,
        from_crossings(plant, crossings, start),
        result.chi2,
        result.dof,
        says,
    )
    return done, dict(zip(lit, (float(abs(a)) for a in result.factors), strict=True))


def _state(crossings: Sequence[Crossing]) -> str:
    """The best that a prism does on either array."""
    states = {c.state for c in crossings}
    return next(s for s in ("unresolved", "crosses", "rim", "dark") if s in states)


def _best(crossings: Sequence[Crossing]) -> Crossing:
    """The crossing to begin with: one that is known, else the brightest."""
    lit = [c for c in crossings if c.state in ("crosses", "rim")]
    return min(lit, key=lambda c: (c.state != "crosses", -c.strength))


def from_crossings(plant: Plant, crossings: Sequence[Crossing], start: Array) -> tuple[Array, Array] | None:
    """Misalignment whose traces cross the arrays where they were seen to (Carretero 2019, section 4.3).

    Parameters
    ----------
    plant : Plant
    crossings : sequence of Crossing
        Of one heliostat; those in state "crosses" are used.
    start : (2,) array
        [rad]

    Returns
    -------
    misalignment (2,) [rad] and covariance (2, 2) [rad²]; None unless both prisms' traces cross an array.
    """
    used = [c for c in crossings if c.state == "crosses"]
    if {c.kind for c in used} != {0, 1}:
        return None
    seen = np.array([c.position for c in used])
    sigma = np.array([c.sigma for c in used])

    def predicted(theta: Array) -> Array:
        out = []
        for c in used:
            on = plant.member == c.array
            miss = sight(prism(plant, c.heliostat, c.kind, theta), plant, plant.detectors[on])[0]
            out.append(zero(plant.along[on], miss)[0])
        return np.array(out)

    theta, step = np.array(start, float), 1e-5
    matrix = np.eye(2)
    for _ in range(6):
        columns = np.stack(
            [(predicted(theta + step * e) - predicted(theta - step * e)) / (2 * step) for e in np.eye(2)]
        )
        columns = columns / sigma
        matrix = columns @ columns.T
        move = np.linalg.solve(matrix, columns @ ((seen - predicted(theta)) / sigma))
        theta = np.clip(theta + move, -2 * RANGE, 2 * RANGE)
        if np.abs(move).max() < 1e-9:
            break
    return theta, np.asarray(np.linalg.inv(matrix))


def _absent(plant: Plant, lines: Lines, noise: Noise, one: Measurement, power: float) -> Measurement:
    """A dark heliostat again, once it is known how bright prisms are."""
    if one.outcome != "dark" or power == 0:
        return one
    certain = [
        _least(plant, lines, noise, family(plant, one.heliostat, kind), one.heliostat, kind, power) > 4 * THRESHOLD
        for kind in range(2)
    ]
    if all(certain):
        return replace(one, outcome="absent", says=OUTCOMES["absent"])
    return one


def _least(plant: Plant, lines: Lines, noise: Noise, light: Family, k: int, kind: int, power: float) -> float:
    """Least strength that the brighter array would have over all misalignments within the stated range."""
    density, gain = noise.density(plant.rates[k, kind]), float(lines.gain[k, kind])
    templates = power * light.template(np.linspace(-STATED_RANGE, STATED_RANGE, 27))
    strength = []
    for array in range(len(plant.arrays)):
        on = np.flatnonzero(plant.member == array)
        strength.append(np.sum(np.abs(whitener(density[np.ix_(on, on)], gain)(templates[:, on])) ** 2, axis=1))
    return float(np.max(strength, axis=0).min())
