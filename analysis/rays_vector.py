"""`rays` with `[physics]` all false against `vector`, over random settings of the bench.

Two codes, written apart, for the same pencil at P(ε) = C + r n(ε): the largest distance of their points at equal
phases. Bar: 1e-9 mm over 1000 settings. Settings that cannot be (laser behind the mirror, trace beside the board) are
drawn again and counted.
"""

from __future__ import annotations

import argparse

import numpy as np

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Exposure, Laser, Mirror, Physics, Screen
from benchsim.bench.place import place
from benchsim.bench.settings import from_vector
from benchsim.rays import trace_curve
from benchsim.vector import trace

BAR = 1e-9
SIGMA = np.array([1.0] * 3 + [1.745e-3] * 4 + [0.2] * 3 + [1e-3] * 3)


def compare(settings: int, seed: int) -> tuple[np.ndarray, int]:
    """Worst distance per setting (settings,) [mm], and the number of draws that could not be."""
    rng = np.random.default_rng(seed)
    worst: list[float] = []
    refused = 0
    while len(worst) < settings:
        mirror = Mirror(
            shape=str(rng.choice(["polygon", "cylinder"])),
            facets=int(rng.integers(5, 25)),
            diameter=rng.uniform(5, 120),
            stands_for=str(rng.choice(["elevation", "azimuth"])),
        )
        exposure = Exposure(
            "A",
            "s",
            rng.uniform(-np.pi, np.pi),
            rng.uniform(np.radians(10), np.radians(80)),
            (rng.uniform(800, 2500), rng.uniform(-800, 800), rng.uniform(-1800, 600)),
            rng.uniform(-100, 200),
            rng.uniform(-np.pi, np.pi),
        )
        placement = place(mirror, exposure, from_vector(rng.normal(size=13) * SIGMA))
        try:
            ours = trace_curve(Laser(), mirror, Physics(False, False, False), Screen(), placement, samples=64)
        except BenchsimError:
            refused += 1
            continue
        theirs = trace(mirror, exposure, ours.phase, placement=placement)
        worst.append(float(np.linalg.norm(ours.points - theirs.points, axis=1).max()))
    return np.array(worst), refused


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--settings", type=int, default=1000)
    parser.add_argument("--quick", action="store_true", help="100 settings")
    args = parser.parse_args()
    worst, refused = compare(100 if args.quick else args.settings, args.seed)
    print(f"rays against vector, {len(worst)} settings (seed {args.seed}), {refused} draws refused")
    print(f"  worst point: largest {worst.max():.1e} mm, median {np.median(worst):.1e} mm")
    print(f"  bar {BAR:.0e} mm: {'met' if worst.max() <= BAR else 'NOT met'}")


if __name__ == "__main__":
    main()
