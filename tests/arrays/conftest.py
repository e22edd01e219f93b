"""A small plant: the six heliostats of analysis/fig4.py at 8 h, records of 5 s."""

from dataclasses import replace

import numpy as np
import pytest

from benchsim import arrays
from benchsim.vector import solar_vector, sun_angles

PLACES = ((150, -16, -143), (80, 150, -143), (100, -100, -143), (800, -350, -143), (650, 450, -143), (900, 0, -143))


@pytest.fixture(scope="session")
def assumptions():
    return arrays.Assumptions(duration=5.0)


@pytest.fixture(scope="session")
def plant(assumptions):
    sun = solar_vector(*sun_angles(np.radians(40.4), 172, 8.0))
    return arrays.build(1e3 * np.array(PLACES, float), sun, assumptions)


@pytest.fixture(scope="session")
def truth(plant, assumptions):
    rng = np.random.default_rng(11)
    return arrays.draw_truth(plant, assumptions, rng.uniform(-8e-3, 8e-3, (6, 2)), rng)


@pytest.fixture(scope="session")
def steady(plant, assumptions):
    return arrays.background(plant, assumptions, np.random.default_rng(12))


@pytest.fixture(scope="session")
def light(plant, assumptions, truth):
    """Clean samples of all six, with rates exactly as labelled."""
    return arrays.clean(plant, assumptions, replace(truth, rate_error=np.zeros((6, 2))))
