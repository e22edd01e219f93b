"""A camera that moved between a photograph and its dark picture: noticed by the marks, taken back in the picture."""

import cv2
import numpy as np
import pytest

from benchsim.bench.model import Camera
from benchsim.trace.image import read_image
from benchsim.trace.marks import MarkObservations
from benchsim.trace.motion import motion, moved_by, taken_back
from benchsim.trace.pose import join

SIGMA = 0.02


def marks(rng, homography=None, ids=range(20), wrong=()):
    """Twenty marks of 60 px on a grid, their corners with noise, moved by a homography."""
    ids = np.array(list(ids))
    centre = np.stack([200 + 200 * (ids % 5), 200 + 200 * (ids // 5)], axis=1)[:, None, :]
    corners = centre + 30.0 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    if homography is not None:
        corners = cv2.perspectiveTransform(corners.reshape(1, -1, 2), homography).reshape(-1, 4, 2)
    corners = corners + SIGMA * rng.standard_normal(corners.shape)
    for i in wrong:
        corners[i] += 3.0
    n = len(ids)
    return MarkObservations(
        "a.jpg", ids, corners, np.tile(SIGMA**2 * np.eye(2), (n, 4, 1, 1)), np.tile(SIGMA**2 * np.eye(8), (n, 1, 1)),
        np.zeros((n, 4, 2)), np.ones((n, 4), bool), np.ones(n),
    )  # fmt: skip


TURNED = np.array([[1.0, 1e-3, 0.3], [-1e-3, 1.0, 0.8], [0.0, 0.0, 1.0]])


def test_a_camera_that_stands_still_is_not_said_to_have_moved():
    """At a false alarm of 1e-6 two hundred pairs raise one with probability 2e-4."""
    rng = np.random.default_rng(1)
    assert all(motion(marks(rng), marks(rng)) is None for _ in range(200))


def test_noise_larger_than_stated_is_no_motion():
    rng = np.random.default_rng(2)
    first, second = marks(rng), marks(rng)
    for m in (first, second):
        m.corners[:] += 0.2 * rng.standard_normal(m.corners.shape)
    assert motion(first, second) is None


@pytest.mark.parametrize("wrong", [(), (3, 8)], ids=["all well", "two crossed by the laser"])
def test_motion_is_found_to_the_noise_of_the_marks(wrong):
    rng = np.random.default_rng(3)
    first, second = marks(rng), marks(rng, TURNED, wrong=wrong)
    found = motion(first, second)
    at = np.stack(np.meshgrid([200.0, 600.0, 1000.0], [200.0, 500.0, 800.0]), axis=-1).reshape(1, -1, 2)
    assert np.abs(cv2.perspectiveTransform(at, found) - cv2.perspectiveTransform(at, TURNED)).max() < 3 * SIGMA
    assert moved_by(found, first.corners) == pytest.approx(moved_by(TURNED, first.corners), abs=SIGMA)


def test_marks_join_only_where_the_camera_stood_still():
    rng = np.random.default_rng(4)
    first = marks(rng)
    still, moved = join(first, marks(rng)), join(first, marks(rng, TURNED))
    assert len(still.ids) == 40 and still.motion is None
    assert np.array_equal(moved.corners, first.corners) and moved.motion is not None


def test_too_few_common_marks_say_nothing():
    rng = np.random.default_rng(5)
    assert motion(marks(rng, ids=range(10)), marks(rng, TURNED, ids=range(8, 18))) is None


def test_the_dark_picture_is_put_back_in_place(tmp_path):
    """Rationale: what is subtracted must lie where the photograph has it. A print seen from two sides of a motion:
    unmended its edges leave more than half of their contrast, mended a few percent."""
    rng = np.random.default_rng(6)
    v, u = np.mgrid[:300, :400].astype(np.float32)
    back = np.linalg.inv(TURNED)

    def scene(h):
        x = h @ np.stack([u.ravel(), v.ravel(), np.ones(u.size)])
        x, y = x[:2] / x[2]
        edge = 1 / (1 + np.exp(-3 * np.sin(x / 6))) * 1 / (1 + np.exp(-3 * np.sin(y / 6)))
        return (40 + 150 * edge).reshape(u.shape) + rng.normal(0, 0.5, u.shape)

    camera = Camera("A", (400, 300), 500.0, bit_depth=8, saturation_level=255.0, principal_point=(200.0, 150.0))
    pictures = []
    for name, h in (("a.png", np.eye(3)), ("b.png", back)):
        assert cv2.imwrite(str(tmp_path / name), np.clip(np.rint(scene(h)), 0, 255).astype(np.uint8))
        pictures.append(read_image(tmp_path / name, camera))
    first, second = pictures
    inside = (slice(5, -5), slice(5, -5))
    before = (first.light - second.light)[inside].std()
    after = (first.light - taken_back(second, TURNED).light)[inside].std()
    assert before > 2.5 and after < 1.0
