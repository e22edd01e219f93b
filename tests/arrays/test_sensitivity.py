"""What is predicted of a record, against a record; labels and places planned."""

from dataclasses import replace

import numpy as np
import pytest

from benchsim import arrays
from benchsim.arrays import labelling, placing
from benchsim.arrays.plant import Line, two_lines
from benchsim.arrays.sensitivity import sensitivity
from benchsim.vector import solar_vector

A = arrays.Assumptions(heliostat_radius=0.0, duration=4.0)
PLACES = 1e3 * np.array([(200.0, 60, -100), (300, -150, -100), (260, 20, -100), (420, 220, -100)])
SUN = solar_vector(np.radians(150.0), np.radians(50.0))


def test_sigma_is_what_a_record_gives():
    """Within 15 %: the record's noise is fitted to what its lines leave."""
    a = replace(A, background_spread=0.0)
    plant = arrays.build(PLACES, SUN, a)
    rng = np.random.default_rng(5)
    truth = arrays.draw_truth(plant, a, np.zeros((4, 2)), rng)
    found, _, _ = arrays.measure(arrays.record(plant, a, truth, arrays.background(plant, a, rng), rng), plant)
    expected = sensitivity(plant, a)
    assert expected.seen.all() and {m.outcome for m in found} == {"measured"}
    stated = np.array([np.sqrt(np.diag(m.covariance)) for m in found])
    np.testing.assert_allclose(expected.sigma, stated, rtol=0.15)
    assert np.median(expected.sigma / stated) == pytest.approx(1, abs=0.08)


def test_what_gives_no_light_is_not_seen():
    plant = arrays.build(PLACES, SUN, A)
    dark = sensitivity(plant, A, np.array([0.0, 1.0, 1.0, 1.0]))
    assert dark.seen.tolist() == [False, True, True, True] and np.isinf(dark.sigma[0]).all()


def test_a_prisms_true_rate_is_found_from_its_light():
    """Of near heliostats; rates off by some 3e-5 of themselves, of which noise leaves a tenth."""
    a = replace(A, rate_error=3e-5)
    plant = arrays.build(0.3 * PLACES[:2], SUN, a)
    rng = np.random.default_rng(6)
    truth = arrays.draw_truth(plant, a, np.zeros((2, 2)), rng)
    samples = arrays.record(plant, a, truth, arrays.background(plant, a, rng), rng)
    found = arrays.tracked(samples, plant).rates / plant.rates - 1
    np.testing.assert_allclose(found, truth.rate_error, atol=3e-6)


@pytest.mark.parametrize("count", [1, 7, 100, 700])
def test_labels_of_a_round_neither_beat_nor_share_a_harmonic(count):
    labels = labelling.plan(count, A, 50.0, 60.0)
    assert labels.duration <= 60 + 1e-9 and len(labels.rates) == count
    assert labels.apart >= labelling.APART - 1e-6
    for r in range(labels.rounds):
        assert not labelling.clashes(labels.rates[labels.round == r], labels.duration, A.sample_rate, 50.0)


def test_labels_that_clash_are_named():
    near = np.array([[130.0, 130.1], [99.9, 180.0]])
    said = labelling.clashes(near, 5.0, 500.0, 50.0)
    assert (130.0, 130.1) in said and (99.9, 100.0) in said
    overtone = labelling.clashes(np.array([[60.0, 120.0]]), 5.0, 500.0)
    assert overtone == [(120.0, 120.0)]


def test_places_that_see_are_found():
    """Arrays stated far outside of all light are brought where both traces cross them."""
    away = [replace(line, low=line.low + 60e3, high=line.high + 60e3) for line in two_lines(A)]
    build = lambda lines: arrays.build(PLACES, SUN, A, lines=lines)  # noqa: E731
    assert not sensitivity(build(away), A).seen.any()
    best = placing.search([(build, np.ones(4))], A, [placing.places(x, 9e3, -150e3) for x in away], 1e-4)
    s = sensitivity(build(best.lines), A)
    assert best.share == 1 and s.seen.all() and s.sigma.max() <= 1e-4


def test_no_place_reaches_into_the_ground():
    line = Line("upright", True, 9e3, -20e3, 20e3, 500.0)
    some, _ = placing.places(line, 9e3, -25e3)
    assert some.lines and min(x.low for x in some.lines) > -25e3
