"""A map over processes: the order, the complaints and the results of ``map``."""

import functools
import operator
import os
import subprocess
import sys

import pytest

from benchsim.bench.errors import BenchsimError
from benchsim.bench.files import read
from benchsim.jobs.workers import workers

# Workers import what they are sent by name, and this file is no module of theirs: library functions stand in.
READ = (
    "(lambda os: (os.getpid(), [os.environ.get(k) for k in "
    "('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS')]))(__import__('os'))"
)


@pytest.fixture(scope="module")
def pool():
    with workers(2) as w:
        yield w


def test_results_come_in_the_order_of_the_tasks(pool):
    assert pool.spread(operator.add, range(100), range(100)) == [2 * n for n in range(100)]
    assert list(pool.each(functools.partial(pow, 2), range(9))) == [2**n for n in range(9)]
    assert pool.spread(operator.neg, []) == []


def test_a_complaint_arrives_as_itself(pool, tmp_path):
    with pytest.raises(BenchsimError, match="no such file or folder"):
        list(pool.each(read, [tmp_path / "nowhere", tmp_path / "neither"]))


def test_work_is_done_elsewhere_with_one_thread_each(pool):
    found = list(pool.each(eval, [READ] * 8))
    assert os.getpid() not in {pid for pid, _ in found}
    assert {tuple(threads) for _, threads in found} == {("1", "1", "1")}


def test_what_cannot_be_sent_is_done_here(pool):
    here = os.getpid()
    assert pool.spread(lambda n: (n, os.getpid()), range(3)) == [(n, here) for n in range(3)]


def test_the_environment_is_left_as_it_was(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    with workers(2):
        pass
    assert os.environ["OMP_NUM_THREADS"] == "7" and "MKL_NUM_THREADS" not in os.environ


def test_a_script_without_a_guard_is_run_once(tmp_path):
    """Its processes do not import it: what it does before and after is done once, and they work nevertheless. What it
    defines itself is done in its own process."""
    script = tmp_path / "unguarded.py"
    script.write_text(
        "import operator, os\nfrom benchsim.jobs.workers import workers\nprint('begun')\n"
        "def own(n):\n    return os.getpid()\n"
        "with workers(2) as w:\n"
        "    print(sum(w.spread(operator.mul, range(20), range(20))))\n"
        "    print({*w.spread(eval, [\"__import__('os').getpid()\"] * 9)} & {os.getpid()})\n"
        "    print({*w.spread(own, range(3))} == {os.getpid()})\n"
    )
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.split("\n") == ["begun", str(sum(n * n for n in range(20))), "set()", "True", ""]
