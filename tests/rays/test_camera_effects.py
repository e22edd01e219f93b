"""The true camera before the true board, against OpenCV, plane geometry and numbers worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from benchsim.bench.fields import field
from benchsim.bench.model import Camera, Exposure, Laser, Mirror, Recording, Screen
from benchsim.bench.place import camera_pose
from benchsim.rays.camera import matrix, project, see

CAMERA = Camera("A", (1600, 1200), 1680.0, (803.0, 596.5), (-0.08, 0.03, 6e-4, -4e-4, 0.0))
ROTATION, TRANSLATION = camera_pose(CAMERA)
BOARD = np.array([[y, z] for y in (-300.0, -40.0, 250.0) for z in (-280.0, 10.0, 300.0)])


def recording(effects=None, fields=None) -> Recording:
    exposure = Exposure("A", "s1", 1.76, 0.87, (1500.0, -160.0, -1430.0))
    return Recording(
        Laser(), Mirror(), Screen(), {"A": CAMERA}, (exposure,), effects=effects or {}, fields=fields or {}
    )


def seen(effects=None, fields=None, **more):
    return see(recording(effects, fields), CAMERA, ROTATION, TRANSLATION, BOARD, **more)


def flat(points=BOARD, height=0.0, camera=CAMERA):
    x = np.column_stack([np.broadcast_to(height, len(points)), points])
    return project(camera, ROTATION, TRANSLATION, x)


def test_without_effects_it_is_the_stated_camera():
    assert np.array_equal(seen(), flat())
    assert np.array_equal(seen(printed=True, level=np.ones(len(BOARD))), flat())


def test_distortion_is_added_to_the_stated_one_and_is_opencv_s():
    got = seen({"radial-distortion": {"k1": 0.02, "k2": -0.01}, "tangential-distortion": {"p1": 1e-3, "p2": -2e-3}})
    total = np.array([-0.06, 0.02, 1.6e-3, -2.4e-3, 0.0])
    turn, _ = cv2.Rodrigues(ROTATION)
    points = np.column_stack([np.zeros(len(BOARD)), BOARD])
    want, _ = cv2.projectPoints(points, turn, TRANSLATION, matrix(CAMERA), total)
    assert np.allclose(got, want.reshape(-1, 2), atol=1e-9)


def test_rows_shake_sideways_by_their_distance_from_the_principal_row():
    got, base = seen({"rolling-shutter": {"rs_s": 2.0, "rs_c": 0.5, "rs_period": 700.0}}), flat()
    phase = 2 * np.pi * (base[:, 1] - 596.5) / 700.0
    assert np.allclose(got[:, 0] - base[:, 0], 2.0 * np.sin(phase) + 0.5 * np.cos(phase))
    assert np.array_equal(got[:, 1], base[:, 1])
    default = seen({"rolling-shutter": {"rs_s": 2.0}})[:, 0] - base[:, 0]
    assert np.allclose(default, 2.0 * np.sin((base[:, 1] - 596.5) * 2 * np.pi / 1400))


def test_blooming_goes_with_the_square_of_brightness_and_spares_the_marks():
    level = np.linspace(0, 1, len(BOARD))
    got = seen({"saturation": {"sat": 1.5}}, level=level) - flat()
    assert np.allclose(got, np.stack([np.zeros(len(BOARD)), 1.5 * level**2], axis=1))
    assert np.array_equal(seen({"saturation": {"sat": 1.5}}, printed=True), flat())


def test_grid_errors_move_print_and_not_light():
    effects = {"grid-scale": {"gs": 2.0}, "grid-aspect": {"ga": 1.0}, "grid-shear": {"gsh": 3.0}}
    y, z = BOARD.T
    moved = np.stack([1.003 * y + 0.003 * z, 1.001 * z + 0.003 * y], axis=1)
    assert np.allclose(seen(effects, printed=True), flat(moved), atol=1e-9)
    assert np.array_equal(seen(effects), flat())


def test_surface_rises_by_bow_and_field():
    y, z = BOARD.T
    effects = {"screen-bow": {"bow_y": 0.02, "bow_z": -0.05}}
    height = 0.5 * (2e-5 * y**2 - 5e-5 * z**2)
    bump = field([[-400.0, 0.0, 400.0], [-400.0, 400.0]], np.array([[[0.0, 0.0], [1.0, 1.0], [0.0, 0.0]]]))
    got = seen(effects, {"height": bump})
    assert np.allclose(got, flat(height=height + 1 - np.abs(y) / 400), atol=1e-9)
    whole = {"screen-tilt": {"st_y": 4.0, "st_z": -7.0}, "screen-rotation": {"srot": 5.0}}
    rigid = seen({"screen-distance": {"sx": 9.0}, **whole})
    assert np.array_equal(rigid, flat()), "a board moved as a whole is a matter of the pose"


def test_fields_of_the_camera_and_the_print():
    ramp = field([[0.0, 1600.0], [0.0, 1200.0]], np.array([[[0.0, 0.0], [1.6, 1.6]], [[0.0, 1.2], [0.0, 1.2]]]))
    inside = (flat() > 0).all(axis=1) & (flat() < [1600, 1200]).all(axis=1)
    assert inside.sum() >= 5
    assert np.allclose((seen(fields={"pixel": ramp}) - flat())[inside], 1e-3 * flat()[inside])
    shift = field([[-400.0, 400.0], [-400.0, 400.0]], np.array([[[0.5, 0.5]] * 2, [[-0.2, -0.2]] * 2]))
    assert np.allclose(seen(fields={"shift": shift}, printed=True), flat(BOARD + np.array([0.5, -0.2])))
    assert np.array_equal(seen(fields={"shift": shift}), flat())
    bright = field([[0.0, 1.0]], np.array([[0.0, 0.4], [0.0, -0.6]]))
    level = np.linspace(0, 1, len(BOARD))
    assert np.allclose(seen(fields={"brightness": bright}, level=level) - flat(), np.outer(level, [0.4, -0.6]))


@pytest.mark.parametrize("name", ["radial-distortion", "rolling-shutter"])
def test_the_stated_camera_is_not_changed(name):
    before = replace(CAMERA)
    seen({name: {"k1": 0.1} if name == "radial-distortion" else {"rs_c": 1.0}})
    assert before == CAMERA
