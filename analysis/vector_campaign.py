"""Does the diagnosis bring out what the paper's vector model leaves out?

``campaign12`` is rendered with facets, beam and diffraction, each time with new noise and setting errors, and diagnosed
against the vector model. Each of the three must be found, with an amplitude within 3 σ of 1, or its limit stated; and
nothing else may be named.

    python analysis/vector_campaign.py --draws 20 --seed 1 --out out/vector_campaign.jsonl

Each draw is written as it ends; a stopped study resumes.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import study_cases as draw
from diagnosis_study import read

from benchsim import diagnosis
from benchsim.instruments.bench import observables
from benchsim.instruments.bench import problem as bench_problem
from benchsim.trial.hashing import code
from benchsim.trial.rates import wilson

LEFT_OUT = ("facets", "finite-beam", "diffraction")

SIGMAS = 3.0
"""Within which a size has to be 1."""

Row = Mapping[str, Any]


def one(seed: int, shrink: int) -> dict[str, Any]:
    """One draw and the code that judged it, or the complaint that ended it."""
    try:
        return {"seed": seed, **judged(seed, shrink), "code": code()[:12]}
    except Exception as error:  # a campaign goes on; the line says what happened and counts as nothing found
        return {"seed": seed, "error": f"{type(error).__name__}: {error}", "code": code()[:12]}


def judged(seed: int, shrink: int) -> dict[str, Any]:
    """Photographs of one draw, and what was said of them."""
    from benchsim.renderer.recording import render_recording

    recording = draw.bench("campaign", np.random.default_rng(seed), shrink)
    with tempfile.TemporaryDirectory() as folder:
        made = render_recording(recording, folder, seed=seed)
        observed, _lost = observables.observe(made.recording)
        d = diagnosis.diagnose(bench_problem.build(made.recording, observed, against="vector"))
    return {
        "verdict": d.verdict,
        "found": {f.name: {k: [s.value, s.sigma] for k, s in f.parameters.items()} for f in d.effects},
        "classes": [[list(m) for m in c.members] for c in d.classes],
        "limits": {k: d.limits[k].five_sigma for k in LEFT_OUT if k in d.limits},
        "held_out": None if d.held_out is None else d.held_out.fraction_removed,
    }


def pull(row: Row, name: str) -> float:
    """(size − 1)/σ of what was found; infinite where σ is none."""
    value, sigma = next(iter(row["found"][name].values()))
    return (value - 1) / sigma if sigma > 0 else math.inf


def right(row: Row, name: str) -> bool:
    """Found with a size within 3 σ of 1, or not found and its limit stated."""
    if "error" in row:
        return False
    if name in row["found"]:
        return abs(pull(row, name)) <= SIGMAS
    return math.isfinite(row["limits"].get(name, math.inf))


def others(row: Row) -> set[str]:
    """Whatever else was named, by itself or in a class."""
    if "error" in row:
        return set()
    members = {name for c in row["classes"] for m in c for name in m}
    return (set(row["found"]) | members) - set(LEFT_OUT)


def rate(k: int, n: int) -> str:
    """``19 of 20 (76.4–99.1 %)``."""
    low, high = wilson(k, n, 1.96)
    return f"{k} of {n} ({100 * low:.1f}–{100 * high:.1f} %)" if n else "0 of 0"


def table(rows: Sequence[Row]) -> str:
    """What was found in how many draws; one that an error ended found nothing, and named nothing wrong either."""
    n, told = len(rows), [r for r in rows if "error" not in r]
    verdicts = dict(Counter(r["verdict"] for r in told))
    lines = [f"{n} draws, {n - len(told)} ended by an error; verdicts {verdicts}"]
    for name in LEFT_OUT:
        found = [r for r in told if name in r["found"]]
        in_class = sum(any(name in m for c in r["classes"] for m in c) for r in told)
        limits = [r["limits"][name] for r in told if name in r["limits"]]
        line = (
            f"{name:<12} found within {SIGMAS:g} σ of 1, or limit stated: {rate(sum(right(r, name) for r in rows), n)}"
        )
        line += f"; found in {len(found)}, in a class in {in_class}"
        if found:
            sizes = [next(iter(r["found"][name].values()))[0] for r in found]
            within = sum(abs(pull(r, name)) <= SIGMAS for r in found)
            line += f"; size {np.mean(sizes):.3f}, within {SIGMAS:g} σ of 1: {rate(within, len(found))}"
        if limits:
            line += f"; limit stated in {len(limits)}, five sigma {np.median(limits):.3g} in the median"
        lines.append(line)
    more = Counter(name for r in told for name in others(r))
    lines.append(
        f"anything else named, or in a class: {rate(sum(bool(others(r)) for r in told), len(told))} {dict(more)}"
    )
    every = sum(all(right(r, name) for name in LEFT_OUT) and not others(r) for r in rows)
    lines.append(f"all three right and nothing else named: {rate(every, n)}")
    lines.append(f"judged by code {', '.join(sorted({r.get('code', 'unknown') for r in rows})) or 'unknown'}")
    return "\n".join([*lines, *(f"  {r['seed']}: {r['error']}" for r in rows if "error" in r)])


def main() -> None:
    """Run what is not there yet and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--shrink", type=int, default=2, help="of the cameras' resolution")
    parser.add_argument("--out", type=Path, default=Path("out/vector_campaign.jsonl"))
    args = parser.parse_args()
    args.out.parent.mkdir(parents=True, exist_ok=True)
    asked = range(1000 * args.seed, 1000 * args.seed + args.draws)
    # A file may hold draws of other seeds too.
    rows = {r["seed"]: r for r in (read([args.out]) if args.out.exists() else []) if r["seed"] in asked}
    for seed in asked:
        if seed not in rows:
            rows[seed] = one(seed, args.shrink)
            with args.out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(rows[seed]) + "\n")
            print(json.dumps(rows[seed]), flush=True)
    print(table([rows[seed] for seed in asked]))


if __name__ == "__main__":
    main()
