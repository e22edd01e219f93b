"""A defect of the lens that no catalogue holds, concealed: how often is it passed over as "nothing is missing"?

    python analysis/lens_defects.py --cases 20 --seed 1

Even cases have a k3, which a catalogue with k1 and k2 can only imitate; odd ones a local shift, of one twelfth of the
picture's width. Data are those of the traces' tier of `diagnosis_study.py`; SNR from 9 to 40.
"""

from __future__ import annotations

import argparse
import os
from collections import Counter
from dataclasses import replace

os.environ.setdefault("OMP_NUM_THREADS", "1")

import diagnosis_study as study
import numpy as np
import study_cases as draw
from numpy.typing import NDArray

from benchsim import diagnosis
from benchsim.bench.fields import Field
from benchsim.bench.fields import field as tabulated
from benchsim.bench.model import Recording
from benchsim.diagnosis.linear import predict_all, whiten
from benchsim.diagnosis.problem import Problem
from benchsim.instruments.bench import problem as bench_problem

SNR = (9.0, 40.0)
WIDTH = 0.08
"""Of a local defect, 1 sigma, over the picture's width."""

SMALL = 1e-3
"""Amplitude at which a defect's SNR is first looked at: of k3, and in pixels over 50."""


def shapes(recording: Recording, k3: bool, rng: np.random.Generator) -> tuple[list[NDArray[np.float64]], ...]:
    """Knots of the pixel field, and its two components for an amplitude of 1."""
    camera = next(iter(recording.cameras.values()))
    knots = [np.linspace(0, n - 1, 41) for n in camera.resolution]
    u, v = np.meshgrid(*knots, indexing="ij")
    if k3:
        x, y = ((w - c) / camera.focal for w, c in zip((u, v), camera.principal_point, strict=True))
        bend = camera.focal * (x**2 + y**2) ** 3
        return knots, [x * bend, y * bend]
    lean, centre = rng.uniform(0, 2 * np.pi), [rng.uniform(0.3, 0.7) * n for n in camera.resolution]
    bump = np.exp(-((u - centre[0]) ** 2 + (v - centre[1]) ** 2) / (2 * (WIDTH * camera.resolution[0]) ** 2))
    return knots, [50 * np.cos(lean) * bump, 50 * np.sin(lean) * bump]


def one(seed: int, case: int) -> tuple[str, str]:
    """A case's verdict, and its line."""
    on = study.stage("traces", "six", seed, case, 1)
    nominal, rng = on.sight.problem, study.rng_of(seed, "traces", "lens", case)
    knots, form = shapes(on.recording, case % 2 == 0, rng)

    def lit(size: float) -> tuple[Problem, float]:
        fields: dict[str, Field] = {"pixel": tabulated(knots, [size * f for f in form])}
        true = bench_problem.build(replace(on.recording, fields=fields), on.observed, attached=False)
        bent = predict_all(true, {}) - true.data + nominal.data - predict_all(nominal, {})
        white = whiten(nominal, nominal.covariance, bent)[0]
        return true, float(np.linalg.norm(on.sight.through(white)))

    wanted = float(np.exp(rng.uniform(*np.log(SNR))))
    true, snr = lit(SMALL * wanted / lit(SMALL)[1])
    nothing = draw.Truth({}, {})
    at = draw.nuisances(nominal, nothing, rng)
    data = draw.noisy(nominal, predict_all(true, at) - true.data + nominal.data, nothing, rng)
    d = diagnosis.diagnose(replace(nominal, data=data))
    place = "" if d.location is None else f"{d.location.element}{'' if d.location.claimed else ' (not claimed)'}"
    names = " + ".join(f"{f.name} ({f.confidence})" for f in d.effects)
    kind = "k3" if case % 2 == 0 else "local"
    return d.verdict, f"{case} {kind}, {snr:.1f} sigma: {d.verdict} {place} {names}"


def main() -> None:
    """Print every case, and how often each verdict was given."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=20)
    parser.add_argument("--seed", type=int, required=True)
    args = parser.parse_args()
    count: Counter[str] = Counter()
    for case in range(args.cases):
        verdict, line = one(args.seed, case)
        count[verdict] += 1
        print(line, flush=True)
    print(", ".join(f"{v} {n}" for v, n in count.most_common()))


if __name__ == "__main__":
    main()
