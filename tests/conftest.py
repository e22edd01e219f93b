"""Each test process computes with one thread: several share the cores, and small matrices gain from no second."""

import importlib.util
import os
import sys
from pathlib import Path

for _key in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_key, "1")  # read once, when numpy is first imported

import pytest  # noqa: E402 -- after the threads are set
from hypothesis import settings  # noqa: E402

sys.path.insert(0, str(Path(__file__).parent))
from schedulers import dask_of_tls  # noqa: E402, F401 -- a fixture of several rooms

# A deadline would measure what else the machine is doing.
settings.register_profile("benchsim", deadline=None)
settings.load_profile("benchsim")

ANALYSIS = Path(__file__).resolve().parents[1] / "analysis"


@pytest.fixture
def script(monkeypatch):
    """Load a script of analysis/ by name, with its folder on the path as when it is run."""
    monkeypatch.syspath_prepend(str(ANALYSIS))

    def load(name):
        spec = importlib.util.spec_from_file_location(name, ANALYSIS / f"{name}.py")
        module = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, name, module)
        spec.loader.exec_module(module)
        return module

    return load


def pytest_terminal_summary(terminalreporter):
    """Which readers the hostile files reached; the tests may have run in other processes."""
    rows = [
        value
        for reports in terminalreporter.stats.values()
        for report in reports
        for key, value in getattr(report, "user_properties", ())
        if key == "hostile" and report.when == "call"
    ]
    if rows:
        total = sum(accepted + refused for _, accepted, refused in rows)
        said = ", ".join(f"{name} {accepted} + {refused}" for name, accepted, refused in sorted(rows))
        terminalreporter.write_line(f"{total} hostile inputs by reader, accepted + refused: {said}")
