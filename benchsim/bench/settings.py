"""Setting errors as a vector with a prior: their names, units, 1 sigma, and which exposures share them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.model import Exposure, Recording, Uncertainty
from benchsim.bench.place import SettingErrors

NAMES = (
    "mirror_position_x",
    "mirror_position_y",
    "mirror_position_z",
    "mirror_axis_1",
    "mirror_axis_2",
    "laser_azimuth",
    "laser_elevation",
    "screen_position_x",
    "screen_position_y",
    "screen_position_z",
    "screen_angle_x",
    "screen_angle_y",
    "screen_angle_z",
)
"""Order of a setting-error vector; positions in mm, angles in rad; axis 1 is about n, axis 2 about n × axis."""

OF_THE_SETTING = slice(0, 7)
"""Errors drawn once per ``setting``."""

OF_THE_SEAT = slice(7, 13)
"""Errors drawn each time the screen is moved."""


def from_vector(theta: NDArray[np.float64]) -> SettingErrors:
    """Setting errors from their vector (13,) in the order of ``NAMES`` [mm, rad]."""
    t = np.asarray(theta, float)
    return SettingErrors(t[0:3], t[3:5], t[5:7], t[7:10], t[10:13])


def to_vector(errors: SettingErrors) -> NDArray[np.float64]:
    """Vector (13,) in the order of ``NAMES`` [mm, rad]."""
    e = errors
    parts = (e.mirror_position, e.mirror_axis, e.laser_direction, e.screen_position, e.screen_angle)
    return np.concatenate([np.asarray(part, float) for part in parts])


def prior_sigma(uncertainty: Uncertainty, *, reseated: bool) -> NDArray[np.float64]:
    """1 sigma (13,) of one exposure's setting errors [mm, rad]; the screen's are 0 unless it was re-seated."""
    u = uncertainty
    seat = [u.screen_position] * 3 + [u.screen_angle] * 3
    return np.array(
        [u.mirror_position] * 3 + [u.mirror_axis] * 2 + [u.laser_direction] * 2 + (seat if reseated else [0.0] * 6)
    )


def scaled(uncertainty: Uncertainty, factor: float) -> Uncertainty:
    """Every setting error so many times as large; nothing else is touched."""
    u = uncertainty
    return replace(
        u,
        mirror_position=u.mirror_position * factor,
        mirror_axis=u.mirror_axis * factor,
        laser_direction=u.laser_direction * factor,
        screen_position=u.screen_position * factor,
        screen_angle=u.screen_angle * factor,
    )


def uncertainty_of(recording: Recording) -> Uncertainty:
    """How far off settings are: as stated, times the scale of the effect ``setting-errors`` where the file has it."""
    return scaled(recording.uncertainty, recording.effects.get("setting-errors", {}).get("scale", 1.0))


def screen_seats(exposures: Sequence[Exposure]) -> tuple[int, ...]:
    """Seat of the screen in every exposure, in file order: 0 is free of error.

    In the order of time (then of the file) each change of shift or roll is a move and begins a new seat, also on the
    way back.
    """
    order = sorted(range(len(exposures)), key=lambda i: (exposures[i].time, i))
    seats, seat = [0] * len(exposures), 0
    for before, now in pairwise(order):
        a, b = exposures[before], exposures[now]
        if (a.screen_shift, a.screen_roll) != (b.screen_shift, b.screen_roll):
            seat += 1
        seats[now] = seat
    return tuple(seats)
