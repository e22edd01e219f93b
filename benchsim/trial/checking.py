"""Files of a trial against its ledger: every check that `open` makes before it opens, and `verify` at any time."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchsim.bench.errors import BenchsimError
from benchsim.bench.reading import JSON_BYTES, load_json, read_file
from benchsim.trial import leak_test, ledger
from benchsim.trial.hashing import canonical, commitment, digest, files_of
from benchsim.trial.ledger import Standing

MOST_TOLD = 5
"""Complaints that are printed; the others are counted."""


@dataclass(frozen=True)
class Trial:
    """A trial's folder and what its ledger says."""

    folder: Path
    stands: Standing


def checked(trial: Trial, *, opened: bool, recordings: bool = True) -> list[str]:
    """What is not as the ledger commits to, one sentence each.

    Parameters
    ----------
    trial : Trial
    opened : bool
        Whether truths are to be checked against their commitments.
    recordings : bool
        False: the recordings' images may be missing; in a trial of the first format, all but their ledger.
    """
    at, stands = trial.folder, trial.stands
    out = []
    names = {p.name for p in _entries(at / "recordings")} - {ledger.NAME}
    out += [
        f"recordings/{name}: was not there when the ledger was sealed" for name in sorted(names - {*stands.concealed})
    ]
    for case, line in stands.concealed.items():
        folder = at / "recordings" / case
        if recordings or folder.is_dir() or stands.trial["format"] != ledger.FIRST:
            wrong = _differences(folder, line["files"], f"recordings/{case}", () if recordings else (".png",))
            if recordings and "clues" in line and not wrong:
                wrong = _clues(folder, line["clues"], f"recordings/{case}")
            out += wrong
    if stands.judged:
        verdicts = at / "verdicts"
        allowed = {ledger.NAME} | {
            _place(case, run) for case, runs in stands.judged.items() for run in range(1, len(runs) + 1)
        }
        if stands.committed:
            names = {p.name for p in _entries(verdicts)}
            out += [f"verdicts/{name}: the ledger knows nothing of it" for name in sorted(names - allowed)]
        for case, runs in stands.judged.items():
            for run, line in enumerate(runs, 1):
                place = _place(case, run)
                out += _differences(verdicts / place, line["files"], f"verdicts/{place}")
    if opened:
        out += _truths(trial)
    return out


def _place(case: str, run: int) -> str:
    return case if run == 1 else f"{case}-run-{run}"


def _entries(folder: Path) -> list[Path]:
    return list(folder.iterdir()) if folder.is_dir() else []


def _clues(folder: Path, written: Mapping[str, int], where: str) -> list[str]:
    """Times and places on the disk were written down when the recordings were sealed, and are another copy's by now."""
    kept = [
        {k: v for k, v in c.items() if not k.endswith(leak_test.PASSING)} for c in (leak_test.clues(folder), written)
    ]
    if kept[0] != kept[1]:
        return [f"{where}: its names, sizes or metadata are not those that the ledger holds for the leak test"]
    return []


def _differences(folder: Path, files: Mapping[str, str], where: str, missing: tuple[str, ...] = ()) -> list[str]:
    """Where a folder does not hold the files of the ledger; those that end in ``missing`` may be."""
    if not folder.is_dir():
        return [f"{where}: is not there"]
    try:
        found = files_of(folder)
    except BenchsimError as error:
        return [str(error)]
    gone = sorted(name for name in files.keys() - found.keys() if not (missing and name.endswith(missing)))
    out = [f"{where}/{name}: is not there" for name in gone]
    out += [f"{where}/{name}: was not there when it was committed to" for name in sorted(found.keys() - files.keys())]
    return out + [f"{where}/{name}: was changed" for name in files if name in found and found[name] != files[name]]


def _truths(trial: Trial) -> list[str]:
    """Truths, salts, plan and certificate against what was committed to."""
    at, stands = trial.folder / "truth", trial.stands
    out = []
    for case, line in stands.concealed.items():
        try:
            raw = read_file(at / f"{case}.json", JSON_BYTES)
            opening = json.loads(raw)
            same = canonical(opening) + b"\n" == raw
            same &= set(opening) == {"salt", "truth"} and opening["truth"]["case"] == case
            same &= commitment(opening["salt"], opening["truth"]) == line["commitment"]
            if case in stands.opened:
                same &= opening["salt"] == stands.opened[case]["salt"]
        except BenchsimError as error:
            out.append(str(error))
            continue
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            same = False
        if not same:
            out.append(f"truth/{case}.json: truth or salt is not what was committed to")
    for name, wanted in (
        ("plan", stands.trial["plan"]),
        ("certificate", digest(canonical(stands.trial["certificate"]))),
    ):
        try:
            raw = read_file(at / f"{name}.json", JSON_BYTES)
            if digest(raw[:-1]) != wanted or raw[-1:] != b"\n":
                out.append(f"truth/{name}.json: is not what was committed to")
        except BenchsimError as error:
            out.append(str(error))
    if stands.trial["certificate"].get("passed") is not True:
        out.append("truth/certificate.json: the generator was not certified")
    known = {f"{case}.json" for case in stands.concealed} | {"plan.json", "certificate.json"}
    out += [f"truth/{p.name}: the ledger knows nothing of it" for p in _entries(at) if p.name not in known]
    return out


def complain(problems: list[str]) -> None:
    """Raise BenchsimError if there are any."""
    if problems:
        more = f"; and {len(problems) - MOST_TOLD} more" if len(problems) > MOST_TOLD else ""
        raise BenchsimError(f"the trial does not verify: {'; '.join(problems[:MOST_TOLD])}{more}")


def truths_of(trial: Trial) -> dict[str, tuple[str, dict[str, Any]]]:
    """Case → salt and truth; check them before."""
    out = {}
    for case in trial.stands.concealed:
        opening = load_json(trial.folder / "truth" / f"{case}.json")
        out[case] = (opening["salt"], opening["truth"])
    return out


def diagnosis_of(trial: Trial, case: str) -> dict[str, Any] | None:
    """``diagnosis.json`` of the first run, None where there is no verdict."""
    path = trial.folder / "verdicts" / case / "diagnosis.json"
    return load_json(path) if path.is_file() else None
