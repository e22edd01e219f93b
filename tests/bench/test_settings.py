"""Setting errors as a vector, and the screen's seats."""

import numpy as np

from benchsim.bench.model import Exposure, Uncertainty
from benchsim.bench.settings import NAMES, from_vector, prior_sigma, screen_seats, to_vector


def exposure(time, shift=0.0, roll=0.0):
    return Exposure("A", "s", 1.0, 0.8, (1500.0, 0.0, -1400.0), screen_shift=shift, screen_roll=roll, time=time)


def test_the_vector_round_trips():
    theta = np.arange(1.0, 14.0)
    np.testing.assert_array_equal(to_vector(from_vector(theta)), theta)
    assert len(NAMES) == 13


def test_the_screen_has_no_error_until_it_is_moved():
    u = Uncertainty()
    assert not prior_sigma(u, reseated=False)[7:].any()
    assert (prior_sigma(u, reseated=True)[7:10] == 0.2).all() and (prior_sigma(u, reseated=True)[10:] == 1e-3).all()


def test_every_change_is_a_move_in_the_order_of_time_also_back():
    """File order 0 … 4; in time: home, home, shifted, home again, rolled."""
    e = [exposure(30, shift=100.0), exposure(0), exposure(40), exposure(10), exposure(50, roll=3.14)]
    assert screen_seats(e) == (1, 0, 2, 0, 3)


def test_exposures_at_the_same_time_keep_the_order_of_the_file():
    assert screen_seats([exposure(0), exposure(0, shift=5.0), exposure(0)]) == (0, 1, 2)
