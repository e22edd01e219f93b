"""The truth: light in time from facets that pass. It is held against closed forms and against the forward model of the
measurement, which shares with it the aim, the beam and nothing else.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from benchsim import arrays
from benchsim.arrays.signals import flicker_density, passage, white_level


def test_the_brightest_instant_of_a_passage(plant, assumptions):
    """Closed form: where the sun's centre passes over a far detector, the facet's area times its radiance there, the
    two cosines and 1/D². A facet 900 m away is small against the beam: within 1 %.
    """
    k, kind = 5, 1
    one = passage(plant, k, kind, np.zeros(2))
    body = arrays.prism(plant, k, kind)
    miss, _, weight, _ = arrays.sight(body, plant, plant.detectors[one.detectors])
    i = int(np.argmin(np.abs(miss)))
    area = 2 * plant.prism_radius * np.tan(np.pi / plant.facets) * plant.prism_height
    assert one.light[i].max() == pytest.approx(area * plant.beam.radiance(miss[i] ** 2) * weight[i], rel=0.01)


def test_lines_in_time_are_those_of_the_vector_model(plant, light, truth):
    """Rationale: two realisations of one light. Samples in time, as the converter writes them, are taken apart by
    label; the amplitudes of each prism over all detectors are one factor times the vector model's, within 2e-4 of the
    largest.
    """
    lines = arrays.separate(light, plant)
    seen = 0
    for k in range(6):
        for kind in range(2):
            model = arrays.response(arrays.prism(plant, k, kind, truth.misalignment[k]), plant)
            z = lines.amplitude[k, kind]
            factor = np.vdot(model, z) / np.vdot(model, model).real
            assert np.abs(z - factor * model).max() < 2e-4 * np.abs(z).max()
            turned = np.angle(factor * np.exp(-1j * plant.facets * truth.phase[k, kind]))
            assert abs(turned) < 1e-3
            seen += np.count_nonzero(np.abs(z) > 0.1 * np.abs(z).max())
    assert seen > 100


def test_nothing_passes_but_the_labels(plant, light):
    """The converter's filter: what the lines leave of clean samples is 1e-4 of them."""
    lines = arrays.separate(light, plant)
    middle = lines.remainder[:, 200:-200]
    assert middle.std() < 1e-4 * np.diff(light, axis=1).std()


def test_facets_that_differ_show_at_the_rate_of_turning(plant, assumptions, truth):
    """A prism with one dim facet of 36 has lines at multiples of its turns per second beside its label, as large as
    closed form says: the dimming over 36.
    """
    dim = np.ones((6, 2, plant.facets))
    dim[0, 0, 5] = 0.5
    only = truth.transmission * 0
    only[0, 0] = 1.0
    odd = replace(truth, facet_reflectance=dim, transmission=only, rate_error=np.zeros((6, 2)))
    samples = arrays.clean(plant, assumptions, odd, [0])
    best = samples[np.argmax(samples.std(axis=1))]
    f = plant.rates[0, 0]
    window = signal.windows.blackmanharris(len(best))
    t = np.arange(len(best)) / plant.sample_rate

    def line(rate):
        return abs(np.sum(window * best * np.exp(-2j * np.pi * rate * t)))

    turn = f / plant.facets
    assert line(f + 3 * turn) / line(f) == pytest.approx(0.5 / plant.facets, rel=0.05)
    assert line(f + 2.5 * turn) < 1e-3 * line(f)


def test_noise_is_as_dense_as_stated(plant, assumptions, truth, steady):
    """Periodograms of a record without prisms, averaged over detectors and 130 to 190 Hz, against white noise and both
    flickers: 5 s × 60 Hz of the common part scatter by 6 %, so that 20 % is over three sigma.
    """
    dark = np.zeros((len(plant.detectors), plant.samples))
    samples = arrays.record(plant, assumptions, truth, steady, np.random.default_rng(5), dark)
    f, power = signal.welch(samples, plant.sample_rate, nperseg=500, axis=1)
    band = (f > 130) & (f < 190)
    expected = white_level(assumptions, steady)[:, None] + steady[:, None] ** 2 * (
        flicker_density(assumptions, assumptions.flicker_local, f)
        + flicker_density(assumptions, assumptions.flicker_common, f)
    )
    assert (power[:, band] / expected[:, band]).mean() == pytest.approx(1, abs=0.2)


def test_a_seed_is_a_record(plant, assumptions, truth, steady, light):
    one, two, other = (
        arrays.record(plant, assumptions, truth, steady, np.random.default_rng(s), light) for s in (1, 1, 2)
    )
    assert np.array_equal(one, two) and not np.array_equal(one, other)
