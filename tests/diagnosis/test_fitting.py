"""Fits of one hypothesis against the truth and against an independent optimiser; what an unconverged one may say."""

from dataclasses import replace

import lines
import numpy as np
import pytest
from scipy.optimize import least_squares

from benchsim.diagnosis import evidence, linear, name, settings
from benchsim.diagnosis.fitting import STILL, Start, fitted
from benchsim.diagnosis.hypothesis import Context, Hypothesis, Point

BY_NAME = {e.name: e for e in lines.CATALOGUE}


def context_of(problem):
    return Context(problem, linear.factors(problem.covariance), *settings.grid())


def starts_of(problem, effects, shape=(), size=0.0, wrong=1.0):
    """From the stated settings, derivatives by the nuisances ``wrong`` times what they are."""
    h = Hypothesis(tuple(BY_NAME[e] for e in effects))
    sigma = np.array([n.sigma for n in problem.nuisances])
    columns = context_of(problem).whiten(linear.columns(problem, {}, problem.nuisances) * sigma) * wrong
    amplitude = np.array([size * p.sigma**p.power for p in h.amplitudes])
    return [Start(h, Point(np.zeros(len(sigma)), amplitude, np.array(shape, float)), columns)]


def solved(problem, effects, shape=(), renewals=8, **start):
    starts = starts_of(problem, effects, shape, **start)
    return fitted(context_of(problem), starts, {starts[0].hypothesis.names: 0.0}, renewals=renewals)[0]


def cost(problem, h, theta, scale):
    """−ln posterior, written anew."""
    p, k = len(problem.nuisances), len(h.amplitudes)
    at = {n.name: x * n.sigma for n, x in zip(problem.nuisances, theta, strict=False)}
    at |= {a.name: v for a, v in zip((*h.amplitudes, *h.shapes), theta[p:], strict=True)}
    residual = (problem.data - linear.predict_all(problem, at)) / lines.SIGMA
    prior = [x / (scale if n.scaled else 1) for n, x in zip(problem.nuisances, theta, strict=False)]
    return np.concatenate([residual, prior, [v / a.sigma for a, v in zip(h.amplitudes, theta[p : p + k], strict=True)]])


@pytest.mark.parametrize(
    ("truth", "effects", "shape"),
    [
        ({"turn": 1.2}, ("turn",), ()),
        ({"bow_1": 0.2, "glass": 0.3}, ("bow", "glass"), ()),
        ({"blur": 0.25}, ("blur",), ()),
        ({"ripple": 0.1, "period": 0.62}, ("ripple",), (0.7,)),
    ],
)
def test_the_peak_is_that_of_an_independent_optimiser(truth, effects, shape):
    problem, _ = lines.problem(truth, seed=11)
    fit = solved(problem, effects, shape, size=0.1).fit
    h = Hypothesis(tuple(BY_NAME[e] for e in effects))
    start = np.array(
        [fit.values[n.name] / n.sigma for n in problem.nuisances]
        + [fit.values[a.name] for a in (*h.amplitudes, *h.shapes)]
    )
    moved = start * 1.02 + 0.002
    best = least_squares(lambda t: cost(problem, h, t, fit.setting_scale), moved, xtol=1e-12, ftol=1e-12, gtol=1e-10)
    ours = 0.5 * (cost(problem, h, start, fit.setting_scale) ** 2).sum()
    assert fit.converged
    assert ours - best.cost < STILL
    for own, value in zip([a.name for a in (*h.amplitudes, *h.shapes)], best.x[len(problem.nuisances) :], strict=True):
        assert abs(value - fit.values[own]) < 0.5 * fit.sigma[own]


def test_laplace_evidence_against_integration_over_a_nonlinear_amplitude():
    """turn bends the prediction by its square; integrated over it with all else refitted linearly at every value."""
    problem, _ = lines.problem({"turn": 0.8}, seed=4)
    end = solved(problem, ("turn",))
    context = context_of(problem)
    sigma, prior = end.fit.sigma["turn"], BY_NAME["turn"].parameters[0].sigma
    grid = end.fit.values["turn"] + sigma * np.linspace(-6, 6, 49)
    logs = []
    for value in grid:
        lin = linear.linearise(problem, {**end.fit.values, "turn": value}, ())
        nothing = [evidence.term([], 0.0)]
        cells = settings.log_cells(lin, np.zeros((len(problem.data), 0)), context.scales, context.weights, nothing)
        logs.append(np.logaddexp.reduce(cells[:, 0]) - 0.5 * (value / prior) ** 2)
    total = np.logaddexp.reduce(logs) + np.log(grid[1] - grid[0]) - 0.5 * np.log(2 * np.pi * prior**2)
    assert end.fit.log_evidence == pytest.approx(total, abs=5e-2)


def test_an_amplitude_pulled_below_zero_stays_there():
    problem, _ = lines.problem({"glass": -0.1}, seed=6)
    fit = solved(problem, ("glass",), size=0.1).fit
    assert fit.values["glass"] == 0.0 and fit.converged
    assert fit.log_evidence < solved(problem, ()).fit.log_evidence


@pytest.mark.parametrize("wrong", [0.6, 1.4])
def test_derivatives_are_renewed_where_they_do_not_hold(wrong):
    problem, _ = lines.problem({"turn": 0.5}, seed=2)
    right, mended = solved(problem, ("turn",)), solved(problem, ("turn",), wrong=wrong)
    assert mended.fit.converged and mended.exact
    assert mended.fit.values["turn"] == pytest.approx(right.fit.values["turn"], abs=0.1 * right.fit.sigma["turn"])
    assert mended.fit.log_evidence == pytest.approx(right.fit.log_evidence, abs=0.1)


def test_without_renewal_a_fit_comes_near_and_says_that_its_derivatives_are_not_exact():
    problem, _ = lines.problem({"turn": 0.5}, seed=2)
    right, scout = solved(problem, ("turn",)), solved(problem, ("turn",), renewals=0)
    assert right.exact and not scout.exact
    assert scout.fit.log_evidence == pytest.approx(right.fit.log_evidence, abs=1.0)


@pytest.mark.parametrize("turn", [1.2, 3.0])
def test_a_fit_that_got_lost_on_rough_derivatives_is_not_credited_with_what_they_promise(turn):
    """Derivatives that point the wrong way allow no step and promise what all steps together would bring."""
    problem, _ = lines.problem({"turn": turn}, seed=2)
    right, lost = solved(problem, ("turn",)).fit, solved(problem, ("turn",), renewals=0, wrong=-1.0).fit
    assert lost.chi2 > right.chi2 + 40
    assert lost.log_evidence < right.log_evidence - 0.5 * (lost.chi2 - right.chi2) + 1


def test_starts_fitted_together_end_where_each_does_alone():
    problem, _ = lines.problem({"bow_1": 0.2, "turn": 0.3}, seed=3)
    starts = [s for e in (("turn",), ("bow",), ("blur",)) for s in starts_of(problem, e, size=0.1)]
    prior = {s.hypothesis.names: 0.0 for s in starts}
    together = fitted(context_of(problem), starts, prior, renewals=8)
    for start, end in zip(starts, together, strict=True):
        (alone,) = fitted(context_of(problem), [start], prior, renewals=8)
        assert end.fit.log_evidence == alone.fit.log_evidence


def test_kinks_that_promise_what_no_step_has_keep_no_fit_from_converging():
    """Scenario: a quadrature leaves kinks of some hundredths of a sigma in the prediction along a setting that the data
    hardly see. Differences over them promise a gain that cannot be had."""
    phases = np.random.default_rng(1).uniform(0, 1, 96)

    def kinked(values, block):
        t = values.get(f"t{block}", 0.0)
        kinks = 0.05 * lines.SIGMA * np.abs((6 * t + phases) % 1 - 0.5)
        return lines.predict(values, block) + 0.2 * lines.SIGMA * t * np.tile(lines.Y**2, 2) + kinks

    made, _ = lines.problem(seed=5, predict=kinked)
    hidden = tuple(lines.Parameter(f"t{b}", "1", 1.0, scaled=True, blocks=(b,)) for b in range(6))
    made = replace(made, nuisances=made.nuisances + hidden)
    assert name(made).null.converged
