"""An aberration that hangs on where the beam was set: its effect on the data is cubic in a setting and the amplitude.

y(x) = (x + s)² / 3 + q (x + s)³ + o + d x over two exposures, s and o set by hand with errors much larger than the
data's noise. About the stated settings the prediction bends a little with s; beside a large q by many times that.
"""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest

from benchsim.diagnosis import curvature, descent, foresight, naming, refit, screen, search, settings, starts
from benchsim.diagnosis.fits import Fit
from benchsim.diagnosis.hypothesis import Context, Hypothesis, Known, Point, Solved, values, whitener
from benchsim.diagnosis.linear import linearise, predict_all
from benchsim.diagnosis.problem import Effect, Parameter, Problem

X = np.linspace(-1, 1, 40)
NOISE = 0.02
AMPLITUDE = Parameter("q", "1", sigma=2.0)
STRAIGHT = Parameter("d", "1", sigma=2.0)
CATALOGUE = (Effect("aberration", "source", (AMPLITUDE,)), Effect("slant", "screen", (STRAIGHT,)))


def predict(values, block):
    s, o = (values.get(f"{name}{block}", 0.0) for name in ("s", "o"))
    return (X + s) ** 2 / 3 + values.get("q", 0.0) * (X + s) ** 3 + o + values.get("d", 0.0) * X


def problem(truth, seed=0):
    rng = np.random.default_rng(seed)
    nuisances = tuple(
        Parameter(f"{name}{b}", "1", sigma, scaled=True, blocks=(b,))
        for b in range(2)
        for name, sigma in (("s", 0.1), ("o", 1.0))
    )
    n = len(X)
    made = Problem(
        data=np.zeros(2 * n),
        block=np.repeat([0, 1], n),
        kind=np.full(2 * n, "y"),
        position=np.tile(X, 2),
        stretch=np.repeat([0, 1], n),
        covariance=(NOISE**2 * np.eye(n),) * 2,
        names=("one", "two"),
        groups=("one", "two"),
        nuisances=nuisances,
        catalogue=CATALOGUE,
        predict=predict,
    )
    return replace(made, data=predict_all(made, truth) + NOISE * rng.standard_normal(2 * n))


TRUTH = {"q": -2.6, "s0": 0.13, "s1": -0.11, "o0": 0.8, "o1": -1.2}


def test_second_derivatives_about_a_point_are_those_of_calculus():
    made = problem(TRUTH)
    about = curvature.measure(made)
    at = {"q": 1.5, "s0": 0.1, "s1": -0.2}
    found, changes, _ = curvature.again(made, about, at, [AMPLITUDE])
    for b, s in enumerate((0.1, -0.2)):
        rows, k = made.rows(b), list(about.curved[b]).index(2 * b)
        # Differences of a cubic: exact in the second derivative, forward in the mixed one.
        assert np.allclose(found.second[b][:, k, k], (2 / 3 + 6 * 1.5 * (X + s)) * 0.1**2)
        step = 0.1 * curvature.CLOSE
        mixed = ((X + s + step) ** 3 - (X + s) ** 3) / step
        assert np.allclose(changes["q"][0][rows, 2 * b], 0.1 * mixed)
    assert np.allclose(changes["q"][1], 0.0, atol=1e-6)


def test_a_start_is_sought_with_the_settings_columns_that_it_has_beside_the_effect():
    """Scenario: settings 1.2 sigma off shear the aberration. With the columns of the stated bench the right size
    misses the data by many times the enlarged noise that is to cover what first order leaves; with its own it fits."""
    made = problem(TRUTH)
    context = Context(made, whitener(made.covariance), *settings.grid(), curvature.measure(made))
    point = Point(np.zeros(4), np.zeros(0), np.zeros(0))
    fit = Fit((), 0.0, {}, {}, np.zeros((0, 0)), 1.0, 0.0, False, linearise(made, {}, ()), np.zeros(9))
    null = Solved(fit, point, Known(context.curvature.first, point.nuisance), np.zeros((80, 0)), made.data)
    begun = starts.scanned(context, Hypothesis(CATALOGUE[:1]), null, np.zeros(1))
    assert all(abs(q[0] - TRUTH["q"]) < 1.0 for q in begun)
    change = context.change(AMPLITUDE, 1.0, {})[0]
    stated = context.curvature.first
    far = starts.misfits(context, [{"q": TRUTH["q"]}] * 2, [stated, stated + TRUTH["q"] * change], [starts.AFAR])[0]
    assert far[1] < 20 and far[0] > 5 * far[1]


def test_foresight_ranks_and_sizes_without_a_fit():
    """Scenario: settings that may be wrong by 1.2 stated sigma take up what the aberration leaves. Models followed from
    the stated settings tell it from a slant, and its size; with one amplitude a fit has two valleys at most to begin
    in."""
    made = problem(TRUTH)
    context = Context(made, whitener(made.covariance), *settings.grid(), curvature.measure(made))
    right, wrong = (foresight.foretell(context, Hypothesis((e,))) for e in CATALOGUE)
    assert right.log_evidence > wrong.log_evidence + 100
    assert abs(right.points[0].amplitude[0] - TRUTH["q"]) < 0.05
    assert np.allclose(right.points[0].nuisance, [1.3, 0.8, -1.1, -1.2], atol=0.1)
    signs = [np.sign(p.amplitude[0]) for p in right.points]
    assert len(set(signs)) == len(signs) <= foresight.VALLEYS


@pytest.mark.parametrize("q", [-2.6, -0.1, 1.1])
def test_foresight_comes_near_what_the_fit_finds(q):
    """Scenario: settings three stated sigma off, and an amplitude whose prior sigma is a hundred sigma in the data. At
    the first model's end its third order is worth hundreds; what is left after some more must be within the margin by
    which a search leaves hypotheses out."""
    truth = {"q": q, "s0": 0.33, "s1": -0.31, "o0": 1.8, "o1": -2.2}
    made = problem(truth)
    context = Context(made, whitener(made.covariance), *settings.grid(), curvature.measure(made))
    foretold = foresight.foretell(context, Hypothesis(CATALOGUE[:1]))
    found = next(f for f in naming.name(made).fits if f.effects == ("aberration",))
    fitted = found.log_evidence - screen.log_prior(found.effects, [e.name for e in CATALOGUE])
    assert abs(foretold.log_evidence - fitted) < search.FORESEEN
    assert abs(foretold.points[0].amplitude[0] - found.values["q"]) < 0.1


BLURS = tuple(Effect(n, "mirror", (Parameter(n, "1", 1.5, one_sided=True, power=2),)) for n in ("even", "lopsided"))


def blurred(values, block):
    """Widths: two blurs of alike, not the same profile add in quadrature; a setting widens what it also tilts."""
    s, o = (values.get(f"{name}{block}", 0.0) for name in ("s", "o"))
    own = 0.05 + 0.3 * s * X + 0.1 * s**2 + 0.05 * o
    return np.sqrt(own**2 + values.get("even", 0.0) ** 2 + values.get("lopsided", 0.0) ** 2 * (1 + 0.02 * X))


def test_foresight_comes_near_the_fit_of_a_blur_that_is_a_tenth_of_what_it_may_be():
    """Scenario: a prior sigma of the blur is thirty times the width, a thousand sigma in the data; what is there is a
    tenth of it. Two blurs that the data hardly tell apart must be foretold alike, or the one is never tried."""
    truth = {"even": 0.15, "s0": 0.2, "s1": -0.2, "o0": 0.6, "o1": 0.4}
    made = replace(problem({}), catalogue=BLURS, predict=blurred)
    made = replace(made, data=predict_all(made, truth) + NOISE * np.random.default_rng(0).standard_normal(80))
    context = Context(made, whitener(made.covariance), *settings.grid(), curvature.measure(made))
    found = {f.effects: f for f in naming.name(made).fits}
    for effect in BLURS:
        foretold = foresight.foretell(context, Hypothesis((effect,)))
        fitted = found[(effect.name,)].log_evidence - screen.log_prior((effect.name,), [e.name for e in BLURS])
        assert abs(foretold.log_evidence - fitted) < search.FORESEEN


def test_foresight_finds_the_valley_of_a_size_at_its_cap(monkeypatch):
    """Scenario: what is seen of an amplitude comes round again with its size, but for a little. The descent from one
    prior sigma ends in the valley next to the true one, hundreds in ln Z above it."""

    def round_again(values, block):
        s, o, a = (values.get(name, 0.0) for name in (f"s{block}", f"o{block}", "a"))
        return np.sin(4 * a) * X + 0.5 * a * X**2 + s * X**3 + o

    made = replace(
        problem({}), catalogue=(Effect("round", "mirror", (Parameter("a", "1", 1.0),)),), predict=round_again
    )
    truth = {"a": 2.2, "s0": 0.1, "s1": -0.1, "o0": 0.8, "o1": -1.2}
    made = replace(made, data=predict_all(made, truth) + NOISE * np.random.default_rng(0).standard_normal(80))
    context = Context(made, whitener(made.covariance), *settings.grid(), curvature.measure(made))
    found = foresight.foretell(context, Hypothesis(made.catalogue))
    # The next valley is 1.6 away.
    assert abs(found.points[0].amplitude[0] - 2.2) < 0.1
    monkeypatch.setattr(foresight, "SIZES", (1.0,))
    assert foresight.foretell(context, Hypothesis(made.catalogue)).log_evidence < found.log_evidence - 100


def test_foresight_in_other_processes_is_the_same():
    """Scenario: a pool takes one effect each. What a process has measured, and the predictions it took, come back."""
    sent = []

    def elsewhere(function, tasks):
        sent.append(pickle.dumps(function))
        return [pickle.loads(pickle.dumps(pickle.loads(sent[0])(pickle.loads(pickle.dumps(t))))) for t in tasks]

    made = problem(TRUTH)
    bends = curvature.measure(made)
    here, there = (
        Context(replace(made, spread=spread, further=lambda: ()), whitener(made.covariance), *settings.grid(), bends)
        for spread in (map, elsewhere)
    )
    hypotheses = [Hypothesis((e,)) for e in CATALOGUE]
    expected, found = (foresight.foretell_all(c, hypotheses) for c in (here, there))
    assert sent
    assert [f.log_evidence for f in found] == [f.log_evidence for f in expected]
    assert here.mixed.keys() == there.mixed.keys() != set()
    assert here.count == there.count
    assert [f.log_evidence for f in found] == [foresight.foretell(here, h).log_evidence for h in hypotheses]


def test_points_that_are_followed_together_end_where_each_does_alone():
    """Scenario: four starts of one amplitude, of which one ends at once, are told what they ask in the same turns."""
    made = problem(TRUTH)
    context = Context(made, whitener(made.covariance), *settings.grid(), curvature.measure(made))
    h, stated = Hypothesis(CATALOGUE[:1]), context.stated()
    prior = descent.prior_of(context, h, 1.0, h.terms()[0].field_sigma)
    sizes = [-2.6, 2.0, 0.3, -0.5]
    points = [Point(np.array([1.3, 0.8, -1.1, -1.2]) * (q == -2.6), np.array([q]), np.zeros(0)) for q in sizes]
    begun = descent.begin(context, h, prior, points)

    def columns_at(theta):
        at = values(made, h, descent.point_of(theta, 4, 1))
        return context.columns(at, h.amplitudes)

    owns = [columns_at(state.theta) for state in begun]
    together = descent.follow(context, h, prior, begun, stated, owns, columns_at)
    for state, own, (ended, its, exact) in zip(begun, owns, together, strict=True):
        ((alone, columns, also),) = descent.follow(context, h, prior, [state], stated, [own], columns_at)
        np.testing.assert_allclose(ended.theta, alone.theta, rtol=1e-12)
        np.testing.assert_allclose(its, columns, rtol=1e-12)
        assert (ended.cost, exact) == (pytest.approx(alone.cost), also)
        assert ended.cost <= state.cost
    assert descent.follow(context, h, prior, [], stated, [], columns_at) == []


def test_settings_descend_while_amplitudes_all_but_stay():
    """Scenario: on either side of an amplitude, which moves only by what bends between it and the settings."""
    made = problem(TRUTH)
    context = Context(made, whitener(made.covariance), *settings.grid(), curvature.measure(made))
    h, stated = Hypothesis(CATALOGUE[:1]), context.stated()
    prior = descent.prior_of(context, h, 1.0, h.terms()[0].field_sigma)
    points = [Point(np.zeros(4), np.array([q]), np.zeros(0)) for q in (TRUTH["q"], -TRUTH["q"])]
    right, wrong = descent.held(context, h, prior, points, stated)
    np.testing.assert_allclose([right.theta[4], wrong.theta[4]], [TRUTH["q"], -TRUTH["q"]], rtol=0.05)
    np.testing.assert_allclose(right.theta[:4], [1.3, 0.8, -1.1, -1.2], atol=0.1)
    assert right.cost < wrong.cost - 100
    # What comes back counts the amplitude's prior, though it was none while it stood.
    (again,) = descent.begin(context, h, prior, [descent.point_of(right.theta, 4, 1)])
    assert right.cost == pytest.approx(again.cost)


def test_foresight_says_when_it_cannot():
    made = problem(TRUTH)
    without = Context(made, whitener(made.covariance), *settings.grid())
    assert foresight.foretell(without, Hypothesis(CATALOGUE[:1])) is None
    context = replace(without, curvature=curvature.measure(made))
    place = Parameter("q_place", "1", sigma=1.0, grid=(0.0, 1.0))
    shaped = Effect("placed", "source", (AMPLITUDE, place))
    assert foresight.foretell(context, Hypothesis((shaped,))) is None
    assert foresight.foretell(context, Hypothesis((replace(CATALOGUE[0], whole=True),))) is None


def test_beside_what_is_there_another_is_foretold_with_settings_as_stated():
    """Scenario: an aberration whose size was found, and a slant beside it that nobody looked for."""
    truth = {"q": -2.6, "d": 0.4, "s0": 0.02, "s1": -0.03, "o0": 0.8, "o1": -1.2}
    made = problem(truth)
    context = Context(made, whitener(made.covariance), *settings.grid(), curvature.measure(made))
    both = Hypothesis(CATALOGUE)
    (found,) = foresight.foretell_all(context, [both], {"q": -2.3})
    assert np.allclose(found.points[0].amplitude, [-2.6, 0.4], atol=0.1)
    begun = foresight._begun(both, {"q": -2.3})
    assert {q[0] for q in begun} == {-2.3} and {q[1] for q in begun} == {-2.0, 2.0}


@pytest.mark.parametrize("seed", range(3))
def test_it_is_named_and_sized_all_the_same(seed):
    found = naming.name(problem(TRUTH, seed))
    best = found.fits[0]
    assert best.converged and best.effects == ("aberration",)
    assert abs(best.values["q"] - TRUTH["q"]) < 4 * best.sigma["q"]


def test_a_null_in_the_wrong_valley_is_led_out_by_the_best_effect():
    """Scenario: settings off by three sigma and nothing else. The null ended elsewhere, 20 in ln Z too low; an effect
    that is not there was fitted with the right settings and would be named for them."""
    made = problem({"s0": 0.33, "s1": -0.31, "o0": 1.8, "o1": -2.2})
    context = Context(made, whitener(made.covariance), *settings.grid(), curvature.measure(made))
    catalogue = screen.expand(made, {})

    def fitted(effects, point):
        h, size = Hypothesis(effects), np.zeros((80, len(effects)))
        known = Known(context.curvature.first, np.zeros(4))
        prior = screen.log_prior(tuple(e.name for e in effects), list(catalogue.effects))
        return refit.fit(context, h, [point], known, size if not effects else None, prior)

    right = fitted((), Point(np.zeros(4), np.zeros(0), np.zeros(0)))
    best = fitted(CATALOGUE[1:], Point(np.zeros(4), np.zeros(1), np.zeros(0)))
    trapped = replace(right, fit=replace(right.fit, log_evidence=right.fit.log_evidence - 20))
    done = {(): trapped, ("slant",): best}
    table = search.Table({(): trapped.fit.log_evidence}, {(): ()})
    search._null_again(context, catalogue, table, done)
    assert abs(done[()].fit.log_evidence - right.fit.log_evidence) < 0.5
    assert done[()].fit.log_evidence == table.log_z[()] > best.fit.log_evidence
    search._null_again(context, catalogue, table, done)
    assert done[()].fit.log_evidence == table.log_z[()]


KINK, PERIOD, PHASES = 0.05 * NOISE, 1 / 6, np.random.default_rng(1).uniform(0, 1, len(X))
"""Size, spacing in prior sigmas of a setting, and where along it every datum has its kinks."""


def kinked(values, block):
    t = values.get(f"t{block}", 0.0)
    return predict(values, block) + 0.2 * NOISE * t * X**2 + KINK * np.abs((t / PERIOD + PHASES) % 1 - 0.5)


@pytest.mark.parametrize("seed", range(5))
def test_a_fit_at_its_lowest_point_has_converged_whatever_kinks_promise(seed):
    """Scenario: a quadrature leaves kinks of some hundredths of a sigma in the prediction, along a setting that the
    data hardly see. Differences over them promise a gain that no step has. A fit that cannot fall has converged: if it
    had not, every other hypothesis would have to be tried before anything may be said."""
    made = problem({**TRUTH, "q": 0.0}, seed)
    hidden = tuple(Parameter(f"t{b}", "1", 1.0, scaled=True, blocks=(b,)) for b in range(2))
    made = replace(made, nuisances=made.nuisances + hidden, predict=kinked)
    null = next(f for f in naming.name(made).fits if not f.effects)
    assert null.converged
