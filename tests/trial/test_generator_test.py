"""The certificate is given to the generator as it is, and refused to one whose light lies elsewhere."""

from dataclasses import replace

import numpy as np
import pytest

from benchsim.trial import draws, generator_test

NOISE = (0.2, 0.01)


@pytest.fixture(scope="module")
def bench():
    """Without diffraction, which costs twenty times the rays."""
    whole = draws.bench("fig7", np.random.default_rng(0), 4)
    return replace(whole, physics=replace(whole.physics, diffraction=False))


@pytest.fixture(scope="module")
def certificate(bench):
    return generator_test.certify(bench, 5, noise=NOISE, sets=3)


def test_the_generator_is_certified(certificate):
    assert certificate.passed, certificate
    assert certificate.rays[1] >= 2 * certificate.rays[0]
    assert len(certificate.plain()["tests"]) == 6


def test_one_count_alone_certifies_nothing(certificate):
    assert not replace(certificate, rays=(certificate.rays[0],) * 2).passed


def test_a_trace_that_lies_elsewhere_is_refused(bench):
    """By 0.1 mm, at both counts."""
    found = generator_test.certify(
        bench, 5, noise=NOISE, sets=2, drawn=replace(bench, effects={"canting": {"pyr": 0.03}})
    )
    assert not found.passed
    assert {t.what for t in found.tests if t.p_value < 1e-4} >= {"coarse against rays", "fine against rays"}


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_with_diffraction_as_trials_have_it(seed):
    bench = draws.bench("six", np.random.default_rng(seed), 2)
    assert generator_test.certify(bench, seed).passed


def test_false_alarms_come_at_their_rate():
    """p ≤ 0.05 of bins of unequal noise, 400 trials: 34 or more in one of 1500 seeds if the rate is 0.05."""
    rng = np.random.default_rng(4)
    sigma = np.exp(rng.normal(0, 0.7, generator_test.BINS))
    low = 0
    for _ in range(400):
        each = sigma * rng.standard_normal((4, generator_test.BINS))
        low += generator_test._test("x", "y", each.mean(axis=0), each.var(axis=0, ddof=1) / 4, 4).p_value <= 0.05
    assert low < 34
