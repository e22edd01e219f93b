"""Arrays of detectors and prisms as a plant's file states them, or as they would suit it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchsim.bench.errors import BenchsimError
from benchsim.fluxes.heliostat import unit
from benchsim.plant import schema
from benchsim.plant.model import Field, Receiver
from benchsim.plant.station import DetectorArray, DroneFlight, Prisms, Station
from benchsim.plant.sunshape import DISC

CLEAR = 2e3
"""From a receiver's edge to arrays that a file does not state [mm]: out of its heat, as near the light as can be."""

REACH = 20e-3
"""Half of what such arrays see of light beside their middle, from the farthest heliostat [rad]: of mirrors 10 mrad
off."""

ACROSS_SUN = 3
"""Detectors of such arrays across the sun's image from the nearest heliostat: two would leave gaps in the beam's
flanks."""

FEWEST, MOST = 40, 200
"""Detectors of such an array: fewer, or more, cost light, or wires."""

ROUND = 0.1
"""To which the pitch of such arrays is rounded [mm], so that a file states them in few digits."""

LAST = 1e-6
"""Part of a pitch by which the last detector may stand beyond a stated end: it is decimals that are stated."""

NOT_STATED = (
    "No [[detector]] is stated: two arrays are taken, {pitch:.3g} m between detectors, {clear:g} m beyond the edges "
    "of {name}."
)


def prisms(p: schema.PrismsTable, file: str) -> Prisms:
    """As a file states them."""

    def refuse(key: str, says: str) -> BenchsimError:
        return BenchsimError(f"{file}: prisms.{key}: {says}")

    if not p.rate_low_hz + 1 <= p.rate_high_hz < 2 * p.rate_low_hz:
        raise refuse(
            "rate_high_hz",
            f"{p.rate_high_hz:g} Hz and rate_low_hz = {p.rate_low_hz:g} Hz bound no band within an octave, in which no "
            "overtone falls on a label; mend them",
        )
    if p.rate_high_hz > 0.4 * p.sample_rate_hz or 2 * p.rate_low_hz < 0.5 * p.sample_rate_hz:
        raise refuse(
            "sample_rate_hz",
            f"a converter at {p.sample_rate_hz:g} Hz passes rates below {0.4 * p.sample_rate_hz:g} Hz and stops "
            f"overtones of rates from {0.25 * p.sample_rate_hz:g} Hz on; put the labels between",
        )
    if p.longest_s < p.record_s:
        raise refuse("longest_s", f"{p.longest_s:g} s is shorter than record_s = {p.record_s:g} s; make it longer")
    return Prisms(
        1e3 * p.radius_m, 1e3 * p.height_m, p.facets, p.reflectance, 1e-3 * p.slope_mrad, p.background_w_m2,
        p.detector_spread, p.rate_low_hz, p.rate_high_hz, p.mains_hz, p.sample_rate_hz, p.record_s, p.longest_s,
    )  # fmt: skip


def drone(d: schema.DroneTable) -> DroneFlight:
    """As a file states it."""
    return DroneFlight(
        1e3 * d.distance_m, None if d.azimuth_deg is None else math.radians(d.azimuth_deg),
        math.radians(d.elevation_deg), 1e3 * d.pitch_m, d.seconds_each, d.at_once, (d.lamp_right_mm, d.lamp_up_mm),
        d.rtk_relative_mm, d.rtk_absolute_mm, d.detection_mm, d.position_mm, d.kinematics_mm, 1e-3 * d.canting_mrad,
        1e3 * d.slope_length_m, None if d.tilt_mrad is None else 1e-3 * d.tilt_mrad, 1e-3 * d.map_mrad,
        1e3 * d.map_length_m, d.false_glints,
    )  # fmt: skip


def station(tables: Sequence[schema.DetectorTable], receivers: Sequence[Receiver], field: Field, path: Path) -> Station:
    """The arrays as a file states them, or two that suit the field."""
    if not tables:
        return _suited(receivers, field)
    file, names = path.name, [r.name for r in receivers]
    out = []
    for k, t in enumerate(tables, 1):
        if t.receiver is not None and t.receiver not in names:
            raise BenchsimError(
                f"{file}: detector[{k}].receiver: {t.receiver[:60]!r} is none of {', '.join(names)}; mend it"
            )
        for key, of in (("receiver", lambda x: x.receiver or names[0]), ("azimuth_deg", lambda x: x.azimuth_deg)):
            if of(t) != of(tables[0]):
                raise BenchsimError(
                    f"{file}: detector[{k}].{key}: all arrays stand on one plane beside one receiver; make it that of "
                    "detector[1]"
                )
        count = int((t.to_m - t.from_m) / t.pitch_m + LAST) + 1
        if count < 2:
            raise BenchsimError(
                f"{file}: detector[{k}].to_m: {t.to_m:g} m is not beyond from_m = {t.from_m:g} m by a pitch; mend it"
            )
        out.append(
            DetectorArray(t.name, t.along == "vertical", 1e3 * t.offset_m, 1e3 * t.from_m, count, 1e3 * t.pitch_m)
        )
    if len({a.name for a in out}) < len(out):
        raise BenchsimError(f"{file}: detector: two have one name; name each of them differently")
    if sum(a.count for a in out) > schema.MOST_DETECTORS:
        raise BenchsimError(
            f"{file}: detector: {sum(a.count for a in out)} detectors are more than {schema.MOST_DETECTORS}; "
            "make pitch_m larger"
        )
    receiver = names.index(tables[0].receiver or names[0])
    looks = tables[0].azimuth_deg
    r = receivers[receiver]
    if looks is None and r.kind == "cylinder":
        raise BenchsimError(
            f"{file}: detector[1].azimuth_deg: {r.name} is a cylinder and looks all around; say where the arrays look"
        )
    return Station(receiver, r.azimuth if looks is None else math.radians(looks), tuple(out))


def _suited(receivers: Sequence[Receiver], field: Field) -> Station:
    """Two arrays beyond the edges of the receiver at which most heliostats aim."""
    k = int(np.bincount(field.receiver, minlength=len(receivers)).argmax())
    r, own = receivers[k], field.receiver == k
    far = field.distance[own]
    azimuth = r.azimuth
    if r.kind == "cylinder":
        e, n, _ = unit((field.position[own] - np.array(r.centre)) * [1.0, 1.0, 0.0]).mean(axis=0)
        azimuth = math.atan2(e, n)
    offsets = r.height / 2 + CLEAR, r.width / 2 + CLEAR
    half = min(max(2 * max(offsets) + REACH * float(far.max()), 1e3), 250e3)
    pitch = float(np.clip(2 * DISC * float(far.min()) / ACROSS_SUN, 2 * half / MOST, 2 * half / FEWEST))
    pitch = ROUND * round(pitch / ROUND)
    steps = math.floor(half / pitch)
    arrays = tuple(
        DetectorArray(name, upright, offset, -steps * pitch, 2 * steps + 1, pitch)
        for name, upright, offset in zip(("above", "left"), (False, True), offsets, strict=True)
    )
    return Station(k, azimuth, arrays, (NOT_STATED.format(pitch=pitch / 1e3, clear=CLEAR / 1e3, name=r.name),))
