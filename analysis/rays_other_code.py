"""`rays` against the truth of photographs that other code made: centre line, flux and width from their setting errors.

The truth is a list of points (y, z) on the board with the spot's light per phase and its covariance; the setting errors
are stated beside it. clean-f7 is geometric; known-six has a bowed board, x = (bow_y y² + bow_z z²)/2 in board
coordinates, whose points are carried to the flat board along the light before the comparison. Their re-seating slopes
r_ty, r_tz tilt the board as x = r_ty z + r_tz y in its own, rolled coordinates; ours is a turn about the world's axes,
which differs in name only.

Bar: 5 µm rms in every exposure. What is left has no statistical error: both are deterministic.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchsim.bench.curve import signed_distance
from benchsim.bench.files import read
from benchsim.bench.model import Exposure, Recording
from benchsim.bench.place import Placement, SettingErrors, place
from benchsim.rays import trace_curve
from benchsim.rays.curve import beam_profiles, sample_phases
from benchsim.rays.sweep import Bench

SHARED = Path(__file__).resolve().parents[2] / "shared" / "recordings" / "bench-other-code"
BAR = 5e-3


def errors_of(truth: dict, exposure: Exposure, index: int) -> SettingErrors:
    """Setting errors of one exposure, from their names and units (mm, mrad) to ours."""
    s = truth["setting_errors"][exposure.setting]
    seat = truth["seat_errors"][str(truth["seats"][index])]
    r = {key: seat.get(key, 0.0) for key in ("r_x", "r_y", "r_z", "r_rot", "r_ty", "r_tz")}
    roll = Rotation.from_rotvec([exposure.screen_roll, 0.0, 0.0])
    return SettingErrors(
        np.array([s["n_cx"], s["n_cy"], s["n_cz"]]),
        np.array([s["n_a1"], s["n_a2"]]) * 1e-3,
        np.array([s["n_saz"], s["n_sel"]]) * 1e-3,
        np.array([r["r_x"], r["r_y"], r["r_z"]]),
        roll.apply(np.array([r["r_rot"], r["r_ty"], -r["r_tz"]]) * 1e-3),
    )


def flatten(points: np.ndarray, placement: Placement, bow: tuple[float, float]) -> np.ndarray:
    """Carry points of the bowed board along the light to its tangent plane at the centre.

    The light is taken to come from the laser's point on the mirror; it comes from within 3 mm of it, 0.3 µm here.
    """
    mirror = (placement.laser_point - placement.screen_origin) @ placement.screen_rotation
    x = 0.5 * (bow[0] * points[:, 0] ** 2 + bow[1] * points[:, 1] ** 2)
    ray = np.column_stack([x, points]) - mirror
    return points - (x / ray[:, 0])[:, None] * ray[:, 1:]


def compare(recording: Recording, truth: dict, traces: list[np.ndarray]) -> list[dict[str, float]]:
    """Per exposure: rms and largest distance of the centre line [mm], relative misfit of flux and rms width."""
    bows = {e["name"]: e["parameters"] for e in truth["effects"]}.get("screen-bow")
    bow = tuple(bows[k]["value"] * 1e-3 for k in ("bow_y", "bow_z")) if bows else (0.0, 0.0)
    rows = []
    for i, (exposure, trace) in enumerate(zip(recording.exposures, traces, strict=True)):
        p = place(recording.mirror, exposure, errors_of(truth, exposure, i))
        flat = flatten(trace[:2].T, p, bow)
        curve = trace_curve(recording.laser, recording.mirror, recording.physics, recording.screen, p, samples=200)
        d, s = signed_distance(curve, flat)
        bench = Bench(recording.laser, recording.mirror, recording.physics, recording.screen, p)
        _, tangent, nodes = beam_profiles(bench, sample_phases(bench, 200))
        along = curve.arc_length()
        a, b = -np.interp(s, along, tangent[:, 1]), np.interp(s, along, tangent[:, 0])
        spread = np.sqrt(a * a * trace[5] + 2 * a * b * trace[6] + b * b * trace[7])
        width = np.interp(s, along, np.sqrt(nodes.mean(nodes.q**2))) / spread - 1
        # Their light is per phase; ours per mm: the speed along the curve turns one into the other, up to a factor.
        per_phase = np.interp(s, along, curve.flux / np.abs(np.gradient(curve.phase, along)))
        ratio = per_phase / trace[4]
        inner = slice(2, -2)
        rows.append(
            {
                "rms": float(np.sqrt((d**2).mean())),
                "worst": float(np.abs(d).max()),
                "flux": float(np.std(ratio[inner]) / ratio.mean()),
                "width": float(np.abs(width[inner]).max()),
            }
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0, help="not used: nothing here is random")
    parser.add_argument("--folder", type=Path, default=SHARED)
    args = parser.parse_args()
    if not args.folder.is_dir():
        print(f"{args.folder} is not there; give --folder with clean-f7, known-six and truth in it")
        return
    for name in ("clean-f7", "known-six"):
        recording = read(args.folder / name)
        truth = json.loads((args.folder / "truth" / f"{name}.json").read_text())
        arrays = np.load(args.folder / "truth" / f"{name}.npz")
        traces = [arrays[f"trace_{i}"] for i in range(len(recording.exposures))]
        rows = compare(recording, truth, traces)
        print(f"{name}: centre line rms, worst (µm); flux along the trace (rms, relative); rms width (worst, relative)")
        for exposure, row in zip(recording.exposures, rows, strict=True):
            print(
                f"  {exposure.name}: {1e3 * row['rms']:6.2f} {1e3 * row['worst']:6.2f}   "
                f"{row['flux']:.1e}   {row['width']:.1e}"
            )
        worst = max(row["rms"] for row in rows)
        print(f"  bar {1e3 * BAR:g} µm rms: {'met' if worst <= BAR else 'NOT met'} ({1e3 * worst:.2f})")


if __name__ == "__main__":
    main()
