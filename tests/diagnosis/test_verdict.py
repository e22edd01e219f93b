"""The rules of design 2.5, one by one."""

from dataclasses import replace

import numpy as np
import pytest
from toy import toy

from benchsim.diagnosis import settings
from benchsim.diagnosis.degeneracy import Claim, Weighed
from benchsim.diagnosis.discrepancy import Attached
from benchsim.diagnosis.hypothesis import Fit
from benchsim.diagnosis.remainder import Family, Remainder
from benchsim.diagnosis.result import VERDICTS, Location
from benchsim.diagnosis.verdict import Findings, Further, confidence, found, verdict

GOOD = Remainder({"c": Family(12.0, 12, 0.5, 0.0)})
HERE, OPEN = Location("screen", "x", True, 9.0, ()), Location("screen", "x", False, 2.0, ())
MUCH, LITTLE, LOUD = Further(40.0, 0.3, False), Further(40.0, 0.01, False), Further(40.0, 0.01, True)
CHANCE = Further(3.0, 0.8, True)
PROBLEM = toy()


def laid(log_evidence):
    empty = np.zeros(0)
    return Attached(PROBLEM.attachments[0], log_evidence, empty, 0.1, 0.3, 1.0, empty, empty[:, None], None)


def findings(log_evidence=50.0, free=(10.0,), more=(48.0,), classes=(), further=(), named=True, **also):
    claim = Claim(("bow",), () if classes else ("bow",), classes) if named else None
    return Findings(
        0.0,
        claim,
        log_evidence if named else 0.0,
        tuple(map(laid, free)),
        tuple(map(laid, more if named else free)),
        GOOD,
        tuple(further),
        **also,
    )


def test_nothing_is_missing_only_where_neither_names_nor_anything_that_matters_say_more():
    assert verdict(findings(named=False), None) == "nothing-missing"
    assert verdict(findings(named=False, further=[CHANCE]), OPEN) == "nothing-missing"
    assert verdict(findings(named=False, further=[Further(5.0, np.inf, False)]), OPEN) == "unexplained"
    assert verdict(findings(named=False, further=[Further(5.0, np.inf, False)]), HERE) == "located"


def test_what_is_left_changes_the_verdict_by_its_size_not_by_its_significance():
    two = ((("bow",), ("lean",)),)
    assert verdict(findings(), HERE) == "named"
    assert verdict(findings(classes=two), HERE) == "class"
    for little in (LITTLE, CHANCE):
        assert verdict(findings(further=[little]), HERE) == "named"
    for much in (MUCH, LOUD):
        assert verdict(findings(further=[much]), OPEN) == "unexplained"
        assert verdict(findings(further=[much]), HERE) == "located"
    assert {verdict(findings(further=f, classes=c), HERE) for f in ((), (MUCH,)) for c in ((), two)} <= set(VERDICTS)


def test_a_part_counts_where_a_hypothesis_touches_the_family():
    before = Remainder({"c": Family(212.0, 12, 1e-30, 1.0), "m": Family(40.0, 12, 1e-4, 0.1)})
    after = Remainder({"c": Family(62.0, 12, 1e-7, 0.3), "m": Family(40.0, 12, 1e-4, 0.1)})
    assert after.part_of(before) == pytest.approx(50 / 150)
    assert after.alarming == ("c", "m")
    # Marks that show as much as before say nothing of a name that they do not see.
    assert Remainder({**after.families, "c": Family(12.0, 12, 0.5, 0.0)}).part_of(before) == 0


def test_p_is_worth_no_more_than_odds_allow():
    assert Remainder({"c": Family(26.0, 12, 0.01, 0.0)}).odds == pytest.approx(np.log(1 / (np.e * 0.01 * np.log(100))))
    assert Remainder({"c": Family(9.0, 12, 0.6, 0.0)}).odds == 0


def test_a_name_below_the_best_function_gives_way_where_that_predicts_better():
    worse = findings(log_evidence=50.0, free=(51.0,), more=(48.0,))
    assert worse.margin == pytest.approx(-1) and not worse.stands
    assert verdict(worse, OPEN) == "unexplained" and verdict(worse, HERE) == "located"
    assert replace(worse, outdone=2.9).stands and verdict(replace(worse, outdone=2.9), HERE) == "named"
    assert not replace(worse, outdone=3.1).stands


def test_what_predicts_is_stated_whatever_its_name_is_worth():
    """Below the best function it is provisional where it predicts left-out settings better than what is stated."""
    worse = findings(log_evidence=50.0, free=(51.0,), more=(48.0,), outdone=5.0, predicted=12.0)
    ((one,), notes) = found(PROBLEM, worse, fit(), sure(0.999), ("bow",), (1.0, 0.1))
    assert one.confidence == "provisional" and notes == ()
    none, notes = found(PROBLEM, replace(worse, predicted=2.0), fit(), sure(0.999), ("bow",), (1.0, 0.1))
    assert none == () and "bow" in notes[0]


def test_a_function_that_gains_more_takes_a_names_place_however_much_both_gain():
    """A dent that an unknown height gains 2500 for is no plume, though a plume of gain 800 makes the height fit better:
    the height's knots are coarse."""
    dent = findings(log_evidence=800.0, free=(2500.0,), more=(3300.0,))
    assert not dent.stands and verdict(dent, HERE) == "located"
    assert found(PROBLEM, dent, fit(), sure(0.999), ("bow",), (1.0, 0.1))[0] == ()
    assert findings(log_evidence=2400.0, free=(1500.0,), more=(3300.0,)).stands


def test_a_name_stands_beside_a_function_that_explains_something_else():
    """A bow of gain 300 beside light that wanders, whose function gains 400 without the bow and the same beside it."""
    beside = findings(log_evidence=300.0, free=(400.0,), more=(700.0,), further=[LOUD], beside=True)
    assert beside.stands and verdict(beside, HERE) == "located"
    ((one,), _) = found(PROBLEM, beside, fit(), sure(0.999), ("bow",), (1.0, 0.1))
    assert one.confidence == "named"


@pytest.mark.parametrize(
    ("probability", "margin", "also", "said"),
    [
        (0.99, 3.0, {}, "named"),
        (0.989, 30.0, {}, "probable"),
        (0.999, 2.9, {}, "probable"),
        (0.9, 0.0, {}, "probable"),
        (0.89, 30.0, {}, None),
        (0.89, 30.0, {"predicted": 3.0}, "provisional"),
        (0.999, -0.1, {}, None),
        (0.999, -0.1, {"predicted": 9.0}, "provisional"),
        (0.999, 30.0, {"apart": {"bow": 2.9}}, "probable"),
        (0.999, 30.0, {"apart": {"bow": -0.1}}, None),
        (0.999, 30.0, {"apart": {"plume": -0.1}}, "named"),
        # Whatever is left, a name stands that is seen to predict what it was not fitted to.
        (0.999, 30.0, {"further": (MUCH,)}, "named"),
        (0.999, 30.0, {"further": (MUCH,), "predicted": 3.0}, "named"),
        (0.999, 30.0, {"further": (MUCH,), "predicted": 2.9}, None),
        (0.999, -0.1, {"further": (MUCH,), "predicted": 1.0}, None),
    ],
)
def test_thresholds(probability, margin, also, said):
    assert confidence("bow", probability, findings(free=(50.0 - margin,), **also)) == said


def fit():
    empty = np.zeros((0, 0))
    return Fit(("bow",), 50.0, {"bow": 0.12}, {"bow": 0.01}, empty, 1.0, 0.0, True, None, np.zeros(9))


def sure(p):
    return Weighed({(): np.log(1 - p), ("bow",): np.log(p)})


def test_what_is_found_carries_the_catalogue_s_sentences_and_sizes():
    ((one,), notes) = found(PROBLEM, findings(), fit(), sure(0.999), ("bow",), (1.0, 0.1))
    assert (one.name, one.element, one.confidence) == ("bow", "screen", "named")
    assert one.says == "bow is there." and one.remedy == "Mend bow."
    assert one.parameters["bow"].value == 0.12 and one.parameters["bow"].sigma == 0.01
    assert one.probability == pytest.approx(0.999) and notes == ()


def test_setting_errors_are_found_like_any_effect_with_their_scale():
    weighed = Weighed({(): np.log(0.001), (settings.NAME,): np.log(0.999)})
    ((one,), _) = found(PROBLEM, findings(), fit(), weighed, (settings.NAME,), (2.9, 0.3))
    assert (one.name, one.element, one.confidence) == ("setting-errors", "settings", "named")
    assert (one.parameters["scale"].value, one.parameters["scale"].sigma) == (2.9, 0.3)


def test_what_is_not_likely_is_a_note_and_no_more():
    none, notes = found(PROBLEM, findings(), fit(), sure(0.8), ("bow",), (1.0, 0.1))
    assert none == () and "bow" in notes[0] and "0.80" in notes[0]
