"""Labels apart, and the noise between them."""

from dataclasses import replace

import numpy as np
import pytest

from benchsim import arrays
from benchsim.arrays.signals import flicker_density
from benchsim.bench.errors import BenchsimError


def sinusoids(plant, amplitude):
    t = np.arange(plant.samples) / plant.sample_rate
    wave = np.exp(2j * np.pi * plant.rates.ravel()[:, None] * t)
    return (amplitude.reshape(12, -1).T @ wave).real


def draw(plant, rng):
    shape = (6, 2, len(plant.detectors))
    return rng.standard_normal(shape) + 1j * rng.standard_normal(shape)


def test_lines_are_found_again(plant):
    rng = np.random.default_rng(1)
    z = draw(plant, rng)
    steady = 100.0 + 0.3 * rng.standard_normal((len(plant.detectors), 1))
    lines = arrays.separate(sinusoids(plant, z) + steady, plant)
    assert np.abs(lines.amplitude - z).max() < 1e-9
    assert lines.resolved.all()
    assert np.allclose(lines.gain * plant.duration, 1, rtol=0.01)


def test_labels_closer_than_the_records_length_are_not_resolved_and_harm_nobody(plant):
    """One pair at 0.5/T, one at the same rate, one at 1.5/T: only the first two pairs are unresolved, and all others,
    the sum of the two included, are as without them.
    """
    rates = plant.rates.copy()
    rates[1, 0] = rates[0, 0] + 0.5 / plant.duration
    rates[3, 1] = rates[2, 1]
    rates[5, 0] = rates[4, 0] - 1.5 / plant.duration
    crowded = replace(plant, rates=rates)
    z = draw(plant, np.random.default_rng(2))
    lines = arrays.separate(sinusoids(crowded, z), crowded)
    lost = np.zeros((6, 2), bool)
    lost[[0, 1], 0] = lost[[2, 3], 1] = True
    assert np.array_equal(~lines.resolved, lost)
    assert np.abs(lines.amplitude - z)[~lost].max() < 1e-6
    assert np.abs((lines.amplitude - z)[2, 1] + (lines.amplitude - z)[3, 1]).max() < 1e-6


def test_the_noise_is_found_between_the_labels(plant, assumptions, truth, steady, light):
    """Flicker's densities at 150 Hz: its own part, known to 0.6 % from 250 bins of 162 detectors, within 10 %; the
    common part, known to 6 %, within 30 %.
    """
    samples = arrays.record(plant, assumptions, truth, steady, np.random.default_rng(3), light)
    lines = arrays.separate(samples, plant)
    noise = arrays.fit_noise(lines, plant)
    local = flicker_density(assumptions, assumptions.flicker_local, 150.0)
    common = flicker_density(assumptions, assumptions.flicker_common, 150.0)
    assert noise.bins > 200
    assert noise.local == pytest.approx(local, rel=0.1)
    assert noise.common == pytest.approx(common, rel=0.3)
    expected = steady**2 * local + 4.96e-11
    found = np.diag(noise.density(150.0)) - noise.common * noise.steady**2
    assert np.allclose(found, expected, rtol=0.06)


def test_white_noise_alone_is_not_called_flicker(plant):
    samples = 100 + 0.01 * np.random.default_rng(4).standard_normal((len(plant.detectors), plant.samples))
    noise = arrays.fit_noise(arrays.separate(samples, plant), plant)
    density = noise.density(150.0)
    assert np.allclose(np.diag(density), 2 * 0.01**2 / plant.sample_rate, rtol=0.05)
    assert np.abs(density - np.diag(np.diag(density))).max() < 0.02 * density[0, 0]


@pytest.mark.parametrize("spoil", ["short", "nan"])
def test_samples_that_cannot_be_used(plant, spoil):
    samples = np.ones((len(plant.detectors), plant.samples))
    if spoil == "short":
        samples = samples[:, :-1]
    else:
        samples[3, 4] = np.nan
    with pytest.raises(BenchsimError, match="samples: "):
        arrays.separate(samples, plant)
