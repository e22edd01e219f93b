"""The published trial still proves what its README says.

Scenario: a referee checks out the repository, without the recordings. The ledger, the commitments and the score have
to hold together, one changed verdict has to be seen, and the README's tables have to be those of the score that is
kept.
"""

import importlib.util
import json
import re
from pathlib import Path

import pytest

from benchsim import trial
from benchsim.bench.errors import BenchsimError
from benchsim.trial import deriving, ledger
from benchsim.trial.checking import Trial

HERE = Path(__file__).resolve().parents[2] / "analysis" / "trial"


def published():
    """The script that keeps a trial, as a module."""
    spec = importlib.util.spec_from_file_location("published", HERE / "published.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def kept():
    with published().unpacked() as folder:
        yield folder


def test_the_kept_trial_verifies_without_its_recordings(kept):
    """Up to its opening: making the predictions of all cases again takes minutes (``benchsim trial verify``)."""
    for name in ("ledger.jsonl", "score.json", "report.html"):
        (kept / name).unlink()
    key = re.search(r"public key `([0-9a-f]{64})`", (HERE / "README.md").read_text(encoding="utf-8")).group(1)
    found = trial.verify(kept, recordings=False, unopened=True, concealer=key, judge=key)
    assert found.stage == "judged, NOT opened" and found.cases == 150
    shown = (HERE / "README.md").read_text(encoding="utf-8")
    assert found.head in shown


def test_the_kept_score_follows_from_truths_and_verdicts(kept):
    """All but what is predicted of settings kept back, which it holds."""
    score = json.loads((kept / "score.json").read_text(encoding="utf-8"))
    stands = ledger.standing(ledger.read(kept / "verdicts" / ledger.NAME))
    lines = ledger.read(kept / ledger.NAME)[:-1]
    again = deriving.assembled(Trial(kept, stands), score["kept_back"], lines)
    assert json.loads(deriving.written(again)) == score


def test_one_changed_byte_of_a_kept_verdict_is_seen(kept):
    verdict = next((kept / "verdicts").rglob("diagnosis.json"))
    verdict.write_text(verdict.read_text(encoding="utf-8").replace("0.", "1.", 1), encoding="utf-8")
    with pytest.raises(BenchsimError, match=r"diagnosis.json: was changed"):
        trial.verify(kept, recordings=False)


def test_the_readme_shows_the_score_that_is_kept(kept):
    module = published()
    score = json.loads((kept / "score.json").read_text(encoding="utf-8"))
    shown = (HERE / "README.md").read_text(encoding="utf-8").split(module.BEGIN)[1].split(module.END)[0]
    assert shown.strip() == "\n\n".join(module.tables(score))
