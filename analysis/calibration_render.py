"""Calibration from views that benchsim's own `render` photographs as a phone would: tone curve, sharpening, one lamp.

The bench of `scenes/phone` with a camera of half its resolution; twelve views of the board a set. What is drawn in
`calibration_sets.py` lacks is here: a tone curve that is no power, and sharpening, which makes edges overshoot. Printed
are error, σ and pull of every parameter of the lens. No bar: it is looked at beside `calibration_sets.py`.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from benchsim.bench.files import read
from benchsim.calibration import LENS, calibrate
from benchsim.renderer.phone import Phone, photograph_with_phone

ROOT = Path(__file__).resolve().parents[1]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--plain", action="store_true", help="sRGB's curve, no sharpening")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    bench = read(ROOT / "scenes" / "phone" / "bench.toml", images=False)
    camera = next(iter(bench.cameras.values()))
    half = camera.binned(2)
    bench = replace(bench, cameras={half.name: half}, exposures=bench.exposures[:1])
    phone = Phone(contrast=0.0, sharpening=0.0) if options.plain else Phone()
    print("seed  parameter               truth      found      error      sigma   pull")
    for seed in range(options.seed, options.seed + options.sets):
        begin = time.process_time()
        with tempfile.TemporaryDirectory() as name:
            truth = photograph_with_phone(bench, name, phone=phone, seed=seed)
            drawn = time.process_time()
            found = calibrate([Path(name) / p for p in truth.board], bench.screen.marks)
        true = np.array([truth.camera.focal, *truth.camera.principal_point, *truth.camera.distortion])
        b = found.bundle
        for parameter, a, x, s in zip(LENS, true, b.lens, b.sigma[: len(LENS)], strict=True):
            print(f"{seed:4d}  {parameter:20s} {a:10.5g} {x:10.5g} {x - a:+10.2g} {s:10.2g}  {(x - a) / s:+5.2f}")
        print(
            f"      focal length {100 * (b.lens[0] / true[0] - 1):+.4f} % off; residuals {np.median(b.rms):.3f} px, "
            f"black spread by {np.median(b.spread[:, 0]):+.3f} px, one focal length p = {found.focal.probability:.2g}, "
            f"one principal point p = {found.principal_point.probability:.2g}; CPU {drawn - begin:.0f} s drawing, "
            f"{time.process_time() - drawn:.0f} s calibrating",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
