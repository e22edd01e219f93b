"""What is put in is held against what is there, on settings that the judge never saw."""

from dataclasses import replace

import numpy as np
import pytest

from benchsim.trial import draws, prediction


@pytest.fixture(scope="module")
def bench():
    return draws.bench("six", np.random.default_rng(1), 2)


@pytest.fixture(scope="module")
def settings(bench):
    return prediction.kept_back(bench, np.random.default_rng(2))


def test_settings_are_others(bench, settings):
    assert len(settings.exposures) == prediction.SETTINGS
    assert not {e.setting for e in settings.exposures} & {e.setting for e in bench.exposures}
    assert settings.cameras.keys() == {e.camera for e in settings.exposures}
    assert {c.resolution for c in settings.cameras.values()} == {(1000, 750)}


@pytest.mark.parametrize(
    ("found", "left"),
    [({"bow_z": 0.0036}, 0.01), ({"bow_z": -0.004}, 4.0)],
    ids=["ten percent off", "the wrong sign"],
)
def test_excess_goes_with_the_square_of_what_is_left(bench, settings, found, left):
    """A bow's effect is linear in its size to a percent."""
    amended = replace(bench, effects={"screen-bow": found})
    p = prediction.predicted(settings, ({"screen-bow": {"bow_z": 0.004}}, {}), amended)
    assert p.before > 1000
    assert p.after / p.before == pytest.approx(left, rel=0.05, abs=1e-9)


def test_a_field_predicts_what_it_stands_for(bench, settings):
    dent = draws.draw_stranger("dent", bench, np.random.default_rng(3))
    p = prediction.predicted(settings, ({}, dent), replace(bench, fields=dent))
    assert p.before > 100 and p.after == pytest.approx(0.0, abs=1e-9)
