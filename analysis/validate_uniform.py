"""Are the p-values of ``validate`` uniform on clean recordings?

Every case is a recording of one exposure: a setting drawn about those of ``scenes/campaign12.toml``, setting errors
from its ``[uncertainty]``, rendered, read back and validated against the vector model with what ``[physics]`` adds to
it (``p_value`` of ``validation.json``), and as printed. On clean recordings the p-values after the setting errors must
be uniform: Kolmogorov-Smirnov at 1 %.

Each case is written as it ends; a stopped study resumes. Prints both tests and the spread of the setting errors found.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.stats import kstest

from benchsim import trace
from benchsim.bench.files import read
from benchsim.bench.model import Recording
from benchsim.instruments.bench.validation import validate_trace
from benchsim.renderer import backend
from benchsim.renderer.recording import render_recording

SCENE = Path(__file__).resolve().parents[1] / "scenes" / "campaign12.toml"


def case(bench: Recording, seed: int) -> Recording:
    """One exposure near one of the campaign's."""
    rng = np.random.default_rng(seed)
    e = bench.exposures[int(rng.integers(len(bench.exposures)))]
    e = replace(
        e,
        laser_azimuth=e.laser_azimuth + math.radians(rng.uniform(-5, 5)),
        laser_elevation=e.laser_elevation + math.radians(rng.uniform(-3, 3)),
        mirror_position=tuple(float(x + rng.uniform(-40, 40)) for x in e.mirror_position),
    )
    return replace(bench, exposures=(e,), cameras={e.camera: bench.cameras[e.camera]})


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=120)
    parser.add_argument("--seed", type=int, default=2026)
    parser.add_argument("--out", type=Path, default=Path("out/validate_uniform.jsonl"))
    args = parser.parse_args()
    args.out.parent.mkdir(parents=True, exist_ok=True)
    rows = [json.loads(line) for line in args.out.read_text().splitlines()] if args.out.exists() else []
    rows = [r for r in rows if r["seed0"] == args.seed][: args.cases]
    bench = read(SCENE)
    backend.use()
    for k in range(len(rows), args.cases):
        seed = args.seed * 100_000 + k
        with tempfile.TemporaryDirectory() as folder:
            render_recording(case(bench, seed), folder, seed=seed % 2**32)
            recording = read(folder, images=True)
            exposure = recording.exposures[0]
            main_ridge = trace.only_ridge(trace.extract(recording, exposure), 0)
            v = validate_trace(
                recording,
                exposure,
                reseated=False,
                points=main_ridge.points,
                s=main_ridge.s_mm,
                covariance=trace.covariance(main_ridge),
            ).as_dict()
        row = {
            "seed0": args.seed,
            "seed": seed,
            "setting": exposure.setting,
            "with physics": v["after"],
            "as printed": v["vector_alone"]["after"],
            "pulls": v["pulls"],
            "converged": v["converged"] and v["vector_alone"]["converged"],
            "profiles": len(main_ridge),
        }
        rows.append(row)
        with args.out.open("a") as out:
            out.write(json.dumps(row) + "\n")
    print(f"{len(rows)} clean recordings, seed {args.seed}; converged: {sum(r['converged'] for r in rows)}")
    for model in ("with physics", "as printed"):
        p = np.array([r[model]["p_value"] for r in rows])
        chi2 = np.array([r[model]["chi2"] / r[model]["dof"] for r in rows])
        test = kstest(p, "uniform")
        print(
            f"vector model {model}: chi2/dof {chi2.mean():.3f} ± {chi2.std() / math.sqrt(len(chi2)):.3f}; "
            f"KS D = {test.statistic:.3f}, p = {test.pvalue:.3f}; bar p >= 0.01: "
            f"{'met' if test.pvalue >= 0.01 else 'missed'}; below 0.01: {np.mean(p < 0.01):.3f}, "
            f"deciles {np.histogram(p, 10, (0, 1))[0].tolist()}"
        )
    pulls = np.array([list(r["pulls"].values()) for r in rows])
    print(
        f"posterior modes of the setting errors over their prior sigma: rms {np.sqrt((pulls**2).mean(axis=0)).round(2)}"
    )


if __name__ == "__main__":
    main()
