"""Does the search find the fit that begins at the truth? Traces, each searched and fitted from its truth.

    python analysis/search_shadow.py --rows single,pair --cases 10 --seed 4242

Per case: the best set and its ln Z, the same of the truth's set fitted from the truth, and CPU seconds.
"lost": the truth's own fit lies more than 0.5 in ln Z above all that the search found.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace

import diagnosis_study as study
import numpy as np
import study_cases as draw

from benchsim.diagnosis import linear, name, screen
from benchsim.diagnosis.fits import Naming
from benchsim.diagnosis.fitting import RENEWALS, Start, fitted
from benchsim.diagnosis.hypothesis import Context, Hypothesis, Point, whitener
from benchsim.diagnosis.problem import Problem, Values
from benchsim.instruments.bench import problem as bench_problem

LOST = 0.5
"""ln Z."""


def cases(row: str, count: int, seed: int) -> Iterator[tuple[int, Problem, tuple[str, ...], Values]]:
    """Number, problem, concealed effects and all true values of each case."""
    for case in range(count):
        rng = study.rng_of(seed, "traces", row, case)
        on = study.stage("traces", study.design(row), seed, case, 1)
        nominal = on.sight.problem
        truth, values = draw.conceal(row, on.recording, on.sight, rng)
        bent = replace(on.recording, fields=truth.fields)
        lit = bench_problem.build(bent, on.observed, attached=False) if truth.fields else nominal
        at = {**draw.nuisances(nominal, truth, rng), **values}
        data = draw.noisy(nominal, linear.predict_all(lit, at) - lit.data + nominal.data, truth, rng)
        yield case, study.without(replace(nominal, data=data), row, truth), tuple(truth.effects), at


def from_the_truth(problem: Problem, found: Naming, effects: tuple[str, ...], at: Values) -> float:
    """ln Z of the truth's own set, fitted from the truth with the noise that the search estimated."""
    h = Hypothesis(tuple(e for e in problem.catalogue if e.name in effects))
    context = Context(problem, whitener(found.noise.covariance), found.setting_scales, found.scale_weights)
    sigma = np.array([p.sigma for p in problem.nuisances])
    point = Point(
        np.array([at.get(p.name, 0.0) for p in problem.nuisances]) / sigma,
        np.array([linear.fit_value(p, at.get(p.name, 0.0)) for p in h.amplitudes]),
        np.array([at[p.name] for p in h.shapes]),
    )
    columns = context.whiten(linear.columns(problem, at, problem.nuisances) * sigma)
    prior = screen.log_prior(h.names, [e.name for e in problem.catalogue])
    (end,) = fitted(context, [Start(h, point, columns)], {h.names: prior}, renewals=RENEWALS)
    return end.fit.log_evidence


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", default="single,pair,clean")
    parser.add_argument("--cases", type=int, default=10)
    parser.add_argument("--seed", type=int, required=True)
    args = parser.parse_args()
    lost = count = 0
    for row in args.rows.split(","):
        for case, problem, effects, at in cases(row, args.cases, args.seed):
            begun = time.process_time()
            found = name(problem)
            spent = time.process_time() - begun
            best = found.fits[0]
            known = {e.name for e in problem.catalogue}
            whole = bool(effects) and set(effects) <= known
            own = from_the_truth(problem, found, effects, at) if whole else -np.inf
            gone = own > best.log_evidence + LOST
            lost, count = lost + gone, count + 1
            said = "+".join(best.effects) or "nothing"
            print(
                f"{row} {case}: truth {'+'.join(effects) or 'nothing'}, ln Z from it {own:.1f}; "
                f"best {said} {best.log_evidence:.1f}{', LOST' if gone else ''}; {spent:.0f} s of CPU",
                flush=True,
            )
    print(f"lost: {lost} of {count}")


if __name__ == "__main__":
    main()
