"""Cases on processes of this machine, and on a real ``dask scheduler`` with two workers that speak TLS alone."""

import os
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path

import dask
import fakes
import psutil
import pytest
from schedulers import certificates, wait

from benchsim import trial
from benchsim.bench.errors import BenchsimError
from benchsim.jobs.cluster import Scheduler, cluster
from benchsim.jobs.workers import MEMORY_KEPT
from benchsim.trial import ledger

HERE = Path(__file__).parent


@pytest.mark.parametrize("where", ["here", "scheduler"])
def test_a_worker_killed_on_the_way_gives_the_same_ledger(where, request, concealed, opened, keys, tmp_path):
    on = {"workers": 2} if where == "here" else {"scheduler": request.getfixturevalue("dask_of_tls")}
    marks = tmp_path / "marks"
    marks.mkdir()

    def begun():
        of = [path.name.split("-")[0] for path in marks.iterdir()]
        return {pid: of.count(pid) for pid in of}

    def kill():
        wait(lambda: len(begun()) == 2 and max(begun().values()) >= 2)
        # In the middle of its second case.
        os.kill(int(max(begun(), key=begun().get)), signal.SIGKILL)

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    judge = partial(fakes.diagnose, seconds=0.25, marks=str(marks))
    trial.judge(concealed / "recordings", tmp_path / "verdicts", **on, diagnose=judge, key=keys["judge"].path)
    killer.join()
    assert len(list(marks.iterdir())) > 20  # what it was at was begun again
    assert (tmp_path / "verdicts" / ledger.NAME).read_bytes() == (opened / "verdicts" / ledger.NAME).read_bytes()


def test_a_case_that_no_process_survives_is_said_and_the_others_are_done():
    with cluster(workers=2) as each:
        found = dict(each(eval, [("6 * 7",), ("__import__('os')._exit(1)",), ("1 / 0",), ("6 * 8",), ("lambda: 0",)]))
    assert (found[0], found[3]) == (42, 48)
    assert isinstance(found[1], BenchsimError) and "died" in str(found[1])
    assert isinstance(found[2], ZeroDivisionError) and isinstance(found[4], Exception)


def test_results_come_as_they_are_finished_and_what_is_left_is_ended():
    with cluster(workers=2) as each:
        results = each(eval, [("__import__('time').sleep(60)",), ("'quick'",)])
        assert next(results) == (1, "quick")
        begun = time.monotonic()
    assert time.monotonic() - begun < 10


def test_processes_have_one_thread_and_keep_their_memory_and_this_one_is_as_it_was(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    with cluster(workers=1) as each:
        [(_, found)] = each(eval, [("dict(__import__('os').environ)",)])
    assert found["OMP_NUM_THREADS"] == found["MKL_NUM_THREADS"] == "1"
    assert MEMORY_KEPT.items() <= found.items() and not MEMORY_KEPT.keys() & os.environ.keys()
    assert os.environ["OMP_NUM_THREADS"] == "7"


def test_nobody_listens_in_a_command_on_processes_of_this_machine(concealed, tmp_path):
    command = [sys.executable, "-m", "benchsim", "trial", "judge", str(concealed / "recordings"), "--workers", "2"]
    process = subprocess.Popen([*command, "-o", str(tmp_path / "v")], stdout=subprocess.DEVNULL)
    seen, listening = set(), []
    while process.poll() is None:
        try:
            everyone = [psutil.Process(process.pid), *psutil.Process(process.pid).children(recursive=True)]
        except psutil.NoSuchProcess:
            continue
        for one in everyone:
            try:
                open_ones = one.net_connections(kind="inet")
            except psutil.Error:
                continue
            seen.add(one.pid)
            listening += [c for c in open_ones if c.status in (psutil.CONN_LISTEN, psutil.CONN_NONE)]
        time.sleep(0.01)
    assert process.returncode == 0 and len(seen) >= 3
    assert not listening


def test_processes_end_with_a_parent_that_is_killed(tmp_path):
    """Those that a case started of its own, too."""
    (tmp_path / "cases.py").write_text(
        "import os, time\nfrom pathlib import Path\nfrom benchsim.jobs.workers import workers\n"
        "def sleep(n):\n    Path(f'pid-{os.getpid()}').touch()\n    time.sleep(60)\n"
        "def nest(n):\n    with workers(2) as pool:\n        list(pool.each(sleep, range(2)))\n"
    )
    (tmp_path / "main.py").write_text(
        "import cases\nfrom benchsim.jobs.cluster import cluster\n"
        "if __name__ == '__main__':\n"
        "    with cluster(workers=2) as each:\n        list(each(cases.nest, [(0,), (1,)]))\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    parent = subprocess.Popen([sys.executable, "main.py"], cwd=tmp_path, env=environment)
    wait(lambda: len(list(tmp_path.glob("pid-*"))) == 4)
    everyone = psutil.Process(parent.pid).children(recursive=True)
    assert len(everyone) >= 6
    parent.kill()
    parent.wait()
    _, alive = psutil.wait_procs(everyone, timeout=10)
    assert not alive


def test_certificates_may_stand_in_the_configuration_of_dask(dask_of_tls):
    keys = ("ca-file", "client.cert", "client.key")
    with dask.config.set({f"distributed.comm.tls.{k}": str(v) for k, v in zip(keys, dask_of_tls.tls, strict=True)}):
        with cluster(Scheduler(dask_of_tls.address)) as each:
            assert list(each(eval, [("6 * 7",)])) == [(0, 42)]


@pytest.mark.parametrize(
    ("scheduler", "told"),
    [
        (Scheduler("tcp://127.0.0.1:9"), "without TLS anyone"),
        (Scheduler("127.0.0.1:9"), "without TLS anyone"),
        (Scheduler("tcp://127.0.0.1:9", insecure=True), "does not answer"),
        (Scheduler("tls://127.0.0.1:9"), "no certificates"),
        (Scheduler("tls://127.0.0.1:9", (Path("ca"), Path("own"), Path("key"))), "does not answer"),
    ],
)
def test_a_scheduler_that_cannot_be_used_is_told(scheduler, told):
    with pytest.raises(BenchsimError, match=told) as error, cluster(scheduler, timeout=1):
        pass
    assert "\n" not in str(error.value)


def test_a_certificate_of_another_authority_is_not_let_in(dask_of_tls, tmp_path):
    with (
        pytest.raises(BenchsimError, match="does not answer"),
        cluster(Scheduler(dask_of_tls.address, certificates(tmp_path / "other")), timeout=2),
    ):
        pass


def test_the_options_of_a_scheduler_are_those_of_the_command(tmp_path):
    from typer.testing import CliRunner

    from benchsim.cli import app

    def said(scheduler):
        command = ["trial", "conceal", "-o", str(tmp_path / "t"), *scheduler.options()]
        done = CliRunner().invoke(app, command)
        assert done.exit_code == 1
        return done.output

    assert "without TLS" in said(Scheduler("tcp://127.0.0.1:9"))
    assert "does not answer" in said(Scheduler("tcp://localhost:x", insecure=True))
    assert "check the address, and the certificates" in said(Scheduler("tls://localhost:9", (tmp_path,) * 3))
