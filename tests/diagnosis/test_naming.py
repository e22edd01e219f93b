"""How often the right name is given, and a wrong one, on a problem that is no bench; and what a naming holds.

Fixed seeds. Thresholds are binomial: each test states how often a tool as good as is aimed at would fail it by chance,
and how bad one would have to be to pass it in one run of twenty. The bars themselves need more sets: those are marked
slow.
"""

from dataclasses import replace

import lines
import numpy as np
import pytest

from benchsim.diagnosis import degeneracy, linear, name, settings

AMPLITUDES = [p for e in lines.CATALOGUE for p in e.parameters if not p.grid]
SURE = 0.99


def probability(found):
    names = [e.name for e in lines.CATALOGUE]
    return degeneracy.weighed(found, True).present([*names, settings.NAME])


def sure(found):
    """Effects beyond doubt; what is said of the settings is `scaled`."""
    return {k for k, v in probability(found).items() if v > SURE and k != settings.NAME}


def scaled(found):
    return probability(found)[settings.NAME]


def drawn(effect, snr, rng, gram):
    """Values of an effect in a random direction whose whitened norm beside the settings is ``snr``."""
    own = [i for i, a in enumerate(AMPLITUDES) if a in effect.parameters]
    direction = rng.normal(size=len(own))
    direction = np.array([abs(d) if AMPLITUDES[i].one_sided else d for i, d in zip(own, direction, strict=True)])
    direction *= snr / np.sqrt(direction @ gram[np.ix_(own, own)] @ direction)
    values = {
        AMPLITUDES[i].name: d ** (1 / AMPLITUDES[i].power) if d > 0 else d for i, d in zip(own, direction, strict=True)
    }
    if effect.name == "ripple":
        values["period"] = rng.uniform(0.5, 0.9)
    return values


@pytest.fixture(scope="module")
def gram():
    problem, _ = lines.problem()
    about = linear.linearise(problem, {"period": 0.7}, tuple(AMPLITUDES))
    return linear.marginal(about, about.effect).gram


@pytest.mark.parametrize(("sets", "most"), [(24, 1), pytest.param(200, 4, marks=pytest.mark.slow)])
def test_clean_sets_are_named_nothing(sets, most):
    """A name in 1 % of sets fails 24 of them in 2 % of runs, a name in 18 % passes in 5 %; 200 of them hold the bar,
    2 %. P also has to be honest on average."""
    wrong, unconverged, told = 0, 0, 0.0
    for seed in range(sets):
        found = name(lines.problem(seed=seed)[0])
        wrong += bool(sure(found))
        unconverged += not found.null.converged
        told += max(p for k, p in probability(found).items() if k != settings.NAME)
    assert wrong <= most
    assert unconverged == 0
    assert told / sets < 0.1


@pytest.mark.parametrize("sets", [8, pytest.param(20, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "how", [{"sigma": 1.3}, {"setting_scale": 3.0}, {"correlated": 1.0}], ids=["sigma", "settings", "correlated"]
)
def test_wrong_statements_about_errors_name_nothing(how, sets):
    """One set may be wrong: of 8, a name in 1 % fails in 0.3 % of runs and one in 47 % passes in 5 %; of 20, 1.7 % and
    22 %. Twelve errors three times as large as stated show it at even odds in 97 % of sets: three misses of 8 happen in
    0.1 % of runs."""
    found = [name(lines.problem(seed=seed, **how)[0]) for seed in range(sets)]
    assert sum(bool(sure(f)) for f in found) <= 1
    if how.get("setting_scale"):
        assert sum(scaled(f) < 0.5 for f in found) <= 2


@pytest.mark.parametrize(
    ("sets", "least", "spread"), [(12, 10, (0.5, 1.57)), pytest.param(48, 46, (0.8, 1.25), marks=pytest.mark.slow)]
)
def test_singles_are_named_and_sized(gram, sets, least, spread):
    """Every effect in turn at SNR 8. Of 12, at the bar of 95 % two or fewer are missed in 98 % of runs, and a tool that
    names 56 % passes in 5 %; 48 hold the bar. Pulls of their parameters: 16 to 20 leave the spread in 0.2 % of runs."""
    rng, exact, pulls = np.random.default_rng(1), 0, []
    for i in range(sets):
        effect = lines.CATALOGUE[i % 6]
        problem, truth = lines.problem(drawn(effect, 8.0, rng, gram), seed=500 + i)
        found = name(problem)
        exact += sure(found) == {effect.name}
        best = found.fits[0]
        if best.effects == (effect.name,):
            assert best.converged
            pulls += [(best.values[p.name] - truth.get(p.name, 0)) / best.sigma[p.name] for p in effect.parameters]
    assert exact >= least
    assert spread[0] < np.std(pulls) < spread[1]
    # More than one of 20 beyond three sigma: 0.1 % of runs.
    assert np.sum(np.abs(pulls) > 3) <= max(1, 0.03 * len(pulls))


def test_the_setting_scale_is_found_and_costs_no_name(gram):
    """Twelve errors know the scale to a fifth, and its prior takes a third of it back (2.1 in the mean): the median of
    three sets lies between the bounds in 99 % of runs."""
    rng, scales = np.random.default_rng(2), []
    for seed in range(3):
        problem, _ = lines.problem(drawn(lines.CATALOGUE[1], 12.0, rng, gram), seed=seed, setting_scale=3.0)
        found = name(problem)
        assert sure(found) == {"turn"} and scaled(found) > 0.3
        scales.append(found.fits[0].setting_scale)
    assert 1.4 < np.median(scales) < 4.5


@pytest.mark.parametrize(("sets", "least"), [(8, 6), pytest.param(16, 14, marks=pytest.mark.slow)])
def test_pairs(gram, sets, least):
    """Of 8, a tool that names 95 % fails in 0.6 % of runs, one that names 40 % passes in 5 %."""
    rng, exact = np.random.default_rng(3), 0
    for seed in range(sets):
        a, b = rng.choice(6, 2, replace=False)
        truth = drawn(lines.CATALOGUE[a], 10.0, rng, gram) | drawn(lines.CATALOGUE[b], 10.0, rng, gram)
        exact += sure(name(lines.problem(truth, seed=seed)[0])) == {lines.NAMES[a], lines.NAMES[b]}
    assert exact >= least


def test_three_effects_are_found_one_after_the_other():
    truth = {"turn": 0.4, "bow_1": 0.3, "tilt_0": 0.1, "tilt_1": -0.1}
    assert sure(name(lines.problem(truth, seed=1)[0])) == {"turn", "bow", "tilts"}


def test_what_a_naming_holds():
    problem, _ = lines.problem({"ripple": 0.1, "period": 0.66}, seed=3)
    told = []
    found = name(problem, lambda what, done: told.append(done))
    assert told == sorted(told) and told[-1] == 1.0
    assert {e for e, _, _ in found.screened} >= {("bow",), ("bow", "turn"), ("blur", "tilts")}
    assert [z for _, z, _ in found.screened] == sorted((z for _, z, _ in found.screened), reverse=True)
    assert found.fits[0].effects == ("ripple",) and any(f is found.null for f in found.fits)
    assert found.linear.names == tuple(p.name for p in AMPLITUDES)
    best = found.fits[0]
    assert best.linear.names == ("ripple",) and best.covariance.shape == (2, 2)
    assert best.sigma["period"] == pytest.approx(np.sqrt(best.covariance[1, 1]))
    assert {e: z for e, z, _ in found.screened}["ripple",] == best.log_evidence
    assert best.values["period"] == pytest.approx(0.66, abs=4 * best.sigma["period"])
    # Noise of unit variance once whitened, nothing left in the residual beside what was fitted.
    assert 450 < best.chi2 < 700


def test_the_same_data_give_the_same_naming():
    first, second = (name(lines.problem({"turn": 0.1}, seed=9)[0]) for _ in range(2))
    assert first.screened == second.screened


def test_predictions_are_counted_on():
    """Where settings hide an effect, what bends is fitted beside it too; even so refits stay below what differentiating
    everything once costs, twelve times over."""
    calls = []

    def predict(values, block):
        calls.append(block)
        return lines.predict(values, block)

    problem, _ = lines.problem({"turn": 0.5}, seed=3, predict=predict)
    calls.clear()
    name(problem)
    assert len(calls) < 4500


def test_data_that_cannot_be_used_are_refused():
    problem, _ = lines.problem()
    data = problem.data.copy()
    data[3] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        name(replace(problem, data=data))
    with pytest.raises(ValueError, match="block after block"):
        name(replace(problem, block=problem.block[::-1].copy()))
