"""Refits against the truth and against an independent optimiser; what an unconverged fit may say."""

import lines
import numpy as np
import pytest
from scipy.optimize import least_squares

from benchsim.diagnosis import descent, linear, naming, refit, screen, settings
from benchsim.diagnosis.hypothesis import Context, Hypothesis, Known, Point, whitener

BY_NAME = {e.name: e for e in lines.CATALOGUE}


def context_of(problem):
    return Context(problem, whitener(problem.covariance), *settings.grid())


def known_at_zero(problem):
    sigma = np.array([n.sigma for n in problem.nuisances])
    return Known(linear.columns(problem, {}, problem.nuisances) * sigma, np.zeros(len(sigma)))


def fitted(problem, effects, shape=()):
    h = Hypothesis(tuple(BY_NAME[e] for e in effects))
    zero = Point(np.zeros(len(problem.nuisances)), np.zeros(len(h.amplitudes)), np.array(shape, float))
    other = Point(zero.nuisance, np.array([0.5 * p.sigma**p.power for p in h.amplitudes]), zero.shape)
    return refit.fit(context_of(problem), h, [zero, other], known_at_zero(problem))


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
    fit = fitted(problem, effects, shape).fit
    h = Hypothesis(tuple(BY_NAME[e] for e in effects))
    start = np.array(
        [fit.values[n.name] / n.sigma for n in problem.nuisances]
        + [fit.values[a.name] for a in (*h.amplitudes, *h.shapes)]
    )
    moved = start * 1.02 + 0.002
    best = least_squares(lambda t: cost(problem, h, t, fit.setting_scale), moved, xtol=1e-12, ftol=1e-12, gtol=1e-10)
    ours = 0.5 * (cost(problem, h, start, fit.setting_scale) ** 2).sum()
    assert fit.converged
    assert ours - best.cost < descent.STILL
    for name, value in zip([a.name for a in (*h.amplitudes, *h.shapes)], best.x[len(problem.nuisances) :], strict=True):
        assert abs(value - fit.values[name]) < 0.5 * fit.sigma[name]


def test_laplace_evidence_against_integration_over_a_nonlinear_amplitude():
    """turn bends the prediction by its square; integrated over it with all else refitted linearly at every value."""
    problem, _ = lines.problem({"turn": 0.8}, seed=4)
    solved = fitted(problem, ("turn",))
    context = context_of(problem)
    sigma, prior = solved.fit.sigma["turn"], BY_NAME["turn"].parameters[0].sigma
    grid = solved.fit.values["turn"] + sigma * np.linspace(-6, 6, 49)
    logs = []
    for value in grid:
        at = {**solved.fit.values, "turn": value}
        lin = linear.linearise(problem, at, ())
        many = settings.marginals(lin, np.zeros((len(problem.data), 0)), context.scales)
        logs.append(np.logaddexp.reduce(settings.log_null(many, context.weights)) - 0.5 * (value / prior) ** 2)
    total = np.logaddexp.reduce(logs) + np.log(grid[1] - grid[0]) - 0.5 * np.log(2 * np.pi * prior**2)
    assert solved.fit.log_evidence == pytest.approx(total, abs=2e-2)


def test_an_amplitude_pulled_below_zero_stays_there():
    problem, _ = lines.problem({"glass": -0.1}, seed=6)
    fit = fitted(problem, ("glass",)).fit
    assert fit.values["glass"] == 0.0 and fit.converged
    assert fit.log_evidence < fitted(problem, ()).fit.log_evidence


def test_a_fit_that_finds_no_step_is_marked_unconverged(monkeypatch):
    """The derivatives promise a gain that the exact prediction does not have, and there is no second round."""
    problem, _ = lines.problem({"turn": 0.2}, seed=1)
    h = Hypothesis((BY_NAME["turn"],))
    zero = Point(np.zeros(len(problem.nuisances)), np.zeros(1), np.zeros(0))
    wrong = -linear.columns(problem, {}, h.amplitudes)
    context, known = context_of(problem), known_at_zero(problem)
    mended = refit.fit(context, h, [zero], known, wrong)
    assert mended.fit.converged
    monkeypatch.setattr(refit, "ROUNDS", 1)
    monkeypatch.setattr(descent, "RENEWALS", 1)
    stuck = refit.fit(context, h, [zero], known, wrong)
    assert not stuck.fit.converged


def test_unconverged_fits_come_last_and_a_naming_says_so(monkeypatch):
    monkeypatch.setattr(descent, "STILL", -np.inf)
    found = naming.name(lines.problem({"turn": 0.5}, seed=1)[0])
    assert not any(f.converged for f in found.fits)
    monkeypatch.undo()
    found = naming.name(lines.problem({"turn": 0.5}, seed=1)[0])
    assert all(f.converged for f in found.fits)


def test_a_frozen_jacobian_would_name_wrongly():
    """A strong turn, weighed about the null's point alone, surely takes a second name; refitted, it does not."""
    for seed in range(3):
        problem, _ = lines.problem({"turn": 1.0}, seed=seed)
        named = naming.name(problem)
        context = Context(problem, whitener(named.noise.covariance), named.setting_scales, named.scale_weights)
        catalogue = screen.expand(problem, named.null.values)
        frozen = screen.screen(
            named.null.linear, catalogue, context.whiten(catalogue.columns), context.scales, context.weights
        )
        assert max(frozen, key=frozen.get) != ("turn",)
        assert frozen["turn",] < max(frozen.values()) - 5
        assert named.fits[0].effects == ("turn",)
        assert named.probability["turn"] > 0.99 and max(v for k, v in named.probability.items() if k != "turn") < 0.1


def test_derivatives_are_renewed_where_they_no_longer_hold():
    problem, _ = lines.problem({"turn": 0.5}, seed=2)
    context = context_of(problem)
    good = known_at_zero(problem)
    rng = np.random.default_rng(0)
    bent = Known(good.columns * rng.uniform(0.6, 1.4, good.columns.shape[1]), good.nuisance + 1.0)
    h = Hypothesis((BY_NAME["turn"],))
    zero = Point(good.nuisance, np.zeros(1), np.zeros(0))
    right = refit.fit(context, h, [zero], good)
    mended = refit.fit(context, h, [zero], bent)
    assert mended.fit.converged
    assert mended.fit.values["turn"] == pytest.approx(right.fit.values["turn"], abs=0.1 * right.fit.sigma["turn"])
    assert mended.fit.log_evidence == pytest.approx(right.fit.log_evidence, abs=0.1)
