"""``benchsim detectors read``: somebody's own record of the detectors, measured by the same code as a simulated one."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from benchsim import arrays
from benchsim.bench.errors import BenchsimError
from benchsim.bench.writing import write_csv, write_text
from benchsim.jobs.detector_files import FEWEST, read_labels, read_record
from benchsim.jobs.detector_station import estimates, tally, watch
from benchsim.jobs.output import wanted_folder, written
from benchsim.jobs.progress import Progress, silent
from benchsim.jobs.shown import Shown
from benchsim.plant import days, files
from benchsim.plant.model import Plant
from benchsim.reports import detector_pictures, page, page_detectors
from benchsim.reports.pictures import save
from benchsim.reports.quantities import counted

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

FORMAT = "benchsim-detector-record/1"

CLIPPED = 0.01
"""Part of a record at its very largest value, from which on a detector is clipped: noise alone holds it once."""

UNSUITED = "turn nothing: the record does not suit the plan"

TOLD = 8
"""Heliostats of a summary; the files have all."""


@dataclass(frozen=True, repr=False)
class RecordResult(Shown):
    """What somebody's record says of the heliostats.

    Attributes
    ----------
    plant : Plant
    time : datetime
    duration : float
        [s]
    rows : tuple of dict
        As `estimates`.
    remarks : tuple of str
        What contradicts the plan, or is left out.
    folder : Path or None
    """

    plant: Plant
    time: datetime
    duration: float
    rows: tuple[dict[str, Any], ...]
    remarks: tuple[str, ...]
    folder: Path | None = None

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``record.json``."""
        return {
            "format": FORMAT,
            "title": self.plant.title,
            "time": self.time.isoformat(),
            "record_s": self.duration,
            **tally(self.rows),
            "heliostats": list(self.rows),
            "remarks": list(self.remarks),
        }

    def text(self) -> str:
        """Plain sentences for ``summary.txt``."""
        said = ", ".join(f"{k} {v}" for k, v in tally(self.rows)["outcomes"].items())
        lines = [f"record of {self.duration:.3g} s at {self.time:%Y-%m-%d %H:%M %Z}: {said}"]
        known = [r for r in self.rows if r["raise_mrad"] is not None or r["turn_azimuth_mrad"] is not None]
        known = [r for r in known if self.suits and r["outcome"] != "contradictory"]
        known.sort(key=lambda r: -max(abs(r["raise_mrad"] or 0), abs(r["turn_azimuth_mrad"] or 0)))
        if known:
            lines.append("  turn normals, largest first (all in measured.csv): raise, turn clockwise from above [mrad]")
        for r in known[:TOLD]:
            by = (
                "unknown" if r[k] is None else f"{r[k]:+.3f} ± {r[s]:.2g}"
                for k, s in ((k, "sigma_" + k) for k in ("raise_mrad", "turn_azimuth_mrad"))
            )
            lines.append(f"    {r['id']:<12} {'   '.join(by)}   {r['outcome']}")
        return "\n".join([*lines, *self.remarks])

    @property
    def suits(self) -> bool:
        """Whether the record is of this plan: something is measured, and few contradict the model."""
        counts = Counter(r["outcome"] for r in self.rows)
        return counts["measured"] > 0 and not _many(counts["contradictory"], len(self.rows))

    def summary(self) -> str:
        """What a person wants to know, on a terminal."""
        more = "turn them, record again, read again" if self.suits else f"{UNSUITED}; mend that and read again"
        return f"{self.text()}{written(self.folder, page=True)}\nnext: {more}"

    def figures(self) -> list[Figure]:
        """Misalignments on the plan."""
        f = self.plant.field
        place = {name: f.position[k] for k, name in enumerate(f.ids)}
        return [detector_pictures.misalignments(place, self.rows)]


@threadpool_limits.wrap(limits=1)
def detectors_read(
    record: Path | str,
    plant: Plant | Path | str,
    output: Path | str | None = None,
    *,
    at: str,
    labels: Path | str | None = None,
    round: int = 1,
    allow_outside: bool = False,
    progress: Progress = silent,
) -> RecordResult:
    """Evaluate a record of the detectors' currents: misalignments, and how to turn each heliostat.

    Parameters
    ----------
    record : path
        A CSV with ``time_s`` and a column ``detector_1`` … for each detector of ``detectors.csv``, any of which may
        be missing; an HDF5 with such datasets at its top, or one, ``samples``, of samples by detectors, and an
        attribute ``rate_hz`` if there is no ``time_s``; or a WAV of 16, 24 or 32 bits, or floats, with a channel for
        each, in that order. In any unit.
    plant : path
    output : path, optional
        Folder for ``record.json``, ``measured.csv``, a picture, ``report.html`` and ``summary.txt``;
        default: nothing is written.
    at : str
        Time of the record's middle.
    labels : path, optional
        A CSV with ``id``, ``rate_elevation_hz`` and ``rate_azimuth_hz``, as ``heliostats.csv`` of `detectors`;
        default the plan's.
    round : int
        Which of the plan's rounds it is, from 1.
    allow_outside : bool
    progress : callable

    Returns
    -------
    RecordResult

    Raises
    ------
    BenchsimError
        If a file cannot be used, or the record does not suit the plan.
    """
    path = Path(record)
    p = plant if isinstance(plant, Plant) else files.read(plant, allow_outside=allow_outside)
    time = days.at(at, p.site)
    sun = days.suns([time], p.site)[0]
    if sun[2] <= 0:
        raise BenchsimError("--at: the sun is below the horizon then; say when the record's middle was")
    w = watch(p, rates=None if labels is None else read_labels(Path(labels), p))
    some = np.flatnonzero(w.labels.round == round - 1)
    if not len(some):
        raise BenchsimError(f"--round: the plan has {w.labels.rounds} rounds, not {round}; name one of them")
    inputs = [*p.files, path, *([Path(labels)] if labels is not None else [])]
    with wanted_folder(output, "detectors read", inputs, {"at": at, "round": round}) as staging:
        progress("reading", 0.0)
        count = sum(len(line.along) for line in w.lines)
        rate, samples, there = read_record(path, count)
        scene, samples, remarks = _suited(w.scene(sun, some=some), path, rate, samples, there)
        progress("measuring", 0.2)
        found, _, _ = arrays.measure(samples, arrays.tracked(samples, scene))
        rows = estimates(scene, [p.field.ids[k] for k in w.who[some]], found)
        result = RecordResult(
            p, time, scene.duration, tuple(rows), (*p.remarks, *remarks, *_contradictions(rows)),
            None if output is None else Path(output),
        )  # fmt: skip
        if staging is not None:
            write_csv(staging / "measured.csv", list(rows[0]), (r.values() for r in rows), 6)
            plain, text = result.as_dict(), result.text()
            write_text(staging / "record.json", json.dumps(plain, indent=1, allow_nan=False) + "\n")
            pictures = {"measured": save(result.figures()[0], staging / "measured.png")}
            write_text(staging / "summary.txt", text + "\n")
            shown = page_detectors.read(plain, p.name, text, pictures, "" if result.suits else UNSUITED)
            write_text(staging / "report.html", page.plant_page(shown))
    progress("done", 1.0)
    return result


def _suited(
    scene: arrays.Plant, path: Path, rate: float, samples: Array, there: NDArray[np.int_]
) -> tuple[arrays.Plant, Array, list[str]]:
    """The scene with the record's detectors, rate and length, and the samples that can be used; remarks where these are
    not the plan's.
    """
    remarks = []
    if scene.rates.max() > 0.5 * rate:
        raise BenchsimError(
            f"{path}: {rate:g} samples a second do not hold labels up to {scene.rates.max():.4g} Hz; record faster"
        )
    if samples.shape[1] < FEWEST:
        raise BenchsimError(f"{path}: has {samples.shape[1]} samples of a detector, fewer than {FEWEST}; record longer")
    if not np.isfinite(samples).all() or not np.abs(samples).max() < 1e30:
        bad = there[int(np.argmin(np.isfinite(samples).all(axis=1) & (np.abs(samples).max(axis=1) < 1e30)))]
        raise BenchsimError(f"{path}: detector_{bad + 1} has values that are no numbers; leave that detector out")
    still = np.ptp(samples, axis=1) == 0
    if still.all():
        raise BenchsimError(f"{path}: all values are the same; record the detectors' currents")
    if still.any():
        kept = ~still
        names = ", ".join(f"detector_{k + 1}" for k in there[still][:5]) + (", …" if still.sum() > 5 else "")
        change = "s and is" if still.sum() == 1 else " and are"
        remarks.append(f"{counted(still.sum(), 'detector')} never change{change} left out: {names}.")
        samples, there = samples[kept], there[kept]
    held = (samples == samples.max(axis=1, keepdims=True)).mean(axis=1) > CLIPPED
    if held.any():
        remarks.append(
            f"{counted(held.sum(), 'detector')} clipped, at the largest value for more than {100 * CLIPPED:g} % of the "
            "record; record with less gain."
        )
    lost = len(scene.detectors) - len(there) - int(still.sum())
    if lost:
        remarks.append(f"Of {len(scene.detectors)} detectors {lost} {'is' if lost == 1 else 'are'} not in the record.")
    member = scene.member[there]
    if min(np.bincount(member, minlength=len(scene.arrays))) < 3:
        raise BenchsimError(f"{path}: fewer than 3 detectors of an array are usable; record more of them")
    if abs(rate / scene.sample_rate - 1) > 1e-6:
        remarks.append(
            f"The record has {rate:g} samples a second, the plan {scene.sample_rate:g}: if its header is wrong, no "
            "label stands at its rate."
        )
    if samples.shape[1] < 0.98 * scene.samples:
        remarks.append(
            f"The record lasts {samples.shape[1] / rate:.3g} s, the plan {scene.duration:.3g} s: labels stand nearer "
            "to one another."
        )
    new = replace(
        scene, detectors=scene.detectors[there], member=member, along=scene.along[there], sample_rate=rate,
        samples=samples.shape[1],
    )  # fmt: skip
    return new, samples, remarks


def _many(contradictory: int, of: int) -> bool:
    """More than one and than one in twenty: a mirror or two may be loose, more say that the record is another's."""
    return contradictory > max(1, 0.05 * of)


def _contradictions(rows: list[dict[str, Any]]) -> list[str]:
    """Sentences on what the whole record says against the plan."""
    out, n = [], len(rows)
    counts = Counter(r["outcome"] for r in rows)
    if counts["dark"] + counts["absent"] == n:
        out.append(
            "No label is in the record: the labels' rates, the channels' order or the time are not as said, or no "
            "prism turned."
        )
    if _many(counts["contradictory"], n):
        out.append(
            f"{counts['contradictory']} of {n} heliostats contradict the model: where detectors or heliostats stand, "
            "the channels' order, or the time is not as said."
        )
    if counts["unresolved"]:
        out.append(
            f"Nearer than 1/T to another: the labels of {counted(counts['unresolved'], 'heliostat')}; record longer."
        )
    return out
