"""What a set leaves open is said, and the views that are asked for close it."""

import cv2
import lens_sets as sets
import numpy as np
import pytest

from benchsim.calibration import advice
from benchsim.calibration.advice import TARGETS, advise, sight
from benchsim.calibration.solve import solve


@pytest.fixture(scope="module")
def poor():
    rng = np.random.default_rng(11)
    return solve(sets.CAMERA, sets.views(rng, sets.poses(rng, 4, tilt=(0, 3)), noise=0.05))


@pytest.fixture(scope="module")
def good():
    rng = np.random.default_rng(10)
    return solve(sets.CAMERA, sets.views(rng, sets.poses(rng)))


def test_a_good_set_asks_for_nothing(good):
    told = advise(good, sets.board())
    assert told.poor == () and told.views == ()


def test_head_on_views_leave_the_focal_length_open_and_tilted_ones_are_asked_for(poor):
    told = advise(poor, sets.board())
    assert "focal length" in told.poor
    assert "40°" in told.views[0]
    assert all(told.then[name] <= TARGETS[name] for name in TARGETS)


def test_the_promise_is_kept(poor, monkeypatch):
    """Photographed as asked, the set is as good as was foretold (within 30 %: noise and scale are drawn anew)."""
    asked = {}
    information = advice._information

    def spied(bundle, corners, pose):
        asked[len(asked)] = pose
        return information(bundle, corners, pose)

    monkeypatch.setattr(advice, "_information", spied)
    candidates = list(advice._candidates(poor, sets.board()))
    told = advise(poor, sets.board())
    rng = np.random.default_rng(11)
    poses = sets.poses(rng, 4, tilt=(0, 3))
    more = np.array([asked[candidates.index(name)] for name in told.views])
    found = solve(sets.CAMERA, sets.views(rng, np.concatenate([poses, more]), noise=0.05))
    assert found.sigma[0] / found.lens[0] == pytest.approx(told.then["focal length"], rel=0.3)


def test_lines_of_sight_are_as_certain_as_the_lens(good):
    """Lenses drawn from the covariance, sent through OpenCV, a camera's turn taken out: the map's 1 σ (200)."""
    u, v, sigma = sight(good)
    f, cu, cv, *_ = good.lens
    rng = np.random.default_rng(13)
    lenses = rng.multivariate_normal(good.lens, good.covariance[:8, :8], 200)
    for j, i in ((0, 0), (9, 13), (4, 20)):
        # Rays of the whole map for the turn, one of them for the comparison.
        rays = np.stack([*np.meshgrid((u - cu) / f, (v - cv) / f), np.ones(sigma.shape)], axis=-1).reshape(-1, 1, 3)
        here, turn = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix(good.lens), good.lens[3:])
        turn, k = turn[:, :3], j * len(u) + i
        off = []
        for lens in lenses:
            there = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix(lens), lens[3:])[0]
            away = (there - here).ravel()
            off.append((away - turn @ np.linalg.lstsq(turn, away, rcond=None)[0]).reshape(-1, 2)[k])
        largest = np.sqrt(np.linalg.eigvalsh(np.cov(np.transpose(off)))[-1])
        assert largest == pytest.approx(sigma[j, i], rel=0.2)


def matrix(lens):
    f, u, v = lens[:3]
    return np.array([[f, 0, u], [0, f, v], [0, 0, 1.0]])
