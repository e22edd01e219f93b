"""Which version of each dependency has a wheel for which platform and Python: what installs, not what works.

    python analysis/platforms.py

Nothing is installed; `pip` is asked what it would take, platform by platform.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
import tomllib
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PLATFORMS = {
    "Linux x86-64": [f"manylinux{tag}_x86_64" for tag in ("_2_28", "_2_27", "_2_24", "_2_17", "2014")],
    "Linux aarch64": [f"manylinux{tag}_aarch64" for tag in ("_2_28", "_2_27", "_2_24", "_2_17", "2014")],
    "macOS arm64": [f"macosx_{major}_0_arm64" for major in (14, 13, 12, 11)],
    "Windows x86-64": ["win_amd64"],
}
"""And the wheels' tags that each takes; pip compares them letter by letter."""

PYTHONS = ("3.11", "3.12", "3.13", "3.14")


def resolved(requirement: str, platform: str, python: str) -> str | None:
    """Version of the wheel that pip takes, None where there is none."""
    with tempfile.TemporaryDirectory() as empty:
        command = [sys.executable, "-m", "pip", "install", "--dry-run", "--quiet", "--no-deps", "--ignore-installed"]
        command += ["--only-binary", ":all:", "--python-version", python]
        command += [word for tag in PLATFORMS[platform] for word in ("--platform", tag)]
        command += ["--target", empty, "--report", "-", requirement]
        done = subprocess.run(command, cwd=empty, capture_output=True, text=True, check=False)
    if done.returncode:
        return None
    return json.loads(done.stdout)["install"][0]["metadata"]["version"]


def main() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for requirement in project["dependencies"]:
        asked = requirement.partition(";")[0].strip()
        found: dict[str | None, list[str]] = defaultdict(list)
        for platform in PLATFORMS:
            for python in PYTHONS:
                found[resolved(asked, platform, python)].append(f"{platform} {python}")
        every = len(PLATFORMS) * len(PYTHONS)
        for version, where in found.items():
            places = "everywhere" if len(where) == every else ", ".join(where)
            print(f"{re.split('[<>=]', asked)[0]:30s} {version or 'no wheel':12s} {places}", flush=True)


if __name__ == "__main__":
    main()
