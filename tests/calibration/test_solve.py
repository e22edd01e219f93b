"""Lens and board from corners: right, with honest errors, and not led astray by one mark or a bad print."""

from dataclasses import replace

import lens_sets as sets
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from benchsim.bench.errors import BenchsimError
from benchsim.calibration.model import State, points, predict, project
from benchsim.calibration.solve import solve
from benchsim.trace.pose import Pose, to_pixels

UNEVEN = (0.07, 0.2, -0.1)
"""Spread of a board that is lit from the left and below [px]."""


def test_the_derivatives_are_those_of_the_prediction():
    rng = np.random.default_rng(1)
    pose = sets.poses(rng, 1)[0]
    view = sets.views(rng, [pose])[0]
    m = len(view.ids)
    state = State(
        sets.LENS,
        np.array([2e-3, -1e-3, 4e-3, -3e-3, 2e-3]),
        rng.normal(0, 0.1, (m, 2)),
        pose[None],
        np.array([[0.1, -0.2, 0.3]]),
    )
    index = np.arange(m)
    _, by = predict(state, view, index, 0, 250.0)
    x = state.flat()
    columns = [*range(13), 13, 14, *range(13 + 2 * m, 13 + 2 * m + 9)]
    steps = np.abs(x[columns]) * 1e-6 + 1e-6
    for column, (parameter, step) in enumerate(zip(columns, steps, strict=True)):
        ends = []
        for sign in (1, -1):
            moved = x.copy()
            moved[parameter] += sign * step
            ends.append(predict(state.moved(moved), view, index, 0, 250.0)[0])
        slope = (ends[0] - ends[1]) / (2 * step)
        # Of a mark's place only its own corners know.
        rows = slice(0, 1) if column in (13, 14) else slice(None)
        assert slope[rows] == pytest.approx(by[rows, ..., column], rel=1e-4, abs=1e-3)


def test_a_flat_board_is_seen_as_the_rest_of_benchsim_sees_it():
    """y to the right and z up: the same pixels as `trace.pose`, whose points are (0, y, z)."""
    rng = np.random.default_rng(2)
    pose = sets.poses(rng, 1)[0]
    f, u, v, *distortion = sets.LENS
    camera = replace(sets.CAMERA, focal=f, principal_point=(u, v), distortion=tuple(distortion))
    axes = np.array([[0, 1, 0], [0, 0, -1], [-1, 0, 0.0]])  # (x, y, z) to (y, −z, −x)
    rotation = Rotation.from_rotvec(pose[:3]).as_matrix() @ axes
    at = rng.uniform(-180, 180, (50, 2))
    reference = to_pixels(Pose(rotation, pose[3:], camera, np.eye(6), np.empty(0), 1.0, np.empty(0, bool), (), 0.0), at)
    assert project(sets.LENS, np.zeros(5), pose, at, 250.0)[0] == pytest.approx(reference, abs=1e-6)


def test_the_board_bows_towards_the_mirror():
    at, _ = points(np.array([0, 0, 0.01, 0.02, 0]), np.array([[250.0, 0.0], [0.0, 250.0]]), 250.0)
    assert at[:, 2] == pytest.approx([-2.5, -5.0])


def test_errors_are_as_large_as_they_say():
    """8 sets: χ² of the thirteen shared parameters' errors by their covariance; false alarm 1e-4 a side.

    The board is lit from one side. What is not known of the noise, its scale, is a factor of 4 in every set.
    """
    total = 0.0
    shape = np.array([1.5e-3, -0.5e-3, 1.0, -0.7, 0.5])
    for seed in range(8):
        rng = np.random.default_rng(seed)
        seen = sets.views(rng, sets.poses(rng), shape=shape, spread=UNEVEN)
        seen = [replace(v, joint=v.joint / 16) for v in seen]
        found = solve(sets.CAMERA, seen)
        off = np.concatenate([found.lens - sets.LENS, found.board - shape])
        total += off @ np.linalg.solve(found.covariance, off)
        assert found.spread == pytest.approx(np.tile(UNEVEN, (8, 1)), abs=0.05)
        assert np.median(found.scale) == pytest.approx(16, rel=0.2)
    assert chi2.ppf(1e-4, 13 * 8) < total < chi2.ppf(1 - 1e-4, 13 * 8)


def test_a_bad_print_costs_certainty_not_truth():
    """Marks laid 0.2 mm off, the same in all views: found, and the focal length's error says so (6 sets)."""
    pulls, places = [], []
    for seed in range(6):
        rng = np.random.default_rng(100 + seed)
        off = rng.normal(0, 0.2, (len(sets.board().ids), 2))
        found = solve(sets.CAMERA, sets.views(rng, sets.poses(rng), places=off))
        pulls.append((found.lens[:4] - sets.LENS[:4]) / found.sigma[:4])
        places.append(found.print_sigma)
    assert np.mean(places) == pytest.approx(0.2, rel=0.25)
    # Of 24 unit normals, false alarm 1e-4 a side were they independent.
    assert chi2.ppf(1e-4, 24) < np.square(pulls).sum() < chi2.ppf(1 - 1e-4, 24)


def test_wrong_marks_are_set_aside():
    rng = np.random.default_rng(7)
    seen = sets.views(rng, sets.poses(rng))
    truth = solve(sets.CAMERA, seen)
    corners = seen[3].corners.copy()
    corners[4] += 2.0
    corners[9] = corners[9][::-1]
    found = solve(sets.CAMERA, [*seen[:3], replace(seen[3], corners=corners), *seen[4:]])
    assert np.flatnonzero(~found.used[3]).tolist() == [4, 9]
    assert (np.abs(found.lens - truth.lens) < truth.sigma[:8]).all()


def test_a_mirrored_board_is_refused():
    rng = np.random.default_rng(8)
    seen = sets.views(rng, sets.poses(rng, 5))
    with pytest.raises(BenchsimError, match=r"00\.jpg: .*behind the board"):
        solve(sets.CAMERA, [replace(v, board=v.board * [-1, 1]) for v in seen])
