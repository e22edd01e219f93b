"""What is compared with a record: how far the predicted beam, or pointing, is from the recorded one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from benchsim.diagnosis.problem import Values
from benchsim.instruments.mount import axes, sky
from benchsim.instruments.mount.records import UNITS, Array, Mount, Records

LOST = 1e6
"""Distance, in the mount's unit, of a prediction that does not exist: no triangle of an actuator closes."""


ABRUPT = 0.12
"""Part of a record over which a change is spread; half a record away 98 % of it are done."""

STEPS = {"IA": "dIA", "IE": "dIE", "grown_1": "step_1", "grown_2": "step_2"}
"""What a change of the mount adds to, and by how much: zero points, or lengths at the same step."""

INPUTS = {"A": ("IA", 0), "E": ("IE", 1), "1": ("grown_1", 0), "2": ("grown_2", 1)}
"""Ending of a parameter that acts on one axis → what it adds to, and the axis' number among the readings."""


@dataclass(frozen=True)
class Predict:
    """Distance of the predicted direction from the recorded one, across and up, in the mount's unit.

    The data are zero: a record says where the beam went, and the prediction is how far from there the mount with the
    given errors would have sent it. Both components are in the plane perpendicular to the recorded direction; *across*
    is horizontal, to the right as seen along the light (toward growing azimuth for the sky), *up* is up.

    Attributes
    ----------
    mount : Mount
    records : Records
    units : mapping of str to float
        Parameter → its unit in rad, mm or s.
    stated : mapping of str to float
        Errors that the simulation holds already, inside.
    target_number : (n,) int array
    drift : (n, m) array
        Smooth functions of the record's number, in the mount's unit per unit of ``drift.across_k`` and
        ``drift.up_k``: what every mount does beside its terms.
    moved : mapping of str to (n,) array
        What functions that are stated add to parameters, inside.
    """

    mount: Mount
    records: Records
    units: Mapping[str, float]
    stated: Mapping[str, float]
    target_number: NDArray[np.intp]
    drift: Array = field(default_factory=lambda: np.zeros((0, 0)))
    moved: Mapping[str, Array] = field(default_factory=dict)

    def __call__(self, values: Values | Sequence[Values], block: int | Sequence[int]) -> Any:
        """Of one record, (2,); of lists of values and of their records, (T, 2)."""
        if isinstance(values, Mapping):
            return self.at([values], np.array([block]))[0]
        return self.many(values, np.asarray(block))  # type: ignore[arg-type]

    def many(self, values: Sequence[Values], blocks: Sequence[int]) -> Array:
        """Of several, (T, 2)."""
        return self.at(values, np.asarray(blocks, np.intp))

    def at(self, values: Sequence[Values], blocks: NDArray[np.intp]) -> Array:
        """All at once, (T, 2)."""
        # The same values are asked of a thousand records.
        keys = list(map(id, values))
        distinct = dict(zip(keys, values, strict=True))
        x: dict[str, Array] = {n: np.full(len(distinct), v) for n, v in self.stated.items()}
        for t, one in enumerate(distinct.values()):
            for name, value in one.items():
                if value == 0.0 or name in self.slopes or (unit := self.units.get(name)) is None:
                    continue
                if name not in x:
                    x[name] = np.zeros(len(distinct))
                x[name][t] += value * unit
        number = {k: t for t, k in enumerate(distinct)}
        of = np.fromiter(map(number.__getitem__, keys), np.intp, len(keys))
        predicted, seen = self.directions({name: v.take(of) for name, v in x.items()}, blocks)
        out = np.einsum("tjk,tk->tj", self._plane[blocks], _arc(predicted - _unit(seen))) / UNITS[self.mount.unit]
        if self.drift.size:
            modes = np.array([[one.get(n, 0.0) for n in self.slopes] for one in distinct.values()])
            out += (modes.reshape(len(distinct), 2, -1) @ self.drift.T)[of, :, blocks]
        return np.where(np.isfinite(out).all(axis=1, keepdims=True), out, LOST)

    def directions(self, x: Mapping[str, Array], i: NDArray[np.intp]) -> tuple[Array, Array]:
        """Where the mount sends the beam, or points, and where the record has it.

        Parameters
        ----------
        x : mapping of str to (T,) or (1,) array
            Errors in rad, mm and s, beside which those that are stated do not count.
        i : (T,) int array
            Records.

        Returns
        -------
        predicted : (T, 3) array
            Unit vectors; nan where no triangle of an actuator closes.
        seen : (T, 3) array
            From the mirror to the spot [mm]; for the sky the unit vector toward the star.
        """
        mount, records, x = self.mount, self.records, dict(x)
        if "change" in x:
            # A little of a slope, so that a fit feels on which side of a record the change falls.
            after = expit((i - x["change"]) / ABRUPT)
            for name, step in STEPS.items():
                if step in x:
                    x[name] = x.get(name, 0.0) + after * x[step]
        for axis, (name, k) in INPUTS.items():
            # An axis with play stands behind its reading by half of it.
            if records.travel is not None and (play := x.get(f"backlash_{axis}")) is not None:
                x[name] = x.get(name, 0.0) - 0.5 * records.travel[i, k] * play
            if records.warmth is not None and (growth := x.get(f"thermal_{axis}")) is not None:
                x[name] = x.get(name, 0.0) + records.warmth[i] * growth
        for name, value in self.moved.items():
            x[name] = x.get(name, 0.0) + value[i]
        normal, centre = axes.pointing(mount, records.reading[i], x)
        source = sky.seen(mount, records.source[i], x)
        if mount.observes == "sky":
            return normal, source
        shift = np.zeros((len(i), 3))
        for k, axis in enumerate("enu"):
            shift[:, k] = x.get(f"mirror_{axis}", 0.0) + x.get(f"survey_{axis}", 0.0)
        predicted = axes.reflected(normal, source)
        seen = records.spot[i] + self._moved(x, i) - centre - shift
        if "spot_scale" in x and records.centre is not None:
            # By where the beam goes: in a recorded spot's place its own error would be scaled, and pass for the scale.
            spot = centre + shift + predicted * np.linalg.norm(seen, axis=1, keepdims=True)
            seen = seen + x["spot_scale"][:, None] * (spot - records.centre[i])
        return predicted, seen

    def _moved(self, x: Mapping[str, Array], i: NDArray[np.intp]) -> Array:
        """Shift of the recorded spots (T, 3)."""
        number, out = self.target_number[i], np.zeros((len(i), 3))
        for axis, whole, each in ((0, "spot_across", "target_e"), (2, "spot_up", "target_u")):
            out[:, axis] = x.get(whole, 0.0)
            for k in range(int(self.target_number.max(initial=-1)) + 1):
                if (name := f"{each}_{k + 1}") in x:
                    out[:, axis] += x[name] * (number == k)
        return out

    @cached_property
    def slopes(self) -> dict[str, Array]:
        """Derivatives (2 n,) by the drift's parameters, across and then up, in which the prediction is linear."""
        component = np.eye(2)
        return {
            f"drift.{way}_{k + 1}": np.kron(column, component[j])
            for j, way in enumerate(("across", "up"))
            for k, column in enumerate(self.drift.T)
        }

    @cached_property
    def _plane(self) -> Array:
        """Across and up in the plane perpendicular to each record's direction, (n, 2, 3)."""
        records = self.records
        about = records.source if self.mount.observes == "sky" else _unit(records.spot - self.mount.position)
        right = np.stack([about[:, 1], -about[:, 0], 0 * about[:, 0]], axis=-1)
        right /= np.maximum(np.linalg.norm(right, axis=1, keepdims=True), 1e-12)
        return np.stack([right, np.cross(right, about)], axis=1)


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _arc(apart: Array) -> Array:
    """Differences (T, 3) of unit vectors lengthened from the chord to the arc: what is 15 degrees off is not called
    less."""
    chord = np.linalg.norm(apart, axis=1, keepdims=True)
    arc = 2 * np.arcsin(np.clip(chord / 2, 0, 1))
    return np.asarray(apart * np.where(chord > 1e-3, arc / np.maximum(chord, 1e-12), 1.0))
