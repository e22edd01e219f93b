"""Records of detectors: simulated of a plant and measured, or somebody's own read and measured by the same code."""

from __future__ import annotations

import io
import json
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.io import wavfile
from threadpoolctl import threadpool_limits

from benchsim import arrays
from benchsim.bench.errors import BenchsimError
from benchsim.bench.names import printable
from benchsim.bench.reading import RECORD_BYTES, read_file
from benchsim.bench.writing import write_bytes, write_csv, write_text
from benchsim.fluxes.day import clear_sky
from benchsim.jobs.detector_station import Watch, estimates, watch
from benchsim.jobs.output import wanted_folder, written
from benchsim.jobs.plant_flux import KINDS, mount_errors
from benchsim.jobs.progress import Progress, silent
from benchsim.jobs.shown import Shown
from benchsim.plant import days, files, tables
from benchsim.plant.model import Plant
from benchsim.reports import detector_pictures
from benchsim.reports.pictures import save

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

FORMAT = "benchsim-detector-record/1"

CHANNELS = ["channel", "array", "along_m", "east_m", "north_m", "up_m"]

MOST_SAMPLES = 10_000_000
"""Of a simulated record, all detectors together: 1.3 GB on the way."""

TOLD = 8
"""Heliostats of a summary; the files have all."""

FEWEST = 200
"""Samples of a detector: fewer say nothing of the noise between labels."""


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
            "outcomes": dict(Counter(self.outcomes)),
            "pulls_rms": float(np.sqrt(np.mean(pulls**2))) if len(pulls) else None,
            "largest_before_mrad": float(1e3 * np.abs(self.before).max()),
            "largest_after_mrad": float(1e3 * np.abs(self.after).max()),
            "measured_largest_after_mrad": float(1e3 * np.abs(self.after[good]).max()) if good.any() else None,
            "heliostats": list(self.rows),
        }

    def lines(self) -> list[str]:
        """For a summary."""
        plain = self.as_dict()
        said = ", ".join(f"{k} {v}" for k, v in Counter(self.outcomes).most_common())
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
            "outcomes": dict(Counter(r["outcome"] for r in self.rows)),
            "outcome_means": {k: v for k, v in arrays.OUTCOMES.items() if k in {r["outcome"] for r in self.rows}},
            "heliostats": list(self.rows),
            "remarks": list(self.remarks),
        }

    def text(self) -> str:
        """Plain sentences for ``summary.txt``."""
        said = ", ".join(f"{k} {v}" for k, v in Counter(r["outcome"] for r in self.rows).most_common())
        lines = [f"record of {self.duration:.3g} s at {self.time:%Y-%m-%d %H:%M %Z}: {said}"]
        known = [r for r in self.rows if r["raise_mrad"] is not None or r["turn_azimuth_mrad"] is not None]
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

    def summary(self) -> str:
        """What a person wants to know, on a terminal."""
        return self.text() + written(self.folder) + "\nnext: turn them, record again, read again"

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
        be missing; or a WAV of 16, 24 or 32 bits, or floats, with a channel for each, in that order. In any unit.
    plant : path
    output : path, optional
        Folder for ``record.json``, ``measured.csv``, a picture and ``summary.txt``; default: nothing is written.
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
            write_text(staging / "record.json", json.dumps(result.as_dict(), indent=1, allow_nan=False) + "\n")
            save(result.figures()[0], staging / "measured.png")
            write_text(staging / "summary.txt", result.text() + "\n")
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
        names = ", ".join(f"detector_{k + 1}" for k in there[still][:5])
        remarks.append(f"{still.sum()} detectors never change and are left out: {names}.")
        samples, there = samples[kept], there[kept]
    lost = len(scene.detectors) - len(there) - int(still.sum())
    if lost:
        remarks.append(f"{lost} of {len(scene.detectors)} detectors are not in the record.")
    member = scene.member[there]
    if min(np.bincount(member, minlength=len(scene.arrays))) < 3:
        raise BenchsimError(f"{path}: fewer than 3 detectors of an array are usable; record more of them")
    if abs(rate / scene.sample_rate - 1) > 1e-6:
        remarks.append(f"The record has {rate:g} samples a second, the plan {scene.sample_rate:g}.")
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


def _contradictions(rows: list[dict[str, Any]]) -> list[str]:
    """Sentences on what the whole record says against the plan."""
    out, n = [], len(rows)
    counts = Counter(r["outcome"] for r in rows)
    if counts["dark"] + counts["absent"] == n:
        out.append(
            "No label is in the record: the labels' rates, the channels' order or the time are not as said, or no "
            "prism turned."
        )
    if counts["contradictory"] > max(1, 0.05 * n):
        out.append(
            f"{counts['contradictory']} of {n} heliostats contradict the model: where detectors or heliostats stand, "
            "the channels' order, or the time is not as said."
        )
    if counts["unresolved"]:
        out.append(f"{counts['unresolved']} labels are nearer than 1/T to another: record longer.")
    return out


def read_labels(path: Path, plant: Plant) -> dict[str, Array]:
    """Labels by id [Hz], of every heliostat of a plant that has any."""
    table = tables.cells(path)
    wanted = ["id", "rate_elevation_hz", "rate_azimuth_hz"]
    places = tables.columns_of(table, wanted, lambda n: True)
    p = plant.prisms
    out = {name: np.array([p.low, p.high]) for name in plant.field.ids}
    told = set()
    for line, row in table.rows[1:]:
        name = row[places["id"]].strip()
        if name not in out:
            raise table.fail(line, "id", f"{printable(name)[:60]!r} is no heliostat of the plant; mend it")
        f = np.array([table.number(line, k, row[places[k]], p.low, p.high) for k in wanted[1:]])
        if np.isfinite(f).all():
            out[name] = f
            told.add(name)
    w = watch(plant)
    lacking = [plant.field.ids[k] for k in w.who if plant.field.ids[k] not in told]
    if lacking:
        raise BenchsimError(f"{path}: rate_elevation_hz, rate_azimuth_hz: {lacking[0]} has none; add its labels")
    return out


def read_record(path: Path, count: int) -> tuple[float, Array, NDArray[np.int_]]:
    """Sampling rate [Hz], samples (m, samples), and which of ``count`` detectors they are, (m,) from 0.

    Raises
    ------
    BenchsimError
        If the file is no such record.
    """
    body = read_file(path, RECORD_BYTES)
    if body[:4] in (b"RIFF", b"RIFX", b"RF64"):
        return _wav(path, body, count)
    return _csv(path, body, count)


def _wav(path: Path, body: bytes, count: int) -> tuple[float, Array, NDArray[np.int_]]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            rate, data = wavfile.read(io.BytesIO(body))
        values = np.asarray(data)
        whole = values.ndim == 2 and values.dtype.kind in "iuf" and rate > 0
    # What stands in a damaged file decides which error it is.
    except Exception:
        raise BenchsimError(f"{path}: is no WAV that can be read; write PCM or floats, all channels in one") from None
    if not whole or values.shape[1] != count:
        n = values.shape[1] if values.ndim == 2 else 1
        raise BenchsimError(
            f"{path}: has {n} channels, the plan {count} detectors; write one for each, in the order of detectors.csv"
        )
    return float(rate), np.asarray(values.T, float), np.arange(count)


def _csv(path: Path, body: bytes, count: int) -> tuple[float, Array, NDArray[np.int_]]:
    def fail(says: str) -> BenchsimError:
        return BenchsimError(f"{path}: {says}")

    try:
        head, _, rest = body.decode("utf-8-sig").partition("\n")
    except UnicodeDecodeError:
        raise fail("is neither WAV nor CSV in UTF-8; save it so") from None
    separator = max(",;\t", key=head.count)
    names = [c.strip() for c in head.strip().split(separator)]
    known = {f"detector_{k + 1}": k for k in range(count)}
    if names[0] != "time_s" or len(names) < 2:
        raise fail("the first line names no columns time_s, detector_1 and so on; add it")
    odd = next((n for n in names[1:] if n not in known or names.count(n) > 1), None)
    if odd is not None:
        raise fail(f"{printable(odd)[:40]!r} is none of detector_1 to detector_{count}, or is there twice; mend it")
    try:
        table = np.loadtxt(io.StringIO(rest), delimiter=separator, ndmin=2, comments=None)
    except (ValueError, OverflowError) as error:
        raise fail(f"a line is not of numbers ({printable(str(error))[:120]}); mend it") from None
    if table.shape[1] != len(names) or len(table) < FEWEST:
        raise fail(f"has {len(table)} lines of {table.shape[1]} numbers; give {FEWEST} or more of {len(names)}")
    steps = np.diff(table[:, 0])
    with np.errstate(all="ignore"):
        mean = float(np.mean(steps))
        even = np.isfinite(mean) and mean > 1e-6 and np.abs(steps - mean).max() < 0.05 * mean
    if not even:
        raise fail("time_s: does not grow by equal steps; resample the record")
    return 1 / mean, table[:, 1:].T, np.array([known[n] for n in names[1:]])
