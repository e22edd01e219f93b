"""One search beside another on the same frozen cases: what may be deleted, and what has to be understood first.

    python analysis/search_shadow.py run --seed 1 --cases 9 --out out/shadow/old.jsonl    # this code
    python analysis/search_shadow.py run --seed 1 --cases 9 --out out/shadow/new.jsonl    # the other checkout's
    python analysis/search_shadow.py compare out/shadow/old.jsonl out/shadow/new.jsonl

Cases are those of the study's tier of traces (`diagnosis_study.py`): on the same seed every checkout whose optics and
catalogue are the same is handed the same data. Nothing more is deleted where ln Z of the best hypothesis is worse by
more than 0.5 in more than 2 % of the cases. ln Z is compared where both estimated the same noise.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import diagnosis_study as study
import numpy as np
import study_cases as draw

from benchsim import diagnosis
from benchsim.diagnosis import linear
from benchsim.trial.hashing import code

ROWS = ("single", "pair", "clean", "removed", "stranger", "fig7", "fig7-pair")

WORSE, OFTEN = 0.5, 0.02
"""ln Z, and part of the cases: the stop rule."""


def case(row: str, seed: int, number: int) -> dict[str, Any]:
    """What a search makes of one case, and what it costs."""
    made = study.traces(row, seed, number)
    nominal = made.on.sight.problem
    problem = study.without(replace(nominal, data=made.drawn(made.at, nominal)), row, made.truth)
    asked, predictions = [0], linear.predictions

    def counted(problem: Any, values: Any, blocks: Any) -> Any:
        asked[0] += len(blocks)
        return predictions(problem, values, blocks)

    linear.predictions = counted
    try:
        start = time.process_time()
        found = diagnosis.name(problem)
        searched, many = time.process_time() - start, asked[0]
        d = diagnosis.conclude(problem, found)
        spent = time.process_time() - start
    finally:
        linear.predictions = predictions
    best = max((f for f in (found.null, *found.fits) if f.converged), key=lambda f: f.log_evidence)
    return {
        "tier": "traces", "row": row, "seed": seed, "case": number, "code": code()[:12],
        "truth": draw.plain(made.truth), "best": list(best.effects), "log_evidence": best.log_evidence,
        "noise": float(sum(np.log(np.diag(c)).sum() for c in found.noise.covariance)),
        "predictions": many, "search_cpu_s": searched, "cpu_s": spent,
        "verdict": d.verdict, "named": [f.name for f in d.effects],
        "classes": [[list(m) for m in c.members] for c in d.classes],
        "location": None if d.location is None or not d.location.claimed else d.location.element,
    }  # fmt: skip


def said(c: dict[str, Any]) -> str:
    """Of a case, what the diagnosis says of it."""
    classes = "; ".join(" | ".join("+".join(m) or "nothing" for m in group) for group in c["classes"])
    place = f" in {c['location']}" if c["location"] else ""
    return f"{c['verdict']} {'+'.join(c['named'])}{f' ({classes})' if classes else ''}{place}"


def compare(old: list[dict[str, Any]], new: list[dict[str, Any]]) -> str:
    """Where the two differ, and the stop rule."""
    known = {(c["row"], c["case"]): c for c in new if "error" not in c}
    pairs = [(c, known[c["row"], c["case"]]) for c in old if "error" not in c and (c["row"], c["case"]) in known]
    lines, worse, alike = [], 0, 0
    for a, b in pairs:
        gain = b["log_evidence"] - a["log_evidence"]
        same = abs(a["noise"] - b["noise"]) < 1e-6 * abs(a["noise"])
        alike += same
        worse += same and gain < -WORSE
        if (same and abs(gain) > WORSE) or said(a) != said(b):
            truth = a["truth"]["stranger"] or "+".join(a["truth"]["effects"]) or "nothing"
            lnz = f"{gain:+.2f}" if same else "other noise"
            lines.append(
                f"{a['row']} {a['case']} ({truth}): {lnz}, {'+'.join(a['best'])} -> {'+'.join(b['best'])}\n"
                f"    {said(a)}\n    {said(b)}"
            )

    def ratio(key: str) -> str:
        first, second = (sum(c[key] for c in some) for some in zip(*pairs, strict=True))
        return f"{second:.0f} of {first:.0f} ({second / first:.2f})"

    rule = "find out why" if worse > OFTEN * max(alike, 1) else "go on"
    differing = sum(said(a) != said(b) for a, b in pairs)
    costs = (
        f"predictions of the search {ratio('predictions')}, its CPU {ratio('search_cpu_s')} s, all {ratio('cpu_s')} s"
    )
    return "\n".join(
        [
            *lines,
            f"{len(pairs)} cases, {alike} with the same noise; ln Z of the best is worse by more than {WORSE} in "
            f"{worse} ({rule}); what is said differs in {differing}",
            costs,
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    sub = parser.add_subparsers(dest="command", required=True)
    go = sub.add_parser("run", help="run cases that are not there yet")
    go.add_argument("--rows", default=",".join(ROWS))
    go.add_argument("--cases", type=int, default=9, help="per row")
    go.add_argument("--seed", type=int, required=True)
    go.add_argument("--out", type=Path, required=True)
    go.add_argument("--workers", type=int, default=2)
    both = sub.add_parser("compare", help="say where two runs differ")
    both.add_argument("old", type=Path)
    both.add_argument("new", type=Path)
    args = parser.parse_args()
    if args.command == "run":
        study.run(case, args.rows.split(","), args.cases, args.seed, args.out, args.workers)
    else:
        print(compare(study.read([args.old]), study.read([args.new])))


if __name__ == "__main__":
    main()
