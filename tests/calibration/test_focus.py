"""A lens that stands still is left alone; one that refocuses, zooms or is stabilised is not; a bent board is none."""

import lens_sets as sets
import numpy as np
import pytest

from benchsim.calibration.focus import FALSE_ALARM, focal, principal_point
from benchsim.calibration.solve import solve


def test_a_lens_that_stands_still_is_one():
    """6 sets, some of a bowed board: the smallest of 12 probabilities is below 1e-4 in one run of 800."""
    smallest = 1.0
    for seed in range(6):
        rng = np.random.default_rng(200 + seed)
        shape = (1e-3, 0, 3.0, -2.0, 0) if seed % 2 else (0, 0, 0, 0, 0)
        bundle = solve(sets.CAMERA, sets.views(rng, sets.poses(rng), shape=shape))
        smallest = min(smallest, focal(bundle).probability, principal_point(bundle).probability)
    assert smallest > 1e-4


def test_a_lens_that_refocuses_is_seen_and_measured():
    rng = np.random.default_rng(3)
    poses = sets.poses(rng)
    breathing = 1 + 0.004 * 700 / poses[:, 5]
    moved = focal(solve(sets.CAMERA, sets.views(rng, poses, focal=breathing)))
    assert moved.seen and moved.follows
    assert moved.trend == pytest.approx(np.ptp(breathing), abs=max(5 * moved.trend_sigma, 0.1 * np.ptp(breathing)))
    assert moved.amount == pytest.approx(abs(moved.trend), rel=0.5)


def test_a_zoom_that_creeps_is_seen_and_is_no_refocusing():
    rng = np.random.default_rng(4)
    own = 1 + 0.002 * rng.standard_normal(8)
    moved = focal(solve(sets.CAMERA, sets.views(rng, sets.poses(rng), focal=own)))
    assert moved.seen and not moved.follows
    good = moved.sigma[:, 0] < 5e-4
    assert np.corrcoef(moved.value[good, 0], own[good])[0, 1] > 0.9


def test_stabilisation_is_seen():
    rng = np.random.default_rng(5)
    bundle = solve(sets.CAMERA, sets.views(rng, sets.poses(rng), point=rng.normal(0, 3.0, (8, 2))))
    moved = principal_point(bundle)
    assert moved.probability < FALSE_ALARM
    assert moved.amount == pytest.approx(3.0, rel=0.5)
