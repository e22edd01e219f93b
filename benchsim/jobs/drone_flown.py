"""What a drone's virtual flight over a plant tells of each heliostat, beside the truth that it was flown with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.errors import BenchsimError
from benchsim.drones.estimate import Pointing, axis_error, estimate
from benchsim.drones.heliostat import design_map
from benchsim.jobs.drone_cluster import Cluster

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Flown:
    """What a virtual flight told of one heliostat.

    Attributes
    ----------
    glints, pictures : int
        Glints read, and pictures that show any.
    sigma_sys : float
        [rad]
    pointing : Pointing or None
        What the estimate says; None: nothing, and ``says`` tells why.
    error : (2,) ndarray
        Of its axis, about the mirror's x and y [rad].
    says : str
    """

    glints: int
    pictures: int
    sigma_sys: float
    pointing: Pointing | None
    error: Array
    says: str = ""

    @property
    def sigma(self) -> Array:
        """(2,) that is stated of the axis [rad]."""
        return np.full(2, np.nan) if self.pointing is None else np.hypot(stated(self.pointing), self.sigma_sys)

    @property
    def pull(self) -> Array:
        """(2,) errors over the stated sigma."""
        return np.asarray(self.error / self.sigma)

    def row(self) -> dict[str, Any]:
        """For a table, [mrad]."""
        p = self.pointing
        width, mean, normal = np.full((3, 2), np.nan) if p is None else (p.sigma_ad, p.sigma_mean, p.p_normal)
        pairs = {
            "error_{}_mrad": 1e3 * self.error,
            "flown_sigma_ad_{}_mrad": 1e3 * width,
            "flown_sigma_mean_{}_mrad": 1e3 * mean,
            "p_normal_{}": normal,
            "flown_sigma_{}_mrad": 1e3 * self.sigma,
        }
        return {
            "flown_glints": self.glints,
            "flown_outliers": 0 if p is None else int((~p.kept).sum()),
            **{n.format(a): None if p is None else float(x[i]) for n, x in pairs.items() for i, a in enumerate("xy")},
            "says": self.says,
        }


def fly(parts: list[Cluster], seed: int, surface: str, told: Callable[[float], None]) -> dict[int, Flown]:
    """Clusters flown virtually, one after the other: what is told, by index into the field."""
    out: dict[int, Flown] = {}
    rng = np.random.default_rng([seed, 48])
    count = sum(len(c.who) for c in parts)
    for c in parts:
        for k, flight, h, sightings in c.fly(rng):
            told(len(out) / count)
            reference = h.measured if surface == "measured" else design_map(c.design(k))
            shown = len(sightings.frame), len(np.unique(sightings.frame)), c.sigma(k)[2]
            try:
                e = estimate(sightings, flight.said_cameras, flight.said_lamps, h.said, reference)
                out[k] = Flown(*shown, e, axis_error(e, h.mount, h.axis))
            except BenchsimError as error:
                out[k] = Flown(*shown, None, np.full(2, np.nan), str(error))
    return out


def stated(pointing: Pointing) -> Array:
    """(2,) σ_mean that is stated [rad]: the paper's, or that with a picture's glints as one draw where it is larger."""
    return np.maximum(pointing.sigma_mean, pointing.sigma_mean_frames)
