"""Against a real ``dask scheduler`` with two ``dask worker`` processes, one of which is killed on the way."""

import os
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path

import fakes
import pytest

from benchsim import trial
from benchsim.bench.errors import BenchsimError
from benchsim.jobs.cluster import cluster
from benchsim.trial import ledger

HERE = Path(__file__).parent


@pytest.fixture
def dask(tmp_path):
    """Address of a scheduler, and its two workers; ended with the test."""
    environment = {**os.environ, "PYTHONPATH": str(HERE), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    file = tmp_path / "scheduler.json"
    common = {"env": environment, "cwd": tmp_path, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    started = [
        subprocess.Popen(
            [sys.executable, "-m", "dask", "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard",
             "--scheduler-file", str(file)],
            **common,
        )
    ]  # fmt: skip
    try:
        wait(lambda: file.exists() and file.stat().st_size > 0)
        worker = [sys.executable, "-m", "dask", "worker", "--scheduler-file", str(file), "--nthreads", "1"]
        started += [subprocess.Popen([*worker, "--no-nanny", "--no-dashboard"], **common) for _ in range(2)]
        import json

        yield json.loads(file.read_text())["address"], started[1:]
    finally:
        for process in started:
            process.kill()
            process.wait()


def wait(ready, seconds=120.0):
    end = time.monotonic() + seconds
    while not ready():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_a_worker_killed_on_the_way_gives_the_same_ledger(dask, concealed, opened, tmp_path):
    address, workers = dask
    marks = tmp_path / "marks"
    marks.mkdir()

    def begun(process):
        return len(list(marks.glob(f"{process.pid}-*")))

    def kill():
        wait(lambda: begun(workers[1]) >= 2)
        # In the middle of its second case.
        workers[1].send_signal(signal.SIGKILL)

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    judge = partial(fakes.diagnose, seconds=0.25, marks=str(marks))
    trial.judge(concealed / "recordings", tmp_path / "verdicts", scheduler=address, diagnose=judge)
    killer.join()
    assert workers[1].wait() == -signal.SIGKILL
    assert begun(workers[0]) > 0
    assert len(list(marks.iterdir())) > 20  # what it was at was begun again
    assert (tmp_path / "verdicts" / ledger.NAME).read_bytes() == (opened / "verdicts" / ledger.NAME).read_bytes()


def test_a_scheduler_that_is_not_there_is_told():
    with pytest.raises(BenchsimError, match="does not answer"), cluster("tcp://127.0.0.1:9", timeout=1):
        pass
