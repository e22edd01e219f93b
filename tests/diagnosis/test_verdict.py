"""The rules of design 2.5, one by one."""

from dataclasses import replace

import numpy as np
import pytest
from toy import toy

from benchsim.diagnosis.attachments import Attached
from benchsim.diagnosis.classes import Claim, Weighed
from benchsim.diagnosis.fits import Fit
from benchsim.diagnosis.remainder import Remainder
from benchsim.diagnosis.result import VERDICTS, Location
from benchsim.diagnosis.verdict import Findings, confidence, found, verdict

GOOD, BAD = Remainder(0.5, {}), Remainder(1e-5, {})
HERE, OPEN = Location("screen", "x", True, 9.0, ()), Location("screen", "x", False, 2.0, ())
PROBLEM = toy()


def laid(log_evidence):
    empty = np.zeros(0)
    return Attached(PROBLEM.attachments[0], log_evidence, 0.1, 0.3, 1.0, empty, empty[:, None], None)


def findings(log_evidence=50.0, free=(10.0,), more=(48.0,), classes=(), left=GOOD, left_null=GOOD, named=True):
    claim = Claim(("bow",), () if classes else ("bow",), classes, 9.0) if named else None
    return Findings(
        0.0,
        claim,
        log_evidence if named else 0.0,
        tuple(map(laid, free)),
        tuple(map(laid, more if named else free)),
        left_null,
        left if named else left_null,
    )


def test_nothing_missing_only_where_neither_names_nor_functions_nor_modes_say_more():
    assert verdict(findings(named=False, free=(-3.0,)), None) == "nothing-missing"
    assert verdict(findings(named=False, free=(4.5,)), OPEN) == "nothing-missing"
    assert verdict(findings(named=False, free=(4.7,)), OPEN) == "unexplained"
    assert verdict(findings(named=False, free=(4.7,)), HERE) == "located"
    assert verdict(findings(named=False, free=(-3.0,), left_null=BAD), OPEN) == "unexplained"


def test_named_and_class_only_where_nothing_is_left():
    two = ((("bow",), ("lean",)),)
    assert verdict(findings(), HERE) == "named"
    assert verdict(findings(classes=two), HERE) == "class"
    assert verdict(findings(more=(55.0,)), OPEN) == "unexplained"
    assert verdict(findings(more=(55.0,)), HERE) == "located"
    assert verdict(findings(left=BAD), OPEN) == "unexplained"
    assert {verdict(findings(left=b, classes=c), HERE) for b in (GOOD, BAD) for c in ((), two)} <= set(VERDICTS)


def test_what_names_leave_is_a_part_of_what_shows_that_something_is_missing():
    before = Remainder(1e-9, {"c": (212.0, 12), "w": (14.0, 12)})
    after = Remainder(1e-5, {"c": (62.0, 12), "w": (20.0, 12)})
    assert after.part_of(before) == pytest.approx(50 / 200)
    assert Remainder(0.5, {"c": (9.0, 12)}).part_of(before) == 0
    # What shows only beside the names is all the more against them.
    assert Remainder(1e-5, {"pulls": (40.0, 12)}).part_of(before) > 1
    assert findings(left=after, left_null=before).part_left == pytest.approx(0.25)
    assert findings(more=(55.0,)).part_left == pytest.approx(0.1)
    assert findings(more=(54.0,)).part_left == 0
    assert findings().part_left == 0


def test_names_that_leave_much_unexplained_are_not_said():
    refuted = replace(findings(left=BAD), refuted=True)
    assert not refuted.stands
    assert verdict(refuted, OPEN) == "unexplained" and verdict(refuted, HERE) == "located"


def test_a_name_below_the_best_function_is_not_said():
    worse = findings(log_evidence=50.0, free=(51.0,), more=(48.0,))
    assert worse.margin == pytest.approx(-1) and not worse.stands
    assert verdict(worse, OPEN) == "unexplained" and verdict(worse, HERE) == "located"
    assert found(PROBLEM, worse, fit(), sure(0.999)) == ((), ())


def test_a_name_with_a_function_on_top_is_compared_as_a_whole():
    # The name alone loses to the function alone, but both together win: the name is needed, and more is missing.
    both = findings(log_evidence=50.0, free=(70.0,), more=(100.0,))
    assert both.stands and both.margin == pytest.approx(30)
    assert both.something_left
    # Adding less than half of what it gains by itself, it explains what the function explains, only worse.
    overlap = findings(log_evidence=50.0, free=(70.0,), more=(90.0,))
    assert not overlap.stands and verdict(overlap, HERE) == "located"


def test_a_name_that_only_mends_a_function_is_not_said():
    """A large misfit that a function takes away to a thousandth: a name that takes the rest may be its coarseness."""
    patch = findings(log_evidence=50.0, free=(1000.0,), more=(1020.0,))
    assert not patch.stands and verdict(patch, HERE) == "located"
    assert replace(findings(log_evidence=50.0, free=(70.0,), more=(90.0,)), together=False).margin == pytest.approx(-20)


def test_beside_a_function_that_outdoes_it_a_name_is_not_said():
    """A dent that an unknown height gains 2500 for is no plume, though a plume of gain 800 makes the height fit better:
    the height's knots are coarse. A name that gains most of what both do stands, and something is left beside it."""
    dent = findings(log_evidence=800.0, free=(2500.0,), more=(3300.0,))
    assert not dent.stands and verdict(dent, HERE) == "located"
    assert found(PROBLEM, dent, fit(), sure(0.999)) == ((), ())
    most = findings(log_evidence=2400.0, free=(1500.0,), more=(3300.0,))
    assert most.stands and most.something_left


def test_no_name_rests_on_settings_that_are_further_off_than_stated():
    stretched = replace(findings(), scale=1.66)
    assert verdict(stretched, OPEN) == "unexplained" and verdict(stretched, HERE) == "located"
    said, notes = found(PROBLEM, stretched, fit(), sure(0.999))
    assert said == () and len(notes) == 1 and "bow would explain it beside settings 1.7 times" in notes[0]
    assert verdict(replace(findings(), scale=1.28), HERE) == "named"


@pytest.mark.parametrize(
    ("probability", "margin", "said"),
    [
        (0.99, 3.0, "named"),
        (0.989, 30.0, "probable"),
        (0.999, 2.9, "probable"),
        (0.9, 0.0, "probable"),
        (0.89, 30.0, None),
        (0.999, -0.1, None),
    ],
)
def test_thresholds(probability, margin, said):
    assert confidence(probability, margin) == said


def fit():
    empty = np.zeros((0, 0))
    return Fit(("bow",), 50.0, {"bow": 0.12}, {"bow": 0.01}, empty, 1.0, 0.0, True, None)


def sure(p):
    return Weighed({(): np.log(1 - p), ("bow",): np.log(p)})


def test_what_is_found_carries_the_catalogue_s_sentences_and_sizes():
    ((one,), notes) = found(PROBLEM, findings(), fit(), sure(0.999))
    assert (one.name, one.element, one.confidence) == ("bow", "screen", "named")
    assert one.says == "bow is there." and one.remedy == "Mend bow."
    assert one.parameters["bow"].value == 0.12 and one.parameters["bow"].sigma == 0.01
    assert one.probability == pytest.approx(0.999) and notes == ()


def test_what_is_not_likely_is_a_note_and_no_more():
    none, notes = found(PROBLEM, findings(), fit(), sure(0.8))
    assert none == () and "bow" in notes[0] and "0.80" in notes[0]
