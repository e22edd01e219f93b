"""Commands killed at random moments; `analysis/kill_runs.py` does the same to the long ones."""

import json
import signal
import subprocess
import sys


def test_a_command_killed_at_random_moments_gives_what_it_gives_undisturbed(script, tmp_path):
    kills = script("kill_runs")
    found = kills.disturbed([sys.executable, "-m", "benchsim", "board"], tmp_path, 4, 2, kills.random.Random(1))
    assert found["kills"] == 4 and found["files"] >= 4
    assert found["differing"] == found["left"] == [] and found["orphans"] == 0, json.dumps(found)


def test_a_command_told_to_end_says_so_and_leaves_nothing(tmp_path):
    waits = (
        "import os, signal\nfrom benchsim import cli, jobs\nfrom benchsim.jobs.output import output_folder\n"
        "from pathlib import Path\n"
        "def board(*_, **__):\n    with output_folder(Path('out'), 'board', []):\n"
        "        os.kill(os.getpid(), signal.SIGTERM)\n        signal.pause()\n"
        "jobs.board = board\ncli.main()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", waits, "board"], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 128 + signal.SIGTERM, done.stderr
    assert done.stderr == "benchsim: stopped; nothing is left half-written\n" and not list(tmp_path.iterdir())
