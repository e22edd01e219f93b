"""The published trial still proves what its README says.

Scenario: a referee checks out the repository, without the recordings. The ledger, the commitments and the score have
to hold together, one changed verdict has to be seen, and the README's tables have to be those of the score that is
kept.
"""

import importlib.util
import json
from pathlib import Path

import pytest

from benchsim import trial
from benchsim.bench.errors import BenchsimError

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
    found = trial.verify(kept, recordings=False, page=False)
    assert found.stage == "opened and scored" and "concealer: unsigned\njudge: unsigned" in found.summary()


def test_one_changed_byte_of_a_kept_verdict_is_seen(kept):
    verdict = next((kept / "verdicts").rglob("diagnosis.json"))
    verdict.write_text(verdict.read_text(encoding="utf-8").replace("0.", "1.", 1), encoding="utf-8")
    with pytest.raises(BenchsimError, match=r"diagnosis.json: was changed"):
        trial.verify(kept, recordings=False, page=False)


def test_the_readme_shows_the_score_that_is_kept(kept):
    module = published()
    score = json.loads((kept / "score.json").read_text(encoding="utf-8"))
    shown = (HERE / "README.md").read_text(encoding="utf-8").split(module.BEGIN)[1].split(module.END)[0]
    assert shown.strip() == "\n\n".join(module.tables(score))
