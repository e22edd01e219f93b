"""What a prediction of the ray model costs and how exact it is: with and without widths, and with each effect.

    python analysis/rays_speed.py [--seed 0] [--rounds 8]

The diagnosis predicts each exposure with 24 samples, some ten thousand times. Times are CPU time, the best of the
rounds, all of one run; compare the ratios, the milliseconds depend on the machine. Accuracy is against 96 samples.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchsim.bench.curve import signed_distance
from benchsim.bench.fields import field
from benchsim.bench.files import read
from benchsim.bench.model import Recording
from benchsim.bench.settings import from_vector
from benchsim.rays import predict

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


def cost(work: Callable[[], object], rounds: int) -> float:
    """CPU time of one call [ms], the best of the rounds."""
    best = np.inf
    for _ in range(rounds):
        start = time.process_time()
        for _ in range(5):
            work()
        best = min(best, (time.process_time() - start) / 5)
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
