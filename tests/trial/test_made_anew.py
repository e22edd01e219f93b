"""Trials made anew, consistent in themselves: for the anchors to refuse; and what is committed to in no known form.

Without an anchor `verify` has to say that nobody vouches for it.
"""

import json
import shutil

import fakes
import numpy as np
import pytest
from forging import (
    FIRST_OF_NEXT,
    PARTS,
    better_verdict,
    chained,
    committed_anew,
    edited,
    of,
    opened_anew,
    redone,
    removed,
    rescored,
    written,
)

from benchsim import trial
from benchsim.bench.errors import BenchsimError
from benchsim.trial import deriving, equalised, ledger
from benchsim.trial.hashing import commitment, digest, files_of


def all_made_anew(t, keys):
    shutil.rmtree(t)
    mine = keys["stranger"].path
    options = {"make": fakes.make, "certificate": fakes.certificate, "key": mine}
    trial.conceal(t, 6, seed=99, workers=0, **options)
    trial.judge(t / "recordings", t / "verdicts", workers=0, diagnose=fakes.diagnose, key=mine)
    trial.open(t)


def signatures_taken_away(t, keys):
    redone(t, lambda lines: None, {})


def all_signed_by_another(t, keys):
    redone(t, lambda lines: None, {"concealer": keys["stranger"], "judge": keys["stranger"]})


def another_truth(t, keys):
    change = {"setting_scale": 2.0}
    redone(t, lambda lines: committed_anew(t, "001", lines, lambda opening: opening["truth"].update(change)), {})


def another_verdict(t, keys):
    redone(t, lambda lines: better_verdict(t, lines), {"concealer": keys["concealer"]})


def another_verdict_signed_by_another(t, keys):
    redone(t, lambda lines: better_verdict(t, lines), {"concealer": keys["concealer"], "judge": keys["stranger"]})


def another_verdict_signed_by_the_concealer(t, keys):
    redone(t, lambda lines: better_verdict(t, lines), {"concealer": keys["concealer"], "judge": keys["concealer"]})


REDONE = [
    all_made_anew,
    signatures_taken_away,
    all_signed_by_another,
    another_truth,
    another_verdict,
    another_verdict_signed_by_another,
    another_verdict_signed_by_the_concealer,
]


@pytest.mark.parametrize("attack", REDONE, ids=lambda x: x.__name__)
def test_a_trial_made_anew_is_refused_by_its_anchors(spoilt, keys, attack):
    head = trial.verify(spoilt).head
    attack(spoilt, keys)
    assert "Nobody vouches for it" in trial.verify(spoilt).summary()
    with pytest.raises(BenchsimError, match=r"--root .*: no part of this trial ends with it"):
        trial.verify(spoilt, roots=[head])
    with pytest.raises(BenchsimError, match=r"--judge: the judge('s part is signed by another key| did not sign)"):
        trial.verify(spoilt, judge=keys["judge"].public)


def test_an_opening_taken_away_is_missed_by_its_root(spoilt, opened):
    head = trial.verify(spoilt).head
    removed("ledger.jsonl", "score.json", "report.html")(spoilt)
    assert trial.verify(spoilt, unopened=True).stage == "judged, NOT opened"
    with pytest.raises(BenchsimError, match="no part of this trial ends with it"):
        trial.verify(spoilt, unopened=True, roots=[head])


def test_what_an_unfinished_trial_may_not_hold(spoilt):
    removed("ledger.jsonl", "score.json")(spoilt)
    with pytest.raises(BenchsimError, match=r"report.html: the ledger knows nothing of it"):
        trial.verify(spoilt, unopened=True)


def test_a_moved_trial_verifies(opened, tmp_path):
    """Times and places on the disk are another copy's; the leak test is of what was written down."""
    shutil.copytree(opened, tmp_path / "t", copy_function=shutil.copyfile)
    assert trial.verify(tmp_path / "t").head == trial.verify(opened).head
    assert (tmp_path / "t/recordings/001/001.png").stat().st_mtime != equalised.EPOCH


# What is committed to in no form that is known: by a concealer, a judge or an opener who want a traceback.

WRONG = (None, True, -1, 10**30, 1e300, "", "x" * 500, "\x1b[2J\n", "\ud800", [], [[]], {}, {"a": {"a": 0}})


def places(value, at=()):
    """Paths to everything in plain values."""
    for key in value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
        yield (*at, key)
        yield from places(value[key], (*at, key))


def put(value, at, new):
    for key in at[:-1]:
        value = value[key]
    value[at[-1]] = new


def committed_to(t, name):
    """The ledgers, over a file as it lies there."""
    lines = [dict(line) for line in ledger.read(t / ledger.NAME)]
    value = json.loads((t / name).read_text())
    if name == "truth/plan.json":
        lines[0]["plan"] = digest((t / name).read_bytes()[:-1])
    elif name.startswith("truth"):
        of(lines, "concealed", "003")["commitment"] = commitment(value["salt"], value["truth"])
    elif name.startswith("verdicts"):
        of(lines, "judged", "003")["files"] = files_of(t / "verdicts/003")
    lines[-1]["results"] = digest((t / "score.json").read_bytes())
    lines = chained(lines, {})
    for part, end in zip(PARTS, FIRST_OF_NEXT, strict=True):
        written(t / part, lines[: next((k for k, line in enumerate(lines) if line["kind"] == end), len(lines))])


@pytest.mark.parametrize("name", ["truth/003.json", "verdicts/003/diagnosis.json", "score.json", "truth/plan.json"])
def test_what_is_committed_to_in_another_form_ends_in_a_sentence(spoilt, name):
    path = spoilt / name
    whole, rng = path.read_text(), np.random.default_rng(5)
    every = [at for at in places(json.loads(whole)) if at[0] != "salt"]
    refused = 0
    for at in (every[int(i)] for i in rng.choice(len(every), min(len(every), 12), replace=False)):
        path.write_text(whole)
        edited(path, lambda value, at=at: put(value, at, WRONG[int(rng.integers(len(WRONG)))]))
        committed_to(spoilt, name)
        ledgers = (spoilt / ledger.NAME).read_bytes()
        for job in (trial.verify, trial.open):
            try:
                job(spoilt)
            except BenchsimError as error:
                assert "\n" not in str(error) and len(str(error)) < 1000
                refused += 1
            (spoilt / ledger.NAME).unlink(missing_ok=True)
        (spoilt / ledger.NAME).write_bytes(ledgers)
    assert refused >= 5


def test_another_machine_may_round_otherwise(spoilt, monkeypatch):
    """Scored where the last digits differ: the score's floats, and predictions that come through linear algebra."""
    rescored(
        spoilt, lambda score: score["reliability"][0].update(stated=score["reliability"][0]["stated"] * (1 + 1e-12))
    )
    trial.verify(spoilt)

    def predicts(by):
        found = {"data": 40, "excess_chi2_before": 2e4 * (1 + by), "excess_chi2_after": 30.0 + 2e4 * by}
        monkeypatch.setattr(deriving.prediction, "of_case", lambda *_: found)

    predicts(0)
    opened_anew(spoilt, ledger.read(spoilt / "verdicts" / ledger.NAME))
    for by in (0, 1e-8, -1e-8):
        predicts(by)
        trial.verify(spoilt)
    for by in (1e-4, -1e-4):
        predicts(by)
        with pytest.raises(BenchsimError, match="kept_back 001: does not follow"):
            trial.verify(spoilt)
