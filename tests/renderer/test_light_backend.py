"""The back end's self-test: a bad LLVM ends in a sentence."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchsim.bench.errors import BenchsimError
from benchsim.renderer import backend

USE = """
import benchsim
from benchsim.renderer import backend
try:
    print(backend.use("llvm_ad_mono"))
except ValueError as error:
    print("SAID", error)
"""


def run(code, tmp_path, **environment):
    env = {k: v for k, v in os.environ.items() if k != "DRJIT_LIBLLVM_PATH"} | {"XDG_CACHE_HOME": str(tmp_path)}
    command = [sys.executable, "-c", code]
    return subprocess.run(command, env=env | environment, capture_output=True, text=True, check=False)


def test_a_working_back_end_is_tested_once(tmp_path):
    """The outcome is remembered in the cache, whole or not at all; a second process finds it and writes nothing new."""
    first = run(USE, tmp_path)
    assert first.stdout.strip() in backend.mi.variants(), first.stderr
    kept = list((tmp_path / "benchsim").iterdir())
    assert [p.name.startswith("backend-") for p in kept] == [True]
    stamp = kept[0].stat().st_mtime_ns
    assert run(USE, tmp_path).stdout == first.stdout
    assert [p.stat().st_mtime_ns for p in (tmp_path / "benchsim").iterdir()] == [stamp]


@pytest.mark.parametrize("library", ["/nowhere/libLLVM.so", str(Path(__file__))], ids=["missing", "not a library"])
def test_a_bad_llvm_is_said_with_the_mend(tmp_path, library):
    done = run(USE, tmp_path, DRJIT_LIBLLVM_PATH=library)
    assert "SAID" in done.stdout, done.stdout + done.stderr
    assert "DRJIT_LIBLLVM_PATH" in done.stdout and "karellen-llvm-core" in done.stdout
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "benchsim").exists()


def test_a_self_test_that_aborts_is_a_message(monkeypatch, tmp_path):
    """A bad LLVM aborts while it compiles a kernel; the message says how the test ended."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(backend, "_PROBE", "import os; os.abort()")
    backend._complaint.cache_clear()
    with pytest.raises(BenchsimError, match=r"self-test ended with -6.*karellen-llvm-core"):
        backend.use("llvm_ad_mono")
    backend._complaint.cache_clear()


def test_drjit_before_benchsim_names_the_line_to_move(tmp_path):
    done = run("import drjit\n" + USE, tmp_path)
    assert "move the line 'import benchsim' above" in done.stdout


@pytest.mark.parametrize("variant", ["llvm_ad_monochrome", "scalar_rgb"])
def test_a_variant_that_cannot_be_used_is_said(variant):
    with pytest.raises(BenchsimError, match="choose"):
        backend.use(variant)


def test_an_old_mitsuba_is_said(monkeypatch):
    monkeypatch.setattr(backend.importlib.metadata, "version", lambda name: "3.5.2")
    with pytest.raises(BenchsimError, match=r"Mitsuba 3\.5\.2 is installed, but benchsim needs 3\.9"):
        backend.use()
