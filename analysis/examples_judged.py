"""Recordings by other code whose truth lies beside them: what is said of each, its cost, and how far sizes are off.

    python analysis/examples_judged.py [--folder ../shared/recordings/bench-other-code] [-o out/examples]

Each is judged by the command line in a process of its own, one after another. *held*: all that is concealed is named or
in a class of at most four that holds it, and nothing else is named; where nothing is concealed, "nothing is missing".
These recordings were seen while the diagnosis was written.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from rays_other_code import SHARED, effects_of

from benchsim.diagnosis.levels import MEMBERS
from benchsim.trial import claims
from benchsim.trial.score import sizes_of


def held(said: dict[str, Any], effects: dict[str, dict[str, float]]) -> bool:
    """Whether a diagnosis allows just what is there."""
    named = [f["name"] for f in said["effects"]]
    classes = [c["members"] for c in said["classes"]]
    if not effects:
        return bool(said["verdict"] == "nothing-missing")
    few = all(len(members) <= MEMBERS for members in classes)
    return few and set(named) <= set(effects) and set(effects) in claims.allowed(named, classes)


def main() -> None:
    """Judge all, a line each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, default=SHARED)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/examples"))
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    for file in sorted((args.folder / "truth").glob("*.json")):
        out, effects = args.output / file.stem, effects_of(json.loads(file.read_text()))
        command = [sys.executable, "-m", "benchsim", "diagnose", str(args.folder / file.stem), "-o", str(out)]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, env=os.environ | {"OMP_NUM_THREADS": "1"})
        _, status, used = os.wait4(process.pid, 0)
        cost = f"{used.ru_utime + used.ru_stime:4.0f} s of CPU  {used.ru_maxrss / 1024:4.0f} MiB"
        if status:
            print(f"{file.stem:16} {cost}  ended with {os.waitstatus_to_exitcode(status)}", flush=True)
            continue
        said = json.loads((out / "diagnosis.json").read_text())
        far = max((abs(s["pull"]) for s in sizes_of({"zero": False, "effects": effects}, said)), default=0.0)
        names = [f["name"] for f in said["effects"]] + [
            "{" + " | ".join(map("+".join, c["members"])) + "}" for c in said["classes"]
        ]
        print(
            f"{file.stem:16} {cost}  {'held' if held(said, effects) else 'NOT HELD'}  largest pull {far:3.1f}  "
            f"{said['verdict']}: {' + '.join(names) or 'nothing'}",
            flush=True,
        )


if __name__ == "__main__":
    main()
