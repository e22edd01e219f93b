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
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import study_cases as draw

from benchsim import diagnosis
from benchsim.instruments.bench import observables
from benchsim.instruments.bench import problem as bench_problem

LEFT_OUT = ("facets", "finite-beam", "diffraction")


def one(seed: int, shrink: int) -> dict[str, Any]:
    """One draw."""
    from benchsim.render.recording import render_recording

    recording = draw.bench("campaign", np.random.default_rng(seed), shrink)
    with tempfile.TemporaryDirectory() as folder:
        made = render_recording(recording, folder, seed=seed)
        observed, _lost = observables.observe(made.recording)
        d = diagnosis.diagnose(bench_problem.build(made.recording, observed, against="vector"))
    return {
        "seed": seed,
        "verdict": d.verdict,
        "found": {f.name: {k: [s.value, s.sigma] for k, s in f.parameters.items()} for f in d.effects},
        "classes": [[list(m) for m in c.members] for c in d.classes],
        "limits": {k: d.limits[k].five_sigma for k in LEFT_OUT if k in d.limits},
        "held_out": None if d.held_out is None else d.held_out.fraction_removed,
    }


def main() -> None:
    """Run what is not there yet and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--shrink", type=int, default=2, help="of the cameras' resolution")
    parser.add_argument("--out", type=Path, default=Path("out/vector_campaign.jsonl"))
    args = parser.parse_args()
    args.out.parent.mkdir(parents=True, exist_ok=True)
    lines = args.out.read_text(encoding="utf-8").splitlines() if args.out.exists() else []
    rows = {r["seed"]: r for r in map(json.loads, lines)}
    for k in range(args.draws):
        seed = 1000 * args.seed + k
        if seed not in rows:
            rows[seed] = one(seed, args.shrink)
            with args.out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(rows[seed]) + "\n")
            print(json.dumps(rows[seed]), flush=True)
    print(f"{len(rows)} draws; verdicts {dict(Counter(r['verdict'] for r in rows.values()))}")
    for name in LEFT_OUT:
        sizes = [next(iter(r["found"][name].values())) for r in rows.values() if name in r["found"]]
        limits = [r["limits"][name] for r in rows.values() if name in r["limits"]]
        in_class = sum(any(name in m for c in r["classes"] for m in c) for r in rows.values())
        pulls = np.array([(v - 1) / s for v, s in sizes])
        line = f"{name:<12} found in {len(sizes)}, in a class in {in_class}"
        if len(pulls):
            line += f"; amplitude {np.mean([v for v, _ in sizes]):.3f}, within 3 σ of 1: {(np.abs(pulls) <= 3).sum()}"
        if limits:
            line += f"; five-sigma limit {np.median(limits):.3g} in the median"
        print(line)
    others = Counter(n for r in rows.values() for n in r["found"] if n not in LEFT_OUT)
    print(f"anything else named: {dict(others) or 'nothing'}")


if __name__ == "__main__":
    main()
