"""Marks: are all found, where are their corners, and how well does the pose put the board under the picture?

Part 1, photographs of other code (../shared/recordings/bench-other-code, truth beside them): every mark found; corners
within 0.06 px rms; mean error along u, v and outward within 3 standard errors. Corners next to an edge that the trace
covers are called unmeasured and counted apart. Those pictures are means of 4 × 4 points a pixel, which alone puts their
edges up to 0.03 px off. `known-six` has a bowed board, so only `clean-f7` is also compared on the board.

Part 2, our own noisy photographs of Figs 7a and 7b with camera poses and boards drawn anew: true corners and centres
sent through the solved pose, worst within 0.05 mm at 1.8 px/mm; pulls (estimate − truth)/σ of the six pose parameters
(decorrelated) and of points of the board 0.9 to 1.15 wide over 100 pictures or more; CPU from file to pose ≤ 0.4 s.
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
from scipy.spatial.transform import Rotation

from benchsim.bench.files import read
from benchsim.bench.place import SettingErrors, place
from benchsim.renderer.irradiance import irradiance
from benchsim.renderer.picture import photograph
from benchsim.renderer.recording import draw_pose
from benchsim.renderer.sensor import expose, signals, write_image
from benchsim.trace import board_corners, find_marks, read_image, solve_pose, to_board, to_pixels

ROOT = Path(__file__).resolve().parents[1]
OTHER = ROOT.parent / "shared" / "recordings" / "bench-other-code"
RMS_BAR, BOARD_BAR, PULL_BAR, CPU_BAR = 0.06, 0.05, (0.9, 1.15), 0.4


def outward(errors, corners):
    """Error of each corner away from its mark's centre [px]."""
    direction = corners - corners.mean(axis=1, keepdims=True)
    return (errors * direction / np.linalg.norm(direction, axis=-1, keepdims=True)).sum(axis=-1)


def other_code() -> bool:
    """Part 1; True if every bar is met."""
    print("Photographs of other code")
    print("picture                 found  unmeasured  rms px  max px  mean u   mean v   outward  board worst mm")
    errors, radial, complete, worst = [], [], True, 0.0
    for name in ("clean-f7", "known-six"):
        recording = read(OTHER / name)
        truth = np.load(OTHER / "truth" / f"{name}.npz")
        for k, exposure in enumerate(recording.exposures):
            camera = recording.cameras[exposure.camera]
            for image in filter(None, (exposure.image, exposure.dark)):
                picture = read_image(recording.folder / image, camera, dark=image == exposure.dark)
                seen = find_marks(picture, recording.screen.marks, camera)
                expected = truth[f"corners_{k}"][[recording.screen.marks.ids.index(i) for i in seen.ids]]
                miss = seen.corners - expected
                good = miss[seen.measured]
                out = outward(miss, expected)[seen.measured]
                errors.append(good)
                radial.append(out)
                complete &= len(seen.ids) == len(recording.screen.marks.ids)
                board, _, _ = to_board(solve_pose(camera, seen), expected.reshape(-1, 2))
                off = np.linalg.norm(board - seen.board.reshape(-1, 2), axis=1).max()
                worst = max(worst, off) if name == "clean-f7" else worst
                mean = good.mean(axis=0)
                print(
                    f"{name + '/' + image:22s} {len(seen.ids):3d}/{len(recording.screen.marks.ids)} "
                    f"{(~seen.measured).sum():9d}  {np.sqrt((good**2).mean()):8.4f} {np.abs(good).max():7.3f} "
                    f"{mean[0]:8.4f} {mean[1]:8.4f} {out.mean():9.4f}   {off:8.4f}"
                )
    errors, radial = np.concatenate(errors), np.concatenate(radial)
    rms = np.sqrt((errors**2).mean())
    print(f"all marks found: {'met' if complete else 'NOT MET'}")
    print(f"corners {rms:.4f} px rms (bar {RMS_BAR}): {'met' if rms <= RMS_BAR else 'NOT MET'}")
    met = complete and rms <= RMS_BAR
    for label, x in (("u", errors[:, 0]), ("v", errors[:, 1]), ("outward", radial)):
        mean, error = x.mean(), x.std() / np.sqrt(len(x))
        met &= abs(mean) <= 3 * error
        print(
            f"mean {label:8s} {mean:+.5f} ± {error:.5f} px (bar 3 standard errors): "
            f"{'met' if abs(mean) <= 3 * error else 'NOT MET'}"
        )
    print(f"true corners of clean-f7 to the board, worst {worst:.4f} mm (bar {BOARD_BAR}): ", end="")
    print("met" if worst <= BOARD_BAR else "NOT MET")
    return bool(met and worst <= BOARD_BAR)


def own_pictures(seed: int, poses: int, draws: int) -> bool:
    """Part 2; True if every bar is met."""
    print(f"\nOur own photographs: {poses} poses, {draws} noisy pictures each")
    rng = np.random.default_rng(seed)
    pulls, points, corners, centres, missing, cpu, pulls_corner, radial = [], [], [], [], 0, [], [], []
    place_on_board = np.array([[0.0, 0.0], [-250.0, 150.0], [200.0, -300.0]])
    for p in range(poses):
        recording = read(ROOT / "scenes" / ("fig7a.toml", "fig7b.toml")[p % 2], images=False)
        exposure, camera, options = recording.exposures[0], recording.cameras["A"], recording.render
        u = recording.uncertainty
        errors = SettingErrors(
            screen_position=u.screen_position * rng.standard_normal(3),
            screen_angle=u.screen_angle * rng.standard_normal(3),
        )
        placement = place(recording.mirror, exposure, errors)
        rotation, translation = draw_pose(camera, rng)
        light = irradiance(recording, exposure, placement=placement, seed=int(rng.integers(2**31)), relative_error=0.05)
        picture = photograph(recording.screen, camera, light, placement=placement, pose=(rotation, translation))
        signal = signals(picture, options, recording.screen.reflectance)
        true_rotation = rotation @ placement.screen_rotation
        true_translation = rotation @ placement.screen_origin + translation
        nominal = board_corners(recording.screen.marks)
        for _ in range(draws):
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "picture.png"
                write_image(path, expose(signal, camera, replace(options, speckle_px=0.8), rng))
                start = time.process_time()
                seen = find_marks(read_image(path, camera), recording.screen.marks, camera)
                pose = solve_pose(camera, seen)
                cpu.append(time.process_time() - start)
            truth = replace(pose, rotation=true_rotation, translation=true_translation)
            missing += len(recording.screen.marks.ids) - len(seen.ids)
            turn = Rotation.from_matrix(pose.rotation @ true_rotation.T).as_rotvec()
            x = np.concatenate([turn, pose.translation - true_translation])
            pulls.append(np.linalg.solve(np.linalg.cholesky(pose.covariance), x))
            board, _, by_pose = to_board(pose, to_pixels(truth, place_on_board))
            sigma = np.sqrt(np.einsum("mip,pq,miq->mi", by_pose, pose.covariance, by_pose))
            points.append((board - place_on_board) / sigma)
            mapped = to_board(pose, to_pixels(truth, nominal.reshape(-1, 2)))[0].reshape(-1, 4, 2)
            corners.append(np.linalg.norm(mapped - nominal, axis=-1).max())
            measured = to_board(pose, seen.corners.reshape(-1, 2))[0].reshape(-1, 4, 2)
            whole = seen.measured.all(axis=1)
            centres.append(np.linalg.norm(measured.mean(axis=1) - seen.board.mean(axis=1), axis=-1)[whole].max())
            expected = to_pixels(truth, seen.board)
            miss = seen.corners - expected
            radial.append(outward(miss, expected)[seen.measured])
            whitened = np.linalg.solve(np.linalg.cholesky(seen.joint), miss.reshape(-1, 8, 1))
            pulls_corner.append(whitened[whole].ravel())
    scale = camera.focal / np.linalg.norm(true_translation)
    pulls, points, n = np.array(pulls), np.array(points), len(pulls)
    out = np.concatenate(radial)
    print(f"scale at the board's centre {scale:.2f} px/mm; marks not found: {missing}")
    print(f"corners outward {out.mean():+.5f} ± {out.std() / np.sqrt(len(out)):.5f} px, {out.std():.4f} px rms")
    print(f"pulls of corners before the pose's scale {np.concatenate(pulls_corner).std():.3f}")
    verdicts = [
        (f"true corner through the pose, worst of {n} pictures", max(corners), f"mm (bar {BOARD_BAR})",
         max(corners) <= BOARD_BAR),
        (f"measured centre of a mark on the board, worst of {n}", max(centres), f"mm (bar {BOARD_BAR})",
         max(centres) <= BOARD_BAR),
        (f"pulls of the pose's parameters (±{1 / np.sqrt(2 * 6 * n):.3f})", pulls.std(), f"(bar {PULL_BAR})",
         PULL_BAR[0] <= pulls.std() <= PULL_BAR[1]),
        ("pulls of points of the board", points.std(), f"(bar {PULL_BAR})",
         PULL_BAR[0] <= points.std() <= PULL_BAR[1]),
        ("CPU, file to pose, median of 3 MP pictures", np.median(cpu), f"s (bar {CPU_BAR})",
         np.median(cpu) <= CPU_BAR),
    ]  # fmt: skip
    # Eight pictures of four poses know the width of a pull to no better than a fifth.
    judged = [v for v in verdicts if n >= 100 or not v[0].startswith("pulls")]
    for verdict in verdicts:
        label, value, unit, met = verdict
        word = ("met" if met else "NOT MET") if verdict in judged else "not judged below 100 pictures"
        print(f"{label}: {value:.4f} {unit}: {word}")
    print("pulls by parameter:", " ".join(f"{x:.2f}" for x in pulls.std(axis=0)))
    return missing == 0 and all(met for *_, met in judged)


def main() -> int:
    """Print every figure with its bar; 1 if one is not met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help="8 of our own pictures only: the bar asks for 100")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    met = True
    if OTHER.exists():
        met = other_code()
    else:
        print(f"no photographs of other code at {OTHER.name}; part 1 left out")
    poses, draws = (4, 2) if options.quick else (30, 4)
    met &= own_pictures(options.seed, poses, draws)
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
