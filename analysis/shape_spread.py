"""Is the place of a faint plume as uncertain as is said? Pulls by the curvature there, and by `shapes.spread`.

    python analysis/shape_spread.py --seed 4145000 --cases 30 --effect plume --snr 7 16

Benches are those of `diagnosis_study.py`; the effect's size is scaled to an SNR drawn between the two, and the
catalogue holds it alone, so that every case has a fit to judge.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace

import diagnosis_study as study
import numpy as np
import study_cases as draw

from benchsim.diagnosis import shapes
from benchsim.diagnosis.linear import predict_all
from benchsim.diagnosis.naming import name
from benchsim.diagnosis.problem import Effect


def drawn(on: study.Stage, effect: Effect, snr: float, rng: np.random.Generator) -> dict[str, float]:
    """Values of an effect that a recording shows at ``snr``, its shapes drawn from their ranges."""
    sight = on.sight
    while True:
        values = draw.draw_effect(sight, effect, rng)
        seen = float(np.linalg.norm(sight.change(draw.as_effects(values, effect)[effect.name])))
        # Where light misses the place drawn, no size within reason shows it.
        if seen > 1:
            break
    grid = {p.name for p in effect.parameters if p.grid}
    return {k: v if k in grid else v * snr / seen for k, v in values.items()}


def pulls(
    kind: str, called: str, snr: Sequence[float], seed: int, case: int
) -> tuple[list[float], list[float], float] | None:
    """(estimate − truth)/σ by the curvature and by the spread, and CPU seconds of the latter; None without a fit."""
    on = study.stage("traces", kind, seed, case, 1)
    nominal = on.sight.problem
    effect = next(e for e in nominal.catalogue if e.name == called)
    rng = np.random.default_rng([seed, case, 77])
    values = drawn(on, effect, float(rng.uniform(*snr)), rng)
    truth = draw.Truth(draw.as_effects(values, effect), {})
    at = {**draw.nuisances(nominal, truth, rng), **values}
    data = draw.noisy(nominal, predict_all(nominal, at), truth, rng)
    problem = replace(nominal, data=data, catalogue=(effect,))
    naming = name(problem)
    fit = next((f for f in naming.fits if f.effects == (called,) and f.converged), None)
    if fit is None:
        return None
    start = time.process_time()
    spread = shapes.spread(problem, naming.noise.covariance, fit, effect)
    took = time.process_time() - start
    off = {k: fit.values[k] - values[k] for k in spread}
    return [off[k] / fit.sigma[k] for k in off], [off[k] / spread[k] for k in off], took


def main() -> None:
    """Print both standard deviations about 0 and the largest pulls."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kind", choices=["six", "fig7"], default="six")
    parser.add_argument("--effect", default="plume")
    parser.add_argument("--snr", type=float, nargs=2, default=[7.0, 16.0])
    parser.add_argument("--cases", type=int, default=30)
    parser.add_argument("--seed", type=int, required=True)
    args = parser.parse_args()
    found = [pulls(args.kind, args.effect, args.snr, args.seed, case) for case in range(1, args.cases + 1)]
    known = [f for f in found if f is not None]
    for title, k in (("curvature", 0), ("spread", 1)):
        x = np.array([p for f in known for p in f[k]])
        print(
            f"{title:<10} std about 0 {np.sqrt(np.mean(x**2)):6.2f}, largest {np.abs(x).max():6.2f}, "
            f"beyond 3 σ {(np.abs(x) > 3).sum()}/{len(x)}"
        )
    print(f"{len(known)} of {len(found)} fits; {np.mean([f[2] for f in known]):.1f} s of CPU each")


if __name__ == "__main__":
    main()
