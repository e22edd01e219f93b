"""Photographs as a phone makes them, from camera to verdict: is a clean bench left alone, is a bowed board named?

    python analysis/phone_recordings.py run --rows clean,bow --cases 2 --seed 6 --out out/phone
    python analysis/phone_recordings.py table out/phone/*.jsonl
    python analysis/phone_recordings.py walk --out out/walk
    python analysis/phone_recordings.py pictures --out out/walk

`run`: the bench of ``scenes/phone/bench.toml``, every case with setting errors, lens, motion and noise of its own,
drawn from (seed, case). Photographs are calibrated by `benchsim calibrate` from the views of the board, which bows
there too, begun by `benchsim new`, filled in as a person would, checked and diagnosed. A bow is 20 sigma large: four
times the five-sigma limit that the diagnosis of the first clean case states, in a direction drawn per case. Every step
that is done stays done; a stopped study goes on where it was. ``--megapixels`` takes a smaller phone, for a quick look;
``--lens drawn`` puts a lens known to ``DRAWN_SIGMA`` in the place of `benchsim calibrate`'s.

`walk`: the commands of ``scenes/phone/README.md`` one after the other, with their times. `pictures`: those of that
page, from the photographs that `walk` left.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

PHONE = Path(__file__).resolve().parents[1] / "scenes" / "phone"
SIGMAS = 20.0

DRAWN_SIGMA = (3e-4, 0.3, 5e-4)
"""Of a drawn lens: focal length (fraction), principal point (px), k1; a dozen views of 40 marks do as well."""


def fill(recording: Path, bench: Path) -> None:
    """Write what the person at the bench knows into the places that `benchsim new` marked."""
    mine, known = tomlkit.parse(recording.read_text()), tomlkit.parse(bench.read_text())
    for table in ("laser", "mirror", "screen"):
        for key, value in known[table].items():
            if mine[table].get(key) == "?":
                mine[table][key] = value
    for key, value in known["uncertainty"].items():
        if key != "intrinsics_sigma":
            mine["uncertainty"][key] = value
    for e, stated in zip(mine["exposure"], known["exposure"], strict=True):
        for key in ("laser_azimuth_deg", "laser_elevation_deg", "mirror_position_mm", "screen_roll_deg"):
            if key in stated:
                e[key] = stated[key]
    recording.write_text(tomlkit.dumps(mine))


def smaller(bench: Path, folder: Path, megapixels: float) -> Path:
    """The bench with a phone of so many megapixels, beside its marks."""
    doc = tomlkit.parse(bench.read_text())
    for camera in doc["cameras"].values():
        w, h = camera["resolution_px"]
        k = float(np.sqrt(megapixels * 1e6 / (w * h)))
        if k < 0.99:
            camera["resolution_px"] = [round(w * k), round(h * k)]
            camera["focal_px"] = float(camera["focal_px"]) * k
            camera["principal_point_px"] = [(round(n * k) - 1) / 2 for n in (w, h)]
            doc["uncertainty"]["intrinsics_sigma"][1] *= k
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "bench.toml").write_text(tomlkit.dumps(doc))
    (folder / "marks.csv").write_bytes((bench.parent / "marks.csv").read_bytes())
    return folder / "bench.toml"


def command(log: list[dict[str, Any]], *words: str | Path) -> subprocess.CompletedProcess[str]:
    """Run one command of benchsim, noting its times."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    args = [str(w) for w in words]
    done = subprocess.run([sys.executable, "-m", "benchsim", *args], capture_output=True, text=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    log.append(
        {
            "command": args[0],
            "wall_s": round(time.monotonic() - began, 1),
            "cpu_s": round(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, 1),
            "exit": done.returncode,
        }
    )
    print(f"  {' '.join(args)}: {log[-1]}", file=sys.stderr, flush=True)
    return done


def draw_lens(bench: Path, seed: int, file: Path) -> None:
    """``camera.toml`` of the true camera but for a draw of ``DRAWN_SIGMA``."""
    from benchsim.bench.files import read
    from benchsim.calibration.record import write_camera
    from benchsim.calibration.solve import LENS
    from benchsim.renderer.phone import draw_truth

    camera = draw_truth(read(bench, images=False), seed)[2]
    focal, point, k1 = DRAWN_SIGMA
    off = np.random.default_rng([seed, 1]).standard_normal(4)
    camera = replace(
        camera,
        focal=float(camera.focal * (1 + focal * off[0])),
        principal_point=tuple(float(c + point * d) for c, d in zip(camera.principal_point, off[1:3], strict=True)),
        distortion=(float(camera.distortion[0] + k1 * off[3]), *camera.distortion[1:]),
        gamma="unknown",
    )
    size = np.array([camera.focal * focal, point, point, k1, 0.0, 0.0, 0.0, 0.0])
    assert len(size) == len(LENS)
    write_camera(file, camera, DRAWN_SIGMA, np.diag(size**2), photographs=12, marks=480, rms=0.1, board="drawn")


def one_case(
    folder: Path, bench: Path, seed: int, effects: Sequence[str], drawn: bool, checked: bool
) -> dict[str, Any]:
    """From photographs to the verdict; what lies in the folder already is taken as done."""
    if drawn and not (folder / "camera.toml").exists():
        folder.mkdir(parents=True, exist_ok=True)
        draw_lens(bench, seed, folder / "camera.toml")
    times = folder / "times.json"
    log: list[dict[str, Any]] = json.loads(times.read_text()) if times.exists() else []
    folder.mkdir(parents=True, exist_ok=True)
    board = ["--board", bench.parent / "marks.csv"]
    steps: list[tuple[Path, list[str | Path]]] = [
        (folder / "photos", ["render", bench, "--phone", "--seed", str(seed), "-o", folder / "photos", *effects]),
        (folder / "camera.toml", ["calibrate", folder / "photos" / "board", *board, "-o", folder / "camera.toml"]),
        (
            folder / "recording" / "recording.toml",
            ["new", folder / "recording", "--photos", folder / "photos" / "bench", "--calibration",
             folder / "camera.toml", "--marks", bench.parent / "marks.csv"],
        ),
        (folder / "check", ["check", folder / "recording", "-o", folder / "check"]),
        (
            folder / "diagnosis" / "diagnosis.json",
            ["diagnose", folder / "recording", "--no-pictures", "-o", folder / "diagnosis"],
        ),
    ]  # fmt: skip
    for made, words in steps:
        if made.exists() or (words[0] == "check" and not checked):
            continue
        done = command(log, *words)
        times.write_text(json.dumps(log))
        if not made.exists():
            return {"stopped": words[0], "says": done.stderr.strip()[-400:]}
        if words[0] == "new":
            fill(made, bench)
    looked = json.loads((folder / "check" / "check.json").read_text()) if checked else {"usable": None}
    found = json.loads((folder / "diagnosis" / "diagnosis.json").read_text())
    return {
        "usable": looked["usable"],
        "verdict": found["verdict"],
        "effects": [e["name"] for e in found["effects"]],
        "classes": [c["members"] for c in found["classes"]],
        "parameters": {e["name"]: e["parameters"] for e in found["effects"]},
        "bow_limit": found["limits"].get("screen-bow", {}).get("five_sigma"),
        "noise": found["noise"],
        "cpu_s": round(sum(step["cpu_s"] for step in log), 1),
    }


def run(rows: Sequence[str], cases: int, seed: int, megapixels: float, drawn: bool, checked: int, out: Path) -> None:
    """Case by case, the clean one first: the first of all says how large a bow must be."""
    bench = smaller(PHONE / "bench.toml", out / "bench", megapixels)
    for case in range(cases):
        for row in sorted(rows, key=lambda r: r != "clean"):
            table = out / f"{row}-{seed}.jsonl"
            done = {json.loads(line)["case"] for line in table.read_text().splitlines()} if table.exists() else set()
            if case in done:
                continue
            own = 1000 * seed + 2 * case + (row == "bow")
            bow = bow_of(out, seed, own) if row == "bow" else {}
            effects = [w for k, v in bow.items() for w in ("--effect", f"screen-bow.{k}={v:.6g}")]
            result = one_case(out / f"{row}-{seed}-{case}", bench, own, effects, drawn, case < checked)
            about = {"row": row, "seed": seed, "case": case, "megapixels": megapixels, "drawn_lens": drawn, "bow": bow}
            line = {**about, **result}
            with table.open("a") as handle:
                handle.write(json.dumps(line) + "\n")
            print(json.dumps(line), flush=True)


def bow_of(out: Path, seed: int, own: int) -> dict[str, float]:
    """A bow of ``SIGMAS``, in a direction of its own [1/m]."""
    lines = (out / f"clean-{seed}.jsonl").read_text().splitlines() if (out / f"clean-{seed}.jsonl").exists() else []
    limits = [json.loads(line).get("bow_limit") for line in lines]
    if not limits or not limits[0]:
        raise SystemExit("run the clean row first: its first case says how large a bow is five sigma")
    size, angle = SIGMAS / 5.0 * limits[0], np.random.default_rng(own).uniform(0, 2 * np.pi)
    return {"bow_y": float(size * np.cos(angle)), "bow_z": float(size * np.sin(angle))}


def table(files: Sequence[Path]) -> None:
    """Shares with their 95 % intervals by Wilson (J. Am. Stat. Assoc. 22, 209, 1927)."""
    lines = [json.loads(line) for f in files for line in f.read_text().splitlines()]
    for row, right in (("clean", ("nothing-missing", [])), ("bow", ("named", ["screen-bow"]))):
        own = [r for r in lines if r["row"] == row]
        if not own:
            continue
        good = sum((r.get("verdict"), r.get("effects")) == right for r in own)
        n = len(own)
        z = 1.96
        middle, half = good + z * z / 2, z * np.sqrt(good * (n - good) / n + z * z / 4)
        low, high = (middle - half) / (n + z * z), (middle + half) / (n + z * z)
        print(f"{row}: {good} of {n} {right[0]} {' '.join(right[1])} ({100 * low:.0f}–{100 * high:.0f} %)")
        for r in own:
            if (r.get("verdict"), r.get("effects")) != right:
                print(f"  case {r['case']}: {r.get('verdict', r.get('says'))} {r.get('effects', '')}")
        pulls = [
            (p["value"] - r["bow"][k]) / p["sigma"]
            for r in own
            for k, p in r.get("parameters", {}).get("screen-bow", {}).items()
            if k in r["bow"]
        ]
        if pulls:
            print(f"  pulls of the bow: {', '.join(f'{p:+.1f}' for p in pulls)}")


def walk(out: Path) -> None:
    """The walk-through's own commands, as its page has them, with their times."""
    text = (PHONE / "README.md").read_text()
    commands = re.findall(r"^\$ benchsim (.*)$", text, re.MULTILINE)
    out.mkdir(parents=True, exist_ok=True)
    log: list[dict[str, Any]] = []
    os.chdir(out)
    for words in commands:
        parts = words.replace("scenes/phone", str(PHONE)).split()
        command(log, *parts)
        if parts[0] == "new":
            fill(Path(parts[1]) / "recording.toml", PHONE / "bench.toml")
    cpu, wall = (sum(step[k] for step in log) for k in ("cpu_s", "wall_s"))
    print(f"{len(commands)} commands, {cpu / 60:.1f} min of CPU, {wall / 60:.1f} min by the clock")


def pictures(out: Path) -> None:
    """The page's pictures: where everything stands, what the phone sees, what its calibration and the report show."""
    import cv2
    import matplotlib.pyplot as plt

    from benchsim.bench.files import read
    from benchsim.bench.place import place, toward_source

    folder = PHONE / "pictures"
    folder.mkdir(exist_ok=True)
    names = ("bench/IMG_0001.jpg", "bench/IMG_0002.jpg", f"board/{min((out / 'photos/board').iterdir()).name}")
    shown = [cv2.resize(cv2.imread(str(out / "photos" / n)), (640, 480), interpolation=cv2.INTER_AREA) for n in names]
    cv2.imwrite(str(folder / "photographs.jpg"), cv2.hconcat(shown), [cv2.IMWRITE_JPEG_QUALITY, 88])

    for source, name in (("camera.png", "calibration.jpg"), ("mine-diagnose/residuals.png", "residuals.jpg")):
        whole = cv2.imread(str(out / source))
        size = (1000, round(1000 * whole.shape[0] / whole.shape[1]))
        small = cv2.resize(whole, size, interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(folder / name), small, [cv2.IMWRITE_JPEG_QUALITY, 90])

    bench = read(PHONE / "bench.toml", images=False)
    camera, e = bench.cameras["phone"], bench.exposures[0]
    at, half = place(bench.mirror, e), np.array(bench.screen.size) / 2
    source = toward_source(e.laser_azimuth, e.laser_elevation)
    mirror, eye = np.array(e.mirror_position), np.array(camera.position)
    figure, axes = plt.subplots(1, 2, figsize=(11, 5.4), layout="constrained")
    for ax, j, name in ((axes[0], 2, "from the east: x and z"), (axes[1], 1, "from above: x and y")):
        laser = mirror + 900 * source
        ax.plot([0, 0], [-half[j - 1], half[j - 1]], color="black", lw=4, solid_capstyle="butt")
        ax.plot([laser[0], mirror[0], 0], [laser[j], mirror[j], 0], color="red", lw=1.5)
        normal = mirror + 250 * at.normal
        ax.plot([mirror[0], normal[0]], [mirror[j], normal[j]], color="0.5", ls="--", lw=1)
        ax.plot(*mirror[[0, j]], "o", color="tab:blue", ms=9)
        ax.plot(*eye[[0, j]], "s", color="tab:green", ms=9)
        ax.annotate("screen, origin at its centre", (0, half[j - 1]), (40, half[j - 1]), va="center", fontsize=9)
        for what, point in (
            (f"mirror, C = {e.mirror_position} mm", mirror), ("phone", eye), ("to the laser", laser)
        ):  # fmt: skip
            below = (-10, -16) if what.startswith("mirror") else (-10, -4)
            ax.annotate(what, point[[0, j]], below, textcoords="offset points", fontsize=9, ha="right")
        ax.set(title=name, xlabel="x, toward the mirror (mm)", ylabel=f"{'xyz'[j]} (mm)", aspect="equal")
        ax.set(xlim=(-100, 1700), ylim=(-1600, 500) if j == 2 else (-1050, 1050))
        ax.grid(color="0.9")
    figure.savefig(folder / "bench.png", dpi=90)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    sub = parser.add_subparsers(dest="what", required=True)
    r = sub.add_parser("run")
    r.add_argument("--rows", default="clean,bow")
    r.add_argument("--cases", type=int, default=2)
    r.add_argument("--seed", type=int, default=6)
    r.add_argument("--megapixels", type=float, default=12.2)
    r.add_argument("--checked", type=int, default=5, help="cases of each row that go through 'benchsim check' too")
    r.add_argument("--lens", choices=("calibrated", "drawn"), default="calibrated")
    r.add_argument("--out", type=Path, default=Path("out/phone"))
    t = sub.add_parser("table")
    t.add_argument("files", type=Path, nargs="+")
    w = sub.add_parser("walk")
    w.add_argument("--out", type=Path, default=Path("out/walk"))
    p = sub.add_parser("pictures")
    p.add_argument("--out", type=Path, default=Path("out/walk"))
    a = parser.parse_args()
    if a.what == "pictures":
        pictures(a.out)
    elif a.what == "run":
        run(a.rows.split(","), a.cases, a.seed, a.megapixels, a.lens == "drawn", a.checked, a.out)
    elif a.what == "table":
        table(a.files)
    else:
        walk(a.out)


if __name__ == "__main__":
    main()
