"""What arrays of detectors see of a plant, in numbers, words and files."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from benchsim.arrays.labelling import clashes
from benchsim.bench.writing import write_csv, write_text
from benchsim.jobs.detector_simulated import CHANNELS, Simulated, channels
from benchsim.jobs.detector_station import UNSEEN, Watch, unseen
from benchsim.jobs.output import written
from benchsim.jobs.shown import Shown
from benchsim.plant.model import Plant
from benchsim.plant.station import DetectorArray, Station
from benchsim.reports import detector_pictures, page, page_detectors
from benchsim.reports.pictures import save
from benchsim.reports.quantities import counted

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

FORMAT = "benchsim-detectors/1"

LIMIT = 1e-4
"""Of sigma of either angle, up to which a heliostat counts as seen [rad]: a tenth of a usual slope error."""


LACKS = ("hidden by another mirror", "with a trace beside the arrays", "too faint")
"""Why a heliostat is not seen at a time: the first of these that holds."""


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
    dark : tuple of str
        Days of a year that are left out, as the sun stands too low.
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
    dark: tuple[str, ...] = ()
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
        seen, lacks = self.seen[:, i], self.lacks[:, i]
        if len(seen) == 1:
            return "seen" if seen[0] else f"not seen: {LACKS[int(lacks.argmax())]}"
        if seen.all():
            return f"seen at all {len(seen)} times"
        many = ", ".join(f"{what} at {n}" for what, n in zip(LACKS, lacks, strict=True) if n)
        return f"{'seen at times' if seen.any() else 'never seen'}; of {len(seen)} times {many}"

    @cached_property
    def lacks(self) -> NDArray[np.int_]:
        """(3, k): at how many times each of `LACKS` is why a heliostat is not seen."""
        lit = self.crossed & ~self.hidden
        return np.array([self.hidden.sum(axis=0), (~lit & ~self.hidden).sum(axis=0), (lit & ~self.seen).sum(axis=0)])

    def never(self) -> str:
        """How many heliostats are never seen, and why: each by what is in the way most often."""
        why = Counter(UNSEEN[w] for w in unseen(self.plant, self.watch.station) if w)
        why.update(LACKS[int(k)] for k in self.lacks.argmax(axis=0)[~self.seen.any(axis=0)])
        reasons = ", ".join(f"{n} {what}" for what, n in why.most_common())
        return f"{why.total()} ({reasons})" if why else "0"

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
            "days_left_out": list(self.dark),
            "remarks": [*self.plant.remarks, *s.remarks],
        }
        if self.record is not None:
            out["record"] = self.record.as_dict()
        return out

    def text(self) -> str:
        """Plain sentences for ``summary.txt``."""
        s, labels, f = self.watch.station, self.watch.labels, self.plant.field
        last = f" to {self.times[-1]:%Y-%m-%d %H:%M}" if len(self.times) > 1 else ""
        lines = [
            f"{self.plant.name}: {counted(len(f), 'heliostat')}, {', '.join(_place(a) for a in s.arrays)}; "
            f"{counted(len(self.times), 'time')}, {self.times[0]:%Y-%m-%d %H:%M}{last}",
            f"  both angles to {1e3 * LIMIT:g} mrad: {100 * self.share:.1f} % of heliostats and times"
            + (f" (as stated {100 * self.before:.1f} %)" if self.before is not None else ""),
        ]
        if self.dark:
            lines.append(f"  left out, as the sun never stands high enough for a plant: {', '.join(self.dark)}")
        if self.seen.any():
            sigma = 1e3 * self.sigma[self.seen]
            low, middle, high = np.percentile(sigma, [5, 50, 95])
            lines.append(f"  sigma then: {middle:.2g} mrad, of nine in ten between {low:.2g} and {high:.2g}")
        hidden, beside = self.hidden.mean(), (~self.crossed & ~self.hidden).mean()
        lines.append(
            f"  never seen: {self.never()}; of all times {100 * hidden:.1f} % hidden by another mirror, "
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
        return self.text() + written(self.folder, page=True) + f"\nnext: {step}"

    def figures(self) -> list[Figure]:
        """The plan, the arrays, hours, sigma, and what a record told."""
        return list(self.drawings().values())

    def drawings(self) -> dict[str, Figure]:
        """The same by the names of their files."""
        f, w = self.plant.field, self.watch
        share = np.zeros(len(f))
        share[w.who] = self.seen.mean(axis=0)
        receiver = self.plant.receivers[w.station.receiver]
        places = 1e3 * np.array([row[3:] for row in channels(w)])
        out = {
            "plan": detector_pictures.plan(f.position, share, w.station, receiver, places, 1e3 * LIMIT),
            "arrays": detector_pictures.arrays(w.station, receiver),
        }
        if len(self.times) > 1:
            hourly = self.seen.mean(axis=1) * len(w.who) / len(f)
            out["hours"] = detector_pictures.hours(self.times, hourly, w.plant.site.zone.key)
        if self.seen.any():
            far = np.linalg.norm(f.position[w.who] - np.array(receiver.centre), axis=1)
            sigma = np.where(self.seen[..., None], self.sigma, np.nan)
            out["sigma"] = detector_pictures.sigmas(far, sigma, 1e3 * LIMIT)
        if (r := self.record) is not None:
            out["loop"] = detector_pictures.loop(r.before, r.after, r.outcomes, 1e3 * LIMIT)
        return out


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
    return f"{counted(a.count, 'detector')} {abs(a.offset) / 1e3:.3g} m {side} ({ends})"


def write(r: DetectorsResult, folder: Path) -> None:
    rows = r.rows()
    write_csv(folder / "heliostats.csv", list(rows[0]), (row.values() for row in rows), 9)
    ids = [r.plant.field.ids[k] for k in r.watch.who]
    body = (
        [t, ids[i], int(r.seen[k, i]), int(r.hidden[k, i]), *(_finite(1e3 * x) for x in r.sigma[k, i])]
        for k, t in enumerate(t.isoformat() for t in r.times)
        for i in range(len(ids))
    )
    header = ["time", "id", "seen", "hidden", "sigma_elevation_mrad", "sigma_azimuth_mrad"]
    write_csv(folder / "times.csv", header, body, 4)
    write_csv(folder / "detectors.csv", CHANNELS, channels(r.watch), 7)
    write_text(folder / "detectors.toml", tables_of(r.plant, r.watch.station))
    pictures = {name: save(figure, folder / f"{name}.png") for name, figure in r.drawings().items()}
    if r.record is not None:
        r.record.write(folder)
    plain, text = r.as_dict(), r.text()
    write_text(folder / "detectors.json", json.dumps(plain, indent=1, allow_nan=False) + "\n")
    write_text(folder / "summary.txt", text + "\n")
    shown = page_detectors.planned(plain, r.plant.name, text, pictures)
    write_text(folder / "report.html", page.plant_page(shown))


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
