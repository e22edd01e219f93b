"""Radial stagger: rings, their number, and the room of each mirror."""

import math

import numpy as np
import pytest
from scipy.spatial import cKDTree

from benchsim.plant.layout import radial_stagger


@pytest.mark.parametrize(("count", "half"), [(100, math.pi / 3), (500, math.pi), (2000, math.pi)])
def test_no_two_mirrors_can_touch(count, half):
    places = radial_stagger(count, 4e3, 3e3, 30e3, 40e3, half)
    assert len(places) == count and len(np.unique(places.round(3), axis=0)) == count
    assert cKDTree(places).query(places, k=2)[0][:, 1].min() > 5e3 * 0.96, "the diagonal, of an arc its chord"


def test_each_ring_stands_in_the_gaps_of_the_one_before():
    places = radial_stagger(60, 4e3, 3e3, 30e3, 40e3)
    radius, azimuth = np.hypot(*places.T).round(3), np.arctan2(*places.T)
    rings = np.unique(radius)
    first, second = (np.sort(azimuth[radius == r]) for r in rings[:2])
    step = np.diff(first)
    np.testing.assert_allclose(step, step[0], atol=1e-9)
    assert step[0] == pytest.approx(2 * math.pi / len(first)) and len(first) == math.floor(2 * math.pi * 30 / 5)
    apart = (second[:, None] - first[None] + step[0] / 2) % step[0]
    np.testing.assert_allclose(np.minimum(apart, step[0] - apart), 0, atol=1e-9)


def test_a_sector_is_kept_to():
    places = radial_stagger(100, 4e3, 3e3, 30e3, 40e3, 0.5)
    assert np.abs(np.arctan2(*places.T)).max() <= 0.5 + 1e-6
