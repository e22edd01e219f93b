"""Cause, size and prediction of made-up verdicts, and the rates made of them."""

import math

import numpy as np
import pytest
from fakes import diagnosis

from benchsim.trial import claims, score
from benchsim.trial.rates import Rate, wilson


def truth(*names, kind=None, stranger="", element="screen", snr=20.0, rival=9.0, zero=False, design="six", case="001"):
    return {
        "case": case, "kind": kind or ("stranger" if stranger else "single" if names else "clean"), "design": design,
        "zero": zero, "effects": {n: {"size": 1.4} for n in names}, "stranger": stranger, "element": element,
        "snr": dict.fromkeys([*names, *filter(None, [stranger])], snr),
        "rival": {"effects": [], "separation_sigma": rival} if names else None,
    }  # fmt: skip


BOW, CANT = "screen-bow", "canting"


@pytest.mark.parametrize(
    ("concealed", "said", "outcome"),
    [
        (truth(BOW), diagnosis(BOW), "right"),
        (truth(BOW), diagnosis(CANT), "wrong"),
        (truth(BOW), diagnosis(), "missed"),
        (truth(BOW), diagnosis(verdict="unexplained"), "missed"),
        (truth(BOW), diagnosis(location="screen", verdict="located"), "missed"),
        (truth(BOW), diagnosis(classes=[[[BOW], [CANT]]]), "class"),
        (truth(BOW), diagnosis(classes=[[["drift"], [CANT]]]), "wrong"),
        (truth(BOW), diagnosis(BOW, verdict="unexplained"), "class"),
        (truth(BOW, CANT, kind="pair"), diagnosis(BOW), "missed"),
        (truth(BOW, CANT, kind="pair"), diagnosis(BOW, verdict="class", classes=[[[CANT], ["drift"]]]), "class"),
        (truth(BOW, CANT, kind="pair"), diagnosis(verdict="class", classes=[[[CANT], ["drift"]]]), "missed"),
        (truth(BOW, CANT, kind="pair"), diagnosis(verdict="class", classes=[[["coma"], ["drift"]]]), "wrong"),
        (truth(), diagnosis(), "right"),
        (truth(), diagnosis(BOW), "wrong"),
        (truth(), diagnosis(verdict="unexplained"), "wrong"),
        (truth(), diagnosis(classes=[[[], ["setting-errors"]]]), "class"),
        (truth(), diagnosis(classes=[[["setting-errors"], [BOW]]]), "wrong"),
        (truth(), diagnosis("setting-errors"), "wrong"),
        (truth(kind="clean-settings"), diagnosis("setting-errors"), "right"),
        (truth(kind="clean-settings"), diagnosis(classes=[[["setting-errors"], [BOW]]]), "class"),
        (truth(kind="clean-settings"), diagnosis(BOW), "wrong"),
        (truth(kind="clean-settings"), diagnosis(), "missed"),
        (truth(stranger="dent"), diagnosis(classes=[[[], ["setting-errors"]]]), "missed"),
        (truth(stranger="dent"), diagnosis(), "missed"),
        (truth(stranger="dent"), diagnosis(location="screen", verdict="located"), "right"),
        (truth(stranger="dent"), diagnosis(location="camera", verdict="located"), "wrong"),
        (truth(stranger="dent"), diagnosis(BOW), "wrong"),
        (truth(stranger="dent"), diagnosis(classes=[[[BOW], [CANT]]]), "wrong"),
        (truth("drift", kind="removed", element="time"), diagnosis(location="time", verdict="located"), "right"),
        (truth("drift", kind="removed", element="time"), diagnosis(), "missed"),
        (truth(BOW, zero=True), diagnosis(), "right"),
        (truth(BOW, zero=True), diagnosis(BOW), "wrong"),
        (truth(BOW), None, ""),
    ],
)
def test_cause(concealed, said, outcome):
    assert claims.cause(concealed, said, ["drift"])[0] == outcome


@pytest.mark.parametrize(("value", "outcome"), [(1.4, "right"), (1.4 + 2.9 * 0.3, "right"), (1.4 - 3.1 * 0.3, "wrong")])
def test_size(value, outcome):
    case = score.scored(truth(BOW), diagnosis(BOW, value=value), [], 1)
    assert case["size"] == outcome
    assert case["sizes"][0]["pull"] == pytest.approx((value - 1.4) / 0.3)
    assert score.scored(truth(BOW), diagnosis(CANT), [], 1)["size"] == ""


@pytest.mark.parametrize(("after", "outcome"), [(40.0, "right"), (60.0, "wrong")])
def test_prediction(after, outcome):
    """Judged alone only where there is much to remove: 60 √(2 · 50) = 600."""
    kept = {"data": 50, "excess_chi2_before": 1000.0, "excess_chi2_after": after}
    assert score.scored(truth(BOW), diagnosis(BOW), [], 1, kept)["prediction"] == outcome
    assert score.scored(truth(BOW), diagnosis(CANT), [], 1, kept)["prediction"] == outcome  # whatever it is called
    little = {**kept, "excess_chi2_before": 500.0}
    assert score.scored(truth(BOW), diagnosis(BOW), [], 1, little)["prediction"] == ""
    assert score.scored(truth(BOW), diagnosis(), [], 1, kept)["prediction"] == ""
    assert score.scored(truth(BOW), diagnosis(BOW), [], 1)["prediction"] == ""


def test_predictions_are_pooled_where_the_cause_is_right():
    kept = {"001": {"data": 50, "excess_chi2_before": 1000.0, "excess_chi2_after": 20.0}}
    kept |= {"002": {"data": 50, "excess_chi2_before": 3000.0, "excess_chi2_after": 60.0}}
    kept |= {"003": {"data": 50, "excess_chi2_before": 9000.0, "excess_chi2_after": 9000.0}}
    cases = [(truth(BOW, case=k), diagnosis(BOW if k != "003" else CANT)) for k in kept]
    [found] = [b for b in score.bars(cases, [], kept) if b["quantity"].startswith("settings that the judge never saw")]
    assert (found["value"], found["n"], found["state"]) == ("0.980", 2, "met")


def bar(cases, words):
    found = [b for b in score.bars(cases, ["drift"], {}) if words in b["quantity"]]
    assert len(found) == 1, [b["quantity"] for b in found]
    return found[0]


def test_rows_are_chosen_by_visibility_and_rival():
    many = [(truth(BOW, snr=s, rival=r), diagnosis(BOW)) for s in (5, 9, 15) for r in (2, 4, 6)]
    assert bar(many, "one effect, six settings, SNR ≥ 8, rival ≥ 5")["n"] == 2
    assert bar(many, "one effect, six settings, SNR ≥ 12, rival ≥ 5")["n"] == 1
    assert bar(many, "one effect, six settings, rival at 3 to 5")["n"] == 2
    below = bar(many, "one effect, six settings, rival below 3")
    assert (below["n"], below["k"], below["state"]) == (2, 0, "missed")
    assert bar(many, "a lone name that the rival does not share")["k"] == 3
    in_common = truth(BOW, CANT, snr=9, rival=2) | {"rival": {"effects": [BOW], "separation_sigma": 2.0}}
    assert bar([(in_common, diagnosis(BOW))], "the rival does not share")["k"] == 0
    assert bar([(in_common, diagnosis(CANT))], "the rival does not share")["k"] == 1
    assert bar(many, "Fig. 7, SNR ≥ 8")["state"] == "open"


def test_a_crash_counts_as_a_miss_and_as_no_false_name():
    cases = [(truth(BOW), diagnosis(BOW)), (truth(BOW), None)]
    named = bar(cases, "one effect, six settings, SNR ≥ 8, rival ≥ 5")
    assert (named["k"], named["n"]) == (1, 2)
    assert bar(cases, "one or two effects: a name that is not there")["n"] == 1
    lost = [(truth(stranger="dent", snr=25.0), None)]
    assert (bar(lost, "above 20: claimed")["k"], bar(lost, "above 20: claimed")["n"]) == (0, 1)
    assert bar(lost, "location, when claimed")["n"] == 0


def test_false_names_are_counted_where_they_belong():
    cases = [
        (truth(), diagnosis(BOW)),
        (truth(), diagnosis()),
        (truth(stranger="dent", snr=15.0), diagnosis(BOW)),
        (truth(stranger="dent", snr=25.0), diagnosis(location="screen", verdict="located")),
        (truth("drift", kind="removed", snr=25.0, element="time"), diagnosis(location="screen", verdict="located")),
        (truth(BOW, zero=True), diagnosis(CANT)),
    ]
    assert (bar(cases, "nothing concealed: anything")["k"], bar(cases, "nothing concealed: anything")["n"]) == (1, 2)
    assert bar(cases, "SNR < 20: a wrong name")["k"] == 1
    assert bar(cases, "SNR ≥ 20: a wrong name")["k"] == 0
    placed = bar(cases, "location, when claimed")
    assert (placed["k"], placed["n"]) == (1, 2)
    assert bar(cases, "set to zero")["k"] == 1


def test_confusion_counts_every_case_once():
    cases = [
        score.scored(t, d, [], 1) for t, d in [(truth(BOW), diagnosis(BOW)), (truth(BOW), diagnosis()), (truth(), None)]
    ]
    found = score.confusion(cases)
    assert found["concealed"] == ["nothing", BOW]
    assert sum(map(sum, found["counts"])) == 3
    assert found["counts"][1][found["said"].index(BOW)] == 1


def test_power_and_reliability_hold_what_was_drawn():
    """A judge who names by chance 1 − exp(−SNR/10) and says so: his curve and his bins are the truth."""
    rng = np.random.default_rng(5)
    pairs, true = [], []
    for _ in range(3000):
        snr = float(np.exp(rng.uniform(math.log(4), math.log(60))))
        p = 1 - math.exp(-snr / 10)
        there = rng.random() < p
        d = diagnosis(BOW if there else None)
        d["probability"] = {BOW: 0.0}
        pairs.append((truth(BOW, snr=snr), d))
        true.append((snr, p))
    [every, bow] = score.power(pairs, [])
    assert every["points"] == bow["points"]
    for point, (low, high) in zip(
        bow["points"], zip(score.SNR_EDGES[1:], score.SNR_EDGES[2:], strict=False), strict=True
    ):
        wanted = np.mean([p for snr, p in true if low <= snr < high])
        # Five intervals at 99.9 % each: one false alarm in 200 seeds.
        a, b = wilson(point["named"], point["of"], 3.3)
        assert a <= wanted <= b
    stated = []
    for _ in range(3000):
        p = float(rng.random())
        d = diagnosis()
        d["probability"] = {BOW: p}
        stated.append((truth(BOW) if rng.random() < p else truth(), d))
    for point in score.reliability(stated, []):
        a, b = wilson(point["right"], point["of"], 3.3)
        assert a <= point["stated"] <= b
    assert score.reliability([(truth(stranger="dent"), diagnosis(BOW))], []) == []


def test_bars_are_met_missed_or_open():
    assert Rate("x", 95, 100, 0.95).plain()["state"] == "met"
    assert Rate("x", 93, 100, 0.95).plain()["state"] == "open"
    assert Rate("x", 80, 100, 0.95).plain()["state"] == "missed"
    assert Rate("x", 1, 100, 0.02, False).plain()["state"] == "met"
    assert Rate("x", 9, 100, 0.02, False).plain()["state"] == "missed"
    assert Rate("x", 0, 0, 0.02, False).plain()["state"] == "open"
