"""How often does the diagnosis name what was concealed? The bars of the issue, row by row, with binomial intervals.

    python analysis/diagnosis_study.py run traces --rows single,clean --cases 300 --seed 1 --out out/study
    python analysis/diagnosis_study.py run photographs --rows clean,single --cases 100 --seed 2 --out out/study
    python analysis/diagnosis_study.py table out/study/*.jsonl

Every case is drawn from (seed, row, number) alone and written as it ends; a stopped study resumes. Cases used for
development must not share a seed with those that are reported.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
import zlib
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import study_cases as draw
import study_score as score

from benchsim import diagnosis
from benchsim.bench.model import Recording
from benchsim.diagnosis import curvature
from benchsim.diagnosis.linear import predict_all
from benchsim.diagnosis.problem import Problem
from benchsim.diagnosis.result import Diagnosis
from benchsim.instruments.bench import observables
from benchsim.instruments.bench import problem as bench_problem
from benchsim.trial.cluster import MEMORY_KEPT
from benchsim.trial.hashing import code

ROWS = (
    "single", "pair", "fig7", "clean", "clean-noise", "clean-settings", "clean-correlated", "removed", "stranger",
)  # fmt: skip


def rng_of(seed: int, tier: str, row: str, case: int) -> np.random.Generator:
    """Its own stream for every case."""
    return np.random.default_rng([seed, zlib.crc32(f"{tier}/{row}".encode()), case])


@dataclass(frozen=True)
class Stage:
    """A bench before anything is concealed in it, and what all cases on it share."""

    recording: Recording
    observed: tuple[observables.Observed, ...]
    sight: draw.Sight
    bends: curvature.Curvature


@lru_cache(maxsize=4)
def stage(tier: str, kind: str, seed: int, case: int, shrink: int) -> Stage:
    """The bench of one case number: drawn apart from what is concealed, so that a case of every row shares it."""
    recording = draw.bench(kind, rng_of(seed, tier, kind, case), shrink)
    observed = observables.simulate(recording)
    nominal = bench_problem.build(recording, observed)
    return Stage(recording, tuple(observed), draw.Sight.of(nominal), curvature.measure(nominal))


def conceal(row: str, on: Stage, rng: np.random.Generator) -> tuple[draw.Truth, dict[str, float]]:
    """Draw what one case conceals; also the parameters of the catalogue's effects, by parameter name."""
    recording, sight = on.recording, on.sight
    nominal = sight.problem
    values: dict[str, float] = {}
    effects: dict[str, dict[str, float]] = {}
    count = {"single": 1, "fig7": 1, "removed": 1, "pair": 2}.get(row, 0)
    for i in rng.choice(len(nominal.catalogue), count, replace=False):
        effect = nominal.catalogue[int(i)]
        drawn = draw.draw_effect(sight, effect, rng)
        values |= drawn
        effects |= draw.as_effects(drawn, effect)
    stranger = draw.STRANGERS[int(rng.integers(len(draw.STRANGERS)))] if row == "stranger" else ""
    fields = draw.draw_stranger(stranger, recording, rng) if stranger else {}
    truth = draw.Truth(
        effects,
        fields,
        stranger,
        setting_scale=3.0 if row == "clean-settings" else 1.0,
        noise_scale=1.3 if row == "clean-noise" else 1.0,
        correlated=0.7 if row == "clean-correlated" else 0.0,
    )
    return truth, values


def visible(
    truth: draw.Truth, sight: draw.Sight, values: Mapping[str, float], bent: np.ndarray | None
) -> dict[str, Any]:
    """SNR of each concealed thing, the nearest rival of them all, and how far they are from any one of them."""
    snr: dict[str, float] = {}
    for name, own in truth.effects.items():
        snr[name] = float(np.linalg.norm(sight.change(own)))
    if bent is not None:
        snr[truth.stranger] = float(np.linalg.norm(bent))
    rival, alone = ("", float("inf")), float("inf")
    if truth.effects:
        delta = sight.change(values)
        rival, alone = sight.rival(delta, tuple(truth.effects)), draw.alone(sight, delta, values, truth.effects)
    return {"snr": snr, "rival": rival, "alone": alone}


def verdict_of(d: Diagnosis) -> dict[str, Any]:
    """What of a diagnosis the scores need."""
    return {
        "verdict": d.verdict,
        "named": [f.name for f in d.effects],
        "confidence": [f.confidence for f in d.effects],
        "classes": [[list(m) for m in c.members] for c in d.classes],
        "location": None
        if d.location is None
        else {"element": d.location.element, "claimed": d.location.claimed, "margin": d.location.margin},
        "law": None if d.law is None else d.law.held_out_gain,
        "held_out": None
        if d.held_out is None
        else {"data": d.held_out.data, "before": d.held_out.excess_chi2_before, "after": d.held_out.excess_chi2_after},
        "probability": {k: round(float(p), 6) for k, p in d.probability.items()},
        "setting_scale": d.setting_scale,
        "sigma_scale": d.sigma_scale,
        "correlation": d.correlation,
    }


def pulls_of(d: Diagnosis, truth: draw.Truth) -> list[float]:
    """(estimate − truth)/σ of every amplitude that was named rightly."""
    out = []
    for f in d.effects:
        for name, size in f.parameters.items():
            true = truth.effects.get(f.name, {}).get(name)
            if true is not None and size.sigma > 0:
                out.append((size.value - true) / size.sigma)
    return out


def traces_case(row: str, seed: int, case: int, fresh: int) -> dict[str, Any]:
    """One case of the traces' tier; of every so many cases a fresh recording is diagnosed against what was named."""
    rng = rng_of(seed, "traces", row, case)
    on = stage("traces", "fig7" if row == "fig7" else "six", seed, case, 1)
    recording, observed, sight = on.recording, on.observed, on.sight
    truth, values = conceal(row, on, rng)
    nominal = sight.problem
    bent = None
    if truth.fields:
        true = bench_problem.build(replace(recording, fields=truth.fields), observed)
        offset = nominal.data - true.data
        bent = draw.whiten(nominal, nominal.covariance, predict_all(true, {}) + offset - predict_all(nominal, {}))[0]
        bent = sight.through(bent)
    else:
        true, offset = nominal, np.zeros(len(nominal.data))
    at = {**draw.nuisances(nominal, truth, rng), **values}
    data = draw.noisy(nominal, predict_all(true, at) + offset, truth, rng)
    judged = replace(nominal, data=data)
    if row == "removed":
        judged = replace(judged, catalogue=tuple(e for e in judged.catalogue if e.name not in truth.effects))
    start = time.process_time()
    d = diagnosis.diagnose(judged, bends=on.bends)
    out = {
        "tier": "traces", "row": row, "seed": seed, "case": case, "truth": draw.plain(truth),
        "truth_element": element_of(nominal, truth), **visible(truth, sight, values, bent), **verdict_of(d),
        "parameter_pulls": pulls_of(d, truth), "cpu_s": time.process_time() - start,
    }  # fmt: skip
    if fresh and case % fresh == 0 and d.verdict == "named":
        found = {f.name: {k: s.value for k, s in f.parameters.items()} for f in d.effects}
        again = bench_problem.build(replace(recording, effects=found), observed)
        moved = again.data - nominal.data
        other = {**draw.nuisances(nominal, truth, rng), **values}
        data = draw.noisy(nominal, predict_all(nominal, other) + moved, truth, rng)
        out["fresh"] = diagnosis.diagnose(replace(again, data=data)).verdict
    return out


def element_of(problem: Problem, truth: draw.Truth) -> str:
    """Where in the light's path the truth sits."""
    if truth.stranger:
        return draw.STRANGER_ELEMENT[truth.stranger]
    return next((e.element for e in problem.catalogue if e.name in truth.effects), "")


def photographs_case(row: str, seed: int, case: int, shrink: int) -> dict[str, Any]:
    """One case of the photographs' tier."""
    from benchsim.render.recording import render_recording

    rng = rng_of(seed, "photographs", row, case)
    on = stage("photographs", "fig7" if row == "fig7" else "six", seed, case, shrink)
    recording, sight = on.recording, on.sight
    truth, values = conceal(row, on, rng)
    bent = None
    if truth.fields:
        true = bench_problem.build(replace(recording, fields=truth.fields), on.observed)
        difference = predict_all(true, {}) - true.data + sight.problem.data - predict_all(sight.problem, {})
        bent = sight.through(draw.whiten(sight.problem, sight.problem.covariance, difference)[0])
    u = recording.uncertainty
    factor = truth.setting_scale
    stated = replace(
        recording,
        effects=truth.effects,
        fields=truth.fields,
        render=replace(recording.render, speckle_px=float(rng.choice([0.0, 0.8])), relative_error=0.02),
        uncertainty=replace(
            u,
            mirror_position=u.mirror_position * factor,
            mirror_axis=u.mirror_axis * factor,
            laser_direction=u.laser_direction * factor,
            screen_position=u.screen_position * factor,
            screen_angle=u.screen_angle * factor,
        ),
    )
    with tempfile.TemporaryDirectory() as folder:
        made = render_recording(stated, folder, seed=int(rng.integers(2**32)), conceal=True)
        taken = replace(made.recording, uncertainty=u)
        observed, _lost = observables.observe(taken)
        judged = bench_problem.build(taken, observed)
        if row == "removed":
            judged = replace(judged, catalogue=tuple(e for e in judged.catalogue if e.name not in truth.effects))
        start = time.process_time()
        d = diagnosis.diagnose(judged)
    return {
        "tier": "photographs", "row": row, "seed": seed, "case": case, "truth": draw.plain(truth),
        "truth_element": element_of(sight.problem, truth), **visible(truth, sight, values, bent), **verdict_of(d),
        "parameter_pulls": pulls_of(d, truth), "cpu_s": time.process_time() - start,
    }  # fmt: skip


def one(row: str, seed: int, case: int, *, tier: str, shrink: int, fresh: int) -> dict[str, Any]:
    """A case and the code that judged it, or the complaint that ended it."""
    try:
        found = traces_case(row, seed, case, fresh) if tier == "traces" else photographs_case(row, seed, case, shrink)
        return {**found, "code": code()[:12]}
    except Exception as error:  # a study goes on; the line says what happened and counts as no verdict
        said = f"{type(error).__name__}: {error}"
        return {"tier": tier, "row": row, "seed": seed, "case": case, "error": said, "code": code()[:12]}


def run(
    call: Callable[[str, int, int], dict[str, Any]], rows: list[str], cases: int, seed: int, path: Path, workers: int
) -> None:
    """Run what is not there yet: ``call(row, seed, case)`` in worker processes, a line of ``path`` for each.

    All rows of a case go to the same worker, so that they share its stage.
    """
    # The workers are spawned with it, one thread each.
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", **MEMORY_KEPT}
    path.parent.mkdir(parents=True, exist_ok=True)
    done = {(c["row"], c["case"]) for c in read([path])} if path.exists() else set()
    todo = [(row, k) for k in range(cases) for row in rows if (row, k) not in done]
    with ExitStack() as stack:
        file = stack.enter_context(path.open("a", encoding="utf-8"))
        pools = [stack.enter_context(ProcessPoolExecutor(1, mp_context=get_context("spawn"))) for _ in range(workers)]
        futures = [pools[k % workers].submit(call, row, seed, k) for row, k in todo]
        for i, future in enumerate(as_completed(futures), 1):
            case = future.result()
            file.write(json.dumps(case) + "\n")
            file.flush()
            said = case.get("error") or f"{case['verdict']} {'+'.join(case['named'])} {case['classes'] or ''}"
            concealed = (
                "" if "truth" not in case else f"{case['truth']['stranger']}{'+'.join(case['truth']['effects'])}"
            )
            print(f"{i}/{len(todo)} {case['row']} {case['case']}: {concealed or 'nothing'} -> {said}", flush=True)


def read(paths: list[Path]) -> list[dict[str, Any]]:
    """Cases of several files; a line that was cut off by a stop is left out."""
    out = []
    for path in paths:
        for line in path.read_text(encoding="utf-8").splitlines():
            try:
                out.append(json.loads(line))
            except json.JSONDecodeError:
                continue
    return out


def main() -> None:
    """Run the study, or print its table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    sub = parser.add_subparsers(dest="command", required=True)
    go = sub.add_parser("run", help="run cases that are not there yet")
    go.add_argument("tier", choices=["traces", "photographs"])
    go.add_argument("--rows", default=",".join(ROWS))
    go.add_argument("--cases", type=int, default=300, help="per row")
    go.add_argument("--seed", type=int, required=True)
    go.add_argument("--out", type=Path, default=Path("out/study"))
    go.add_argument("--workers", type=int, default=2)
    go.add_argument("--shrink", type=int, default=2, help="of the cameras' resolution, photographs only")
    go.add_argument(
        "--fresh", type=int, default=0, metavar="N",
        help="of every Nth case diagnose a fresh recording against what was named (traces)",
    )  # fmt: skip
    show = sub.add_parser("table", help="print rates, confusion and reliability")
    show.add_argument("files", type=Path, nargs="+")
    args = parser.parse_args()
    if args.command == "run":
        rows = args.rows.split(",")
        call = partial(one, tier=args.tier, shrink=args.shrink, fresh=args.fresh)
        run(call, rows, args.cases, args.seed, args.out / f"{args.tier}-{args.seed}.jsonl", args.workers)
        return
    tell(read(args.files))


def tell(cases: list[dict[str, Any]], *more: str) -> None:
    """Print the tables of cases, with more between rates and confusion."""
    print(score.table(cases), *more, score.confusion(cases), score.reliability(cases), sep="\n\n")
    bad = [c for c in cases if "error" in c]
    codes = sorted({c.get("code", "unknown") for c in cases})
    print(f"\n{len(cases)} cases, {len(bad)} without a verdict; judged by code {', '.join(codes)}")
    for c in bad[:10]:
        print(f"  {c['row']} {c['case']}: {c['error']}")


if __name__ == "__main__":
    main()
