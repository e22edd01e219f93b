"""A full disk or a closed pipe where the output goes ends a command in one sentence, not in a traceback."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

COMMANDS = (["effects"], ["effects", "--json"])


def run(command, stdout):
    return subprocess.run(
        [sys.executable, "-m", "benchsim", *command], stdout=stdout, stderr=subprocess.PIPE, text=True, timeout=60
    )


def one_sentence(done):
    assert done.returncode == 1
    assert done.stderr.startswith("benchsim: the output cannot be printed") and done.stderr.count("\n") == 1


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
@pytest.mark.parametrize("command", [*COMMANDS, ["--help"]])
def test_a_full_disk(command):
    with open("/dev/full", "w") as full:
        one_sentence(run(command, full))


@pytest.mark.parametrize("command", COMMANDS)
def test_a_closed_pipe(command):
    reads, writes = os.pipe()
    os.close(reads)
    with os.fdopen(writes, "w") as closed:
        one_sentence(run(command, closed))
