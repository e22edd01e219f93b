"""Wall time of the same trial with one and with two workers, and the leak test's trial of zero size.

    python analysis/trial/scaling.py --cases 8 --seed 1
    python analysis/trial/scaling.py --cases 40 --seed 1 --zero

The seed is given so that both runs do the same; such a trial shows how fast it is, and that nothing leaks, no more.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

from benchsim import trial
from benchsim.jobs.workers import cores


def timed(cases: int, seed: int, workers: int, zero: bool) -> tuple[float, trial.opening.OpenResult]:
    """Seconds of one whole trial, and its outcome."""
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        result = trial.run(Path(folder) / "t", cases, seed=seed, workers=workers, zero=zero)
        return time.perf_counter() - start, result


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=8)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--zero", action="store_true")
    args = parser.parse_args()
    print(f"{cores()} cores, {args.cases} cases, seed {args.seed}")
    if args.zero:
        _, result = timed(args.cases, args.seed, cores(), True)
        print(result.summary())
        return
    first = 0.0
    for workers in (1, 2):
        seconds, _ = timed(args.cases, args.seed, workers, False)
        first = first or seconds
        print(
            f"{workers} workers: {seconds:7.1f} s, {seconds / args.cases:6.1f} s a case, {seconds / first:.2f} of one"
        )


if __name__ == "__main__":
    main()
