"""How long a diagnosis takes: twelve exposures of 3 MP, from images to diagnosis.json, stage by stage.

    python analysis/diagnose_time.py [--cases clean,bow,coma,vector] [--pictures]
    python analysis/diagnose_time.py RECORDING [--against bench|vector] [--pictures]

Without a recording the campaign of twelve settings is rendered for every case, which does not count: with nothing
concealed, with a bowed screen, with a coma of 12 to 20 sigma, and once more with nothing but against the vector model.
Each diagnosis has a process of its own. The clock starts when that does, imports and worker processes included, and
stops when diagnosis.json lies in its folder.
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

SCENE = Path(__file__).resolve().parents[1] / "scenes" / "campaign12.toml"
BAR = 60.0
"""Seconds on two cores."""

CASES = {"clean": "bench", "bow": "bench", "coma": "bench", "vector": "vector"}
"""What is concealed, and what it is diagnosed against."""

BOW = {"bow_y": 0.0026, "bow_z": 0.0030}
"""[1/m], that of `known-six`."""

COMA_SNR = (12.0, 20.0)


def cpu() -> float:
    """CPU seconds of this process and of the workers that have ended."""
    return sum(
        r.ru_utime + r.ru_stime for r in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    )


def concealed(case: str, seed: int) -> list[str]:
    """Effects of a case, as the command line of ``render`` has them."""
    if case == "bow":
        return [f"screen-bow.{name}={value!r}" for name, value in BOW.items()]
    if case != "coma":
        return []
    import numpy as np

    from benchsim.bench.files import read
    from benchsim.instruments.bench import observables
    from benchsim.instruments.bench import problem as bench_problem
    from benchsim.trial.draws import draw_effect
    from benchsim.trial.visibility import Sight

    recording = read(SCENE)
    problem = bench_problem.build(recording, observables.simulate(recording), attached=False)
    effect = next(e for e in problem.catalogue if e.name == "coma")
    drawn = draw_effect(Sight.of(problem), effect, np.random.default_rng(seed), COMA_SNR)
    return [f"coma.{name}={value!r}" for name, value in drawn.items()]


def rendered(effects: list[str], folder: Path, seed: int) -> Path:
    """The campaign's folder, photographed with something concealed in it."""
    from benchsim import jobs

    return jobs.render(SCENE, folder, seed=seed, effects=effects, conceal=True).folder


def timed(recording: Path, out: Path, against: str, pictures: bool) -> str:
    """Time one diagnosis, print its stages, and sum it up in a line. For a process that has done nothing else."""
    start, before = time.perf_counter(), cpu()
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

    result = jobs.diagnose(recording, out, against=against, pictures=pictures, progress=progress)
    whole, spent = time.perf_counter() - start, cpu() - before
    problem, d = result.problem, result.diagnosis
    said = " + ".join([f.name for f in d.effects] + [" | ".join("+".join(m) for m in c.members) for c in d.classes])
    print(f"{len(problem.names)} exposures, {len(problem.data)} data, verdict {d.verdict} {said}".rstrip())
    for what, seconds in stages.items():
        print(f"{seconds:8.1f} s  {what}")
    state = "met" if written[0] <= BAR else "missed"
    cores = len(os.sched_getaffinity(0))
    line = f"{written[0]:.1f} s until diagnosis.json, {cores} cores; bar {BAR:.0f} s: {state}"
    line += f"; {whole:.1f} s and {spent:.1f} s of CPU in all; {d.verdict} {said}".rstrip()
    print(line, flush=True)
    return line


def main() -> None:
    """Time one diagnosis, or those of several cases, each in a fresh process."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path, nargs="?")
    parser.add_argument("--against", choices=["bench", "vector"], default="bench", help="of RECORDING")
    parser.add_argument("--cases", default=",".join(CASES), help="of what is rendered where no RECORDING is given")
    parser.add_argument("--seed", type=int, default=20)
    parser.add_argument("--pictures", action="store_true")
    args = parser.parse_args()
    cases = [args.recording.name] if args.recording else args.cases.split(",")
    if not args.recording and not set(cases) <= set(CASES):
        parser.error(f"--cases: take of {', '.join(CASES)}")
    lines = {}
    # What is said of the vector model rests on the pictures that the clean case has, too.
    made: dict[tuple[str, ...], Path] = {}
    with tempfile.TemporaryDirectory() as scratch:
        for case in cases:
            recording, against = args.recording, args.against
            if recording is None:
                against = CASES[case]
                effects = tuple(concealed(case, args.seed))
                if effects not in made:
                    made[effects] = rendered(list(effects), Path(scratch) / case, args.seed)
                recording = made[effects]
                print(f"{case}: {', '.join(effects) or 'nothing concealed'}, against {against}", flush=True)
            out = Path(scratch) / f"{case}-diagnosis"
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as fresh:
                lines[case] = fresh.submit(timed, recording, out, against, args.pictures).result()
    if len(lines) > 1:
        print(*(f"{case:<8} {line}" for case, line in lines.items()), sep="\n")


if __name__ == "__main__":
    main()
