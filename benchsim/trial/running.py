"""``benchsim trial run``: a whole trial on this machine, each part as its own command would do it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from benchsim.bench.errors import BenchsimError
from benchsim.jobs.cluster import Scheduler
from benchsim.jobs.progress import Progress, silent
from benchsim.jobs.workers import processes
from benchsim.trial import ledger
from benchsim.trial.concealing import conceal
from benchsim.trial.judging import Diagnose, judge
from benchsim.trial.opening import OpenResult, open
from benchsim.trial.verifying import verify

Judge = Callable[[Path, Path, Scheduler | None, int | None, Path | None], None]
"""judge(recordings, verdicts, scheduler, workers, key)."""


def apart(
    recordings: Path,
    verdicts: Path,
    scheduler: Scheduler | None,
    workers: int | None,
    key: Path | None = None,
    diagnose: Diagnose | None = None,
) -> None:
    """Judge in a process of its own that is told two folders, of recordings and for verdicts, and nothing else.

    It ends with this one, however this one does.
    """
    with processes(1) as own:
        [(_, ended)] = own.each(_judge, [[(recordings, verdicts, scheduler, workers, key, diagnose)]])
    if isinstance(ended, BenchsimError):
        raise ended
    if isinstance(ended, Exception):
        raise BenchsimError(f"the judge ended with {type(ended).__name__}: {ended}; run the command again to go on")


def _judge(
    recordings: Path,
    verdicts: Path,
    scheduler: Scheduler | None,
    workers: int | None,
    key: Path | None,
    diagnose: Diagnose | None,
) -> None:
    judge(recordings, verdicts, scheduler=scheduler, workers=workers, key=key, diagnose=diagnose)


def run(
    output: Path | str,
    cases: int = 60,
    *,
    seed: int | None = None,
    shrink: int = 2,
    zero: bool = False,
    key: Path | None = None,
    scheduler: Scheduler | None = None,
    workers: int | None = None,
    judge: Judge = apart,
    progress: Progress = silent,
) -> OpenResult:
    """Conceal, judge, open and verify. A stopped run goes on where it was.

    Parameters
    ----------
    output : path
    cases, seed, shrink, zero, key
        As `conceal`; the key signs the verdicts as well.
    scheduler, workers
        What the cases run on, see `cluster.cluster`.
    judge : callable
        See `Judge`.

    Raises
    ------
    BenchsimError
        As the parts.
    """
    folder = Path(output).absolute()
    conceal(
        folder, cases, seed=seed, shrink=shrink, zero=zero, key=key, scheduler=scheduler, workers=workers,
        progress=lambda what, done: progress(what, 0.4 * done),
    )  # fmt: skip
    progress("judging", 0.4)
    path = folder / "verdicts" / ledger.NAME
    ledger.mend(path)
    if not (path.exists() and ledger.standing(ledger.read(path)).committed):
        judge(folder / "recordings", folder / "verdicts", scheduler, workers, key)
    progress("opening", 0.95)
    result = open(folder, workers=workers)
    verify(folder, workers=workers)
    progress("done", 1.0)
    return result
