"""How the predicted trace moves with the setting errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.curve import signed_distance
from benchsim.bench.model import Exposure, Laser, Mirror, Physics, Screen
from benchsim.bench.place import SettingErrors, place
from benchsim.rays.curve import trace_curve

Array = NDArray[np.float64]

COMPONENTS = (
    "mirror_position_x",
    "mirror_position_y",
    "mirror_position_z",
    "mirror_axis_n",
    "mirror_axis_b",
    "laser_azimuth",
    "laser_elevation",
    "screen_position_x",
    "screen_position_y",
    "screen_position_z",
    "screen_angle_x",
    "screen_angle_y",
    "screen_angle_z",
)
"""Order of the columns of `jacobian` and of `setting_errors`: mm for positions, rad for angles."""


def setting_errors(vector: Array) -> SettingErrors:
    """Setting errors from the 13 numbers in the order of `COMPONENTS` [mm, rad]."""
    v = np.asarray(vector, float)
    return SettingErrors(v[0:3], v[3:5], v[5:7], v[7:10], v[10:13])


def jacobian(
    laser: Laser,
    mirror: Mirror,
    physics: Physics,
    screen: Screen,
    exposure: Exposure,
    points: Array,
    *,
    errors: Array | None = None,
    step_mm: float = 0.02,
    step_rad: float = 2e-5,
    samples: int = 64,
) -> Array:
    """How the trace shifts with the setting errors: derivative of the shift of the curve along its left normal.

    Points measured on a trace whose setting errors are p lie at `signed_distance` ≈ J p from the curve predicted
    without errors. Central differences; their error is below 1e-5 of a column's largest entry on the nominal bench.

    Parameters
    ----------
    laser, mirror, physics, screen, exposure
        The stated bench.
    points : (n, 2) array [mm]
        Where on the board, on or near the trace.
    errors : (13,) array, optional
        Setting errors about which to differentiate [mm, rad]; default none.
    step_mm, step_rad : float
    samples : int
        Points of the curves that are differenced.

    Returns
    -------
    (n, 13) ndarray
        Columns in the order of `COMPONENTS` [mm per mm, mm per rad].

    Raises
    ------
    BenchsimError
        As `trace_curve`.
    """
    physics = replace(physics, diffraction=False)  # it does not move the centre line, and costs time
    base = np.zeros(13) if errors is None else np.asarray(errors, float)
    out = np.empty((len(points), 13))
    for j, name in enumerate(COMPONENTS):
        step = step_mm if "position" in name else step_rad
        side = []
        for sign in (1.0, -1.0):
            moved = base.copy()
            moved[j] += sign * step
            there = place(mirror, exposure, setting_errors(moved))
            curve = trace_curve(laser, mirror, physics, screen, there, facet=exposure.facet, samples=samples)
            side.append(signed_distance(curve, points)[0])
        out[:, j] = (side[1] - side[0]) / (2 * step)
    return out
