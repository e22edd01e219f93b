"""How long a diagnosis takes: twelve exposures of 3 MP, from images to diagnosis.json, stage by stage.

    python analysis/diagnose_time.py [RECORDING] [--against bench|vector] [--pictures]

Without a recording the campaign of twelve settings is rendered first (a minute), which does not count. The clock starts
when the program does, imports and worker processes included, and stops when diagnosis.json lies in its folder.
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import tempfile
import time
from pathlib import Path

SCENE = Path(__file__).resolve().parents[1] / "scenes" / "campaign12.toml"
BAR = 60.0
"""Seconds on two cores."""


def cpu() -> float:
    """CPU seconds of this process and of the workers that have ended."""
    return sum(
        r.ru_utime + r.ru_stime for r in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    )


def main() -> None:
    """Time one diagnosis and print its stages."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path, nargs="?")
    parser.add_argument("--against", choices=["bench", "vector"], default="bench")
    parser.add_argument("--pictures", action="store_true")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        recording = args.recording
        if recording is None:
            from benchsim import jobs

            recording = jobs.render(SCENE, Path(scratch) / "campaign12", seed=20).folder
        out = Path(scratch) / "diagnosis"
        start, cpu_before = time.perf_counter(), cpu()
        written: list[float] = []
        stages: dict[str, float] = {}
        last = ["imports and worker processes", start]

        def progress(what: str, done: float) -> None:
            now = time.perf_counter()
            if not written and (out / "diagnosis.json").exists():
                written.append(now - start)
            stages[last[0]] = stages.get(last[0], 0.0) + now - last[1]
            # One stage for all exposures or folds of a kind.
            last[:] = [re.sub(r"[\d./]+(\.png)?", "…", what), now]

        from benchsim import jobs

        result = jobs.diagnose(recording, out, against=args.against, pictures=args.pictures, progress=progress)
        whole = time.perf_counter() - start
        problem, verdict = result.problem, result.diagnosis.verdict
        print(f"{len(problem.names)} exposures, {len(problem.data)} data, verdict {verdict}")
        for what, seconds in stages.items():
            print(f"{seconds:8.1f} s  {what}")
        said = "met" if written[0] <= BAR else "missed"
        print(
            f"{written[0]:8.1f} s  until diagnosis.json lay in its folder, {len(os.sched_getaffinity(0))} cores; ",
            end="",
        )
        print(f"bar {BAR:.0f} s: {said}")
        print(f"{whole:8.1f} s  in all, {cpu() - cpu_before:.0f} s of CPU")


if __name__ == "__main__":
    main()
