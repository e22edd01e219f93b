"""What a prediction of the ray model costs and how exact it is: alone and in lists, with and without widths.

    python analysis/rays_speed.py [--seed 0] [--rounds 8]

The diagnosis predicts each exposure some ten thousand times, most of them in lists of slightly different values, which
may be of several exposures (`rays.predict_many`, `Predict.many`). Times are CPU time of one thread, the best of the
rounds, all of one run; compare the ratios, the milliseconds depend on the machine. Accuracy is against 96 samples.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchsim.bench.curve import Curve, signed_distance
from benchsim.bench.fields import field
from benchsim.bench.files import read
from benchsim.bench.model import Recording
from benchsim.bench.settings import from_vector
from benchsim.instruments.bench import observables
from benchsim.instruments.bench.prediction import SAMPLES, Predict
from benchsim.instruments.bench.problem import build
from benchsim.rays import Case, predict, predict_many

SCENES = Path(__file__).resolve().parents[1] / "scenes"
PRIOR = np.array([1.0] * 3 + [1.745e-3] * 4 + [0.2] * 3 + [1e-3] * 3)

EFFECTS: dict[str, dict[str, float]] = {
    "canting": {"pyr": 2.0},
    "facet-tilts": {"tilt_rms": 1.0},
    "second-surface": {"glass": 2.0},
    "facet-curvature": {"fcurv": 0.1},
    "coma": {"coma_u": 0.05},
    "window": {"win": 4.0},
    "air-gradient": {"air": 100.0},
    "plume": {"plume": 1.0, "plume_z": -700.0},
    "screen-bow": {"bow_y": 0.1},
    "drift": {"dry": 1.0},
    "vibration": {"amp": 0.5},
}


def cost(work: Callable[[], object], rounds: int, calls: int = 5) -> float:
    """CPU time of one call [ms], the best of the rounds."""
    best = np.inf
    for _ in range(rounds):
        start = time.process_time()
        for _ in range(calls):
            work()
        best = min(best, (time.process_time() - start) / calls)
    return 1e3 * float(best)


def free_fields(rng: np.random.Generator) -> dict[str, dict]:
    """One field per element, 15 × 15 knots."""
    section, board, half = np.linspace(-10, 10, 15), np.linspace(-350, 350, 15), np.linspace(-1100, -200, 15)
    return {
        "angle": {"angle": field([section, section], 1e-4 * rng.normal(size=(2, 15, 15)))},
        "lean": {"lean": field([np.linspace(-0.3, 0.3, 15), np.arange(12.0)], 1e-4 * rng.normal(size=(1, 15, 12)))},
        "kick": {"kick": field([board, half], 1e-4 * rng.normal(size=(2, 15, 15)))},
        "height": {"height": field([board, board], 0.1 * rng.normal(size=(1, 15, 15)))},
    }


def accuracy(recording: Recording, seed: int, draws: int = 10) -> tuple[float, float]:
    """Largest error [mm] of centre and width with 24 samples, over random setting errors."""
    rng = np.random.default_rng(seed)
    worst = np.zeros(2)
    for _ in range(draws):
        errors = from_vector(PRIOR * rng.normal(size=13))
        few, many = (predict(recording, recording.exposures[0], errors, n) for n in (24, 96))
        d, s = signed_distance(few, many.points)
        assert few.width is not None and many.width is not None
        off = many.width - np.interp(s, few.arc_length(), few.width)
        worst = np.maximum(worst, [np.abs(d[1:-1]).max(), np.abs(off[1:-1]).max()])
    return float(worst[0]), float(worst[1])


def together(recording: Recording, seed: int, rounds: int) -> None:
    """Print what predictions of many setting errors cost, one by one and together, and how far they differ."""
    rng = np.random.default_rng(seed)
    exposure = recording.exposures[0]
    cases = [Case(recording, exposure, from_vector(PRIOR * rng.normal(size=13))) for _ in range(48)]
    for width in (False, True):

        def alone(width: bool = width) -> list[Curve]:
            return [predict(r, e, errors, SAMPLES, width=width) for r, e, errors, *_ in cases]

        one = cost(alone, rounds, 1) / len(cases)

        def listed(width: bool = width) -> list[Curve | None]:
            return predict_many(cases, SAMPLES, width=width)

        many = cost(listed, rounds, 1) / len(cases)
        pairs = zip(alone(), listed(), strict=True)
        apart = max(float(np.abs(a.points - b.points).max()) for a, b in pairs if b is not None)
        what = f"{len(cases)} settings, {'with' if width else 'without'} width"
        print(f"{what}: alone {one:.2f} ms, together {many:.2f} ms each, ratio {one / many:.1f}; apart {apart:.0e} mm")


def columns(seed: int, rounds: int) -> None:
    """Print what the predictions of a block's derivatives cost, one by one and as a list: nuisances, then all."""
    recording = read(SCENES / "campaign12.toml", images=False)
    recording = replace(recording, exposures=recording.exposures[:2])
    problem = build(recording, observables.simulate(recording, seed=seed), attached=False)
    predicted = problem.predict
    assert isinstance(predicted, Predict)
    here = {n.name: 0.3 * n.sigma for n in problem.nuisances}
    amplitudes = [p for e in problem.catalogue for p in e.parameters if not p.grid]
    for what, parameters in (("nuisances", problem.nuisances), ("and catalogue", (*problem.nuisances, *amplitudes))):
        mine = [p for p in parameters if p.blocks is None or 0 in p.blocks]
        ends = [(p, s) for p in mine for s in ((0.0, 1.0) if p.one_sided else (-1.0, 1.0))]
        values = [{**here, p.name: here.get(p.name, 0.0) + s * 0.05 * p.sigma} for p, s in ends]

        def alone(values: list[dict[str, float]] = values) -> None:
            for v in values:
                predicted(v, 0)
                predicted.cache.clear()

        def listed(values: list[dict[str, float]] = values) -> None:
            predicted.cache.clear()
            predicted.many(values, 0)

        one, many = (cost(work, rounds, 1) / len(values) for work in (alone, listed))
        print(f"{len(values)} columns' ends, {what}: alone {one:.2f} ms, listed {many:.2f} ms, ratio {one / many:.1f}")


def mixed(seed: int, rounds: int) -> None:
    """Print what lists of several exposures cost: one value in each, and a few values in each, and how far they are
    from single predictions."""
    recording = read(SCENES / "campaign12.toml", images=False)
    recording = replace(recording, exposures=recording.exposures[:6])
    problem = build(recording, observables.simulate(recording, seed=seed), attached=False)
    predicted = problem.predict
    assert isinstance(predicted, Predict)
    rng = np.random.default_rng(seed)
    at = {n.name: float(0.5 * n.sigma * rng.normal()) for n in problem.nuisances}
    blocks = list(range(len(problem.names)))
    amplitudes = [p for e in problem.catalogue for p in e.parameters if not p.grid]
    effects = {"canting": ("pyr",), "facet tilts": ("tilt_rms",), "coma and plume": ("coma_u", "plume")}
    cases = {"without effects": [at]}
    for what, names in effects.items():
        sigma = {p.name: p.sigma for p in amplitudes if p.name in names}
        cases[f"{what}, both ends"] = [{**at, **{n: k * s for n, s in sigma.items()}} for k in (0.1, 0.2)]
    for what, some in cases.items():
        values, numbers = [v for v in some for _ in blocks], blocks * len(some)

        def alone(values: list[dict[str, float]] = values, numbers: list[int] = numbers) -> list[np.ndarray]:
            predicted.cache.clear()
            return [predicted(v, b) for v, b in zip(values, numbers, strict=True)]

        def listed(values: list[dict[str, float]] = values, numbers: list[int] = numbers) -> list[np.ndarray]:
            predicted.cache.clear()
            return predicted(values, numbers)

        apart = max(float(np.abs(a - b).max()) for a, b in zip(alone(), listed(), strict=True))
        one, many = cost(alone, rounds, 1), cost(listed, rounds, 3)
        print(
            f"{len(blocks)} exposures x {len(some)}, {what}: alone {one:.1f} ms, listed {many:.1f} ms, "
            f"{many / len(values):.2f} ms each, ratio {one / many:.1f}; apart {apart:.0e}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rounds", type=int, default=8)
    args = parser.parse_args()
    recordings = {name: read(SCENES / f"{name}.toml", images=False) for name in ("fig7a", "fig7b")}
    for name, recording in recordings.items():
        centre, width = accuracy(recording, args.seed)
        print(f"{name}: 24 samples against 96: centre {centre:.1e} mm, width {width:.1e} mm")
    plain = recordings["fig7a"]
    together(plain, args.seed, args.rounds)
    columns(args.seed, args.rounds)
    mixed(args.seed, args.rounds)
    exposure = plain.exposures[0]

    def both(recording: Recording) -> tuple[float, float]:
        return (
            cost(lambda: predict(recording, exposure, None, 24, width=False), args.rounds),
            cost(lambda: predict(recording, exposure, None, 24), args.rounds),
        )

    base = both(plain)
    print(f"{'24 samples, CPU':24s} {'without width':>20s} {'with':>20s}")
    print(f"{'plain':24s} {base[0]:10.2f} ms        1 {base[1]:10.2f} ms {base[1] / base[0]:8.2f}")
    cases = {name: replace(plain, effects={name: table}) for name, table in EFFECTS.items()}
    cases |= {f"field {n}": replace(plain, fields=f) for n, f in free_fields(np.random.default_rng(args.seed)).items()}
    for name, recording in cases.items():
        bare, whole = both(recording)
        print(f"{name:24s} {bare:10.2f} ms {bare / base[0]:8.2f} {whole:10.2f} ms {whole / base[0]:8.2f}")


if __name__ == "__main__":
    main()
