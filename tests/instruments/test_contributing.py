"""The contributor's page: its worked example, applied to a copy of the package, adds an effect by three files alone."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "benchsim" / "instruments" / "bench" / "CONTRIBUTING.md"

RUN = """
import math
from dataclasses import replace
import numpy as np
import benchsim
from benchsim import rays
from benchsim.bench.files import read
from benchsim.bench.place import place
from benchsim.instruments.bench import effects, observables
from benchsim.instruments.bench.candidates import candidates
from benchsim.instruments.bench.problem import build
from benchsim.renderer import EFFECTS as drawn
from benchsim.renderer.motion import motion

assert benchsim.__file__.startswith({copy!r}), benchsim.__file__
settling = dict(sety=0.4, setz=-0.2, set_h=0.5)
plain = read({scene!r}, images=False)
plain = replace(plain, exposures=plain.exposures[:3])
moved = replace(plain, effects=dict(settling=settling))
effects.check(moved)
assert "settling" in rays.EFFECTS and "settling" in drawn
late = moved.exposures[2]
share = 1 - math.exp(-late.time / 3600 / 0.5)
a, b = (rays.predict(r, late, width=False).points for r in (plain, moved))
at = place(moved.mirror, late)
ey, ez = at.screen_rotation[:, 1], at.screen_rotation[:, 2]
world = share * np.array([0.0, 0.4, -0.2])
expected = np.array([world @ ey, world @ ez])
# Points slide along the trace where it is cut by the board's edge: compare across it.
from benchsim.bench.curve import Curve, signed_distance
normal = signed_distance(Curve(a + expected), b)[0]
assert np.abs(normal).max() < 1e-6, np.abs(normal).max()
assert np.allclose(motion(moved, late, at).shift, expected, atol=1e-12)
problem = build(plain, observables.simulate(plain), attached=False)
assert "settling" not in [e.name for e in candidates(replace(plain, exposures=plain.exposures[:1]))]
entry = next(e for e in problem.catalogue if e.name == "settling")
changed = problem.predict(settling, 2) - problem.predict({{}}, 2)
assert np.abs(changed).max() > 0.01
print("settled")
"""


def edits(text):
    """(file, was, now) of every block of the page, in order."""
    file, out = None, []
    for part in re.split(r"(?m)^(?=\*\*`benchsim/|```python\n# was)", text):
        if found := re.match(r"\*\*`(benchsim/[\w/.]+)`\*\*", part):
            file = found.group(1)
        elif found := re.match(r"```python\n# was\n(.*?)# now\n(.*?)```", part, re.DOTALL):
            out.append((file, found.group(1), found.group(2)))
    return out


@pytest.fixture(scope="module")
def changes():
    return edits(PAGE.read_text(encoding="utf-8"))


def test_the_example_touches_three_files(changes):
    files = [file for file, _, _ in changes]
    assert len(set(files)) == 3 and len(files) == 5
    assert [Path(f).parts[1] for f in dict.fromkeys(files)] == ["rays", "renderer", "instruments"]


def test_the_example_works_as_it_stands(changes, tmp_path):
    """Ray model, picture model and catalogue know the new effect, and agree with its closed form."""
    copy = tmp_path / "copy"
    shutil.copytree(ROOT / "benchsim", copy / "benchsim", ignore=shutil.ignore_patterns("__pycache__"))
    for file, was, now in changes:
        path = copy / file
        text = path.read_text(encoding="utf-8")
        assert text.count(was) == 1, f"{file}: the page's '# was' no longer stands there once:\n{was}"
        path.write_text(text.replace(was, now), encoding="utf-8")
    script = RUN.format(copy=str(copy), scene=str(ROOT / "scenes" / "campaign12.toml"))
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=copy, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0 and done.stdout.strip() == "settled", done.stderr
