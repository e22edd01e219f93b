"""Commands killed at random moments and begun again: is the result an undisturbed run's, and is anything left behind?

    python analysis/kill_runs.py --seed 1 --kills 30 --folder FOLDER run diagnose trial

Each command is killed up to ``--chain`` times in a row (SIGKILL or SIGTERM to its first process, or SIGINT to all, as a
terminal sends it), at moments drawn uniformly from the time that it takes undisturbed, then left to end. ``trial`` is
``trial run`` with the tests' quick generator and judge; ``whole-trial`` the command itself, one case.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil

ROOT = Path(__file__).resolve().parents[1]

TRIAL = """
import sys
from functools import partial
from pathlib import Path
sys.path.insert(0, {fakes!r})
import fakes
from benchsim import cli
from benchsim.trial import concealing, running
if __name__ == "__main__":
    running.conceal = partial(concealing.conceal, make=fakes.make, certificate=fakes.certificate)
    import benchsim.trial
    judge = partial(running.apart, diagnose=partial(fakes.diagnose, seconds=0.1))
    benchsim.trial.run = partial(running.run, judge=judge)
    cli.main()
"""

SMALL = {
    "resolution_px = [2000, 1500]": "resolution_px = [1000, 750]",
    "focal_px = 2200.0": "focal_px = 1100.0",
    "principal_point_px = [999.5, 749.5]": "principal_point_px = [499.5, 374.5]",
}
"""Of a scene: half the pixels each way."""

TIMES = re.compile(rb"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d)?(\+\d\d:\d\d|Z)?")
DISK = re.compile(rb'(?<= order on disk":)\d+')
CHAIN = re.compile(rb'"(?:hash|results|page)":"([0-9a-f]{64})"')
"""All that may differ between two runs: times, a trial's note of where the disk put a file, and the hashes of its
ledger, which hold both."""

MARK = "BENCHSIM_KILL_RUN"
"""Environment of every process of a run, by which those that outlive it are found."""

PATIENCE = 10.0
"""What a process may take to notice that its parent is gone [s]: it may be importing."""


def commands(folder: Path) -> dict[str, list[str]]:
    """Name → command, without ``-o``; what they read is made where it is not there."""
    benchsim = [sys.executable, "-m", "benchsim"]
    recording, driver = folder / "recording", folder / "trial.py"
    folder.mkdir(parents=True, exist_ok=True)
    if not recording.exists():
        text = (ROOT / "scenes" / "fig7a.toml").read_text()
        for old, new in SMALL.items():
            text = text.replace(old, new)
        (folder / "small.toml").write_text(text)
        shutil.copy(ROOT / "scenes" / "marks.csv", folder)
        subprocess.run([*benchsim, "render", str(folder / "small.toml"), "-o", str(recording)], check=True)
    driver.write_text(TRIAL.format(fakes=str(ROOT / "tests" / "trial")))
    trial = ["trial", "run", "--seed", "7", "--workers", "2"]
    return {
        "board": [*benchsim, "board"],
        "run": [*benchsim, "run", str(recording)],
        "diagnose": [*benchsim, "diagnose", str(recording)],
        "trial": [sys.executable, str(driver), *trial, "--cases", "12"],
        "whole-trial": [*benchsim, *trial, "--cases", "1", "--shrink", "4"],
    }


def begin(command: list[str], place: Path) -> subprocess.Popen[bytes]:
    """Start a command that writes ``place/out``, with a temporary folder of its own in ``place``."""
    (place / "tmp").mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, "TMPDIR": str(place / "tmp"), MARK: str(place)}
    return subprocess.Popen(
        [*command, "-o", str(place / "out")],
        env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True,
    )  # fmt: skip


def ended(process: subprocess.Popen[bytes]) -> None:
    said = process.communicate()[1].decode()
    if process.returncode:
        raise SystemExit(f"{process.args}: ended with {process.returncode}\n{said}")


def orphans(place: Path) -> int:
    """Processes of a run that are still there when they should have noticed its end."""
    until = time.monotonic() + PATIENCE
    while (alive := [p for p in psutil.process_iter() if _of(p, place)]) and time.monotonic() < until:
        time.sleep(0.05)
    return len(alive)


def _of(process: psutil.Process, place: Path) -> bool:
    try:
        return process.status() != psutil.STATUS_ZOMBIE and process.environ().get(MARK) == str(place)
    except psutil.Error:
        return False


def contents(folder: Path) -> dict[str, bytes]:
    """Relative name → body of every file, without where it lies and what may differ."""
    found = {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}
    ledgers = [body for name, body in found.items() if name.endswith(".jsonl")]
    chained = {h: b"%d" % i for i, h in enumerate(dict.fromkeys(h for body in ledgers for h in CHAIN.findall(body)))}
    for name, body in found.items():
        if name.endswith((".json", ".jsonl", ".html", ".txt")):
            body = DISK.sub(b"", TIMES.sub(b"", body.replace(bytes(folder), b"")))
            found[name] = re.sub(rb"[0-9a-f]{64}", lambda h: chained.get(h[0], h[0]), body)
    return found


def left_behind(place: Path) -> list[str]:
    """What is beside the result, hidden in it, or in the temporary folder."""
    beside = [p.name for p in place.iterdir() if p.name not in ("out", "tmp")]
    hidden = [p.name for p in (place / "out").rglob(".*")]
    return beside + hidden + [p.name for p in (place / "tmp").iterdir()]


def disturbed(command: list[str], folder: Path, kills: int, chain: int, rng: random.Random) -> dict[str, object]:
    """Kill a command so many times and compare what comes of it with an undisturbed run's."""
    shutil.rmtree(folder, ignore_errors=True)
    start = time.monotonic()
    ended(begin(command, folder / "whole"))
    seconds = time.monotonic() - start
    wanted, done, runs = contents(folder / "whole" / "out"), 0, 0
    outlived, left, differing = 0, left_behind(folder / "whole"), []
    while done < kills:
        place = folder / f"{runs}"
        for _ in range(min(chain, kills - done)):
            process = begin(command, place)
            try:
                process.wait(rng.uniform(0, seconds))
                break  # it was quicker than the undisturbed one
            except subprocess.TimeoutExpired:
                pass
            number = rng.choice([signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
            (os.killpg if number == signal.SIGINT else os.kill)(process.pid, number)
            # Not to the end of what is said: whoever outlives it holds that open.
            process.wait()
            done += 1
            outlived += orphans(place)
        ended(begin(command, place))
        runs += 1
        found = contents(place / "out")
        differing += sorted(k for k in wanted.keys() | found.keys() if wanted.get(k) != found.get(k))
        left += left_behind(place)
        shutil.rmtree(place)
    return {
        "seconds": round(seconds, 1), "kills": done, "compared": runs, "files": len(wanted),
        "differing": differing, "left": left, "orphans": outlived,
    }  # fmt: skip


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="+")
    parser.add_argument("--kills", type=int, default=30, help="of each command")
    parser.add_argument("--chain", type=int, default=5, help="kills before it is left to end")
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--folder", type=Path, required=True)
    asked = parser.parse_args(arguments)
    # Started in the background it is ignored, and would be by all that are started here.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    known, bad = commands(asked.folder.absolute()), False
    for name in asked.names:
        rng = random.Random(f"{asked.seed} {name}")
        found = disturbed(known[name], asked.folder.absolute() / name, asked.kills, asked.chain, rng)
        print(name, json.dumps(found), flush=True)
        bad |= bool(found["differing"] or found["left"] or found["orphans"])
    return int(bad)


if __name__ == "__main__":
    sys.exit(main())
