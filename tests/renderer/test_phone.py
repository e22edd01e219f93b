"""A bench as a phone photographs it: what is in the files, and that what reads them finds what was put in.

Set-up: Fig. 7(a) with a camera of 0.5 MP, held upright, and one view of the board. Expected: a photograph and its dark
picture as a phone takes them, EXIF that says so, the laser in red alone, and a camera that moved in between as asked.
"""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from benchsim.bench.errors import BenchsimError
from benchsim.bench.files import read
from benchsim.bench.place import place
from benchsim.renderer import backend
from benchsim.renderer.phone import Phone, photograph_with_phone, tone

SCENES = Path(__file__).resolve().parents[2] / "scenes"


@pytest.fixture(scope="module")
def bench():
    recording = read(SCENES / "fig7a.toml", images=False)
    camera = replace(
        recording.cameras["A"], resolution=(800, 600), focal=880.0, principal_point=(399.5, 299.5), bit_depth=8,
        gamma="srgb", black_level=0.0, saturation_level=255.0,
    )  # fmt: skip
    return replace(
        recording,
        cameras={"A": camera},
        render=replace(recording.render, relative_error=0.1, peak_fraction=0.6),
    )


@pytest.fixture(scope="module")
def taken(bench, tmp_path_factory):
    backend.use()
    folder = tmp_path_factory.mktemp("phone")
    truth = photograph_with_phone(bench, folder, phone=Phone(portrait=1, views=1, motion=2.0), seed=3)
    return folder, truth


def test_files_are_as_a_phone_writes_them(taken):
    folder, truth = taken
    assert truth.bench == ("bench/IMG_0001.jpg", "bench/IMG_0002.jpg") and truth.board == ("board/IMG_0003.jpg",)
    said = []
    for name in truth.bench:
        with Image.open(folder / name) as picture:
            assert picture.format == "JPEG" and picture.size == (800, 600) and picture.mode == "RGB"
            own = picture.getexif().get_ifd(0x8769)
            said.append((picture.getexif()[0x0112], own[0x9003][-8:]))
    assert said == [(6, "09:00:00"), (6, "09:00:20")]


def test_the_laser_is_red_and_the_dark_picture_has_none(taken):
    folder, truth = taken
    red = [cv2.imread(str(folder / n), cv2.IMREAD_UNCHANGED).astype(int) @ [0, -1, 1] for n in truth.bench]
    assert np.quantile(red[0], 0.999) > 60 and np.quantile(red[1], 0.9999) < 25


def test_the_reader_finds_the_motion_that_was_put_in(taken, bench):
    """A turn of some pixels; corners of 80 marks at 0.02 px, so that their mean is good to 0.01 px."""
    from benchsim.trace.image import read_image
    from benchsim.trace.marks import find_marks
    from benchsim.trace.motion import motion

    folder, truth = taken
    camera = replace(truth.camera, gamma="unknown")
    first, second = (
        find_marks(read_image(folder / n, camera, dark=i > 0), bench.screen.marks, camera)
        for i, n in enumerate(truth.bench)
    )
    where = place(bench.mirror, bench.exposures[0], truth.errors[0])
    at = np.array([[-200.0, -100.0], [0.0, 0.0], [200.0, 100.0]])
    world = where.screen_origin + np.column_stack([np.zeros(3), at]) @ where.screen_rotation.T
    matrix = np.array([[camera.focal, 0, camera.principal_point[0]], [0, camera.focal, camera.principal_point[1]]])
    matrix = np.vstack([matrix, [0, 0, 1.0]])
    then, later = (
        cv2.projectPoints(world, cv2.Rodrigues(r)[0], t, matrix, np.array(camera.distortion))[0][:, 0]
        for r, t in (truth.poses[0], truth.dark_poses[0])
    )
    found = cv2.perspectiveTransform(then[None], motion(first, second))[0]
    assert np.abs(later - then).max() > 0.5
    assert np.abs(found - later).max() < 0.05


def test_the_tone_curve_rises_and_keeps_black_and_white():
    ramp = np.repeat(np.linspace(0, 65535, 500).astype(np.uint16)[None, :, None], 3, axis=2)
    y = tone(ramp, Phone(sharpening=0.0))[0, :, 0]
    assert y[0] == 0 and y[-1] == pytest.approx(1, abs=1e-6) and np.all(np.diff(y) > 0)


def test_a_camera_that_is_no_phone_is_refused(bench, tmp_path):
    deep = replace(bench, cameras={"A": replace(bench.cameras["A"], bit_depth=16)})
    with pytest.raises(BenchsimError, match="bit_depth = 8"):
        photograph_with_phone(deep, tmp_path)
