"""What errors of mounts cost, heliostat by heliostat, and what mending each would bring back.

One heliostat is changed at a time, all others stay with their errors: its cost is the energy that it does not bring to
the receiver, and the energy above a receiver's limit that is there only because of its errors.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchsim.instruments.mount.axes import reflected
from benchsim.jobs.flux_engines import Pool, done
from benchsim.jobs.flux_times import Times
from benchsim.plant.model import Plant
from benchsim.plant.moment import Moment, meshes, moment, normals, over_limit_changes, shifted

Array = NDArray[np.float64]
Errors = Mapping[str, Array]

ALIGNINGS = 3
"""Each leaves a thousandth of what the one before it left."""


@dataclass(frozen=True)
class Cost:
    """What the mounts' errors cost each heliostat in a day or a year [kWh].

    Attributes
    ----------
    lost : (n,)
        On the receiver without errors less with them.
    over : (n,)
        Above the receivers' limits with its errors less without, or 0 if it is less with them or nothing has a limit.
    sigma : (n,)
        Of lost and over together, to first order in the errors' own sigmas.
    recalibrated : (n,)
        Of both, what is brought back on average if the errors are mended to within their sigmas.
    reaimed : (n,)
        The same if only the aim is shifted, by one constant, so that on average its image is where it should be.
    shift : (n, 2)
        By which the aim is shifted for that, along the receiver and up [mm].
    """

    lost: Array
    over: Array
    sigma: Array
    recalibrated: Array
    reaimed: Array
    shift: Array

    @property
    def total(self) -> Array:
        """By which heliostats are ordered, (n,) kWh."""
        return self.lost + self.over


def cost(
    plant: Plant,
    times: Times,
    errors: Errors,
    sigmas: Errors,
    with_errors: tuple[Moment, ...],
    cells: int | None,
    pool: Pool,
    told: Callable[[float], None],
) -> Cost:
    """Cost of errors through a day or a year, by the product.

    Parameters
    ----------
    plant : Plant
    times : Times
    errors, sigmas : mapping of str to (n,)
        Of the mounts [rad].
    with_errors : tuple of Moment
        By the product.
    cells : int or None
    pool : Pool
    told : callable
        Hears which part is done.
    """
    weights = np.array([m.reflected for m in with_errors])
    off = np.array([misses(plant, s, errors) for s in times.suns])
    weights = np.where(np.isnan(off).any(axis=2), 0.0, weights)
    shift = -(weights[..., None] * np.nan_to_num(off)).sum(axis=0) / np.maximum(weights.sum(axis=0), 1e-12)[:, None]
    names = [k for k, v in sigmas.items() if np.any(v)]
    tasks = [
        (plant, s, float(i), errors, {k: sigmas[k] for k in names}, shift, cells)
        for s, i in zip(times.suns, times.sky, strict=True)
    ]
    power, above = np.sum(done(gains, tasks, pool, told), axis=0).transpose(1, 0, 2) * times.stands / 1e3

    def worth(k: int) -> Array:
        """Of change k: power gained, less what is above limits because of what is then left of the errors."""
        return np.asarray(power[k] - np.maximum(above[k] - above[0], 0))

    over = np.maximum(-above[0], 0)
    gained = [worth(k) + over for k in range(len(power))]
    none, moved, left, reaimed = gained[0], gained[1 : 1 + len(names)], gained[1 + len(names) : -1], gained[-1]
    # Of errors that are independent, means add up to second order.
    back = none + sum(((a + b) / 2 - none for a, b in zip(left[::2], left[1::2], strict=True)), np.zeros_like(none))
    return Cost(none - over, over, np.sqrt(sum((m**2 for m in moved), np.zeros_like(none))), back, reaimed, shift)


def misses(plant: Plant, sun: Array, errors: Errors) -> Array:
    """By how far errors move where central rays land, along the receiver and up, (n, 2) mm; nan: beside it."""
    f = plant.field
    out = np.full((len(f), 2), np.nan)
    rays = [reflected(normals(f, sun, e), sun) for e in (errors, {})]
    for k, receiver in enumerate(plant.receivers):
        own = f.receiver == k
        there, ideal = (receiver.landing(f.position[own], ray[own]) for ray in rays)
        out[own] = there - ideal
        if receiver.kind == "cylinder":
            around = receiver.extent[0]
            out[own, 0] = (out[own, 0] + around / 2) % around - around / 2
    return out


def aligned(plant: Plant, sun: Array, errors: Errors) -> Plant:
    """A plant whose aims are shifted so that with its errors images stand where they should at that sun."""
    total = np.zeros((len(plant.field), 2))
    for _ in range(ALIGNINGS):
        # Errors move the image of a shifted aim almost as they do that of the aim itself.
        total = -np.nan_to_num(misses(shifted(plant, total), sun, errors))
    return shifted(plant, total)


def gains(
    plant: Plant, sun: Array, sky: float, errors: Errors, sigmas: Errors, shift: Array, cells: int | None
) -> Array:
    """What one heliostat's change changes at one moment, (kinds of change, 2, n): on the receiver, above limits [W].

    Changes: no errors; each error a sigma larger; no error but one, at plus and at minus its sigma; aims shifted.
    """
    grids = meshes(plant, cells)
    base = moment(plant, sun, sky, errors, grids)

    def change(changed: Errors, where: Plant = plant) -> Array:
        after = moment(where, sun, sky, changed, grids)
        over = over_limit_changes((plant, where), (base, after), (errors, changed))
        return np.array([after.power - base.power, over])

    out = [change({})]
    out += [change({**errors, name: errors.get(name, 0.0) + sigma}) for name, sigma in sigmas.items()]
    out += [change({name: sign * sigma}) for name, sigma in sigmas.items() for sign in (1, -1)]
    return np.array([*out, change(errors, shifted(plant, shift))])
