"""``benchsim trial run``: a whole trial on this machine, each part as its own command would do it."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from benchsim.bench.errors import BenchsimError
from benchsim.jobs.cluster import Scheduler
from benchsim.jobs.progress import Progress, silent
from benchsim.trial import ledger
from benchsim.trial.concealing import conceal
from benchsim.trial.opening import OpenResult, open
from benchsim.trial.verifying import verify

Judge = Callable[[Path, Path, Scheduler | None, int | None, Path | None], None]
"""judge(recordings, verdicts, scheduler, workers, key)."""


def apart(
    recordings: Path, verdicts: Path, scheduler: Scheduler | None, workers: int | None, key: Path | None = None
) -> None:
    """Judge in a process of its own that is told two folders, of recordings and for verdicts, and nothing else."""
    command = [sys.executable, "-m", "benchsim", "trial", "judge", str(recordings), "-o", str(verdicts)]
    command += scheduler.options() if scheduler else []
    command += ["--workers", str(workers)] if workers is not None else []
    command += ["--key", str(key)] if key is not None else []
    done = subprocess.run(command, stdout=subprocess.DEVNULL, check=False)
    if done.returncode != 0:
        raise BenchsimError(f"the judge ended with {done.returncode}; run the command again to go on")


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
    if not (path.exists() and ledger.standing(ledger.read(path)).committed):
        judge(folder / "recordings", folder / "verdicts", scheduler, workers, key)
    progress("opening", 0.95)
    result = open(folder, workers=workers)
    verify(folder, workers=workers)
    progress("done", 1.0)
    return result
