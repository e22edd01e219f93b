"""Functions without a name: their evidence against a dense integral, and their contest with the names."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal
from toy import toy

from benchsim.diagnosis import discrepancy, functions, naming
from benchsim.diagnosis.evidence import PRESENCE
from benchsim.diagnosis.functions import kernel_root
from benchsim.diagnosis.linear import nuisance_posterior, predict_all, whiten

SNR_ONE = {"bow": 1 / 89.6, "lean": 1 / 58.2, "creep": 1 / 6.11}
"""Size of each effect at a whitened norm of 1 once the settings are marginalised."""


def test_the_kernel_falls_with_distance_and_not_across_components():
    a = toy().attachments[0]
    two = type(a)(**{**vars(a), "component": np.arange(13) % 2})
    root = kernel_root(two, 0.3, 1e-14)
    got = root @ root.T
    assert got[0, 2] == pytest.approx(np.exp(-0.5 * (2 / 6 / 0.3) ** 2), abs=1e-6)
    assert got[0, 1] == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("stated", [True, False])
def test_evidence_is_the_dense_gaussian_integral(stated):
    """Where nobody stated the errors, those of one kind or of all may be smaller beside a function, at prior weights
    whose sum is 1."""
    problem = replace(toy({"bow": 0.1}, 1, blocks=3), stated=stated)
    kinds = np.unique(problem.kind)
    some = [kinds == k for k in kinds] + [kinds == kinds] * (len(kinds) > 1)
    parts = [np.ones(len(kinds)), *(np.where(w, p, 1.0) for p in discrepancy.UNSTATED for w in some)]
    parts = parts[:1] if stated else parts
    found = naming.name(problem)
    laid = discrepancy.weigh(problem, found, functions.prepare(problem, found.noise.covariance))
    null, covariance = found.null, found.noise.covariance
    got = next(a for a in laid if a.attachment.name == "mirror.lean")
    white, _ = whiten(problem, covariance, got.attachment.basis)
    grid = np.geomspace(1e-4, 1, 21) * got.attachment.sigma
    weights = grid / grid.sum()
    plain, with_it = [], []
    for scale, w in zip(found.setting_scales, found.scale_weights, strict=True):
        n = null.linear.nuisance * np.where(null.linear.scaled, scale, 1.0)
        settings = n @ n.T
        plain.append(np.log(w) + multivariate_normal.logpdf(null.linear.residual, cov=np.eye(len(n)) + settings))
        for length in got.attachment.lengths:
            r = white @ kernel_root(got.attachment, length, 1e-12)
            for a, v in zip(grid, weights, strict=True):
                for part in parts:
                    of_datum = part[np.searchsorted(kinds, problem.kind)]
                    m = np.diag(of_datum**2) + settings + a**2 * r @ r.T
                    z = multivariate_normal.logpdf(null.linear.residual, cov=m)
                    with_it.append(np.log(w * v / len(got.attachment.lengths) / len(parts)) + z)
    gain = logsumexp(with_it) - logsumexp(plain)
    prior = np.log(PRESENCE / (1 - PRESENCE) / len(problem.attachments))
    assert got.log_evidence - null.log_evidence == pytest.approx(gain + prior, abs=0.01)


@pytest.mark.filterwarnings("error")
def test_a_column_that_grew_beyond_reason_leaves_the_evidence_finite():
    """Near a caustic a derivative can be 1e9 sigma per prior sigma: the data then fix that nuisance, and no more."""
    problem = toy({"bow": 0.1}, 1, blocks=3)
    found = naming.name(problem)
    prepared = functions.prepare(problem, found.noise.covariance)
    wild = np.random.default_rng(5).standard_normal((len(problem.data), 1))

    def gains(*columns):
        linear = discrepancy.with_columns(found.null.linear, np.concatenate(columns, axis=1))
        laid = discrepancy.weigh(problem, found, prepared, linear=linear)
        return {a.attachment.name: a.log_evidence for a in laid}

    assert gains(1e9 * wild, 1e9 * wild) == pytest.approx(gains(1e4 * wild), abs=1e-3)


def contest(truth, seeds, **options):
    """ln Z of the best name over the best function, seed after seed."""
    out = []
    for seed in seeds:
        problem = toy(truth, seed, **options)
        found = naming.name(problem)
        laid = discrepancy.weigh(problem, found, functions.prepare(problem, found.noise.covariance))
        out.append(max(f.log_evidence for f in found.fits if f.converged) - laid[0].log_evidence)
    return np.array(out)


@pytest.mark.parametrize("name", ["bow", "lean", "creep"])
def test_a_true_name_beats_its_own_element_s_function(name):
    # Each of these effects is a special case of its element's function, so only the price of freedom decides. At
    # SNR 10 the name may be only probable (margin 0 … 3), but loses in less than one of twenty: 0 or 1 of 12 passes
    # with probability 0.88 if the rate is 5 %, and 2 or more would refute 1 % at 99 %.
    margin = contest({name: 10 * SNR_ONE[name]}, range(100, 112))
    assert (margin < 0).sum() <= 1
    assert np.median(margin) > 2


def test_what_the_catalogue_lacks_prefers_the_function():
    for truth, options in (({"warp": 0.15}, {}), ({"lean": 15 * SNR_ONE["lean"]}, {"without": ("lean",)})):
        margin = contest(truth, range(200, 208), **options)
        assert (margin < 0).sum() >= 7


def bending(values, block, inner):
    """The toy's prediction with settings that bend the line: their squares count."""
    y = inner(values, block)
    bend = 0.5 * values.get(f"g{block}.offset", 0.0) ** 2
    return y + bend * np.linspace(-1, 1, len(y)) ** 3 * (np.arange(len(y)) < 24)


def test_a_function_is_weighed_about_its_own_nuisances():
    # Offsets fitted without the bow take up a third of it; there the line bends otherwise than where they belong.
    problem = toy({"bow": 1.0}, 5, without=("bow",))
    model = partial(bending, inner=problem.predict)
    truth = toy({"bow": 1.0}, 5)
    start = np.concatenate([truth.predict({}, b) for b in range(8)])
    offsets = np.random.default_rng(9).normal(0, 0.3, 8)
    at = {f"g{b}.offset": float(o) for b, o in enumerate(offsets)} | {"bow": 1.0}
    noise = 0.05 * np.random.default_rng(10).normal(size=len(start))
    data = np.concatenate([model(at, b) for b in range(8)]) + noise
    problem = replace(problem, predict=model, data=data)
    found = naming.name(problem)
    prepared = functions.prepare(problem, found.noise.covariance)
    first = next(a for a in discrepancy.weigh(problem, found, prepared) if a.attachment.name == "screen.height")
    again = discrepancy.refine(problem, found, prepared, first, found.null)
    wrong = []
    for laid in (first, again):
        white, _ = whiten(problem, found.noise.covariance, laid.attachment.basis)
        rest = laid.linear.residual - white @ laid.coefficients
        pull, _ = nuisance_posterior(laid.linear, rest, laid.scale)
        at = {p.name: x * p.sigma for p, x in zip(problem.nuisances, pull, strict=True)}
        exact = problem.data - predict_all(problem, at) - laid.attachment.basis @ laid.coefficients
        wrong.append(
            np.linalg.norm(whiten(problem, found.noise.covariance, exact)[0] - rest + laid.linear.nuisance @ pull)
        )
    assert wrong[0] > 3
    assert wrong[1] < 0.3
    x = again.attachment.knots[:, 0]
    assert np.polyfit(x, again.coefficients, 2)[0] == pytest.approx(1, abs=0.05)


def test_what_a_function_promises_and_the_prediction_does_not_keep_is_taken_off():
    """Scenario: about settings where no linearisation holds, the linear residual says that a function would leave next
    to nothing. The exact prediction knows better, and the function loses by what is left."""
    problem = toy({"bow": 0.3}, 5, without=("bow",))
    found = naming.name(problem)
    prepared = functions.prepare(problem, found.noise.covariance)
    first = next(a for a in discrepancy.weigh(problem, found, prepared) if a.attachment.name == "screen.height")
    white, _ = whiten(problem, found.noise.covariance, first.attachment.basis)
    function = white @ first.coefficients
    honest = discrepancy.checked(problem, found, first, function, found.null)
    assert honest.log_evidence == pytest.approx(first.log_evidence, abs=0.1)
    empty = replace(first.linear, residual=np.zeros(len(function)), nuisance=np.zeros_like(first.linear.nuisance))
    promising = replace(first, linear=replace(empty, residual=function))
    kept = discrepancy.checked(problem, found, promising, function, found.null)
    seen, _ = whiten(problem, found.noise.covariance, problem.data - predict_all(problem, {}))
    left = 0.5 * float(np.sum((seen - function) ** 2))
    assert left > 100
    assert kept.log_evidence == pytest.approx(first.log_evidence - left, rel=1e-6)
