"""``benchsim trial verify``: is everything as it was committed to? Needs no secret."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchsim.bench.errors import BenchsimError
from benchsim.jobs.progress import Progress, silent
from benchsim.trial import ledger
from benchsim.trial.checking import Trial, checked, complain, truths_of
from benchsim.trial.hashing import digest
from benchsim.trial.opening import assembled


@dataclass(frozen=True)
class VerifyResult:
    """What was found to hold."""

    folder: Path
    cases: int
    stage: str
    head: str
    recordings: bool

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``--json``."""
        return {
            "verified": True,
            "folder": str(self.folder),
            "cases": self.cases,
            "stage": self.stage,
            "head": self.head,
            "recordings_checked": self.recordings,
        }

    def summary(self) -> str:
        """What a person wants to know, on a terminal."""
        unseen = "" if self.recordings else "\nThe recordings' images were not there and were NOT checked."
        return f"verified: {self.cases} cases, {self.stage}; the ledger's last hash is {self.head}{unseen}"


def verify(
    folder: Path | str, *, published: str | None = None, recordings: bool = True, progress: Progress = silent
) -> VerifyResult:
    """Check a trial as far as it has come: ledger, recordings, verdicts, and after the opening truths and score.

    Parameters
    ----------
    folder : path
        Holds ``recordings/``, ``verdicts/``, ``truth/`` as far as they are there.
    published : str, optional
        A hash that was published when a part ended; the ledger must hold it. Without one, a ledger that was written
        anew from its beginning cannot be told from the first.
    recordings : bool
        False: the images are not there and are not checked.

    Raises
    ------
    BenchsimError
        If anything is not as it was committed to.
    """
    at = Path(folder)
    progress("checking the ledger", 0.0)
    parts = [at / "recordings" / ledger.NAME, at / "verdicts" / ledger.NAME, at / ledger.NAME]
    there = [p for p in parts if p.exists()]
    if not there:
        raise BenchsimError(f"{at}: holds no ledger; name the folder of a trial")
    read = [ledger.read(p) for p in there]
    last = parts.index(there[-1])
    problems = [f"{p.parent.name}/{p.name}: is not there" for p in parts[:last] if p not in there]
    for shorter, longer, path in zip(read, read[1:], there, strict=False):
        if longer[: len(shorter)] != shorter:
            problems.append(f"{path.parent.name}/{path.name}: what followed it does not begin with it")
    lines = read[-1]
    stands = ledger.standing(lines, str(there[-1].relative_to(at)))
    for path, part in zip(there[:-1], read[:-1], strict=True):
        before = ledger.standing(part, str(path.relative_to(at)))
        whole = before.sealed if path.parent.name == "recordings" else before.committed
        if not whole:
            problems.append(f"{path.parent.name}/{path.name}: ends before its part was done")
    if there[-1] == parts[2] and stands.closed is None:
        problems.append("ledger.jsonl: ends before the trial was closed; a line was removed")
    if there[-1] == parts[0] and not stands.sealed:
        problems.append("recordings/ledger.jsonl: ends before the recordings were sealed; a line was removed")
    if (at / "score.json").exists() and stands.closed is None:
        problems.append("score.json: is there, but the ledger is not closed")
    problems += [f"case {case}: was judged {len(stands.judged[case])} times" for case in stands.twice]
    if published is not None and published not in {line["hash"] for line in lines}:
        problems.append(f"--published {published[:12]}…: no line of the ledger has this hash; it was written anew")
    progress("checking files", 0.2)
    trial = Trial(at, stands)
    opened = stands.closed is not None
    problems += checked(trial, opened=opened, recordings=recordings)
    complain(problems)
    if opened:
        progress("scoring again", 0.8)
        complain(_score(trial, lines))
    stage = (
        "opened and scored"
        if opened
        else "judged, not opened"
        if stands.committed
        else f"{len(stands.judged)} of them judged"
        if stands.judged
        else "concealed, not judged"
    )
    return VerifyResult(at, len(stands.concealed), stage, stands.head, recordings)


def _score(trial: Trial, lines: list[ledger.Line]) -> list[str]:
    """The score's hash, and whether it follows from truths and verdicts; predictions are taken as they stand."""
    assert trial.stands.closed is not None
    try:
        text = (trial.folder / "score.json").read_bytes()
    except OSError:
        return ["score.json: is not there"]
    if digest(text) != trial.stands.closed["results"]:
        return ["score.json: was changed"]
    found = {k: v for k, v in json.loads(text).items() if k != "leak"}
    truths = {case: truth for case, (_, truth) in truths_of(trial).items()}
    again = json.loads(json.dumps(assembled(trial, truths, found["kept_back"], lines[:-1])))
    if found != again:
        which = ", ".join(sorted(k for k in again if found.get(k) != again[k])) or "more than there is"
        return [f"score.json: does not follow from truths and verdicts ({which})"]
    return []
