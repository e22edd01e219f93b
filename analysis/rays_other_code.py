"""`rays` against the truth of photographs that other code made: centre line, flux and width from their setting errors.

The truth is a list of points (y, z) of the board as its marks define it, with the spot's light per phase and its
covariance; effects and setting errors are stated beside it. Their board stands on the plane x = slopes · (y, z) of tilt
and re-seating together, in coordinates that roll as stated, and is turned within it by ``srot`` and the re-seating's
roll; ours is seated by a turn about the world's axes, which differs in name only: the turn that leads to their board is
taken.

Bar: 5 µm rms in every exposure. What is left has no statistical error: both are deterministic.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchsim.bench.curve import Curve, signed_distance
from benchsim.bench.files import read
from benchsim.bench.model import Exposure, Recording
from benchsim.bench.place import SettingErrors
from benchsim.rays.camera import print_places
from benchsim.rays.curve import beam_profiles
from benchsim.rays.phases import sample_phases
from benchsim.rays.prediction import bench_of

SHARED = Path(__file__).resolve().parents[2] / "shared" / "recordings" / "bench-other-code"
BAR = 5e-3


def effects_of(truth: dict) -> dict[str, dict[str, float]]:
    """The truth's effects as a recording's ``[effects]``."""
    return {e["name"]: {k: v["value"] for k, v in e["parameters"].items()} for e in truth["effects"]}


def board(roll: float, along_y: float, along_z: float, turn: float) -> Rotation:
    """Their board: turned within the plane x = along_y y + along_z z, which rolls as stated."""
    axis = np.array([0.0, along_z, -along_y])
    steep = float(np.linalg.norm(axis))
    tilt = Rotation.from_rotvec(axis * (np.arctan(steep) / steep if steep else 1.0))
    return Rotation.from_rotvec([roll, 0.0, 0.0]) * tilt * Rotation.from_rotvec([turn, 0.0, 0.0])


def errors_of(truth: dict, exposure: Exposure, index: int) -> SettingErrors:
    """Setting errors of one exposure, from their names and units (mm, mrad) to ours."""
    s = truth["setting_errors"][exposure.setting]
    seat = truth["seat_errors"][str(truth["seats"][index])]
    r = {key: seat.get(key, 0.0) for key in ("r_x", "r_y", "r_z", "r_rot", "r_ty", "r_tz")}
    own = {k: v for table in effects_of(truth).values() for k, v in table.items()}
    slopes = np.array([own.get("st_z", 0.0), own.get("st_y", 0.0)]) * 1e-3
    turn = own.get("srot", 0.0) * 1e-3
    seated = slopes + 1e-3 * np.array([r["r_tz"], r["r_ty"]])
    as_seated = board(exposure.screen_roll, *seated, turn + 1e-3 * r["r_rot"])
    return SettingErrors(
        np.array([s["n_cx"], s["n_cy"], s["n_cz"]]),
        np.array([s["n_a1"], s["n_a2"]]) * 1e-3,
        np.array([s["n_saz"], s["n_sel"]]) * 1e-3,
        np.array([r["r_x"], r["r_y"], r["r_z"]]),
        (as_seated * board(exposure.screen_roll, *slopes, turn).inv()).as_rotvec(),
    )


def compare(recording: Recording, truth: dict, traces: list[np.ndarray]) -> list[dict[str, float]]:
    """Per exposure: rms and largest distance of the centre line [mm], relative misfit of flux and rms width."""
    recording = replace(recording, effects=effects_of(truth))
    rows = []
    for i, (exposure, trace) in enumerate(zip(recording.exposures, traces, strict=True)):
        bench = bench_of(recording, exposure, errors_of(truth, exposure, i))
        points, tangent, nodes = beam_profiles(bench, sample_phases(bench, 200))
        curve = Curve(points, None, nodes.flux, nodes.mean(nodes.phase))
        # Where marks are printed out of place, theirs are places as the marks have them.
        d, s = signed_distance(curve, print_places(recording, trace[:2].T))
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
                "rms": float(np.sqrt((d[inner] ** 2).mean())),
                "worst": float(np.abs(d[inner]).max()),
                "flux": float(np.std(ratio[inner]) / ratio[inner].mean()),
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
        print(f"{args.folder} is not there; give --folder with the recordings and truth in it")
        return
    for name in sorted(path.stem for path in (args.folder / "truth").glob("*.json")):
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
