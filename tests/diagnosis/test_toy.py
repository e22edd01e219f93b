"""End to end on an instrument that is no bench: what was put in comes out, and what has no name gets none.

Rationale: `diagnose` may know nothing but the problem it is handed. Set-up: straight lines at eight angles (`toy`),
seven effects of which two are all but one, three functions without a name. Expected: the verdict that the rules of the
design ask for, with sizes within 3 sigma.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
from toy import NOISE, POINTS, hats, toy

from benchsim.diagnosis import diagnose, naming
from benchsim.diagnosis.decision import judge


def test_clean_lines_lack_nothing_and_the_limits_are_stated():
    # Of eight settings, 3 % of clean sets leave open whether those were set as well as stated; of sixteen, none.
    problem = toy(seed=3, blocks=16)
    steps = []
    d = diagnose(problem, lambda what, done: steps.append(done))
    assert d.verdict == "nothing-missing" and d.effects == () and d.classes == () and d.law is None
    assert set(d.limits) == {e.name for e in problem.catalogue}
    assert all(np.isfinite(v.five_sigma) for v in d.limits.values())
    assert d.held_out.folds == 6 and abs(d.held_out.excess_chi2_before) < 4 * d.held_out.sigma
    assert d.sigma_scale == pytest.approx(1, abs=0.15) and d.setting_scale < 2.5
    assert steps == sorted(steps) and steps[-1] == 1
    text = d.as_dict()
    assert json.loads(json.dumps(text))["verdict"] == "nothing-missing"
    assert text["fit"]["rms_mm"]["before"] == pytest.approx(0.05, abs=0.01)


def test_one_effect_is_named_sized_and_taken_away():
    d = diagnose(toy({"bow": 0.2}, 4))
    assert d.verdict == "named"
    (one,) = d.effects
    assert (one.name, one.element, one.confidence) == ("bow", "screen", "named")
    assert abs(one.parameters["bow"].value - 0.2) < 3 * one.parameters["bow"].sigma < 0.1
    assert one.says and one.remedy
    assert d.location.element == "screen" and d.location.claimed
    before, after = d.rms["c"]
    assert after < 0.055 < before
    assert d.held_out.fraction_removed > 0.8
    assert "bow" not in d.limits and "lean" in d.limits
    assert d.next == ()
    assert d.residuals.held_out_after.shape == d.residuals.sigma.shape == d.residuals.before.shape


def test_two_effects_are_named_together():
    d = diagnose(toy({"bow": 0.2, "creep": 3.0}, 5))
    assert d.verdict == "named"
    assert [f.name for f in d.effects] == ["bow", "creep"]
    for f, true in zip(d.effects, (0.2, 3.0), strict=True):
        (size,) = f.parameters.values()
        assert abs(size.value - true) < 3 * size.sigma


def test_what_cannot_be_told_apart_is_a_class_with_what_would_split_it():
    d = diagnose(toy({"lens_a": 0.5}, 6))
    assert d.verdict == "class" and d.effects == ()
    (group,) = d.classes
    assert {m for (m,) in group.members} == {"lens-a", "lens-b"}
    assert group.probability > 0.99
    assert "microscope" in group.split_by.what and group.split_by.separation_sigma > 10
    assert d.next[0] == group.split_by
    assert d.location.element == "camera"


def test_a_sure_effect_beside_a_class_is_still_named():
    d = diagnose(toy({"bow": 0.25, "lens_b": 0.5}, 7))
    assert d.verdict == "class"
    assert [f.name for f in d.effects] == ["bow"]
    assert {m for (m,) in d.classes[0].members} == {"lens-a", "lens-b"}


def test_an_effect_without_a_name_is_located_and_a_smooth_one_gets_its_law():
    d = diagnose(toy({"bow": 0.4}, 8, without=("bow",)))
    assert d.verdict == "located" and d.effects == ()
    assert d.location.element == "screen" and d.location.claimed and d.location.margin > 5
    assert list(d.law.terms) == ["x^2"] and d.law.terms["x^2"] == pytest.approx(0.4, abs=0.05)
    before, after = d.rms["c"]
    assert after < 0.055 < before


def test_what_is_left_is_stated_as_large_as_it_is_beside_what_settings_can_do():
    """Scenario: a warp of 0.13 mm rms that has no name. Offsets and slopes are set by hand and take up a little of it;
    the rest, of every line a straight one taken off, is what the data show."""
    problem = toy({"warp": 0.3}, 11)
    (left,) = diagnose(problem).left
    x = np.linspace(-1, 1, 24)
    warps = [0.3 * t * np.cos(5 * x) for t in np.linspace(-1, 1, 8) + 0.03 * np.sin(np.arange(8))]
    true = np.sqrt(np.mean([(w - np.polyval(np.polyfit(x, w, 1), x)) ** 2 for w in warps]))
    assert left.family == "c" and left.rms == pytest.approx(true, rel=0.1)


def test_an_effect_beside_something_without_a_name_is_found_and_nothing_else_is():
    """Scenario: a bow, and a lean that has no name and is twice as large. The catalogue's own lean takes up a part of
    that; beside the function that explains it, it explains nothing. Bows add so little to what the function gains that
    they could be its patch, so that they are provisional, and a fifth of them (6 of 30), which settings left out do not
    show at 3 sigma, are not found: of ten, fewer than five would be in 1 % of runs.
    """
    said = [{f.name for f in diagnose(toy({"bow": 0.2, "warp": 0.3}, seed)).effects} for seed in range(620, 630)]
    assert sum("bow" in names for names in said) >= 5
    assert sum(bool(names - {"bow"}) for names in said) <= 1


def test_what_can_only_be_taken_for_noise_is_not_named_but_said():
    # Neither a name nor a function reaches it: it counts as noise that neighbours share, and the notes say so.
    d = diagnose(toy({"warp": 0.3}, 9, attached=False))
    assert d.effects == () and d.classes == ()
    assert d.location is None or not d.location.claimed
    assert any("Errors of kind c" in n and "correlated" in n for n in d.notes)


@pytest.mark.parametrize(("seeds", "may_miss"), [(12, 2), pytest.param(50, 5, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("truth", "without", "element"), [({"lean": 0.2}, ("lean",), "mirror"), ({"warp": 0.08}, (), "mirror")]
)
def test_what_the_catalogue_lacks_is_rarely_given_a_wrong_name(truth, without, element, seeds, may_miss):
    # At SNR 10 to 15. A wrong name in 10 % of cases is the bar: of 50, 1 or fewer would happen at 10 % in 3 % of runs,
    # so passing shows that the rate is below the bar; of 12, a name in 1 % fails in 0.6 % of runs and one in 34 %
    # passes in 5 %. Locations, where claimed, are right in 9 of 10; of 12, 95 % right fails in 2 % of runs and 56 %
    # passes in 5 %.
    wrong = claimed = right = 0
    for seed in range(400, 400 + seeds):
        problem = toy(truth, seed, without=without)
        judged = judge(problem, naming.name(problem))
        wrong += judged.verdict in ("named", "class") or bool(judged.found)
        if judged.place is not None and judged.place.claimed:
            claimed += 1
            right += judged.place.element == element
    assert wrong <= 1
    assert claimed >= seeds / 2
    assert right >= claimed - may_miss


def test_clean_lines_lack_nothing_but_better_settings_where_those_are_worse_than_stated():
    # Of 10 seeds with settings three times as bad, two or more are named in 0.4 % of runs at the 1 % that is aimed at;
    # one or none in 5 % at 39 %.
    named = 0
    for seed in range(500, 510):
        problem = toy({}, seed, setting_scale=3.0)
        named += bool({f.name for f in judge(problem, naming.name(problem)).found} - {"setting-errors"})
    assert named <= 1


@pytest.mark.parametrize(("size", "seed", "said"), [(0.08, 24, "class"), (0.12, 32, "named")])
def test_what_is_suspected_or_probable_comes_with_what_would_settle_it(size, seed, said):
    d = diagnose(toy({"lens_a": size}, seed, without=("lens-b",), attached=False))
    assert d.verdict == said and all(f.confidence == "probable" for f in d.effects)
    assert d.effects or {m for c in d.classes for m in c.members} == {(), ("lens-a",)}
    assert d.next and d.next[0].what == "the line through a microscope"


def test_settings_three_times_as_bad_are_what_is_found():
    d = diagnose(toy({}, 3, setting_scale=3.0))
    assert d.verdict == "named"
    (one,) = d.effects
    size = one.parameters["scale"]
    assert (one.name, one.element) == ("setting-errors", "settings")
    assert abs(size.value - 3) < 3 * size.sigma


@pytest.mark.parametrize("lead", [1.0, -1.0])
def test_an_effect_in_whose_place_settings_could_be_further_off_is_left_open(lead):
    """Scenario: a bow beyond doubt, and a creep that settings twice as far off as stated would explain as well. Which
    of the two it is the data cannot tell; the bow is named in either case.
    """
    problem = toy({"bow": 0.2, "creep": 3.0}, 5, attached=False)
    naming_ = naming.name(problem)
    both = next(f for f in naming_.fits if f.effects == ("bow", "creep"))
    within, far = np.where(naming_.setting_scales < 1.5, [[0.0], [-40.0]], [[-40.0], [0.0]])
    both = replace(both, log_scales=both.log_evidence + within)
    alone = next(f for f in naming_.fits if f.effects == ("bow",))
    alone = replace(alone, log_evidence=both.log_evidence + lead, log_scales=both.log_evidence + lead + far)
    fits = (
        *(f for f in naming_.fits if f.effects not in (("bow",), ("bow", "creep"))),
        both,
        replace(alone, converged=True),
    )
    judged = judge(problem, replace(naming_, fits=fits))
    assert judged.best.claim.lone == ("bow",)
    assert {m for c in judged.best.claim.classes for m in c} == {("creep",), ("setting-errors",)}


def test_what_is_new_in_every_block_has_no_place():
    """Light that wanders by six sigma, along each line in its own way; a function without a place may say just that."""
    problem = toy(seed=21)
    rng, knots = np.random.default_rng(7), np.linspace(-1, 1, 13)
    data, basis = problem.data.copy(), np.zeros((len(problem.data), 13 * len(problem.names)))
    for b in range(len(problem.names)):
        rows = slice(problem.rows(b).start, problem.rows(b).start + POINTS)
        basis[rows, 13 * b : 13 * b + 13] = hats(knots, np.linspace(-1, 1, POINTS))
        data[rows] += 6 * NOISE * np.cos(4 * np.linspace(-1, 1, POINTS) + rng.uniform(0, 2 * np.pi))
    height = problem.attachments[0]
    each = np.repeat(np.arange(len(problem.names)), 13)
    anew = replace(
        height, name="time.anew", element="time", coordinate="x, anew in every line", basis=basis,
        knots=np.tile(knots, len(problem.names))[:, None], component=each,
    )  # fmt: skip
    d = diagnose(replace(problem, data=data, attachments=(*problem.attachments, anew)))
    assert d.verdict == "unexplained" and d.effects == () and d.law is None
    assert d.location.element == "time" and not d.location.claimed
