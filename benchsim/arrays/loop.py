"""The loop closed: measure all heliostats, turn each by what was measured, measure again."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchsim.arrays.misalignment import Measurement, measure
from benchsim.arrays.plant import Assumptions, Plant
from benchsim.arrays.signals import Truth, record

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Step:
    """One record of the loop.

    Attributes
    ----------
    before, after : (n, 2) ndarray
        True misalignments during the record, and once the drives have turned [rad].
    measurements : list of Measurement
    """

    before: Array
    after: Array
    measurements: list[Measurement]


def correction(measurements: list[Measurement]) -> Array:
    """By how much (n, 2) each heliostat is to be turned [rad]: what is known of its misalignment, else nothing.

    Heliostats whose lines contradict the model are left as they are.
    """
    told = np.array([m.misalignment for m in measurements])
    told[[m.outcome == "contradictory" for m in measurements]] = np.nan
    return -np.nan_to_num(told)


def close_loop(
    plant: Plant, assumptions: Assumptions, truth: Truth, steady: Array, rng: np.random.Generator, steps: int = 3
) -> list[Step]:
    """Records and corrections in turn.

    Parameters
    ----------
    plant, assumptions
    truth : Truth
        At the beginning.
    steady : (m,) array
        Background of the detectors [W/m²].
    rng : Generator
        Of noise and of the drives' errors.
    steps : int

    Returns
    -------
    list of Step
    """
    out = []
    for _ in range(steps):
        found, _, _ = measure(record(plant, assumptions, truth, steady, rng), plant)
        drive = 1 + assumptions.drive_error * rng.standard_normal(truth.misalignment.shape)
        after = truth.misalignment + drive * correction(found)
        out.append(Step(truth.misalignment, after, found))
        truth = replace(truth, misalignment=after)
    return out
