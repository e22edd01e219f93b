"""Limits against injections: an effect of just that size is five sigma in the data."""

from dataclasses import replace

import numpy as np
import pytest
from toy import toy

from benchsim.diagnosis import degeneracy
from benchsim.diagnosis.detection_limits import limits
from benchsim.diagnosis.linear import linearise, marginal, predict_all, whiten


def everything(problem):
    return tuple(p for e in problem.catalogue for p in e.parameters)


@pytest.mark.parametrize("scale", [1.0, 3.0])
def test_an_injection_of_that_size_is_five_sigma(scale):
    problem = toy()
    linear = linearise(problem, {}, everything(problem))
    found = limits(problem, degeneracy.space(problem, linear, scale), linear.names)
    assert set(found) == {e.name for e in problem.catalogue}
    for name, limit in found.items():
        change = predict_all(problem, {limit.parameter: limit.five_sigma}) - predict_all(problem, {})
        white, _ = whiten(problem, problem.covariance, change)
        power = marginal(linear, white[:, None], scale).gram[0, 0]
        assert np.sqrt(power) == pytest.approx(5.0, rel=0.03), name


def test_what_was_found_is_marginalised_and_has_no_limit():
    problem = toy()
    linear = linearise(problem, {}, everything(problem))
    within = degeneracy.space(problem, linear, 1.0)
    alone, beside = limits(problem, within, linear.names), limits(problem, within, linear.names, ("lens-a",))
    assert "lens-a" not in beside
    # lens-b is lens-a but for a fiftieth: next to it, it can hardly be seen.
    assert beside["lens-b"].five_sigma > 10 * alone["lens-b"].five_sigma
    assert beside["lens-b"].reachable is False


def test_the_worst_parameter_speaks_for_the_effect():
    problem = toy()
    one = problem.catalogue[0]
    both = type(one)(**{**vars(one), "parameters": (*one.parameters, *problem.catalogue[1].parameters)})
    problem = replace(problem, catalogue=(both,))
    linear = linearise(problem, {}, everything(problem))
    found = limits(problem, degeneracy.space(problem, linear, 1.0), linear.names)
    assert found["bow"].parameter == "swell"
    assert found["bow.bow"].five_sigma < found["bow"].five_sigma


def test_a_field_of_many_is_given_by_its_rms():
    problem = toy()
    one = problem.catalogue[0]
    parts = tuple(type(p)(**{**vars(p), "name": f"tilt_{k}"}) for k, p in enumerate(one.parameters * 4))
    field = type(one)(**{**vars(one), "parameters": parts, "random_field": True})
    gram = np.diag([100.0, 100.0, 400.0, 400.0])
    within = degeneracy.Space(gram, np.zeros(4), np.ones(4), -np.ones(4), np.ones(4), {"bow": np.arange(4)})
    problem = replace(problem, catalogue=(field,))
    found = limits(problem, within, tuple(p.name for p in parts))["bow"]
    assert found.parameter == "tilt_rms"
    # Amplitudes of that rms have a mean squared norm of 25.
    assert found.five_sigma**2 * np.trace(gram) == pytest.approx(25)
