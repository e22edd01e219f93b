"""The fit of the bench's own cone: its invariants are determined, and its errors are honest."""

import json

import numpy as np
import pytest
from scipy import stats

from benchsim.bench import conic
from benchsim.bench.errors import BenchsimError
from benchsim.conics import fit, fit_section, invariants, section_of, to_dict


def test_cone_determines_what_a_free_conic_cannot(fig7, prior):
    """Rationale: 13 setting errors under their priors leave the cone far less free than a conic is.

    Set-up: 60 draws of setting errors and noise on Fig. 7a. Expectation: e within 0.5 % (a free conic: tens of per
    cent), covered at 95 % (binomial, 1e-4), chi2 of points and priors uniform (1e-3), curve no worse than free.
    """
    setting, rng = fig7("a"), np.random.default_rng(31)
    hits, chi2, square = 0, [], []
    for _ in range(60):
        truth = prior * rng.normal(size=13)
        x = setting.points(400, truth)
        y = x + 0.05 * rng.normal(size=x.shape)
        found = fit_section(y, 0.05, setting.coefficients, np.zeros(13), prior)
        assert found.converged
        e = invariants(found)["eccentricity"]
        true_e = float(conic.geometry(setting.coefficients(truth)).eccentricity)
        hits += e.low <= true_e <= e.high
        assert e.determined and (e.high - e.low) / 2 < 0.005 * true_e
        chi2.append(found.chi2)
        u = found.frame.apply(x)
        g = np.linalg.norm(conic.gradient(found.coefficients, u) @ found.frame.matrix, axis=1)
        square.append(np.mean((conic.value(found.coefficients, u) / g) ** 2))
    assert hits >= stats.binom.ppf(1e-4, 60, 0.95)
    assert stats.kstest(chi2, stats.chi2(400).cdf).pvalue > 1e-3
    assert np.sqrt(np.mean(square)) < 0.05 * np.sqrt(5 / 400)


def test_what_the_trace_fixes(fig7, prior):
    """Three combinations of the thirteen are seen, the rest keep their priors; posterior never exceeds prior."""
    setting, rng = fig7("b"), np.random.default_rng(3)
    x = setting.points(500)
    names = [f"q{i}" for i in range(13)]
    found = fit_section(x + 0.05 * rng.normal(size=x.shape), 0.05, setting.coefficients, np.zeros(13), prior, names)
    assert np.all(np.diff(found.remaining) >= 0) and np.all(found.remaining < 1 + 1e-6)
    assert np.sum(found.remaining < 0.5) == 3 and np.sum(found.remaining < 0.9) <= 5
    assert np.allclose(found.combinations @ found.combinations.T, np.eye(13), atol=1e-9)
    assert np.all(np.sqrt(np.diag(found.parameter_covariance)) <= prior * (1 + 1e-6))
    record = json.loads(json.dumps(to_dict(found), allow_nan=False))
    assert set(record["parameters"]) == set(names) and len(record["combinations"]) >= 3


def test_tight_prior_fixes_the_curve_and_weak_prior_frees_it(fig7, prior):
    setting, rng = fig7("a"), np.random.default_rng(4)
    x = setting.points(400)
    y = x + 0.05 * rng.normal(size=x.shape)
    tight = fit_section(y, 0.05, setting.coefficients, np.zeros(13), 1e-6 * prior)
    assert np.allclose(tight.remaining, 1, atol=1e-3)
    u = tight.frame.apply(x)
    assert np.max(np.abs(conic.value(tight.coefficients, u))) < 1e-4
    free = fit(y, 0.05)
    section = fit_section(y, 0.05, setting.coefficients, np.zeros(13), prior)
    assert section.curve_rms < free.curve_rms
    assert tight.curve_rms < 0.01 * free.curve_rms


def test_section_from_predicted_points(fig7, prior):
    """A model that predicts points instead of coefficients gives the same fit."""
    setting, rng = fig7("a"), np.random.default_rng(5)
    errors = 0.5 * prior * rng.normal(size=13)
    y = setting.points(200, errors) + 0.05 * rng.normal(size=(200, 2))
    predict = section_of(lambda t: setting.points(60, t))
    one = fit_section(y, 0.05, setting.coefficients, np.zeros(13), prior)
    other = fit_section(y, 0.05, predict, np.zeros(13), prior)
    assert np.allclose(one.coefficients, other.coefficients, atol=1e-6)
    assert np.allclose(one.pulls, other.pulls, atol=1e-3)


@pytest.mark.parametrize(
    "mean, sigma, names, says",
    [
        (np.zeros(13), np.zeros(13), (), "prior of 13 parameters"),
        (np.zeros(13), np.ones(12), (), "prior of 13 parameters"),
        (np.full(13, np.nan), np.ones(13), (), "prior of 13 parameters"),
        (np.zeros(13), np.ones(13), ("a",), "as many names"),
    ],
)
def test_bad_prior(fig7, mean, sigma, names, says):
    setting = fig7("a")
    with pytest.raises(BenchsimError, match=says):
        fit_section(setting.points(50), 0.1, setting.coefficients, mean, sigma, names)


def test_section_that_is_no_conic(fig7):
    with pytest.raises(BenchsimError, match="not a conic"):
        fit_section(fig7("a").points(50), 0.1, lambda t: np.full(6, np.nan), np.zeros(1), np.ones(1))
