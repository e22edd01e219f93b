"""The ridge in photographs made by other code, against the truth beside them.

``clean-f7`` (geometric optics) on the screen in mm; ``known-six`` (diffraction; its board is bowed, which marks cannot
tell) in the picture, in pixels. These pictures have speckle of 0.8 px and 12-bit counts. Their folder is not part of
the project: it is looked for beside it, as ``shared/recordings``.

The truth is the mean of the light as geometric optics gives it. A trace lies at `benchsim.bench.centre` instead, which
for lopsided light, behind a mirror that stands off the beam's axis, is another place: by how much is taken from `rays`
at the true settings, and printed as ``aside``.

    python analysis/ridge_other_code.py [--overlay FILE.png]
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import cv2
import numpy as np

from benchsim import rays
from benchsim.bench.curve import Curve, signed_distance
from benchsim.bench.files import read
from benchsim.bench.model import Exposure, Recording
from benchsim.bench.settings import from_vector
from benchsim.instruments.bench.observed import beside
from benchsim.trace.extract import extract
from benchsim.trace.pose import to_pixels
from benchsim.trace.table import Trace, only_ridge

FOLDER = Path(__file__).resolve().parents[2] / "shared" / "recordings" / "bench-other-code"


def inside(curve: Curve, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Signed distance from the true curve, and which points are not beyond its ends."""
    d, s = signed_distance(curve, points)
    return d, (s > 0) & (s < curve.arc_length()[-1])


def at_mean(recording: Recording, exposure: Exposure, values: dict[str, float], points: np.ndarray) -> np.ndarray:
    """Points of the board at the light's centre put where its mean is [mm]; settings are off by ``values``."""
    off = np.zeros(13)
    for i, key in enumerate(("n_cx", "n_cy", "n_cz", "n_a1", "n_a2", "n_saz", "n_sel")):
        off[i] = values[key] * (1.0 if i < 3 else 1e-3)
    curve = rays.predict(recording, exposure, from_vector(off), blur=0.5)
    assert curve.aside is not None
    s = np.clip(signed_distance(curve, points)[1], 0.0, curve.arc_length()[-1])
    return points - beside(curve, s, np.interp(s, curve.arc_length(), curve.aside)) + beside(curve, s, 0.0 * s)


def sigma_px(trace: Trace) -> np.ndarray:
    """The trace noise's sigma in the picture: from the ratio of steps along the curve, which cameras this far share."""
    mm = np.gradient(trace.s_mm)
    px = np.hypot(np.gradient(trace.u_px), np.gradient(trace.v_px))
    return trace.sigma_mm * np.median(px / mm)


def overlay(path: Path, image: Path, trace: Trace) -> None:
    """The photograph with the ridge ± 30 σ, and what was dropped in red."""
    counts = cv2.imread(str(image), cv2.IMREAD_UNCHANGED).astype(float)
    grey = np.clip(counts / np.quantile(counts, 0.9995) * 255, 0, 255).astype(np.uint8)
    picture = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    for u, v in trace.dropped_px:
        cv2.circle(picture, (round(u), round(v)), 1, (0, 0, 255), -1)
    for u, v in zip(trace.u_px, trace.v_px, strict=True):
        cv2.circle(picture, (round(u), round(v)), 0, (0, 255, 0), -1)
    cv2.imwrite(str(path), picture)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--overlay", type=Path, help="write the first photograph with its ridge drawn over it")
    options = parser.parse_args()
    if not FOLDER.is_dir():
        sys.exit(f"{FOLDER} is not there; nothing to compare with")
    met = True
    for name, unit, bar in (("clean-f7", "mm", 0.01), ("known-six", "px", 0.05)):
        truth = np.load(FOLDER / "truth" / f"{name}.npz")
        recording = read(FOLDER / name)
        known = json.loads((FOLDER / "truth" / f"{name}.json").read_text())
        print(f"{name}: bias in {unit}, bar {bar}; pull std, bar 0.9 … 1.15")
        for i, exposure in enumerate(recording.exposures):
            trace = only_ridge(extract(recording, exposure))
            y, z, u, v = truth[f"trace_{i}"][:4]
            points = at_mean(recording, exposure, known["setting_errors"][exposure.setting], trace.points)
            aside = np.linalg.norm(points - trace.points, axis=1).mean()
            if unit == "mm":
                error, on = inside(Curve(np.stack([y, z], axis=1)), points)
                sigma, common = trace.sigma_mm, np.concatenate([trace.shape_mm, trace.pose_mm], axis=1)
            else:
                assert trace.pose is not None
                pixels = np.stack([trace.u_px, trace.v_px], axis=1)
                pixels = pixels + to_pixels(trace.pose, points) - to_pixels(trace.pose, trace.points)
                error, on = inside(Curve(np.stack([u, v], axis=1)), pixels)
                sigma = sigma_px(trace)
                common = trace.shape_mm * (sigma / trace.sigma_mm)[:, None]
            bias, pull = error[on].mean(), np.std(error[on] / sigma[on])
            together = np.linalg.norm(common[on].mean(axis=0))
            good = abs(bias) <= bar and 0.9 <= pull <= 1.15
            met &= bool(good)
            print(
                f"  {exposure.name}: {on.sum()} profiles, bias {bias:+.4f} ± {together:.4f}, aside {aside:.4f} mm, "
                f"rms {error[on].std():.4f}, sigma {sigma.mean():.4f}, pull std {pull:.3f}, "
                f"scale {trace.noise[0].scale:.2f}, correlation "
                f"{trace.noise[0].correlation_mm:.1f} mm: {'met' if good else 'NOT met'}"
            )
            if options.overlay and i == 0 and name == "clean-f7":
                overlay(options.overlay, recording.folder / str(exposure.image), trace)
    print("every bar met" if met else "a bar is NOT met")


if __name__ == "__main__":
    main()
