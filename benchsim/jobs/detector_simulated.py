"""Records of detectors simulated of a plant, and measured by the code that measures anybody's."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.io import wavfile

from benchsim import arrays
from benchsim.bench.errors import BenchsimError
from benchsim.bench.writing import write_bytes, write_csv
from benchsim.fluxes.day import clear_sky
from benchsim.jobs.detector_station import Watch, estimates, tally
from benchsim.jobs.plant_flux import KINDS, mount_errors
from benchsim.plant import days

Array = NDArray[np.float64]

CHANNELS = ["channel", "array", "along_m", "east_m", "north_m", "up_m"]

MOST_SAMPLES = 10_000_000
"""Of a simulated record, all detectors together: 1.3 GB on the way."""


def channels(w: Watch) -> list[list[Any]]:
    """Of each detector: its channel in a record, and where it stands."""
    out: list[list[Any]] = []
    for line, a in zip(w.lines, w.station.arrays, strict=True):
        along = line.along
        places = line.places(along) @ w.station.frame + w.origin
        for x, place in zip(along if a.upright else -along, places, strict=True):
            out.append([len(out) + 1, a.name, float(x) / 1e3, *(place / 1e3).tolist()])
    return out


@dataclass(frozen=True, repr=False)
class Simulated:
    """A simulated record, what was measured, and what the drives make of it.

    Attributes
    ----------
    time : datetime
    records : tuple of (m, samples) arrays
        Of each round [W/m²].
    rows : tuple of dict
        As `estimates`, of all heliostats that the arrays may see.
    before, after : (k, 2)
        True misalignments, elevation and azimuth [rad].
    sample_rate : int
    """

    time: datetime
    records: tuple[Array, ...]
    rows: tuple[dict[str, Any], ...]
    before: Array
    after: Array
    sample_rate: int

    @property
    def outcomes(self) -> list[str]:
        """Of each heliostat."""
        return [r["outcome"] for r in self.rows]

    def pulls(self) -> Array:
        """Errors over their sigmas, where both are known."""
        out = []
        for r in self.rows:
            for kind in arrays.KINDS:
                if r["outcome"] == "measured":
                    out.append((r[f"{kind}_mrad"] - r[f"true_{kind}_mrad"]) / r[f"sigma_{kind}_mrad"])
        return np.array(out)

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        pulls = self.pulls()
        good = np.array([o == "measured" for o in self.outcomes])
        return {
            "time": self.time.isoformat(),
            **tally(self.rows),
            "pulls_rms": float(np.sqrt(np.mean(pulls**2))) if len(pulls) else None,
            "largest_before_mrad": float(1e3 * np.abs(self.before).max()),
            "largest_after_mrad": float(1e3 * np.abs(self.after).max()),
            "measured_largest_after_mrad": float(1e3 * np.abs(self.after[good]).max()) if good.any() else None,
            "heliostats": list(self.rows),
        }

    def lines(self) -> list[str]:
        """For a summary."""
        plain = self.as_dict()
        said = ", ".join(f"{k} {v}" for k, v in plain["outcomes"].items())
        out = [f"  record at {self.time:%Y-%m-%d %H:%M}: {said}"]
        if plain["pulls_rms"] is not None:
            out.append(
                f"  errors over sigma {plain['pulls_rms']:.2f} rms; misalignments up to "
                f"{plain['largest_before_mrad']:.3g} mrad, after one correction up to "
                f"{plain['measured_largest_after_mrad']:.2g} of those measured"
            )
        return out

    def write(self, folder: Path) -> None:
        """The records, as `read_record` takes them, and the table."""
        for k, samples in enumerate(self.records, 1):
            body = io.BytesIO()
            wavfile.write(body, self.sample_rate, samples.T.astype(np.float32))
            write_bytes(folder / ("record.wav" if len(self.records) == 1 else f"record-{k}.wav"), body.getvalue())
        write_csv(folder / "measured.csv", list(self.rows[0]), (r.values() for r in self.rows), 6)


def simulate(w: Watch, time: datetime, errors: str, seed: int, told: Callable[[float], None]) -> Simulated:
    """A record of each round, measured, and the heliostats corrected by drives that err.

    Raises
    ------
    BenchsimError
        If the sun is down, the errors are none that there are, or the record would be too large.
    """
    p = w.plant
    if errors not in KINDS:
        raise BenchsimError(f"--errors: {errors!r} is none of {', '.join(KINDS)}")
    sun = days.suns([time], p.site)[0]
    if sun[2] <= 0:
        raise BenchsimError(f"--record: the sun is below the horizon at {time:%Y-%m-%d %H:%M}; name another time")
    count = sum(len(line.along) for line in w.lines)
    samples = round(w.labels.duration * p.prisms.sample_rate)
    if count * samples > MOST_SAMPLES:
        raise BenchsimError(
            f"--record: {count} detectors by {samples} samples are more than {MOST_SAMPLES}; make pitch_m larger or "
            "longest_s shorter"
        )
    rng = np.random.default_rng([seed, 47])
    before = w.misaligned(sun, mount_errors(p, errors, seed)[0])
    light, _ = w.arriving(sun)
    sky = float(clear_sky(sun, p.site.elevation)[0])
    a = replace(w.assumptions, duration=w.labels.duration, direct_irradiance=sky)
    records: list[Array] = []
    rows: dict[int, dict[str, Any]] = {}
    turn = np.zeros_like(before)
    for r in range(w.labels.rounds):
        told(r / w.labels.rounds)
        some = np.flatnonzero(w.labels.round == r)
        scene = w.scene(sun, some=some)
        truth = arrays.draw_truth(scene, a, before[some], rng)
        truth = replace(truth, transmission=truth.transmission * light[some, None])
        record = arrays.record(scene, a, truth, arrays.background(scene, a, rng), rng)
        told((r + 0.7) / w.labels.rounds)
        found, _, _ = arrays.measure(record, arrays.tracked(record, scene))
        ids = [p.field.ids[k] for k in w.who[some]]
        rows |= dict(zip(some.tolist(), estimates(scene, ids, found, before[some]), strict=True))
        turn[some] = arrays.correction(found)
        records.append(record)
    after = before + turn * (1 + a.drive_error * rng.standard_normal(turn.shape))
    ordered = tuple(rows[k] for k in range(len(before)))
    return Simulated(time, tuple(records), ordered, before, after, p.prisms.sample_rate)
