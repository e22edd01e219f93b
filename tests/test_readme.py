"""What the README tells a newcomer to type is typed, in its order, and answers with the lines that it shows.

Numbers may differ. Photographs of a phone, which the README leaves to its reader, are rendered; a night of the MMT is
not part of the project, and its command is left out where the file is not there.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from benchsim.bench.files import read
from benchsim.renderer import backend
from benchsim.renderer.phone import photograph_with_phone

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[1]
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?")
README = (ROOT / "README.md").read_text(encoding="utf-8")


def shown():
    """Lines of commands that blocks of the README show, and what each answers there."""
    for block in re.findall(r"```\n(\$ .*?)```", README, re.S):
        for part in re.split(r"^\$ ", block, flags=re.M)[1:]:
            line, _, answer = part.partition("\n")
            yield line, answer.splitlines()


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    """A folder as the reader's: the scenes, and photographs of a phone of 3 MP."""
    folder = tmp_path_factory.mktemp("desk")
    shutil.copytree(ROOT / "scenes", folder / "scenes")
    backend.use()
    bench = read(ROOT / "scenes" / "phone" / "bench.toml", images=False)
    bench = replace(bench, exposures=bench.exposures[:2], cameras={n: c.binned(2) for n, c in bench.cameras.items()})
    (folder / "taken").mkdir()
    photograph_with_phone(bench, folder / "taken")
    (folder / "taken" / "board").rename(folder / "photos")
    (folder / "taken" / "bench").rename(folder / "bench")
    return folder


def benchsim(words, folder):
    command = [sys.executable, "-m", "benchsim", *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, env={**os.environ, "COLUMNS": "100"})


@pytest.mark.parametrize(("line", "answer"), [pytest.param(*s, id=s[0]) for s in shown()])
def test_a_command_answers_as_it_is_shown(line, answer, desk):
    said = ""
    for command in line.split("&&"):
        words = shlex.split(command)[1:]
        if words[-1].endswith(".dat"):
            nights = sorted(ROOT.parent.glob(f"shared/**/{words[-1]}"))
            if not nights:
                pytest.skip(f"{words[-1]} is not here")
            shutil.copy(nights[0], desk)
        done = benchsim(words, desk)
        # A recording just begun still lacks what only the person at the bench knows.
        assert done.returncode == (1 if words[0] == "check" else 0), done.stderr
        assert "Traceback" not in done.stderr
        said += done.stdout
    had = {re.sub(r"\s+", " ", NUMBER.sub("#", one)).strip() for one in said.splitlines()}
    assert [one for one in answer if re.sub(r"\s+", " ", NUMBER.sub("#", one)).strip() not in had] == []


def test_the_python_of_the_readme_runs(desk):
    (code,) = re.findall(r"```python\n(.*?)```", README, re.S)
    done = subprocess.run([sys.executable, "-"], input=code, cwd=desk, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
