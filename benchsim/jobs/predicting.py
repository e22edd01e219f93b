"""``benchsim predict``: by how much a mount, amended by what was found, misses in recordings that were not used."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from benchsim.bench.writing import write_csv, write_text
from benchsim.instruments.mount import later_records, misses
from benchsim.instruments.mount.json_values import finite, load
from benchsim.instruments.mount.records import UNITS, Array, Session
from benchsim.jobs import amended_mounts
from benchsim.jobs.aiming import Aim, aim_at
from benchsim.jobs.output import wanted_folder, written
from benchsim.jobs.progress import Progress, silent
from benchsim.jobs.shown import Shown
from benchsim.reports import mount_pictures
from benchsim.reports.quantities import counted

TOLD = 20
"""Records of a summary; the file has all."""


@dataclass(frozen=True)
class Miss:
    """The miss of a record, nan where there is none.

    Attributes
    ----------
    id : str
    target : str
        Empty for the sky.
    miss_mrad, stated_mrad : float
        Half the angle between the predicted beam and the spot, of the amended mount and of the mount as stated; of a
        telescope the angle between where it points and the star.
    sigma_mrad : float
        Below which such a miss lies in 68.27 % of cases; nan where the file does not say.
    miss_mm : float
        On the target.
    learnt : bool
        Whether the record is among those that the mount was amended by.
    """

    id: str
    target: str
    miss_mrad: float
    stated_mrad: float
    sigma_mrad: float
    miss_mm: float
    learnt: bool

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in vars(self).items()}


@dataclass(frozen=True, repr=False)
class Prediction(Shown):
    """Misses of recordings.

    Attributes
    ----------
    title : str
    sky : bool
        Whether the mount is a telescope's; its text is in arcsec.
    records : tuple of Miss
    remarks : tuple of str
    aim : Aim or None
        Motor positions that were asked for beside.
    folder : Path, optional
        Where it was written.
    """

    title: str
    sky: bool
    records: tuple[Miss, ...]
    remarks: tuple[str, ...]
    aim: Aim | None
    folder: Path | None = None

    @property
    def counted(self) -> tuple[Miss, ...]:
        """The records that figures are made of: those that were not used, or all where there is no other."""
        finite = [r for r in self.records if math.isfinite(r.miss_mrad)]
        return tuple([r for r in finite if not r.learnt] or finite)

    @property
    def coverage(self) -> float | None:
        """Part of the misses that lie within their predicted sigma, 0.68 being expected; None: none is predicted, or
        all were learnt from."""
        known = [r for r in self.counted if math.isfinite(r.sigma_mrad) and not r.learnt]
        return float(np.mean([r.miss_mrad <= r.sigma_mrad for r in known])) if known else None

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``prediction.json``; what is not known is null."""
        amended, as_stated = (_figures([getattr(r, k) for r in self.counted]) for k in ("miss_mrad", "stated_mrad"))
        return {
            "format": "benchsim-prediction/1",
            "records": [r.as_dict() for r in self.records],
            "median_mrad": amended[0],
            "rms_mrad": amended[1],
            "stated_median_mrad": as_stated[0],
            "stated_rms_mrad": as_stated[1],
            "coverage": self.coverage,
            "learnt": sum(r.learnt for r in self.records),
            "remarks": list(self.remarks),
            "aim": None if self.aim is None else self.aim.as_dict(),
        }

    def text(self) -> str:
        """Plain sentences and a table for ``summary.txt``."""
        unit, one = ("arcsec", UNITS["mrad"] / UNITS["arcsec"]) if self.sky else ("mrad", 1.0)
        plain = self.as_dict()
        count = len(self.counted)
        lines = [f"{self.title}: {counted(count, 'record')} predicted"]
        for word, key in (("as amended", ""), ("as stated", "stated_")):
            values = [plain[f"{key}{k}_mrad"] for k in ("median", "rms")]
            if None not in values:
                of = "" if self.sky else " of the normal"
                lines.append(f"  {word:<11} median {one * values[0]:.3g}, rms {one * values[1]:.3g} {unit}{of}")
        if self.coverage is not None:
            lines.append(f"  {100 * self.coverage:.0f} % within their predicted sigma (68 % are to be expected)")
        on_target = "" if self.sky else "; on target"
        lines += ["", f"  {'record':<20} {'miss':>9} {'sigma':>9} {'as stated':>9} {unit}{on_target}"]
        worst = sorted(self.records, key=lambda r: -r.miss_mrad if math.isfinite(r.miss_mrad) else -math.inf)
        for r in worst[:TOLD]:
            known = (r.miss_mrad, r.sigma_mrad, r.stated_mrad)
            cells = " ".join(f"{one * v:9.3f}" if math.isfinite(v) else f"{'–':>9}" for v in known)
            on = f"      {r.miss_mm:8.0f} mm" if math.isfinite(r.miss_mm) else ""
            lines.append(f"  {r.id:<20} {cells}{on}{'  (learnt from)' if r.learnt else ''}")
        if len(worst) > TOLD:
            lines.append(f"  … and {len(worst) - TOLD} that miss by less")
        lines += ["", *self.remarks] if self.remarks else []
        return "\n".join(lines + (["", self.aim.text()] if self.aim is not None else []))

    def summary(self) -> str:
        """What a person wants to know, on a terminal."""
        return f"{self.text()}\n{written(self.folder)}"


@threadpool_limits.wrap(limits=1)
def predict(
    amended: Path | str,
    recordings: Path | str,
    output: Path | str | None = None,
    *,
    tower: Path | str | None = None,
    aim: str | None = None,
    time: str | None = None,
    draw: bool = True,
    progress: Progress = silent,
) -> Prediction:
    """Predict recordings that were not used, and say by how much they are missed.

    The mount is that of ``amended``; of the recordings only readings, sun and spots count.

    Parameters
    ----------
    amended : path
        An ``amended.toml`` of a mount; or a heliostat's properties in the PAINT format, a file or a folder.
    recordings : path
        A PAINT folder, or a telescope's pointing file.
    output : path, optional
        Folder for ``prediction.json``, ``prediction.csv``, ``summary.txt`` and ``prediction.png``; by default nothing
        is written.
    tower : path, optional
        Tower file of PAINT recordings; default that of ``amended``.
    aim, time : str, optional
        Beside, motor positions as `aiming.aim` gives them.
    draw : bool
        Whether to draw a picture.
    progress : callable

    Returns
    -------
    Prediction

    Raises
    ------
    BenchsimError
        If either cannot be used, or they are not of one mount.
    """
    progress("reading the records", 0.0)
    place = None if tower is None else Path(tower)
    session = amended_mounts.read(Path(amended), place)
    later, remarks = later_records.read(session, Path(recordings))
    learnt = later_records.among(later.records, session.records)
    if session.mount.observes == "spot" and session.path.suffix != ".toml":
        # A heliostat as its file states it was learnt from nothing.
        learnt[:] = False
    if learnt.any():
        remarks.append(
            f"{learnt.sum()} of {len(learnt)} records were used to learn it; their misses say nothing"
            + (", and no other is there." if learnt.all() else ", and are not counted.")
        )
    remarks += _untold(later)
    folder = None if output is None else Path(output)
    with wanted_folder(folder, "predict", later.files, {"pictures": draw}) as staging:
        aimed = None if aim is None else aim_at(session, aim, time)
        progress("predicting", 0.2)
        records = _missed(session, later, learnt)
        lost = [r.id for r in records if not math.isfinite(r.miss_mrad)]
        if lost:
            remarks.append(f"The amended mount cannot reach the readings of {', '.join(lost)}: no triangle closes.")
        result = Prediction(later.title, later.mount.observes == "sky", records, tuple(remarks), aimed, folder)
        if staging is None:
            return result
        write_text(staging / "prediction.json", json.dumps(result.as_dict(), indent=1, allow_nan=False) + "\n")
        rows = [r.as_dict() for r in records]
        write_csv(staging / "prediction.csv", list(rows[0]), (row.values() for row in rows))
        write_text(staging / "summary.txt", result.text() + "\n")
        if draw:
            progress("drawing", 0.8)
            _draw(staging / "prediction.png", result)
    progress("done", 1.0)
    return result


def _untold(later: Session) -> list[str]:
    """What is stated that these records do not show the cause of."""
    records, out = later.records, []
    if "thermal-growth" in later.effects and records.warmth is None:
        out.append("thermal-growth is stated, but these records have no season or temperature: taken at the mean.")
    if "backlash" in later.effects and (records.travel is None or not records.travel.all(axis=1).any()):
        out.append("backlash is stated, but the order of these records does not show it: taken amid the play.")
    return out


def _missed(session: Session, later: Session, learnt: NDArray[np.bool_]) -> tuple[Miss, ...]:
    planes = _planes(session) if session.mount.observes == "spot" else {}
    miss, distance = misses.misses(later, planes)
    plain = replace(later, mount=amended_mounts.as_stated(session), effects={}, fields={})
    as_stated = misses.misses(plain, planes)[0]
    sigma = np.full(len(miss), np.nan)
    if later.learnt is not None:
        sigma = np.array([misses.radius(c) for c in misses.covariances(later, later.learnt)])
    columns = (x.tolist() for x in (miss, as_stated, sigma, distance, learnt))
    return tuple(Miss(*row) for row in zip(later.records.names, later.records.target, *columns, strict=True))


def _planes(session: Session) -> dict[str, Array]:
    """Normals of the targets that the tower's file states."""
    plant = load(session.files[-1])
    normals = {t: plant[t].get("normal_vector") for t in session.mount.targets if isinstance(plant[t], Mapping)}
    return {
        t: np.array(v, float)
        for t, v in normals.items()
        if isinstance(v, list) and len(v) == 3 and all(finite(x) for x in v) and any(v)
    }


def _draw(path: Path, result: Prediction) -> None:
    unit, one = ("arcsec", UNITS["mrad"] / UNITS["arcsec"]) if result.sky else ("mrad of the normal", 1.0)
    keys = ("miss_mrad", "sigma_mrad", "stated_mrad")
    miss, sigma, as_stated = (one * np.array([getattr(r, k) for r in result.records]) for k in keys)
    learnt = np.array([r.learnt for r in result.records])
    within = "" if result.coverage is None else f"; {100 * result.coverage:.0f} % within their predicted sigma"
    title = f"{result.title}: misses of {len(result.counted)} records{within}"
    mount_pictures.prediction(path, miss, sigma, as_stated, learnt, unit, title)


def _figures(values: list[float]) -> tuple[float | None, float | None]:
    """Median and rms of those that are known."""
    known = [v for v in values if math.isfinite(v)]
    return (float(np.median(known)), float(np.sqrt(np.mean(np.square(known))))) if known else (None, None)
