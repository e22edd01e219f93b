"""A whole trial with a quick generator and a quick judge (`fakes`), made once; tests copy it and spoil the copy."""

import shutil
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

import fakes

from benchsim import trial

CASES, SEED = 20, 7


@pytest.fixture(scope="session")
def keys(tmp_path_factory):
    """Who signs → key."""
    folder = tmp_path_factory.mktemp("keys")
    return {by: trial.key(folder / by) for by in ("concealer", "judge", "stranger")}


@pytest.fixture(scope="session")
def concealed(tmp_path_factory, keys):
    """Recordings and truth, signed; read it, never write into it."""
    folder = tmp_path_factory.mktemp("trial") / "t"
    options = {"make": fakes.make, "certificate": fakes.certificate, "key": keys["concealer"].path}
    trial.conceal(folder, CASES, seed=SEED, workers=0, **options)
    return folder


@pytest.fixture(scope="session")
def opened(concealed, keys, tmp_path_factory):
    """Judged, signed and opened; read it, never write into it."""
    folder = tmp_path_factory.mktemp("trial") / "t"
    shutil.copytree(concealed, folder)
    trial.judge(folder / "recordings", folder / "verdicts", workers=0, diagnose=fakes.diagnose, key=keys["judge"].path)
    trial.open(folder)
    return folder


@pytest.fixture
def spoilt(opened, tmp_path):
    """A copy that a test may spoil."""
    shutil.copytree(opened, tmp_path / "t")
    return tmp_path / "t"
