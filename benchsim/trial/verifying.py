"""``benchsim trial verify``: is everything as it was committed to, and who vouches for that? Needs no secret."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchsim.bench.errors import BenchsimError
from benchsim.bench.reading import file_hash
from benchsim.jobs.progress import Progress, silent
from benchsim.jobs.reporting import NAME as PAGE
from benchsim.trial import anchors, deriving, ledger
from benchsim.trial.checking import Trial, checked, complain
from benchsim.trial.ledger import Standing

NOBODY = (
    "Nobody vouches for it: whoever held the folder may have made all of it anew. Check a root hash that was published "
    "(--root), the signers (--concealer, --judge), a time stamp (--timestamp) or a Git commit (--commit)."
)


@dataclass(frozen=True)
class VerifyResult:
    """What was found to hold.

    Attributes
    ----------
    folder : Path
    cases : int
    stage : str
    head : str
        Hash of the ledger's last line.
    signed : mapping of "concealer" or "judge" → public key
    vouched : tuple of str
        What ties it to the world; empty if the folder stands for itself alone.
    unchecked : tuple of str
        What was not, or could not be, made again.
    """

    folder: Path
    cases: int
    stage: str
    head: str
    signed: dict[str, str]
    vouched: tuple[str, ...]
    unchecked: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``--json``."""
        return {
            "verified": True,
            "folder": str(self.folder),
            "cases": self.cases,
            "stage": self.stage,
            "head": self.head,
            "signed": self.signed,
            "vouched": list(self.vouched),
            "unchecked": list(self.unchecked),
        }

    def summary(self) -> str:
        """What a person wants to know, on a terminal."""
        lines = [f"verified: {self.cases} cases, {self.stage}; root hash {self.head}"]
        lines += [f"{by}: " + (f"signed, key {self.signed[by]}" if by in self.signed else "unsigned") for by in BOTH]
        if len(set(self.signed.values())) == 1 and len(self.signed) == len(BOTH):
            lines.append("Both signed with the same key.")
        lines += [f"NOT checked: {what}" for what in self.unchecked]
        return "\n".join([*lines, f"vouched for by: {'; '.join(self.vouched)}" if self.vouched else NOBODY])


BOTH = ("concealer", "judge")


def verify(
    folder: Path | str,
    *,
    roots: Sequence[str] = (),
    concealer: str | None = None,
    judge: str | None = None,
    timestamp: tuple[Path, Path] | None = None,
    commit: tuple[Path, str] | None = None,
    unopened: bool = False,
    recordings: bool = True,
    page: bool = True,
    workers: int | None = None,
    progress: Progress = silent,
) -> VerifyResult:
    """Check a trial: ledger, recordings, verdicts, truths; and make again all that follows from them.

    Parameters
    ----------
    folder : path
    roots : sequence of str
        Hashes that were published when a part ended; each has to end a part of this ledger.
    concealer, judge : str, optional
        Public keys by which they have to have signed.
    timestamp : (token, authority), optional
        See `anchors.stamped`.
    commit : (repository, hash), optional
        See `anchors.committed`.
    unopened : bool
        True: it is on its way; check it as far as it has come.
    recordings, page : bool
        False: the images, the page may be missing, and are not checked.
    workers : int, optional
        See `cluster.cluster`.

    Raises
    ------
    BenchsimError
        If anything is not as it was committed to, or not vouched for as asked.
    """
    at = Path(folder)
    progress("checking the ledger", 0.0)
    parts = {"recordings": at / "recordings", "verdicts": at / "verdicts", "opening": at}
    read = {part: ledger.read(p / ledger.NAME) for part, p in parts.items() if (p / ledger.NAME).exists()}
    if "recordings" not in read:
        raise BenchsimError(f"{at}: holds no recordings/{ledger.NAME}; name the folder of a trial")
    if "opening" in read and "verdicts" not in read:
        raise BenchsimError(f"the trial does not verify: verdicts/{ledger.NAME}: is not there")
    stood = {part: ledger.standing(own, f"{parts[part].relative_to(at) / ledger.NAME}") for part, own in read.items()}
    lines, stands = list(read.values())[-1], list(stood.values())[-1]
    ends = {part: s.head for part, s in stood.items()}
    problems = _unfinished(stood, unopened) + _files(at, stands, recordings, page)
    for shorter, longer in zip(read, list(read)[1:], strict=False):
        if read[longer][: len(read[shorter])] != read[shorter]:
            problems.append(f"{longer}: the ledger does not begin with that of {shorter}")
    problems += [f"case {case}: was judged {len(stands.judged[case])} times" for case in stands.twice]
    problems += anchors.unsigned(stands, {"concealer": concealer, "judge": judge})
    problems += [
        f"--root {root[:12]}…: no part of this trial ends with it; it is another one, was written anew or cut short"
        for root in roots
        if root.strip().lower() not in ends.values()
    ]
    progress("checking files", 0.1)
    trial = Trial(at, stands)
    opened = stands.closed is not None
    problems += checked(trial, opened=opened or (at / "truth").exists(), recordings=recordings)
    complain(problems)
    vouched = [f"published root of the {part}" for part, head in ends.items() if head in _plain(roots)]
    vouched += [f"{by} as expected" for by, key in zip(BOTH, (concealer, judge), strict=True) if key]
    if timestamp is not None:
        part, when = anchors.stamped(*timestamp, ends)
        vouched.append(f"time stamp of the {part}, {when}")
    if commit is not None:
        vouched.append(f"commit {commit[1]} with the root of the {anchors.committed(*commit, ends)}")
    unchecked = [] if recordings else ["the recordings' images"]
    if opened:
        with deriving.readable(at):
            wrong, unmade = deriving.differing(
                trial, lines, page=page, workers=workers, progress=lambda what, done: progress(what, 0.2 + 0.8 * done)
            )
        complain(wrong)
        unchecked += unmade
    stage = (
        "opened and scored"
        if opened
        else "judged, NOT opened"
        if stands.committed
        else f"{len(stands.judged)} of them judged"
        if stands.judged
        else "concealed, NOT judged"
    )
    signed = {by: line["key"] for by, line in stands.signed.items()}
    return VerifyResult(at, len(stands.concealed), stage, stands.head, signed, tuple(vouched), tuple(unchecked))


def _plain(roots: Sequence[str]) -> set[str]:
    return {root.strip().lower() for root in roots}


def _unfinished(stood: dict[str, Standing], unopened: bool) -> list[str]:
    """Parts whose ledger ends before they were done."""
    out = []
    if not stood["recordings"].sealed or stood["recordings"].judged:
        out.append(f"recordings/{ledger.NAME}: does not end where the recordings were sealed")
    if "opening" in stood:
        if not stood["verdicts"].committed or stood["verdicts"].opened:
            out.append(f"verdicts/{ledger.NAME}: does not end where the verdicts were committed to")
        if stood["opening"].closed is None:
            out.append(f"{ledger.NAME}: ends before the trial was closed; a line was removed")
    elif not unopened:
        out.append("the trial is not opened, or its opening was taken away; say --unopened to check one on its way")
    elif "verdicts" in stood and stood["verdicts"].opened:
        out.append(f"verdicts/{ledger.NAME}: goes on beyond the verdicts")
    return out


def _files(at: Path, stands: Standing, recordings: bool, page: bool) -> list[str]:
    """What must lie in the folder by what the ledger claims, and nothing else."""
    must, may = {"recordings"}, {"truth"}
    if stands.judged:
        must |= {"verdicts"}
    else:
        may |= {"verdicts"}
    if stands.closed is not None:
        must |= {"truth", "score.json", PAGE, ledger.NAME}
    if not page:
        must, may = must - {PAGE}, may | {PAGE}
    found = {p.name for p in at.iterdir()}
    out = [f"{name}: is not there" for name in sorted(must - found)]
    out += [f"{name}: the ledger knows nothing of it" for name in sorted(found - must - may)]
    out += [f"{name}: is a link" for name in sorted(found) if (at / name).is_symlink()]
    closed = stands.closed
    for name, key in (("score.json", "results"), (PAGE, "page")):
        if closed is not None and key in closed and (at / name).is_file() and file_hash(at / name) != closed[key]:
            out.append(f"{name}: is not the one that the ledger closes with")
    return out
