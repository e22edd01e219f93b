"""benchsim before drjit and mitsuba, whichever test module comes first; and this folder on the path."""

import sys
from pathlib import Path

import pytest

import benchsim  # noqa: F401
from benchsim.bench.errors import BenchsimError

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(scope="module")
def backend():
    """Mitsuba's back end; without one, its tests skip."""
    from benchsim.renderer.backend import use

    try:
        use()
    except BenchsimError as error:
        pytest.skip(str(error))
