"""Settings left out: the expectation, the isolation of each fold, and what is removed."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from toy import toy

from benchsim.diagnosis import cross_validation, degeneracy, diagnose, functions, naming


def prepared(problem):
    found = naming.name(problem)
    best = next(f for f in found.fits if f.converged)
    return (
        found,
        cross_validation.folds(problem, found, degeneracy.about(found.linear, best)),
        functions.prepare(problem, found.noise.covariance),
    )


def test_clean_settings_have_no_excess():
    # Excess over its stated sigma, 10 seeds: mean within 1 of 0 (3 sigma), scatter of order one (χ² of 9 degrees of
    # freedom leaves 0.36 … 1.76 once in a thousand). Choosing among 25 explanations costs nothing here.
    z = []
    for seed in range(10):
        problem = toy(seed=300 + seed)
        _, many, ready = prepared(problem)
        shown = cross_validation.show(problem, many, ready)
        z.append(shown.held_out.excess_chi2_after / shown.held_out.sigma)
        assert shown.held_out.data == len(problem.data) and shown.held_out.folds == 6
    assert abs(np.mean(z)) < 1
    assert 0.36 < np.std(z, ddof=1) < 1.76


def test_every_setting_is_left_out_once_with_all_its_lines():
    problem = toy(blocks=8, per_group=2)
    _, many, _ = prepared(problem)
    assert len(many) == 4
    assert (sum(f.test.astype(int) for f in many) == 1).all()
    for f in many:
        inside = {problem.groups[b] for b in np.unique(problem.block[f.test])}
        outside = {problem.groups[b] for b in np.unique(problem.block[~f.test])}
        assert not inside & outside


def test_fewer_than_three_settings_cannot_be_left_out():
    problem = toy(blocks=4, per_group=2)
    _, many, ready = prepared(problem)
    assert many == () and cross_validation.show(problem, many, ready) is None


def test_a_fold_knows_nothing_of_what_it_leaves_out():
    # Choice, amplitudes, scale and noise of a fold stay the same whatever is written into the data that it leaves out.
    problem = toy({"bow": 0.2}, 7)
    found, many, ready = prepared(problem)
    best = next(f for f in found.fits if f.converged)
    before = cross_validation.predict(problem, many[2], ready, cross_validation.choices(problem, many[2]))
    spoilt = np.where(many[2].test, 40.0 * np.sin(np.arange(len(problem.data))), 0.0)
    lines = degeneracy.about(found.linear, best)
    spoilt_null = replace(found, linear=replace(found.linear, residual=found.linear.residual + spoilt))
    again = cross_validation.folds(problem, spoilt_null, replace(lines, residual=lines.residual + spoilt))[2]
    after = cross_validation.predict(problem, again, ready, cross_validation.choices(problem, again))
    assert after.chosen == before.chosen == "bow"
    assert after.scale == before.scale
    assert again.naming.noise.scale == many[2].naming.noise.scale
    kept = ~again.test
    assert after.after[kept] == pytest.approx(before.after[kept], abs=1e-9)
    # What was written in is all that differs where it was written in.
    change = (after.after - before.after)[again.test]
    assert np.abs(change).max() > 10


def test_a_large_effect_is_taken_away_by_folds_that_never_saw_the_setting():
    problem = toy({"bow": 0.6, "lens_b": 1.0}, 8)
    _, many, ready = prepared(problem)
    shown = cross_validation.show(problem, many, ready)
    assert shown.held_out.excess_chi2_before > 60 * np.sqrt(2 * len(problem.data))
    assert shown.held_out.fraction_removed > 0.95
    # Each fold chooses by itself, and may prefer either lens.
    assert set(shown.chosen) <= {"bow+lens-a", "bow+lens-b"}
    c = problem.kind == "c"
    assert np.std(shown.after[c]) < 0.06 < 0.1 < np.std(shown.before[c])


def test_where_the_effect_has_no_name_a_function_is_chosen():
    problem = toy({"warp": 0.3}, 9)
    _, many, ready = prepared(problem)
    shown = cross_validation.show(problem, many, ready)
    assert set(shown.chosen) == {"mirror.lean"}
    assert shown.held_out.fraction_removed > 0.8


def test_what_a_function_explains_is_no_noise():
    """A bump of 60 times the noise, sharper than the smoothest functions: as errors that neighbours share it would make
    the left-out data fit far too well, and hide how much they were missed by before."""
    d = diagnose(toy({"bump": 3.0}, 6))
    assert d.verdict == "located" and d.law is not None
    assert d.sigma_scale < 1.5 and d.correlation == 0.0
    assert abs(d.held_out.excess_chi2_after) < 4 * d.held_out.sigma
    # The bump's own square in the noise's units, settings aside: sum of its values over 8 lines.
    x = np.linspace(-1, 1, 24)
    bump = 3.0 * np.exp(-(((x - 0.3) / 0.25) ** 2)) / 0.05
    assert 0.3 * 8 * (bump**2).sum() < d.held_out.excess_chi2_before < 8 * (bump**2).sum()


def test_a_fold_without_an_amplitude_keeps_the_names_of_the_others():
    """A function beside a hypothesis whose first amplitude a fold has not."""
    problem = toy({"bow": 0.2}, 7, blocks=3)
    found, many, _ = prepared(problem)
    first, second = found.linear.names[:2]
    fold = many[0]
    short = replace(fold.linear, effect=fold.linear.effect[:, 1:], names=fold.linear.names[1:])
    on = SimpleNamespace(linear=SimpleNamespace(names=(first, second)))
    laid = SimpleNamespace(attachment=problem.attachments[0])
    model = cross_validation.function(problem, (replace(fold, linear=short),), laid, on)
    assert model.about[0].names == (second,)
    np.testing.assert_array_equal(model.about[0].effect[:, 0], fold.linear.effect[:, 1])
