"""The certificate is given to the generator as it is, and refused to one whose light lies elsewhere."""

from dataclasses import replace

import numpy as np
import pytest

from benchsim.trial import certify, draws


@pytest.fixture(scope="module")
def bench():
    return draws.bench("fig7", np.random.default_rng(0), 4)


def test_the_generator_is_certified(bench):
    found = certify.certify(bench, 5, noise=(0.2, 0.08), sets=3)
    assert found.passed, found
    assert found.rays[1] > found.rays[0]
    assert len(found.plain()["tests"]) == 6


def test_a_trace_that_lies_elsewhere_is_refused(bench):
    other = replace(bench, effects={"canting": {"pyr": 0.05}})
    found = certify.certify(bench, 5, noise=(0.2, 0.08), sets=3, drawn=other)
    assert not found.passed
    assert {t.what for t in found.tests if t.p_value < 1e-4} >= {"fine against rays"}


def test_false_alarms_come_at_their_rate():
    """p ≤ 0.05 of bins of unequal noise, 400 trials: 34 or more in one of 1500 seeds if the rate is 0.05."""
    rng = np.random.default_rng(4)
    sigma = np.exp(rng.normal(0, 0.7, certify.BINS))
    low = 0
    for _ in range(400):
        each = sigma * rng.standard_normal((4, certify.BINS))
        low += certify._test("x", "y", each.mean(axis=0), each.var(axis=0, ddof=1) / 4, 4).p_value <= 0.05
    assert low < 34
