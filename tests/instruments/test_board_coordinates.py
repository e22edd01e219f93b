"""The measured board coordinate against brute force: pixels of the true camera, pose solved again, light read back.

Light and marks are seen by a true camera from a true pose; the marks are solved for a pose with the stated camera, and
the light is read back from there. `board_coordinates` is handed only that solved pose, and must find where the light
was measured and what the marks were left with.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchsim import rays, trace
from benchsim.bench.fields import field
from benchsim.bench.model import Camera, Exposure, Laser, Marks, Mirror, Recording, Screen
from benchsim.bench.place import camera_pose
from benchsim.instruments.bench import board_coordinates
from benchsim.trace.marks import MarkObservations, board_corners

CAMERA = Camera("A", (1600, 1200), 1680.0, (803.0, 596.5), (-0.08, 0.03, 6e-4, -4e-4, 0.0))
PLACES = [(y, z) for y in (-300, -150, 0, 150, 300) for z in (-300, -150, 0, 150, 300)]
MARKS = Marks(tuple(range(25)), tuple((float(y), float(z)) for y, z in PLACES), (36.0,) * 25)
LIGHT = np.column_stack([np.linspace(-40.0, 120.0, 30), np.linspace(330.0, -330.0, 30)])
LEVEL = np.linspace(1.0, 0.4, 30)
CORNER = 0.02

GRID = np.linspace(-350.0, 350.0, 15)
Y, Z = np.meshgrid(GRID, GRID, indexing="ij")
DENT = field([GRID, GRID], np.exp(-((Y - 40) ** 2 + (Z - 90) ** 2) / 2 / 62**2)[None])
SHIFT = field([GRID, GRID], 0.2 * np.stack([np.sin(Y / 90) * np.cos(Z / 120), np.cos(Y / 80)]))
U, V = np.meshgrid(np.linspace(0, 1600, 20), np.linspace(0, 1200, 16), indexing="ij")
SPOT = field([U[:, 0], V[0]], np.stack([np.exp(-((U - 790) ** 2 + (V - 700) ** 2) / 2 / 70**2), np.zeros_like(U)]))
BRIGHT = field([[0.0, 0.5, 1.0]], np.array([[0.0, 0.1, 0.5], [0.0, 0.0, -0.3]]))

CASES = {
    "screen-bow": ({"screen-bow": {"bow_y": 0.1, "bow_z": -0.05}}, {}),
    "grid-scale": ({"grid-scale": {"gs": 8.0}}, {}),
    "grid-aspect": ({"grid-aspect": {"ga": 8.0}}, {}),
    "grid-shear": ({"grid-shear": {"gsh": -8.0}}, {}),
    "radial-distortion": ({"radial-distortion": {"k1": 0.06, "k2": -0.04}}, {}),
    "tangential-distortion": ({"tangential-distortion": {"p1": 0.01, "p2": -0.008}}, {}),
    "rolling-shutter": ({"rolling-shutter": {"rs_s": 3.0, "rs_c": 1.0, "rs_period": 900.0}}, {}),
    "saturation": ({"saturation": {"sat": 2.0}}, {}),
    "dent": ({}, {"height": DENT}),
    "print": ({}, {"shift": SHIFT}),
    "lens spot": ({}, {"pixel": SPOT}),
    "brightness": ({}, {"brightness": BRIGHT}),
    "bow and lens": ({"screen-bow": {"bow_z": 0.05}, "radial-distortion": {"k1": -0.05}}, {"height": DENT}),
}


def recording(effects, fields) -> Recording:
    exposure = Exposure("A", "s1", 1.76, 0.87, (1500.0, -160.0, -1430.0))
    screen = Screen(marks=MARKS)
    return Recording(Laser(), Mirror(), screen, {"A": CAMERA}, (exposure,), effects=effects, fields=fields)


def observations(corners: np.ndarray) -> MarkObservations:
    n = len(corners)
    joint = np.tile(np.eye(8) * CORNER**2, (n, 1, 1))
    return MarkObservations(
        "made", np.arange(n), corners, np.tile(np.eye(2) * CORNER**2, (n, 4, 1, 1)), joint, board_corners(MARKS),
        np.ones((n, 4), bool), np.ones(n),
    )  # fmt: skip


def solved(truth: Recording, rotation, translation, camera=CAMERA):
    corners = rays.see(truth, camera, rotation, translation, board_corners(MARKS).reshape(-1, 2), printed=True)
    pose = trace.solve_pose(CAMERA, observations(corners.reshape(-1, 4, 2)))
    # A local fault may make the solution set marks aside; the pose hangs on the others.
    weight = np.eye(8) / CORNER**2 * pose.used[:, None, None]
    return pose, board_coordinates.view(pose, board_corners(MARKS), weight)


def true_pose():
    rotation, translation = camera_pose(CAMERA)
    return Rotation.from_rotvec([0.003, -0.004, 0.002]).as_matrix() @ rotation, translation + np.array([3.0, -2.0, 4.0])


@pytest.mark.parametrize("case", CASES)
def test_measured_places_and_residuals_are_those_of_a_pose_solved_again(case):
    truth = recording(*CASES[case])
    assert board_coordinates.active(truth)
    rotation, translation = true_pose()
    pose, seen = solved(truth, rotation, translation)
    want = trace.to_board(pose, rays.see(truth, CAMERA, rotation, translation, LIGHT, level=LEVEL))[0]
    got, residual = board_coordinates.measured(truth, seen, LIGHT, LEVEL)
    effect = np.abs(want - LIGHT).max()
    assert effect > 0.03, "the case moves the light by more than it is held to"
    # A thousandth of what the effect does, and well below a bin's sigma of 5 µm.
    assert np.abs(got - want).max() < 5e-4 + 1e-4 * effect
    assert np.abs(residual - pose.residuals.mean(axis=1)).max() < 1e-3


def test_wrong_intrinsics_are_seen_through_the_same_step():
    true = replace(CAMERA, focal=1690.0, principal_point=(808.0, 592.0), distortion=(-0.07, 0.03, 6e-4, -4e-4, 0.0))
    truth = recording({}, {})
    assert not board_coordinates.active(truth)
    rotation, translation = true_pose()
    pose, seen = solved(truth, rotation, translation, true)
    want = trace.to_board(pose, rays.see(truth, true, rotation, translation, LIGHT))[0]
    got, residual = board_coordinates.measured(truth, seen, LIGHT, camera=true)
    assert np.abs(want - LIGHT).max() > 0.05
    assert np.abs(got - want).max() < 5e-4
    assert np.abs(residual - pose.residuals.mean(axis=1)).max() < 1e-3


@pytest.mark.parametrize("turn", [(0.02, 0.0, 0.0), (0.0, 0.02, 0.015), (0.3, -0.2, 0.4)], ids=str)
def test_a_turned_board_shows_nothing_of_it(turn):
    """Geometry alone: corners and light of a plane, turned by R before a camera that stays, projected by OpenCV.

    The pose that is solved from the corners takes the turn: no residual is left, and the light is read at its own
    coordinates. So the prediction of a tilt, a roll and a shift along x is none.
    """
    rotation, translation = true_pose()
    r = Rotation.from_rotvec(turn).as_matrix()

    def pictured(board):
        world = np.column_stack([np.zeros(len(board)), board]) @ r.T + [7.0, 0.0, 0.0]
        lens = np.array([[1680.0, 0, 803.0], [0, 1680.0, 596.5], [0, 0, 1]])
        turned, _ = cv2.Rodrigues(rotation)
        return cv2.projectPoints(world, turned, translation, lens, np.array(CAMERA.distortion))[0].reshape(-1, 2)

    pose = trace.solve_pose(CAMERA, observations(pictured(board_corners(MARKS).reshape(-1, 2)).reshape(-1, 4, 2)))
    assert np.abs(pose.residuals).max() < 1e-6
    assert np.abs(trace.to_board(pose, pictured(LIGHT))[0] - LIGHT).max() < 1e-6
    seen = board_coordinates.view(pose, board_corners(MARKS), np.tile(np.eye(8) / CORNER**2, (25, 1, 1)))
    effects = {"screen-tilt": {"st_y": 20.0, "st_z": -15.0}, "screen-rotation": {"srot": 9.0}}
    got, residual = board_coordinates.measured(recording({**effects, "screen-distance": {"sx": 7.0}}, {}), seen, LIGHT)
    assert np.abs(got - LIGHT).max() < 1e-6 and np.abs(residual).max() < 1e-6


def test_without_effects_nothing_moves():
    truth = recording({}, {})
    pose, seen = solved(truth, *true_pose())
    got, residual = board_coordinates.measured(truth, seen, LIGHT, LEVEL)
    assert np.abs(got - LIGHT).max() < 1e-6 and np.abs(residual).max() < 1e-6
    assert np.allclose(board_coordinates.read_back(seen, trace.to_pixels(pose, LIGHT)), LIGHT, atol=1e-8)


@pytest.mark.parametrize("case", [c for c in CASES if c not in ("saturation", "brightness", "rolling-shutter")])
def test_what_a_solved_pose_keeps_is_what_pose_nuisances_would(case):
    """How visible an effect is, with the pose as six free nuisances of light and corners, and through a solved pose.

    Beside a pose that the data alone fix, an effect that moves corners by m and light by l is as visible as what is
    left of (m, l) in the noise's metric once the pose's own columns are taken out. Through a solved pose the marks keep
    their residuals and the light the pose's covariance; a mark's centre in place of its corners costs a few percent.
    """
    effects, fields = CASES[case]
    little = {name: {k: 0.01 * v for k, v in table.items()} for name, table in effects.items()}
    truth, nothing = recording(little, fields), recording({}, {})
    _, seen = solved(nothing, *true_pose())
    corners = board_corners(MARKS).reshape(-1, 2)

    def pictured(rec, delta):
        rotation, translation = board_coordinates.turned(seen.rotation, seen.translation, delta)
        light = rays.see(rec, CAMERA, rotation, translation, LIGHT, level=LEVEL)
        return np.concatenate(
            [
                rays.see(rec, CAMERA, rotation, translation, corners, printed=True).ravel() / CORNER,
                board_coordinates.read_back(seen, light).ravel() / 0.01,
            ]
        )

    steps = np.diag([1e-5] * 3 + [1e-2] * 3)
    pose = np.column_stack([(pictured(nothing, s) - pictured(nothing, -s)) / 2 / s.max() for s in steps])
    change = pictured(truth, np.zeros(6)) - pictured(nothing, np.zeros(6))
    unit = np.linalg.norm(pose, axis=0)
    free = change - (pose / unit) @ np.linalg.lstsq(pose / unit, change, rcond=None)[0]
    marks = 2 * len(corners)
    by_marks = np.linalg.inv(pose[:marks].T @ pose[:marks])
    light, centres = board_coordinates.measured(truth, seen, LIGHT, LEVEL)
    moved = ((light - board_coordinates.measured(nothing, seen, LIGHT, LEVEL)[0]) / 0.01).ravel()
    noise = np.eye(len(moved)) + pose[marks:] @ by_marks @ pose[marks:].T
    kept = moved @ np.linalg.solve(noise, moved) + (centres**2).sum() / (CORNER / 2) ** 2
    assert 0.95 < np.sqrt(kept) / np.linalg.norm(free) < 1.001
