"""How often does the diagnosis name what was concealed? The bars of the issue, row by row, with binomial intervals.

    python analysis/diagnosis_study.py run traces --rows single,clean --cases 300 --seed 1 --out out/study
    python analysis/diagnosis_study.py run photographs --rows clean,single --cases 100 --seed 2 --out out/study
    python analysis/diagnosis_study.py run stressed --rows single,pair,clean --cases 20 --seed 3 --out out/study
    python analysis/diagnosis_study.py run foreign --rows single,clean --cases 12 --seed 4 --other "python other.py"
    python analysis/diagnosis_study.py table out/study/*.jsonl          # or analysis/study/traces-660223.jsonl.xz
    python analysis/diagnosis_study.py pack out/study/*.jsonl           # FILE.jsonl.xz, as it is kept

Pictures of the tier *foreign* are made by a program that is not this project's, called as ``OTHER TRUTH.toml FOLDER
--seed N``: a bench file to the contract with ``[effects]`` and ``[render]``, which it turns into a recording without
them, its settings off by errors of its own draw.

Every case is drawn from (seed, row, number) alone and written as it ends; a stopped study resumes. Cases used for
development must not share a seed with those that are reported.
"""

from __future__ import annotations

import argparse
import json
import lzma
import os
import shlex
import subprocess
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass, replace
from decimal import ROUND_DOWN, Context, Decimal
from functools import lru_cache, partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import stress
import study_cases as draw
import study_score as score
import study_search
import study_words as words

from benchsim import diagnosis
from benchsim.bench.files import read as read_recording
from benchsim.bench.model import Recording
from benchsim.bench.settings import scaled
from benchsim.bench.writing import write, write_bytes
from benchsim.diagnosis.linear import predict_all
from benchsim.diagnosis.problem import Problem
from benchsim.diagnosis.result import Diagnosis
from benchsim.instruments.bench import amended_file, displacement, observables
from benchsim.instruments.bench import problem as bench_problem
from benchsim.jobs.workers import MEMORY_KEPT, end_with_parent
from benchsim.trial.hashing import code

ROWS = (
    "single", "pair", "fig7", "fig7-pair", "clean", "clean-noise", "clean-settings", "clean-correlated", "removed",
    "stranger", "beside", "fig7-beside",
)  # fmt: skip

TRACES_ONLY = {
    "clean-noise": "a recording of photographs states no noise that could be understated, theirs is read from the "
    "pictures alone; this row is of the traces' tier",
}
"""Rows that photographs do not have, and why."""

SPECKLES = (0.0, 0.8)
"""Of photographs [px]: one or the other; always the second where the row is of correlated noise."""

DIGITS = 4
"""Of numbers that are kept."""

Part = dict[str, Any]
"""Of a case's line, as it comes to be known."""


def rng_of(seed: int, tier: str, row: str, case: int) -> np.random.Generator:
    """Its own stream for every case."""
    return np.random.default_rng([seed, zlib.crc32(f"{tier}/{row}".encode()), case])


@dataclass(frozen=True)
class Stage:
    """A bench before anything is concealed in it, and what all cases on it share."""

    recording: Recording
    observed: tuple[observables.Observed, ...]
    sight: draw.Sight


@lru_cache(maxsize=4)
def stage(tier: str, kind: str, seed: int, case: int, shrink: int) -> Stage:
    """The bench of one case number: drawn apart from what is concealed, so that a case of every row shares it."""
    recording = draw.bench(kind, rng_of(seed, tier, kind, case), shrink)
    observed = observables.simulate(recording)
    nominal = bench_problem.build(recording, observed)
    return Stage(recording, tuple(observed), draw.Sight.of(nominal))


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
        "left": [[x.family, x.p, x.rms, x.rms_mm] for x in d.left],
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


def limits_stated(d: Diagnosis, truth: draw.Truth) -> dict[str, bool]:
    """Of each effect that is concealed, whether the size is stated from which on it would have been seen."""
    return {name: name in d.limits and bool(np.isfinite(d.limits[name].five_sigma)) for name in truth.effects}


def without(problem: Problem, row: str, truth: draw.Truth) -> Problem:
    """The problem as the judge of a row has it: of what was removed its catalogue knows nothing."""
    kept = {"removed": 0, "beside": 1, "fig7-beside": 1}.get(row, len(truth.effects))
    gone = tuple(truth.effects)[kept:]
    return replace(problem, catalogue=tuple(e for e in problem.catalogue if e.name not in gone))


def design(row: str) -> str:
    """Settings of a row: the two of Fig. 7, or six."""
    return "fig7" if row.startswith("fig7") else "six"


def diagnosed(problem: Problem, truth: draw.Truth, sampled: bool) -> tuple[Diagnosis, Part]:
    """The verdict, and what of it the case's line holds; the evidence is sampled where that is asked for."""
    start = time.process_time()
    found = diagnosis.name(problem)
    d = diagnosis.conclude(problem, found)
    spent = time.process_time() - start
    line = {"parameter_pulls": pulls_of(d, truth), "limit_stated": limits_stated(d, truth), "cpu_s": spent}
    if truth.effects and {*truth.effects} <= {e.name for e in problem.catalogue}:
        line["truth_ahead"] = study_search.ahead(problem, found, truth.effects)
    if sampled:
        best = next((f for f in found.fits if f.converged), found.null)
        line["evidence_off"] = study_search.sampled(problem, found, best)
    return d, {**verdict_of(displacement.sized(problem, d)), **line}


@dataclass(frozen=True)
class Traces:
    """A case of the traces' tier: what is concealed, the parameters at which data are drawn, and the generator as it
    stands then; ``true``: the problem with the fields of a stranger, where there is one."""

    on: Stage
    truth: draw.Truth
    values: dict[str, float]
    at: dict[str, float]
    true: Problem | None
    rng: np.random.Generator

    def drawn(self, at: dict[str, float], about: Problem) -> draw.Array:
        """Data about a simulation in doubt, with noise that is new."""
        nominal, lit = self.on.sight.problem, self.true or self.on.sight.problem
        return draw.noisy(nominal, predict_all(lit, at) - lit.data + about.data, self.truth, self.rng)


def traces(row: str, seed: int, case: int) -> Traces:
    """One case."""
    rng = rng_of(seed, "traces", row, case)
    on = stage("traces", design(row), seed, case, 1)
    truth, values = draw.conceal(row, on.recording, on.sight, rng)
    bent = replace(on.recording, fields=truth.fields)
    true = bench_problem.build(bent, on.observed, attached=False) if truth.fields else None
    return Traces(on, truth, values, {**draw.nuisances(on.sight.problem, truth, rng), **values}, true, rng)


def traces_case(row: str, seed: int, case: int, fresh: int, sampled: bool) -> Iterator[Part]:
    """One case of the traces' tier; of every so many cases a fresh recording is diagnosed against what was put in."""
    made = traces(row, seed, case)
    on, truth, nominal = made.on, made.truth, made.on.sight.problem
    yield {
        "truth": draw.plain(truth),
        "truth_element": draw.element_of(nominal, truth),
        **draw.visible(truth, on.sight, made.values, made.true),
    }
    data = made.drawn(made.at, nominal)
    d, line = diagnosed(without(replace(nominal, data=data), row, truth), truth, sampled)
    yield line
    if fresh and case % fresh == fresh - 1:
        amended = amended_file.amended(on.recording, d)
        if amended_file.put_in(on.recording, amended):
            # The same bench set up once more: errors of the settings and noise are new, its beam and lenses are not.
            new = draw.nuisances(nominal, truth, made.rng)
            again = made.at | {p.name: new[p.name] for p in nominal.nuisances if p.scaled}
            doubted = bench_problem.build(amended, on.observed)
            data = made.drawn(again, doubted)
            yield {"fresh": diagnosis.diagnose(without(replace(doubted, data=data), row, truth)).verdict}


def elsewhere(other: str, recording: Recording, folder: Path, seed: int) -> Recording:
    """A bench rendered by a program that is not this project's."""
    write(recording, folder / "truth.toml", render=True)
    made = folder / "recording"
    call = [*shlex.split(other), str(folder / "truth.toml"), str(made), "--seed", str(seed)]
    done = subprocess.run(call, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{other}: {done.stderr.strip().splitlines()[-1]}")
    return read_recording(made)


def photographs_case(
    row: str, seed: int, case: int, shrink: int, tier: str, other: str, snr: tuple[float, float] | None, sampled: bool
) -> Iterator[Part]:
    """One case of the photographs' tier, of those with a defect (`stress`), or of those by another program; how visible
    the truth is there is read from the pictures that are judged."""
    from benchsim.renderer.recording import render_recording

    rng = rng_of(seed, tier, row, case)
    on = stage(tier, design(row), seed, case, shrink)
    recording = on.recording
    drawn, values = draw.conceal(row, recording, on.sight, rng, snr)
    truth, values = draw.in_pixels(drawn, values, on.sight.problem.catalogue, shrink)
    # Drawn for every row, so that all take the same numbers.
    speckle = float(rng.choice(SPECKLES))
    speckle = SPECKLES[1] if row == "clean-correlated" else speckle
    kind = stress.KINDS[case % len(stress.KINDS)] if tier == "stressed" else ""
    speckle = stress.COARSE if kind == "coarse" else speckle
    yield {
        "truth": {**draw.plain(truth), "speckle_px": speckle},
        "truth_element": draw.element_of(on.sight.problem, truth),
    }
    stated = replace(
        recording,
        effects=truth.effects,
        fields=truth.fields,
        render=replace(recording.render, speckle_px=speckle, relative_error=0.02),
        uncertainty=scaled(recording.uncertainty, truth.setting_scale),
    )
    with tempfile.TemporaryDirectory() as folder:
        # Without a defect nothing is drawn for one: the cases that are kept stay what they are.
        number = int(rng.integers(2**32))
        if other:
            made = elsewhere(other, stated, Path(folder), number)
        else:
            with stress.put(kind, rng) if kind else nullcontext() as defect:
                made = render_recording(stated, folder, seed=number, conceal=True).recording
            if defect:
                yield {"stress": defect}
        taken = replace(made, uncertainty=recording.uncertainty)
        observed, _lost = observables.observe(taken)
        seen = bench_problem.build(taken, observed)
        bent = replace(taken, fields=truth.fields)
        true = bench_problem.build(bent, observed, attached=False) if truth.fields else None
        # Where nothing is concealed there is nothing to see, and the pictures' own need not be computed.
        sight = draw.Sight.of(seen) if truth.effects or truth.fields else on.sight
        yield draw.visible(truth, sight, values, true)
        yield diagnosed(without(seen, row, truth), truth, sampled)[1]


def one(
    row: str,
    seed: int,
    case: int,
    *,
    tier: str,
    shrink: int,
    fresh: int,
    other: str,
    snr: tuple[float, float] | None,
    sampled: bool,
) -> dict[str, Any]:
    """A case and the code that judged it; where a complaint ended it, that and what was known by then."""
    line: dict[str, Any] = {"tier": tier, "row": row, "seed": seed, "case": case, "code": code()[:12]}
    parts = (
        traces_case(row, seed, case, fresh, sampled)
        if tier == "traces"
        else photographs_case(row, seed, case, shrink, tier, other, snr, sampled)
    )
    try:
        for part in parts:
            line |= part
    except Exception as error:  # a study goes on; the line says what happened and counts as no verdict
        line["error" if "verdict" not in line else "fresh_error"] = f"{type(error).__name__}: {error}"
    return line


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
        own = {"mp_context": get_context("spawn"), "initializer": end_with_parent}
        pools = [stack.enter_context(ProcessPoolExecutor(1, **own)) for _ in range(workers)]
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
    """Cases of several files, packed (.xz) or not; a line that was cut off by a stop is left out."""
    out = []
    for path in paths:
        held = path.read_bytes()
        for line in (lzma.decompress(held) if path.suffix == ".xz" else held).decode().splitlines():
            try:
                out.append(json.loads(line))
            except json.JSONDecodeError:
                continue
    return out


def packed(cases: list[dict[str, Any]]) -> bytes:
    """Cases as a compressed file that is kept: numbers are cut to `DIGITS` digits, probabilities to decimals.

    Cut, not rounded, and as written: so none crosses a limit of the table.
    """
    digits, last = Context(DIGITS, ROUND_DOWN), Decimal(1).scaleb(-DIGITS)

    def cut(value: Any) -> Any:
        if isinstance(value, dict):
            return {k: cut(v) for k, v in value.items()}
        if isinstance(value, list):
            return [cut(v) for v in value]
        return float(digits.create_decimal(repr(value))) if isinstance(value, float) else value

    text = ""
    for case in cases:
        short = cut({k: v for k, v in case.items() if k != "probability"})
        if "probability" in case:
            sure = {k: Decimal(repr(p)).quantize(last, ROUND_DOWN) for k, p in case["probability"].items()}
            short["probability"] = {k: float(p) for k, p in sure.items()}
        text += json.dumps(short, separators=(",", ":")) + "\n"
    return lzma.compress(text.encode(), preset=9 | lzma.PRESET_EXTREME)


def main() -> None:
    """Run the study, or print its table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    sub = parser.add_subparsers(dest="command", required=True)
    go = sub.add_parser("run", help="run cases that are not there yet")
    go.add_argument("tier", choices=["traces", "photographs", "stressed", "foreign"])
    go.add_argument("--rows", help=f"default all that the tier has of {','.join(ROWS)}")
    go.add_argument("--cases", type=int, default=300, help="per row")
    go.add_argument("--seed", type=int, required=True)
    go.add_argument("--out", type=Path, default=Path("out/study"))
    go.add_argument("--workers", type=int, default=2)
    go.add_argument("--shrink", type=int, default=2, help="of the cameras' resolution, photographs only")
    go.add_argument(
        "--fresh", type=int, default=0, metavar="N",
        help="of every Nth case diagnose a fresh recording against what was found and put into the file (traces)",
    )  # fmt: skip
    go.add_argument("--other", default="", help="the program that makes the pictures of the tier foreign")
    go.add_argument(
        "--snr", type=lambda text: tuple(map(float, text.split(","))), metavar="LOW,HIGH",
        help="conceal only what has this SNR in pictures as benchsim would render them (default 6,60, or as near as "
        "the caps let it come; not traces)",
    )  # fmt: skip
    go.add_argument(
        "--sampled", action="store_true", help="hold the best fit's evidence against importance sampling, 10 s a case"
    )
    show = sub.add_parser("table", help="print rates, confusion and reliability")
    show.add_argument("files", type=Path, nargs="+")
    show.add_argument("--against", type=Path, help="cases of a study before, of the same tier")
    keep = sub.add_parser("pack", help="write FILE.xz, the compressed file that is kept, beside every FILE.jsonl")
    keep.add_argument("files", type=Path, nargs="+")
    args = parser.parse_args()
    if args.command == "run":
        known = [row for row in ROWS if args.tier == "traces" or row not in TRACES_ONLY]
        rows = args.rows.split(",") if args.rows else known
        for row in rows:
            if row not in known:
                parser.error(f"{row}: {TRACES_ONLY.get(row, 'is no row; take of ' + ', '.join(known))}")
        if (args.tier == "foreign") != bool(args.other):
            parser.error("--other names the program that makes the pictures of the tier foreign, and of no other")
        if args.snr and args.tier == "traces":
            parser.error("--snr is of the tiers of photographs; leave it out for traces")
        own = {k: getattr(args, k) for k in ("tier", "shrink", "fresh", "other", "snr", "sampled")}
        call = partial(one, **own)
        run(call, rows, args.cases, args.seed, args.out / f"{args.tier}-{args.seed}.jsonl", args.workers)
        return
    if args.command == "pack":
        for path in args.files:
            write_bytes(path.with_name(path.name.removesuffix(".xz") + ".xz"), packed(read([path])))
        return
    cases = read(args.files)
    tell(cases, *([score.against(cases, read([args.against]))] if args.against else []))


def tell(cases: list[dict[str, Any]], *more: str) -> None:
    """Print the tables of cases, each tier for itself, and more behind them."""
    tiers = list(dict.fromkeys(c["tier"] for c in cases if "tier" in c))
    # Lines that a complaint ended early may lack it.
    only = tiers[0] if len(tiers) == 1 else "unknown tier"
    by: dict[str, list[dict[str, Any]]] = {}
    for c in cases:
        by.setdefault(c.get("tier", only), []).append(c)
    for tier, own in by.items():
        print(f"== {tier}: {len(own)} cases ==\n")
        parts = [score.table(own), words.confusion(own), words.reliability(own)]
        if tier in ("stressed", "foreign"):
            parts.insert(0, score.stressed(own))
        print(*parts, sep="\n\n", end="\n\n")
    for text in more:
        print(text, end="\n\n")
    bad = [c for c in cases if "error" in c or "fresh_error" in c]
    codes = sorted({c.get("code", "unknown") for c in cases})
    print(f"{len(cases)} cases, {sum('error' in c for c in bad)} without a verdict; judged by code {', '.join(codes)}")
    for c in bad[:10]:
        print(f"  {c['row']} {c['case']}: {c.get('error') or 'fresh recording: ' + c['fresh_error']}")


if __name__ == "__main__":
    main()
