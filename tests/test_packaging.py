"""What pyproject.toml installs is what the folder tree holds."""

import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def test_every_package_is_listed():
    listed = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"])
    found = {".".join(p.parent.relative_to(ROOT).parts) for p in (ROOT / "benchsim").rglob("__init__.py")}
    assert listed == found | {"benchsim.scenes"}


def test_versions_agree():
    import benchsim

    assert tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"] == benchsim.__version__
