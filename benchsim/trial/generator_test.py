"""Is the generator fit to give truths? Its light on a clean bench is held against `rays`, at two ray counts.

Both are cut along the same lines across the trace that `rays` predicts. Independent sets of rays give the Monte Carlo
error of what their mean differs by, in bins along the trace: centroid [mm] and light (relative). Certified is a
generator whose mean agrees within that error, at both counts, and whose finer count changes nothing beyond it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.stats import f as f_distribution

from benchsim.bench.model import Exposure, Recording
from benchsim.bench.place import Placement, SettingErrors, place
from benchsim.bench.settings import from_vector, prior_sigma, uncertainty_of
from benchsim.rays import irradiance_profiles

Array = NDArray[np.float64]

NOISE = (0.03, 0.01)
"""Noise of a lit bin that each set of rays is traced to, coarse and fine: the ends of what cases draw
(`cases.noise`). The generator finds the count that it takes; some fixed counts resonate with the board's bins, which
this way of asking sees and mends."""

SETS = 4
"""Independent sets of rays at each count."""

BINS = 16
"""Along the trace; sets of rays share no noise, neighbouring bins hardly any."""

REACH = 8.0
"""Half width of the cut [mm]; with diffraction centroid and light depend on where the tails are cut."""

FLOOR = {"centroid_mm": 1e-3, "light": 1e-3}
"""1 sigma of what agreement is not asked for: Mitsuba's 32-bit hits lie within 0.8 µm of 64-bit ones, and the predicted
light is integrated to 0.1 %."""

FALSE_ALARM = 1e-3
"""Of the whole certificate, shared by its six tests."""


@dataclass(frozen=True)
class Test:
    """One comparison: ``off`` the rms difference of the means over the bins, ``sigma`` what noise makes of it."""

    what: str
    quantity: str
    off: float
    sigma: float
    p_value: float


@dataclass(frozen=True)
class Certificate:
    """Outcome for one clean bench; ``rays`` of a set on average, coarse and fine."""

    rays: tuple[int, ...]
    sets: int
    tests: tuple[Test, ...]

    @property
    def passed(self) -> bool:
        """Whether the counts are two, and no test fails at the false-alarm rate of the whole."""
        return self.rays[1] >= 2 * self.rays[0] and all(t.p_value >= FALSE_ALARM / len(self.tests) for t in self.tests)

    def plain(self) -> dict[str, Any]:
        """For files."""
        return {
            "passed": self.passed,
            "rays": list(self.rays),
            "sets": self.sets,
            "tests": [
                {"what": t.what, "quantity": t.quantity, "off": t.off, "sigma": t.sigma, "p_value": t.p_value}
                for t in self.tests
            ],
        }


def certify(
    bench: Recording,
    seed: int,
    *,
    noise: tuple[float, float] = NOISE,
    sets: int = SETS,
    drawn: Recording | None = None,
) -> Certificate:
    """Hold the light that `renderer` makes of a clean bench against `rays`.

    Parameters
    ----------
    bench : Recording
        Its first exposure is used, at setting errors drawn from its ``[uncertainty]``.
    seed : int
    noise : (coarse, fine)
        As `NOISE`.
    sets : int
        At least 2.
    drawn : Recording, optional
        Rendered in place of ``bench``, to see the certificate refused.
    """
    from benchsim.renderer import backend, irradiance

    backend.use(None)
    rng = np.random.default_rng(seed)
    exposure = bench.exposures[0]
    placement = place(bench.mirror, exposure, _errors(bench, rng))
    q: Array = np.linspace(-REACH, REACH, 1 + round(2 * REACH / 0.02))
    model = _model(bench, exposure, placement, q)
    means: list[Array] = []
    variances: list[Array] = []
    counts: list[int] = []

    def traced(wanted: float) -> tuple[Array, Array, int]:
        """Mean and its variance over the sets, and the rays of one on average."""
        lights = (
            irradiance(
                drawn or bench, exposure, placement=placement, seed=int(rng.integers(1 << 31)), relative_error=wanted
            )
            for _ in range(sets)
        )
        found = [(_difference(light, model, q), light.rays) for light in lights]
        each = np.array([d for d, _ in found])
        return each.mean(axis=0), each.var(axis=0, ddof=1) / sets, round(float(np.mean([n for _, n in found])))

    for wanted in noise:
        mean, variance, count = traced(wanted)
        while counts and count < 2 * counts[0]:
            # The coarse count happened to be dear on this bench; half the noise takes 1.5 times the rays or more.
            wanted /= 2
            mean, variance, count = traced(wanted)
        means.append(mean)
        variances.append(variance)
        counts.append(count)
    tests = []
    for k, (quantity, floor) in enumerate(FLOOR.items()):
        for name, mean, variance in zip(("coarse", "fine"), means, variances, strict=True):
            tests.append(_test(f"{name} against rays", quantity, mean[k], variance[k] + floor**2, sets))
        both = variances[0][k] + variances[1][k]
        tests.append(_test("fine against coarse", quantity, means[1][k] - means[0][k], both, sets))
    return Certificate(tuple(counts), sets, tuple(tests))


def _errors(bench: Recording, rng: np.random.Generator) -> SettingErrors:
    sigma = prior_sigma(uncertainty_of(bench), reseated=False)
    return from_vector(sigma * rng.standard_normal(len(sigma)))


def _model(bench: Recording, exposure: Exposure, placement: Placement, q: Array) -> tuple[Array, Array, Array]:
    """Points of the trace (n, 2), unit vectors across it, and the light along each cut (n, len(q))."""
    curve, light = irradiance_profiles(
        bench.laser, bench.mirror, bench.physics, bench.screen, placement, q, facet=exposure.facet, samples=192
    )
    tangent = np.gradient(curve.points, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    across = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    half = np.array(bench.screen.size) / 2 - REACH
    # At the ends the tangent is one-sided; beyond the edge the map's bins are not whole.
    inside: NDArray[np.bool_] = np.asarray((np.abs(curve.points) < half).all(axis=1))
    inside[[0, -1]] = False
    return curve.points[inside], across[inside], light[inside]


def _difference(light: Any, model: tuple[Array, Array, Array], q: Array) -> Array:
    """Centroid [mm] and relative light of a map less the model's, in bins: (2, BINS)."""
    points, across, expected = model
    at = points[:, None, :] + q[None, :, None] * across[:, None, :]
    row, column = (at[..., 1] - light.z0) / light.pitch, (at[..., 0] - light.y0) / light.pitch
    seen = map_coordinates(light.values, [row, column], order=1, mode="nearest")
    centroid = (seen * q).sum(1) / seen.sum(1) - (expected * q).sum(1) / expected.sum(1)
    flux = seen.sum(1) / expected.sum(1) - 1
    return np.array([[part.mean() for part in np.array_split(v, BINS)] for v in (centroid, flux)])


def _test(what: str, quantity: str, mean: Array, variance: Array, sets: int) -> Test:
    """F-test of bins' means against their variances, pooled.

    Some bins are noisier than others: as many count as would give a sum of equal variances that scatters as much
    (Satterthwaite 1946, Biometrics Bulletin 2, 110).
    """
    off, sigma = float(np.sqrt(np.mean(mean**2))), float(np.sqrt(np.mean(variance)))
    bins = float(variance.sum() ** 2 / (variance**2).sum())
    p = float(f_distribution.sf(off**2 / sigma**2, bins, bins * (sets - 1)))
    return Test(what, quantity, off, sigma, p)
