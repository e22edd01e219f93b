"""Many clusters flown, read and estimated, beside the truth: what the stated uncertainty is worth."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchsim.drones.estimate import axis_error, estimate, sigma_sys
from benchsim.drones.flight import Errors, Sightings, camera_point, fly, pattern, read, rows, seen, stand
from benchsim.drones.heliostat import axes, design_map, four_facets

Array = NDArray[np.float64]

DISTANCE = 150e3
HALF, PITCH = (3200.0, 2800.0), 350.0
"""Half extents and pitch of the pattern [mm]: the mirror, and four sigma of where it may look."""

ACROSS, ALONG = 7e3, 12e3
"""Spacings of the heliostats [mm]: none stands in another's way at the elevations that are flown."""


@dataclass(frozen=True)
class Outcomes:
    """Heliostats (rows) about the concentrator's x and y (columns), angles in rad.

    Attributes
    ----------
    error : (n, 2) ndarray
        Of the optical axis.
    sigma_ad, sigma_mean, sigma_mean_frames, p_normal : (n, 2) ndarray
        As in `Pointing`.
    sigma_sys : (n,) ndarray
    glints, frames, outliers, turns : (n,) ndarray of int
        Glints read; frames that show any; outliers removed; turns of the tracking angles before outliers went.
    """

    error: Array
    sigma_ad: Array
    sigma_mean: Array
    sigma_mean_frames: Array
    p_normal: Array
    sigma_sys: Array
    glints: NDArray[np.intp]
    frames: NDArray[np.intp]
    outliers: NDArray[np.intp]
    turns: NDArray[np.intp]

    @property
    def pull(self) -> Array:
        """(n, 2) error over the stated σ_tot."""
        return np.asarray(self.error / np.hypot(self.sigma_mean, self.sigma_sys[:, None]))


def survey(
    errors: Errors,
    seed: int,
    flights: int,
    per_flight: int = 12,
    distance: float = DISTANCE,
    only: Callable[[Sightings], Sightings] = lambda s: s,
    pitch: float = PITCH,
) -> tuple[Outcomes, Outcomes]:
    """Fly over clusters that are drawn afresh, each at its own calibration point, and estimate every heliostat.

    The glints come from `benchsim.drones.glints`, not from pictures.

    Parameters
    ----------
    errors : Errors
        What is drawn, and what σ_sys is told of.
    seed : int
    flights, per_flight : int
    distance : float
        From the cluster's middle to the camera point [mm].
    only : callable, optional
        Which sightings are used.
    pitch : float
        Of the pattern [mm].

    Returns
    -------
    by_design, measured : Outcomes
        With the surface by design, and with the measured map.
    """
    rng = np.random.default_rng(seed)
    design = four_facets()
    ideal = design_map(design)
    found: tuple[list[tuple], list[tuple]] = ([], [])
    for _ in range(flights):
        azimuth = rng.uniform(-math.pi, math.pi)
        target = camera_point(distance, azimuth, math.radians(rng.uniform(13, 40)))
        flight = fly(target, pattern(target, HALF, pitch), errors, rng)
        for h in stand(rows(per_flight, ACROSS, ALONG, azimuth), design, target, errors, rng):
            sightings = only(read(seen(h, flight), len(flight.cameras), design, errors, rng))
            away = float(np.linalg.norm(target - axes(h.said)[1]))
            sizes = (errors.position, errors.offset, errors.rtk_absolute)
            for rows_, reference in zip(found, (ideal, h.measured), strict=True):
                p = estimate(sightings, flight.said_cameras, flight.said_lamps, h.said, reference)
                rows_.append(
                    (
                        axis_error(p, h.mount, h.axis),
                        p.sigma_ad,
                        p.sigma_mean,
                        p.sigma_mean_frames,
                        p.p_normal,
                        sigma_sys(away, sizes),
                        len(sightings.frame),
                        len(np.unique(sightings.frame)),
                        int((~p.kept).sum()),
                        p.second - 1,
                    )
                )
    by_design, measured = (Outcomes(*(np.array(c) for c in zip(*r, strict=True))) for r in found)
    return by_design, measured
