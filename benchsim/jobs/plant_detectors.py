"""``benchsim detectors``: which heliostats of a plant two arrays see, when, how well; labels, places, a record."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from benchsim.arrays import placing
from benchsim.arrays.labelling import clashes
from benchsim.arrays.sensitivity import sensitivity
from benchsim.bench.errors import BenchsimError
from benchsim.bench.writing import write_csv, write_text
from benchsim.fluxes.day import clear_sky
from benchsim.jobs import detector_record
from benchsim.jobs.detector_record import Simulated
from benchsim.jobs.detector_station import UNSEEN, Watch, unseen, watch
from benchsim.jobs.output import wanted_folder, written
from benchsim.jobs.progress import Progress, silent
from benchsim.jobs.shown import Shown
from benchsim.plant import days, files
from benchsim.plant.model import Plant
from benchsim.plant.sensors import CLEAR
from benchsim.plant.station import DetectorArray, Station
from benchsim.reports import detector_pictures
from benchsim.reports.pictures import save

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

FORMAT = "benchsim-detectors/1"

LIMIT = 1e-4
"""Of sigma of either angle, up to which a heliostat counts as seen [rad]: a tenth of a usual slope error."""

LOWEST = np.radians(10.0)
"""Height of the sun below which no plant runs."""

BATCH = 500
"""Heliostats whose light is computed at once: 300 MB."""

YEAR = 2026
"""Whose four days are taken unless a time is said; the sun's course differs by 0.1° from year to year."""

SEARCHED = 60
"""Heliostats by which places are compared, evenly through the table: the share is then known to some percent."""

SEARCH_STEP = 3.0
"""Hours between the times by which places are compared."""


@dataclass(frozen=True, repr=False)
class DetectorsResult(Shown):
    """What arrays of detectors see of a plant.

    Attributes
    ----------
    plant : Plant
    watch : Watch
        Arrays, heliostats (k of them) and labels; the arrays placed anew if that was asked for.
    times : tuple of datetime
    sigma : (T, k, 2)
        Of elevation and azimuth by one record of an aligned heliostat [rad]; infinite without light.
    crossed, hidden : (T, k) of bool
        Both traces cross an array, with light above the noise; another mirror stands before the heliostat.
    before : float or None
        Share seen by the arrays as stated, where they were placed anew.
    record : Simulated or None
    folder : Path or None
    """

    plant: Plant
    watch: Watch
    times: tuple[datetime, ...]
    sigma: Array
    crossed: NDArray[np.bool_]
    hidden: NDArray[np.bool_]
    before: float | None = None
    record: Simulated | None = None
    folder: Path | None = None

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(T, k): both angles to `LIMIT`."""
        return np.asarray(self.crossed & (self.sigma <= LIMIT).all(axis=2))

    @property
    def share(self) -> float:
        """Of all heliostats and times, also of heliostats that the arrays can never see."""
        return float(self.seen.sum() / (len(self.times) * len(self.plant.field)))

    def clashes(self) -> list[tuple[float, float]]:
        """Labels that are not apart."""
        labels, a = self.watch.labels, self.watch.assumptions
        return [
            c
            for r in range(labels.rounds)
            for c in clashes(labels.rates[labels.round == r], labels.duration, a.sample_rate, self.plant.prisms.mains)
        ]

    def rows(self) -> list[dict[str, Any]]:
        """For each heliostat of the field: labels, how often it is seen, and how well then (medians, mrad)."""
        f, labels = self.plant.field, self.watch.labels
        why = unseen(self.plant, self.watch.station)
        place = {int(k): i for i, k in enumerate(self.watch.who)}
        out = []
        for k, name in enumerate(f.ids):
            row: dict[str, Any] = {"id": name}
            row |= dict(zip(("east_m", "north_m", "up_m"), (f.position[k] / 1e3).tolist(), strict=True))
            i = place.get(k)
            if i is None:
                row |= dict.fromkeys(
                    ("round", "rate_elevation_hz", "rate_azimuth_hz", "sigma_elevation_mrad", "sigma_azimuth_mrad")
                )
                out.append(row | {"seen": 0.0, "hidden": 0.0, "says": UNSEEN[why[k]]})
                continue
            seen = self.seen[:, i]
            middle = np.median(1e3 * self.sigma[seen, i], axis=0) if seen.any() else [None, None]
            row |= {
                "round": int(labels.round[i]) + 1,
                "rate_elevation_hz": float(labels.rates[i, 0]),
                "rate_azimuth_hz": float(labels.rates[i, 1]),
                "sigma_elevation_mrad": middle[0] if middle[0] is None else float(middle[0]),
                "sigma_azimuth_mrad": middle[1] if middle[1] is None else float(middle[1]),
                "seen": float(seen.mean()),
                "hidden": float(self.hidden[:, i].mean()),
                "says": self._says(i),
            }
            out.append(row)
        return out

    def _says(self, i: int) -> str:
        seen, crossed, hidden = self.seen[:, i], self.crossed[:, i], self.hidden[:, i]
        if seen.all():
            return f"seen at all {len(seen)} times"
        lacks = []
        if hidden.any():
            lacks.append(f"hidden by another mirror at {hidden.sum()} of {len(hidden)} times")
        if (beside := ~crossed & ~hidden).any():
            lacks.append(f"a trace misses the arrays at {beside.sum()}")
        if (faint := crossed & ~seen).any():
            lacks.append(f"too faint at {faint.sum()}")
        return ("seen at times; " if seen.any() else "never seen; ") + ", ".join(lacks)

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``detectors.json``."""
        labels, s = self.watch.labels, self.watch.station
        out: dict[str, Any] = {
            "format": FORMAT,
            "title": self.plant.title,
            "receiver": self.plant.receivers[s.receiver].name,
            "azimuth_deg": float(np.degrees(s.azimuth)),
            "arrays": [_table(a) for a in s.arrays],
            "limit_mrad": 1e3 * LIMIT,
            "share_seen": self.share,
            "share_seen_as_stated": self.before,
            "record_s": labels.duration,
            "sample_rate_hz": self.plant.prisms.sample_rate,
            "rounds": labels.rounds,
            "labels_apart": labels.apart,
            "clashes_hz": [list(c) for c in self.clashes()],
            "times": [
                {
                    "time": t.isoformat(),
                    "seen": int(seen.sum()),
                    "hidden": int(hidden.sum()),
                    "sigma_mrad": float(1e3 * np.median(sigma[seen])) if seen.any() else None,
                }
                for t, seen, hidden, sigma in zip(self.times, self.seen, self.hidden, self.sigma, strict=True)
            ],
            "heliostats": self.rows(),
            "remarks": [*self.plant.remarks, *s.remarks],
        }
        if self.record is not None:
            out["record"] = self.record.as_dict()
        return out

    def text(self) -> str:
        """Plain sentences for ``summary.txt``."""
        s, labels, f = self.watch.station, self.watch.labels, self.plant.field
        name = self.plant.title or self.plant.path.resolve().parent.name
        last = f" to {self.times[-1]:%Y-%m-%d %H:%M}" if len(self.times) > 1 else ""
        lines = [
            f"{name}: {len(f)} heliostats, {', '.join(_place(a) for a in s.arrays)}; {len(self.times)} "
            f"time{'s' if len(self.times) > 1 else ''}, {self.times[0]:%Y-%m-%d %H:%M}{last}",
            f"  both angles to {1e3 * LIMIT:g} mrad: {100 * self.share:.1f} % of heliostats and times"
            + (f" (as stated {100 * self.before:.1f} %)" if self.before is not None else ""),
        ]
        if self.seen.any():
            sigma = 1e3 * self.sigma[self.seen]
            low, middle, high = np.percentile(sigma, [5, 50, 95])
            lines.append(f"  sigma then: {middle:.2g} mrad, of nine in ten between {low:.2g} and {high:.2g}")
        never = int((~self.seen.any(axis=0)).sum()) + len(f) - len(self.watch.who)
        hidden, beside = self.hidden.mean(), (~self.crossed & ~self.hidden).mean()
        lines.append(
            f"  never seen: {never}; of the others' times {100 * hidden:.1f} % hidden by another mirror, "
            f"{100 * beside:.1f} % with a trace beside the arrays"
        )
        rounds = "" if labels.rounds == 1 else f", in {labels.rounds} rounds, while the other prisms rest"
        clash = self.clashes()
        lines.append(
            f"  labels {labels.rates.min():.4g} to {labels.rates.max():.4g} Hz, {labels.apart:.1f}/T apart or "
            f"more by records of {labels.duration:.3g} s{rounds}: "
            + ("none beat or share a harmonic" if not clash else f"{len(clash)} beat or share a harmonic")
        )
        if self.record is not None:
            lines += self.record.lines()
        return "\n".join([*lines, *self.plant.remarks, *s.remarks])

    def summary(self) -> str:
        """What a person wants to know, on a terminal."""
        plant = self.plant.path.parent
        at = f"{self.times[int(self.seen.sum(axis=1).argmax())]:%Y-%m-%dT%H:%M}"
        if self.record is None:
            step = f"benchsim detectors plan {plant} --record {at} simulates a record, measures, corrects"
        else:
            step = f"benchsim detectors read RECORD {plant} --at TIME evaluates your own record"
        return self.text() + written(self.folder) + f"\nnext: {step}"

    def figures(self) -> list[Figure]:
        """The plan, and what a record told."""
        f, w = self.plant.field, self.watch
        share = np.zeros(len(f))
        share[w.who] = self.seen.mean(axis=0)
        receiver = self.plant.receivers[w.station.receiver]
        far = np.linalg.norm(f.position[w.who] - np.array(receiver.centre), axis=1)
        out = [
            detector_pictures.plan(
                f.position, share, w.station, receiver, self.times, self.seen.mean(axis=1) * len(w.who) / len(f),
                far, np.where(self.seen[..., None], self.sigma, np.nan), w.plant.site.zone.key, 1e3 * LIMIT,
            )
        ]  # fmt: skip
        if self.record is not None:
            out.append(detector_pictures.loop(self.record.before, self.record.after, self.record.outcomes, 1e3 * LIMIT))
        return out


@threadpool_limits.wrap(limits=1)
def detectors(
    plant: Plant | Path | str,
    output: Path | str | None = None,
    *,
    at: str | None = None,
    day: str | None = None,
    year: int | None = None,
    step: float = 1.0,
    place: bool = False,
    record: str | None = None,
    errors: str = "drawn",
    seed: int = 0,
    allow_outside: bool = False,
    progress: Progress = silent,
) -> DetectorsResult:
    """Say which heliostats of a plant its arrays of detectors see, when, and how well.

    Parameters
    ----------
    plant : path
        ``plant.toml``, or the folder that holds it.
    output : path, optional
        Folder for ``detectors.json``, ``heliostats.csv``, ``times.csv``, ``detectors.csv``, pictures and
        ``summary.txt``; default: nothing is written.
    at, day, year : optional
        A time of ISO 8601, a date, or a year, of which equinoxes and solstices are taken; default the year 2026.
    step : float
        Between the times of a day [h].
    place : bool
        Look for places of two arrays at which they see the most.
    record : str, optional
        A time at which a record is simulated, measured, and the heliostats corrected.
    errors : {"stated", "none", "drawn", "diagnosed"}
        Of the mounts, in the record.
    seed : int
        Of drawn errors, and of the record's noise.
    allow_outside : bool
        Whether the plant's tables may lie outside of its folder.
    progress : callable

    Returns
    -------
    DetectorsResult

    Raises
    ------
    BenchsimError
        If the plant, a time or an option cannot be used.
    """
    p = plant if isinstance(plant, Plant) else files.read(plant, allow_outside=allow_outside)
    if [at, day, year].count(None) < 2:
        raise BenchsimError("--at, --day, --year: give one of them, or none for a year")
    when = days.at(record, p.site, "--record") if record is not None else None
    dates = [day] if day is not None else [f"{year or YEAR:04d}-{d}" for d in days.QUARTERS]
    times = [days.at(at, p.site)] if at is not None else [t for d in dates for t in days.of_day(d, step, p.site)]
    times = _lit(times, p, LOWEST if at is None else 0.0)
    w = watch(p)
    options = {"at": at, "day": day, "year": year, "step": step, "place": place, "record": record}
    options |= {"errors": errors, "seed": seed}
    with wanted_folder(output, "detectors", p.files, options) as staging:
        weight = (2 if place else 0) + 1 + (3 if when is not None else 0)

        def through(what: str, first: float) -> Any:
            return lambda done: progress(what, 0.98 * (first + done) / weight)

        result = _looked(p, w, times, through("light on the arrays", 0.0))
        if place:
            moved = _placed(p, w, times, through("places", 1.0))
            again = _looked(p, watch(p, moved), times, through("light on the arrays", 2.0))
            if again.share > result.share:
                result = replace(again, before=result.share)
            else:
                result = replace(result, before=result.share)
        if when is not None:
            done = detector_record.simulate(result.watch, when, errors, seed, through("record", weight - 3.0))
            result = replace(result, record=done)
        result = replace(result, folder=None if output is None else Path(output))
        if staging is not None:
            _write(result, staging)
    progress("done", 1.0)
    return result


def _lit(times: Sequence[datetime], plant: Plant, lowest: float) -> list[datetime]:
    """Times at which the sun stands high enough."""
    high = np.arcsin(days.suns(times, plant.site)[:, 2])
    if not (high > lowest).any():
        raise BenchsimError(
            f"--at, --day: the sun stands {np.degrees(high.max()):.1f} deg above the horizon at most; name another time"
        )
    return [t for t, h in zip(times, high, strict=True) if h > lowest]


def _looked(plant: Plant, w: Watch, times: Sequence[datetime], told: Any) -> DetectorsResult:
    suns = days.suns(times, plant.site)
    sky = clear_sky(suns, plant.site.elevation)
    shape = (len(times), len(w.who))
    sigma, crossed, hidden = np.full((*shape, 2), np.inf), np.zeros(shape, bool), np.zeros(shape, bool)
    for t, sun in enumerate(suns):
        told(t / len(suns))
        light, hidden[t] = w.arriving(sun)
        a = replace(w.assumptions, direct_irradiance=float(sky[t]), duration=w.labels.duration)
        for start in range(0, len(w.who), BATCH):
            some = slice(start, start + BATCH)
            s = sensitivity(w.scene(sun, some=some), a, light[some])
            sigma[t, some], crossed[t, some] = s.sigma, s.seen
    return DetectorsResult(plant, w, tuple(times), sigma, crossed, hidden)


def _placed(plant: Plant, w: Watch, times: Sequence[datetime], told: Any) -> Station:
    """The plant's two arrays where they see the most of some heliostats at some of the times."""
    s, receiver = w.station, plant.receivers[w.station.receiver]
    if len(s.arrays) != 2:
        raise BenchsimError(f"{plant.path.name}: detector: two arrays are placed, not {len(s.arrays)}; state two")
    halves = [(receiver.height if not a.upright else receiver.width) / 2 for a in s.arrays]
    found = [placing.places(line, half + CLEAR, -w.origin[2]) for line, half in zip(w.lines, halves, strict=True)]
    if not all(len(p.lines) for p, _ in found):
        raise BenchsimError(f"{plant.path.name}: detector: an array reaches into the ground; make it shorter")
    some = np.unique(np.linspace(0, len(w.who) - 1, SEARCHED).round().astype(int))
    hours = [times[0]]
    for t in times[1:]:
        if abs((t - hours[-1]).total_seconds()) >= 3600 * SEARCH_STEP:
            hours.append(t)
    suns = days.suns(hours, plant.site)
    sky = clear_sky(suns, plant.site.elevation)
    moments = []
    for sun, dni in zip(suns, sky, strict=True):
        # The light is compared at one irradiance: what a sky lets pass goes with what is hidden.
        light = w.arriving(sun)[0][some] * float(dni) / w.assumptions.direct_irradiance
        moments.append((lambda lines, sun=sun: w.scene(sun, lines, some), light))
    best = placing.search(moments, w.assumptions, found, LIMIT, told)
    arrays = []
    for old, line in zip(s.arrays, best.lines, strict=True):
        along = line.along if line.upright else -line.along
        offset = -line.offset if line.upright else line.offset
        arrays.append(replace(old, offset=offset, low=float(along.min()), count=len(along)))
    return Station(s.receiver, s.azimuth, tuple(arrays), ())


def _table(a: DetectorArray) -> dict[str, Any]:
    """Of the plant's file, to twelve digits: with fewer the last detector may be lost."""
    lengths = {"offset_m": a.offset, "from_m": a.along[0], "to_m": a.along[-1], "pitch_m": a.pitch}
    return {
        "name": a.name,
        "along": "vertical" if a.upright else "horizontal",
        **{k: round(float(v) / 1e3, 12) for k, v in lengths.items()},
    }


def tables_of(plant: Plant, station: Station | None = None) -> str:
    """A station's arrays, or the plant's, as its file states them."""
    s = station or plant.station
    if s is None:
        return ""
    own = {"receiver": plant.receivers[s.receiver].name, "azimuth_deg": round(float(np.degrees(s.azimuth)), 12)}
    return "\n".join(
        "[[detector]]\n" + "".join(f"{k} = {json.dumps(v, ensure_ascii=False)}\n" for k, v in (_table(a) | own).items())
        for a in s.arrays
    )


def _place(a: DetectorArray) -> str:
    side = ("left" if a.offset > 0 else "right") if a.upright else ("above" if a.offset > 0 else "below")
    ends = f"{a.along[0] / 1e3:.3g} to {a.along[-1] / 1e3:.3g} m"
    return f"{a.count} detectors {abs(a.offset) / 1e3:.3g} m {side} ({ends})"


def _write(r: DetectorsResult, folder: Path) -> None:
    rows = r.rows()
    write_csv(folder / "heliostats.csv", list(rows[0]), (row.values() for row in rows), 9)
    ids = [r.plant.field.ids[k] for k in r.watch.who]
    body = (
        [t.isoformat(), ids[i], int(r.seen[k, i]), int(r.hidden[k, i]), *(_finite(1e3 * x) for x in r.sigma[k, i])]
        for k, t in enumerate(r.times)
        for i in range(len(ids))
    )
    header = ["time", "id", "seen", "hidden", "sigma_elevation_mrad", "sigma_azimuth_mrad"]
    write_csv(folder / "times.csv", header, body, 4)
    write_csv(folder / "detectors.csv", detector_record.CHANNELS, detector_record.channels(r.watch), 7)
    write_text(folder / "detectors.toml", tables_of(r.plant, r.watch.station))
    first, *more = r.figures()
    save(first, folder / "plan.png")
    for figure in more:
        save(figure, folder / "loop.png")
    if r.record is not None:
        r.record.write(folder)
    write_text(folder / "detectors.json", json.dumps(r.as_dict(), indent=1, allow_nan=False) + "\n")
    write_text(folder / "summary.txt", r.text() + "\n")


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
