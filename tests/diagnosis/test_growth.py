"""The best fit held against its neighbours: valleys on the other side, and effects that stand in for one another.

Two exposures of a line y(x) and its width w(x). A defocus q makes the width |1 + q| and bends the line slightly, so
that q and −2 − q are as wide; a haze h widens too, in quadrature; a lean l tilts the line. An offset of every exposure
is set by hand.
"""

from __future__ import annotations

import pickle
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from benchsim.diagnosis import attempt, curvature, evidence, growth, refit, screen, search, settings
from benchsim.diagnosis.hypothesis import Context, Hypothesis, Known, Point, whitener
from benchsim.diagnosis.linear import Linear, predict_all
from benchsim.diagnosis.problem import Effect, Parameter, Problem
from benchsim.diagnosis.weighing import Table

X, NOISE = np.linspace(-1, 1, 30), 0.02
CATALOGUE = (
    Effect("defocus", "source", (Parameter("q", "1", 2.0),)),
    Effect("haze", "air", (Parameter("h", "1", 1.0, one_sided=True, power=2),)),
    Effect("lean", "mirror", (Parameter("l", "1", 1.0),)),
)
NAMES = tuple(e.name for e in CATALOGUE)


def predict(values, block):
    q, h, lean, o = (values.get(n, 0.0) for n in ("q", "h", "l", f"o{block}"))
    y = X**2 + o + 0.04 * q * X**3 * (1 + block) + lean * X * (1 - block)
    return np.concatenate([y, np.sqrt((1 + q) ** 2 + h**2 + 0 * X)])


def problem(truth):
    n = 2 * len(X)
    made = Problem(
        data=np.zeros(2 * n),
        block=np.repeat([0, 1], n),
        kind=np.tile(np.repeat(["y", "w"], len(X)), 2),
        position=np.tile(X, 4),
        stretch=np.tile(np.repeat([0, 1], len(X)), 2),
        covariance=(NOISE**2 * np.eye(n),) * 2,
        names=("one", "two"),
        groups=("one", "two"),
        nuisances=tuple(Parameter(f"o{b}", "1", 0.1, scaled=True, blocks=(b,)) for b in range(2)),
        catalogue=CATALOGUE,
        predict=predict,
    )
    return replace(made, data=predict_all(made, truth) + NOISE * np.random.default_rng(5).standard_normal(2 * n))


def context_of(made):
    return Context(made, whitener(made.covariance), *settings.grid(), curvature.measure(made))


def fitted(context, names, amplitude):
    """A set's fit from one point alone: the valley that it lies in."""
    h = Hypothesis(tuple(e for e in CATALOGUE if e.name in names))
    point = Point(np.zeros(2), np.array(amplitude, float), np.zeros(0))
    own = None if names else np.zeros((len(context.problem.data), 0))
    known = Known(context.curvature.first, point.nuisance)
    return refit.fit(context, h, [point], known, own, screen.log_prior(h.names, NAMES))


def settled(made, fits):
    context = context_of(made)
    catalogue = screen.expand(made, {})
    done = {names: fitted(context, names, amplitude) for names, amplitude in {(): (), **fits}.items()}
    before = dict(done)
    table = Table({e: s.fit.log_evidence for e, s in done.items()}, dict.fromkeys(done, ()))
    growth.settle(context, catalogue, context.whiten(catalogue.columns), table, done, set())
    return before, done, table


def test_a_fit_on_the_wrong_side_of_a_width_is_begun_again_from_the_other():
    """Scenario: the fit of the defocus began beyond the waist and ended at the sign that only the line refutes."""
    before, done, table = settled(problem({"q": 0.5}), {("defocus",): [-2.4]})
    was, now = before[("defocus",)].fit, done[("defocus",)].fit
    assert was.values["q"] == pytest.approx(-2.5, abs=0.1)
    assert now.converged and abs(now.values["q"] - 0.5) < 4 * now.sigma["q"]
    assert now.log_evidence > was.log_evidence + 3
    assert table.log_z[("defocus",)] == now.log_evidence


def test_fits_in_other_processes_are_the_same():
    """Scenario: the fits that a best one is held against go to a pool, one each; what they measured comes back."""
    sent = []

    def elsewhere(function, *tasks):
        sent.append(function)
        return [pickle.loads(pickle.dumps(pickle.loads(pickle.dumps(function))(*t))) for t in zip(*tasks, strict=True)]

    made, start = problem({"q": 0.5}), {("defocus", "lean"): [-2.4, 0.0]}
    _, here, _ = settled(made, start)
    _, there, _ = settled(replace(made, spread=elsewhere), start)
    assert any(f is not predict for f in sent)
    assert {e: s.fit.log_evidence for e, s in there.items()} == {e: s.fit.log_evidence for e, s in here.items()}


def test_a_good_fit_stays_what_it_is():
    before, done, _ = settled(problem({"q": 0.5}), {("defocus",): [0.4]})
    assert done[("defocus",)] is before[("defocus",)]


def test_the_best_without_a_stand_in_is_fitted_though_it_was_weighed_low():
    """Scenario: in the wrong valley a lean made up for the line's shape a little; the defocus alone was not tried."""
    made = problem({"q": 0.5})
    before, done, _ = settled(made, {("defocus", "lean"): [-2.4, 0.0]})
    assert ("defocus",) not in before and ("defocus",) in done
    assert abs(done[("defocus",)].fit.values["q"] - 0.5) < 0.1
    assert growth.leader(context_of(made), done).fit.effects == ("defocus",)


def test_nothing_is_done_where_the_null_is_best_or_nothing_is_near():
    made = problem({})
    before, done, _ = settled(made, {("lean",): [0.0]})
    assert done == before and growth.leader(context_of(made), done).fit.effects == ()
    before, done, _ = settled(problem({"q": 0.5, "l": 1.9}), {("haze",): [1.0]})
    assert done == before


def test_what_came_near_by_itself_is_put_beside_a_best_that_strayed(monkeypatch):
    """Scenario: the best needs settings three times as far off as stated; one effect came near with settings as stated,
    one only with settings far off, one shares an effect with the best."""

    def fit(effects, log_z, scale):
        return SimpleNamespace(
            fit=SimpleNamespace(effects=effects, log_evidence=log_z, setting_scale=scale, converged=True)
        )

    best = fit(("defocus",), 50.0, 3.0)
    done = {s.fit.effects: s for s in (fit((), 0.0, 4.0), best, fit(("haze",), 20.0, 1.0), fit(("lean",), 30.0, 2.0))}
    tried = []
    monkeypatch.setattr(growth, "attempt", lambda c, k, effects, source, *rest: tried.append((effects, source)))
    catalogue = SimpleNamespace(effects={e.name: e for e in CATALOGUE})
    list(growth._joined(None, catalogue, best, done))
    assert tried == [(("defocus", "haze"), done[("haze",)])]


@pytest.mark.parametrize(("size", "faint"), [(12.0, False), (5.0, True)])
def test_whether_an_effect_with_a_place_is_seen_is_asked_at_its_place(size, faint):
    """Scenario: a plume of 12 sigma that may be wide and weak or narrow and strong. Its size is known to a quarter, and
    by that sigma it would count as unseen."""
    place = Parameter("place", "1", 1.0, grid=(0.0, 1.0))
    h = Hypothesis((Effect("plume", "air", (Parameter("p", "1", 1.0), place)), CATALOGUE[2]))
    columns = np.zeros((50, 2))
    columns[0, 0], columns[1, 1], columns[1, 0] = 10.0, 30.0, 3.0
    lin = Linear(np.zeros(50), np.zeros((50, 0)), np.zeros(0, bool), columns, ("p", "l"), np.zeros(50, int), 0.0)
    value = size / 10.0
    fit = SimpleNamespace(linear=lin, setting_scale=1.0, values={"p": value, "l": 1.0}, sigma={"p": value / 3.7})
    solved = SimpleNamespace(fit=fit, point=Point(np.zeros(0), np.array([value, 1.0]), np.array([0.4])))
    assert attempt.unseen(h, solved) == ({"plume"} if faint else set())


def test_an_effect_beside_a_placed_one_is_sought_with_the_place_held():
    """Scenario: the best holds a plume where its fit has it; what is sought beside it leaves the place alone."""
    place = Parameter("place", "1", 1.0, grid=(0.0, 0.5, 1.0))
    plume = Effect("plume", "air", (Parameter("p", "1", 1.0), place))
    held = growth._placed(plume, {"p": 0.3, "place": 0.37})
    h = Hypothesis((held, CATALOGUE[2]))
    assert h.shapes == () and h.names == ("plume", "lean")
    assert evidence.fixed(held) == {"place": 0.37}


def bumped(values, block):
    return np.tile(values.get("a", 0.0) * np.exp(-50 * (X - values.get("place", 0.0)) ** 2), 2) + predict(values, block)


def test_a_place_that_made_up_for_another_effect_is_sought_again_beside_it():
    """Scenario: a bump was placed where the lean, not yet there, asked for one. Beside the lean the descent from there
    ends where it is: nothing of the bump's true place shows at the wrong one."""
    place = Parameter("place", "1", 1.0, grid=(-0.8, -0.4, 0.0, 0.4, 0.8))
    bump = Effect("bump", "air", (Parameter("a", "1", 0.5), place))
    truth = {"a": 0.2, "place": 0.5, "l": 0.3}
    made = replace(problem({}), catalogue=(CATALOGUE[2], bump), predict=bumped)
    made = replace(made, data=made.data + predict_all(made, truth) - predict_all(made, {}))
    context, catalogue = context_of(made), screen.expand(made, {})
    h = Hypothesis(made.catalogue)
    wrong = Point(np.zeros(2), np.array([0.3, 0.1]), np.array([-0.6]))
    known, prior = Known(context.curvature.first, np.zeros(2)), screen.log_prior(h.names, list(catalogue.effects))
    was = refit.fit(context, h, [wrong], known, None, prior)
    assert abs(was.fit.values["place"] - 0.5) > 0.5
    now = max(growth._placed_anew(context, catalogue, was), key=lambda s: s.fit.log_evidence)
    assert now.fit.converged and now.fit.log_evidence > was.fit.log_evidence + 50
    assert all(abs(now.fit.values[n] - x) < 4 * now.fit.sigma[n] for n, x in truth.items())


def test_an_effect_that_is_alone_is_placed_again_beside_the_settings_that_it_was_fitted_with():
    """Scenario: settings had been bent to hide a bump, and it was placed where those left room for one."""
    place = Parameter("place", "1", 1.0, grid=(-0.8, -0.4, 0.0, 0.4, 0.8))
    bump = Effect("bump", "air", (Parameter("a", "1", 0.5), place))
    made = replace(problem({}), catalogue=(bump,), predict=bumped)
    made = replace(made, data=made.data + predict_all(made, {"a": 0.2, "place": 0.5}) - predict_all(made, {}))
    context, catalogue = context_of(made), screen.expand(made, {})
    wrong = Point(np.array([2.0, -2.0]), np.array([0.3]), np.array([-0.6]))
    was = refit.fit(context, Hypothesis((bump,)), [wrong], context.stated(), None, 0.0)
    assert abs(was.fit.values["place"] - 0.5) > 0.5
    now = max(growth._placed_anew(context, catalogue, was), key=lambda s: s.fit.log_evidence)
    assert now.fit.converged and abs(now.fit.values["place"] - 0.5) < 4 * now.fit.sigma["place"]


def test_what_came_near_and_was_cut_off_leads_before_what_converged_far_from_the_data():
    """Scenario: a defocus converged where it misses the data; a haze came near them and was cut off."""
    context = context_of(problem({}))

    def fit(name, log_z, converged, residual):
        found = SimpleNamespace(effects=(name,), log_evidence=log_z, converged=converged)
        return SimpleNamespace(fit=found, residual=np.full(len(context.problem.data), residual * NOISE))

    far, near, good = fit("defocus", 10.0, True, 3.0), fit("haze", 50.0, False, 1.0), fit("lean", 5.0, True, 0.9)
    assert growth.leader(context, {s.fit.effects: s for s in (far, near)}) is near
    assert growth.leader(context, {s.fit.effects: s for s in (far, near, good)}) is good


def twisted(values, block):
    """Two ways to widen a line as the square of a size of either sign: a blur evenly, a twist more to one side."""
    (y, w), t = np.split(predict(values, block), 2), values.get("t", 0.0)
    return np.concatenate([y + 0.03 * t * X**3, np.sqrt(w**2 + 2 * values.get("b", 0.0) ** 2 + t**2 * (2 + X))])


def test_what_widens_as_its_square_is_tried_in_place_of_what_widens_too():
    """Scenario: beside the lean a blur was found where a twist is. About the lean alone a twist of either sign does
    nothing to first order, so that it was never tried."""
    blur, twist = (Effect(e, "source", (Parameter(p, "1", 1.0),)) for e, p in (("blur", "b"), ("twist", "t")))
    truth = {"t": 0.5, "l": 0.3}
    made = replace(problem({}), catalogue=(CATALOGUE[2], blur, twist), predict=twisted)
    made = replace(made, data=made.data + predict_all(made, truth) - predict_all(made, {}))
    context, catalogue = context_of(made), screen.expand(made, {})
    h, point = Hypothesis((CATALOGUE[2], blur)), Point(np.zeros(2), np.array([0.3, 0.5]), np.zeros(0))
    known, prior = Known(context.curvature.first, point.nuisance), screen.log_prior(h.names, list(catalogue.effects))
    best = refit.fit(context, h, [point], known, None, prior)
    found = list(growth._bent_otherwise(context, catalogue, best, {h.names: best}))
    assert {s.fit.effects for s in found} == {("lean", "twist")}
    now = max(found, key=lambda s: s.fit.log_evidence)
    assert best.fit.converged and now.fit.converged and now.fit.log_evidence > best.fit.log_evidence + 20
    assert all(abs(abs(now.fit.values[n]) - x) < 4 * now.fit.sigma[n] for n, x in truth.items())
    assert not list(growth._bent_otherwise(context, catalogue, best, {h.names: best, ("lean", "twist"): now}))


def test_what_was_weighed_far_from_the_data_is_weighed_again_where_a_fit_is_good():
    """Scenario: about a null that misses the data by far a pair was promised hundreds, and no refit was left for it."""
    made = problem({"q": 0.5})
    context, catalogue = context_of(made), screen.expand(made, {})
    done = {names: fitted(context, names, size) for names, size in {(): (), ("defocus",): [0.4]}.items()}
    good = done[("defocus",)]
    pair, beside = ("haze", "lean"), ("defocus", "lean")

    def recanted(fits):
        log_z = {**{e: s.fit.log_evidence for e, s in fits.items()}, pair: 1e4, beside: 1e4}
        table = Table(log_z, dict.fromkeys(fits, ()))
        table.source.update({pair: (), beside: ("defocus",)})
        white = context.whiten(catalogue.columns)
        search._recant(search._Walk(context, catalogue, white, table, fits, fits[()], False, False, catalogue))
        return table

    table = recanted(done)
    assert refit.misses(context, done[()]) and not refit.misses(context, good)
    assert table.log_z[pair] < good.fit.log_evidence - 5 and table.source[pair] == ("defocus",)
    assert table.log_z[beside] == 1e4
    assert recanted({(): done[()]}).log_z[pair] == 1e4


def spilling(values, block):
    """A spill moves the line by its square, along it more and more, and widens it but where it is a whole number."""
    (y, w), q = np.split(predict(values, block), 2), values.get("spill", 0.0)
    return np.concatenate([y + 0.03 * q * X**3, w + 0.05 * np.abs(np.sin(np.pi * q)) + 0.02 * q * X])


def test_what_goes_on_otherwise_than_it_starts_is_weighed_from_afar():
    """Scenario: the spill's first tenth makes the line wider than it is, so that from 0 it looks worse than nothing."""
    spill = Effect("spill", "camera", (Parameter("spill", "px", 1.0, one_sided=True),))
    made = replace(problem({}), catalogue=(*CATALOGUE[::2], spill), predict=spilling)
    made = replace(made, data=made.data + predict_all(made, {"spill": 1.95}) - predict_all(made, {}))
    context, catalogue = context_of(made), screen.expand(made, {})
    null = fitted(context, (), ())
    white = context.whiten(catalogue.columns)
    log_z = screen.screen(null.fit.linear, catalogue, white, context.scales, context.weights)
    table = Table(dict(log_z), dict.fromkeys(log_z, ()))
    search._foresee_one_sided(context, catalogue, table)
    assert table.log_z[("spill",)] > log_z[("spill",)] + 10
    assert table.begin[("spill",)][0].amplitude == pytest.approx([1.95], abs=0.1)
    assert all(table.log_z[e] == z for e, z in log_z.items() if e != ("spill",))

    # A null that does not miss the data leads nowhere else: the fit begins in both valleys and ends in the deeper.
    context = context_of(replace(made, covariance=tuple(2 * c for c in made.covariance)))
    null = fitted(context, (), ())
    near, far = (
        attempt.attempt(context, catalogue, ("spill",), null, {(): null}, 0.0, begin).fit
        for begin in ((), table.begin[("spill",)])
    )
    assert not refit.strayed(context, null) and near.values["spill"] < 1
    assert far.converged and far.values["spill"] == pytest.approx(1.95, abs=0.1)
    assert far.log_evidence > near.log_evidence + 5


@pytest.mark.parametrize("jump", [0.0, 1.0])
def test_no_name_rests_on_a_gain_that_is_promised_and_cannot_be_had(jump):
    """Scenario: the line is bent as by a tilted pane, but the pane, which would bow it too, is not there: about a pane
    that is turned by nothing and not there either, its derivatives promise all of the bend."""

    def through(values, block):
        tilt = values.get("t", 0.0)
        y, w = np.split(predict(values, block), 2)
        return np.concatenate([y + 0.1 * tilt * X**3 + jump * X**2 * (tilt != 0), w])

    pane = Effect("pane", "air", (Parameter("t", "deg", 1.0),))
    made = replace(problem({}), catalogue=(*CATALOGUE[2:], pane), predict=through)
    made = replace(made, data=made.data + np.tile(np.append(0.1 * X**3, 0 * X), 2))
    context, catalogue = context_of(made), screen.expand(made, {})
    null = fitted(context, (), ())
    found = attempt.attempt(context, catalogue, ("pane",), null, {(): null}, 0.0).fit
    assert found.log_evidence > null.fit.log_evidence + refit.OWED
    assert found.converged == (jump == 0) and (found.values["t"] == 0) == (jump != 0)
