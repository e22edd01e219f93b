"""Whether anything is left: p-values by their stated distribution, and the power that the study promises."""

from dataclasses import replace

import numpy as np
from scipy.stats import chi2, kstest
from toy import toy

from benchsim.diagnosis import remainder
from benchsim.diagnosis.linear import linearise, marginal


def draws(problem, linear, n, seed, scale=1.0):
    """Residuals as the marginal covariance has them."""
    rng = np.random.default_rng(seed)
    s = np.where(linear.scaled, scale, 1.0)
    for _ in range(n):
        yield linear.nuisance @ (s * rng.normal(size=len(s))) + rng.normal(size=len(linear.residual))


def test_chance_gives_the_stated_rate():
    problem = toy()
    linear = linearise(problem, {}, ())
    families = remainder.modes(problem, linear, problem.covariance)
    many = [remainder.remainder(replace(linear, residual=r), families, 1.0) for r in draws(problem, linear, 300, 1)]
    # Every family is a χ² of its rank: Kolmogorov-Smirnov at 0.1 % each.
    for name in families:
        p = [chi2.sf(m.families[name].statistic, m.families[name].rank) for m in many]
        assert kstest(p, "uniform").pvalue > 1e-3, name
    # 1 % stated, Bonferroni makes it a little less: 9 or more of 300 happen once in 250 times at 1 %.
    assert sum(not m.acceptable for m in many) < 9


def test_a_smooth_misfit_is_seen_as_the_study_promises():
    # SNR 10 always; SNR 5 in more than half (three families of a dozen modes at 1 %: 0.7 expected for these two).
    problem = toy()
    linear = linearise(problem, {}, tuple(p for e in problem.catalogue for p in e.parameters))
    families = remainder.modes(problem, linear, problem.covariance)
    for name in ("lens_a", "creep"):
        shape = linear.effect[:, linear.names.index(name)]
        shape = shape / np.sqrt(marginal(linear, shape[:, None]).gram[0, 0])
        for snr, least in ((10, 40), (5, 20)):
            seen = sum(
                not remainder.remainder(replace(linear, residual=r + snr * shape), families, 1.0).acceptable
                for r in draws(problem, linear, 40, 2)
            )
            assert seen >= least, (name, snr, seen)


def test_noise_that_was_estimated_from_little_excuses_more():
    problem = toy()
    linear = linearise(problem, {}, ())
    families = remainder.modes(problem, linear, problem.covariance)
    r = next(draws(problem, linear, 1, 3))
    known = remainder.remainder(replace(linear, residual=1.8 * r), families, 1.0)
    little = remainder.remainder(replace(linear, residual=1.8 * r), families, 1.0, dict.fromkeys(families, 12))
    much = remainder.remainder(replace(linear, residual=1.8 * r), families, 1.0, dict.fromkeys(families, 1e9))
    assert little.p > known.p
    assert np.isclose(much.p, known.p, rtol=1e-4)
