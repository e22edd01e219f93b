"""A plant's heliostats as its arrays of detectors see them: from east, north and up to the arrays' own frame."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchsim import arrays
from benchsim.arrays import Assumptions, Measurement
from benchsim.arrays.labelling import Labels, plan
from benchsim.arrays.plant import Line
from benchsim.bench.errors import BenchsimError
from benchsim.plant.hiding import hidden
from benchsim.plant.model import Plant
from benchsim.plant.moment import normals, transmitted
from benchsim.plant.station import Station

Array = NDArray[np.float64]

BEFORE = 0.05
"""Least cosine between where the arrays look and the way to a heliostat that they can see: 87°."""

UNSEEN = {
    "other": "aimed at another receiver than the arrays'",
    "behind": "behind the plane of the arrays",
}


@dataclass(frozen=True, eq=False)
class Watch:
    """The heliostats that arrays may see.

    Attributes
    ----------
    plant : Plant
    station : Station
    who : (k,) ndarray of int
        Indices into the field.
    labels : Labels
        Of these.
    assumptions : Assumptions
    """

    plant: Plant
    station: Station
    who: NDArray[np.int_]
    labels: Labels
    assumptions: Assumptions

    @cached_property
    def origin(self) -> Array:
        """(3,): the receiver's centre [mm]."""
        return np.array(self.plant.receivers[self.station.receiver].centre)

    def turned(self, vectors: Array) -> Array:
        """From east, north, up to the arrays' frame."""
        return np.asarray(vectors @ self.station.frame.T)

    @property
    def lines(self) -> tuple[Line, ...]:
        """The arrays in their frame, in which y runs to the right of who looks at them."""
        out = []
        for a in self.station.arrays:
            along = np.sort(a.along if a.upright else -a.along)
            offset = -a.offset if a.upright else a.offset
            out.append(Line(a.name, a.upright, offset, float(along[0]), float(along[-1]), a.pitch))
        return tuple(out)

    def scene(self, sun: Array, lines: Sequence[Line] | None = None, some: Any = slice(None)) -> arrays.Plant:
        """What whoever measures knows, of ``some`` of the heliostats under a sun."""
        f, who = self.plant.field, self.who[some]
        a = replace(self.assumptions, duration=self.labels.duration)
        return arrays.build(
            self.turned(f.position[who] - self.origin), self.turned(sun), a, self.labels.rates[some],
            lines or self.lines, self.turned(f.aim[who] - self.origin),
        )  # fmt: skip

    def arriving(self, sun: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Part (k,) of each heliostat's light that arrives, and who is hidden by another's mirror."""
        f = self.plant.field
        through = transmitted(f.distance[self.who], self.plant.site.attenuation)
        n = normals(f, sun)
        behind = hidden(f.position, n, f.width, f.height, sun)
        behind |= hidden(f.position, n, f.width, f.height, f.aim - f.position, f.distance)
        return np.where(behind[self.who], 0.0, through), behind[self.who]

    def misaligned(self, sun: Array, errors: Mapping[str, Array]) -> Array:
        """(k, 2) misalignments (ε, φ) that errors of the mounts make [rad]."""
        f = self.plant.field
        ideal, real = (self.turned(normals(f, sun, e)[self.who]) for e in ({}, errors))
        flat = np.cross([0.0, 0.0, 1.0], ideal)
        flat /= np.linalg.norm(flat, axis=1, keepdims=True)
        away = real - ideal
        # About a_e = z × n the normal moves along a_e × n, about a_a = n × a_e along a_e.
        return np.stack([(away * np.cross(flat, ideal)).sum(axis=1), (away * flat).sum(axis=1)], axis=1)


def watch(plant: Plant, station: Station | None = None, rates: Mapping[str, Array] | None = None) -> Watch:
    """The heliostats that a plant's arrays may see, with their labels.

    Parameters
    ----------
    plant : Plant
    station : Station, optional
        Default the plant's.
    rates : mapping of str to (2,), optional
        Labels by id [Hz]; default planned.

    Raises
    ------
    BenchsimError
        If there is no such heliostat, or the labels cannot be planned.
    """
    s = station or plant.station
    if s is None:
        raise BenchsimError(f"{plant.path.name}: detector: none is stated; add [[detector]] tables")
    who = np.flatnonzero(np.array([w == "" for w in unseen(plant, s)]))
    if not len(who):
        raise BenchsimError(
            f"{plant.path.name}: detector: no heliostat aims at {plant.receivers[s.receiver].name} from before the "
            "arrays; mend receiver or azimuth_deg"
        )
    p = plant.prisms
    a = Assumptions(
        heliostat_radius=0.0, prism_radius=p.radius, prism_height=p.height, facets=p.facets, reflectance=p.reflectance,
        facet_error=p.slope, background=p.background, rate_low=p.low, rate_high=p.high,
        sample_rate=float(p.sample_rate), duration=p.record, gain_spread=p.spread,
    )  # fmt: skip
    labels = plan(len(who), a, p.mains, p.longest)
    if rates is not None:
        stated = np.array([rates[plant.field.ids[k]] for k in who])
        labels = replace(labels, rates=stated)
    return Watch(plant, s, who, labels, a)


def unseen(plant: Plant, station: Station) -> list[str]:
    """Why arrays cannot see each heliostat at all, a key of `UNSEEN`; empty: they may."""
    f = plant.field
    away = f.position - np.array(plant.receivers[station.receiver].centre)
    cosine = away @ station.frame[0] / np.linalg.norm(away, axis=1)
    return [
        "other" if r != station.receiver else "behind" if c < BEFORE else ""
        for r, c in zip(f.receiver, cosine, strict=True)
    ]


def estimates(
    scene: arrays.Plant, ids: Sequence[str], found: Sequence[Measurement], truth: Array | None = None
) -> list[dict[str, Any]]:
    """What was measured of each heliostat, and how it is to be turned, as plain values in mrad; None: unknown.

    ``raise`` lifts the normal, ``turn_azimuth`` lets its azimuth grow, which runs from north through east: clockwise
    from above, eastward only of normals that look north.
    """
    out = []
    turn = arrays.correction(list(found))
    for m, name, by, frame in zip(found, ids, turn, scene.frames, strict=True):
        sigma = np.sqrt(np.diag(m.covariance))
        # The axes point so that ε lowers the normal, and φ turns it from north toward west.
        high = np.arcsin(np.clip(frame[0, 2], -1, 1))
        known = np.isfinite(m.misalignment) & (m.outcome != "contradictory")
        row: dict[str, Any] = {"id": name, "outcome": m.outcome}
        for k, kind in enumerate(arrays.KINDS):
            row[f"{kind}_mrad"] = _mrad(m.misalignment[k])
            row[f"sigma_{kind}_mrad"] = _mrad(sigma[k])
            if truth is not None:
                row[f"true_{kind}_mrad"] = _mrad(truth[m.heliostat, k])
        row["raise_mrad"] = _mrad(-by[0]) if known[0] else None
        row["sigma_raise_mrad"] = _mrad(sigma[0]) if known[0] else None
        row["turn_azimuth_mrad"] = _mrad(-by[1] / np.cos(high)) if known[1] else None
        row["sigma_turn_azimuth_mrad"] = _mrad(sigma[1] / np.cos(high)) if known[1] else None
        row["says"] = m.says
        out.append(row)
    return out


def tally(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """How often each outcome is among `estimates`, the commonest first, and what it means."""
    counts = dict(Counter(r["outcome"] for r in rows).most_common())
    return {"outcomes": counts, "outcome_means": {k: arrays.OUTCOMES[k] for k in counts}}


def _mrad(value: float) -> float | None:
    return 1e3 * float(value) if np.isfinite(value) else None
