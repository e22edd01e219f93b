"""Are the data's stated errors their true ones? Pulls of what a whole picture shares, and χ² of every family.

    python analysis/noise_pulls.py run --out out/pulls [--kinds plain,bits8,coarse,jpeg,phone] [--cases 6] [--seed 1]
    python analysis/noise_pulls.py run --out out/pulls --kinds other
    python analysis/noise_pulls.py table out/pulls/*.jsonl

Recordings of known truth are read as the diagnosis reads them, and held against the prediction at the truth: settings,
beam and effects as they were drawn, what the file states as unknown and nobody drew (the blur that the marks' edges
show, gains; of other code's pictures the beam as well) marginalised over the whole recording. Of a picture's centre
line, width and flux the common offset, slope and bend along the trace are fitted by weighted least squares, Legendre
polynomials of order 0, 1, 2, and divided by their stated errors; the flux has no offset, its gain is free. χ² and its
probability are given for each family in a picture.

Kinds: ``plain`` 16 bits with no speckle or one of 0.8 px; ``bits8``; ``coarse`` speckle of 1.6 px, as large as the
line; ``jpeg`` of quality 85 to 95 and 8 bits; ``phone`` the same with sRGB's curve and the noise of a small pixel; each
six settings of a concealed trial's benches, blur, gain and room light drawn. ``other``: photographs by other code in
``../shared/recordings`` but for those of a tilted board, whose marks are not the noise's.

One line per picture; what is there is not done again. 35 s of CPU for a recording of six, 10 where it is kept.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.stats import chi2

from benchsim.bench.errors import BenchsimError
from benchsim.bench.files import read
from benchsim.bench.model import Recording
from benchsim.bench.settings import NAMES, to_vector
from benchsim.diagnosis.problem import Problem
from benchsim.instruments.bench import observables
from benchsim.instruments.bench.prediction import SHAPES, UNITS
from benchsim.instruments.bench.problem import build
from benchsim.trial.draws import bench

OTHER = Path(__file__).resolve().parents[2] / "shared" / "recordings" / "bench-other-code"
KINDS = ("plain", "bits8", "coarse", "jpeg", "phone", "other")
OFF = {"n_cx": 0, "n_cy": 1, "n_cz": 2, "n_a1": 3, "n_a2": 4, "n_saz": 5, "n_sel": 6}
ORDERS = {"c": (0, 1, 2), "w": (0, 1, 2), "f": (1, 2)}

Values = dict[str, float]


def drawn(kind: str, seed: int, case: int) -> tuple[Recording, list[str], int]:
    """A bench of a kind with its sensor drawn, its images' names, and the quality of JPEG."""
    rng = np.random.default_rng([seed, case, KINDS.index(kind)])
    recording = bench("six", rng, 2)
    bits = 16 if kind in ("plain", "coarse") else 8
    gamma: float | str = "srgb" if kind == "phone" else 1.0
    cameras = {
        name: replace(
            c,
            bit_depth=bits,
            saturation_level=2.0**bits - 1,
            black_level=0.0 if bits == 8 else c.black_level,
            gamma=gamma,
        )
        for name, c in recording.cameras.items()
    }
    options = replace(
        recording.render,
        blur_px=float(rng.uniform(0.5, 0.9)),
        full_well_e=float(np.exp(rng.uniform(np.log(3000), np.log(5000 if kind == "phone" else 20000)))),
        peak_fraction=float(rng.uniform(0.35, 0.7)),
        room_fraction=float(rng.uniform(0.1, 0.4)),
        speckle_px=1.6 if kind == "coarse" else 1.0 if kind == "phone" else float(rng.choice([0.0, 0.8])),
        relative_error=0.005,
        dark=bool(rng.random() < 0.7),
    )
    suffix = ".jpg" if kind in ("jpeg", "phone") else ".png"
    names = [f"{i:03d}{suffix}" for i in range(1, len(recording.exposures) + 1)]
    return replace(recording, cameras=cameras, render=options), names, int(rng.integers(85, 96))


def rendered(kind: str, seed: int, case: int, folder: Path) -> tuple[Recording, Values]:
    """A recording rendered into a folder, if it is not there, and the true values of its nuisances."""
    from benchsim.renderer import backend, render_recording

    truth = folder / "truth.json"
    if not truth.is_file():
        backend.use()
        recording, names, quality = drawn(kind, seed, case)
        made = render_recording(recording, folder, seed=1000 * seed + case, images=names, jpeg_quality=quality)
        laser = recording.laser
        values = {
            "beam_diameter": made.laser.beam_diameter / laser.beam_diameter - 1,
            "divergence": made.laser.divergence / laser.divergence - 1,
            **dict.fromkeys(SHAPES, 0.0),
        }
        offs = [to_vector(e).tolist() for e in made.errors]
        truth.write_text(json.dumps({"values": values, "errors": offs}))
    recording, known = read(folder), json.loads(truth.read_text())
    return recording, {**known["values"], **_named(recording, known["errors"])}


def foreign(name: str) -> tuple[Recording, Values]:
    """A recording by other code with its effects stated, and the true values of what its truth names."""
    recording = read(OTHER / name)
    truth = json.loads((OTHER / "truth" / f"{name}.json").read_text())
    effects = {e["name"]: {k: p["value"] for k, p in e["parameters"].items()} for e in truth["effects"]}
    errors = []
    for e in recording.exposures:
        off = np.zeros(len(NAMES))
        for key, value in truth["setting_errors"][e.setting].items():
            off[OFF[key]] = value * (1.0 if UNITS[OFF[key]] == "mm" else 1e-3)
        errors.append(off.tolist())
    # Of a board set down anew the two codes turn about axes of their own, which is some 10 µm: its errors stay free.
    values = {k: v for k, v in _named(recording, errors).items() if not k.startswith("seat")}
    return replace(recording, effects=effects), values


def _named(recording: Recording, errors: list[list[float]]) -> Values:
    """Setting errors by the names of the nuisances."""
    from benchsim.bench.settings import OF_THE_SEAT, screen_seats

    out: Values = {}
    for e, seat, off in zip(recording.exposures, screen_seats(recording.exposures), errors, strict=True):
        names = [f"{e.setting}.{n}" for n in NAMES]
        names[OF_THE_SEAT] = [f"seat{seat}.{n}" if seat else "" for n in NAMES[OF_THE_SEAT]]
        for name, unit, value in zip(names, UNITS, off, strict=True):
            if name:
                out[name] = value * (1.0 if unit == "mm" else 1e3)
    return out


def judged(problem: Problem, truth: Values) -> Iterator[dict[str, Any]]:
    """A line for every picture."""
    n = len(problem.data)
    free = [p for p in problem.nuisances if p.name not in truth]
    size = {p.name: 0.3 * p.sigma for p in free}
    at = [dict(truth)]
    for p in free:
        at += [{**truth, p.name: h * size[p.name]} for h in (1.0, -1.0)]
    left, columns = np.zeros(n), np.zeros((n, len(free)))
    noise = np.zeros((n, n))
    for b, covariance in enumerate(problem.covariance):
        rows = problem.rows(b)
        found = problem.predict(at, b)
        left[rows] = problem.data[rows] - found[0]
        for k, p in enumerate(free):
            columns[rows, k] = (found[1 + 2 * k] - found[2 + 2 * k]) * p.sigma / (2 * size[p.name])
        noise[rows, rows] = covariance
    whole = noise + columns @ columns.T
    half = np.linalg.cholesky(whole)
    for b, name in enumerate(problem.names):
        line: dict[str, Any] = {"picture": name, "pulls": {}, "errors": {}, "chi2": {}}
        rows = np.zeros(n, bool)
        rows[problem.rows(b)] = True
        for family, orders in ORDERS.items():
            mine = np.flatnonzero(rows & (problem.kind == family))
            if len(mine) < 8:
                continue
            s = problem.position[mine]
            basis = np.zeros((n, len(orders)))
            x = 2 * (s - s.min()) / np.ptp(s) - 1
            basis[mine] = np.polynomial.legendre.legvander(x, max(orders))[:, list(orders)]
            a, r = (np.linalg.solve(half, y) for y in (basis, left))
            spread = np.linalg.inv(a.T @ a)
            value = spread @ (a.T @ r)
            for k, order in enumerate(orders):
                line["pulls"][f"{family}{order}"] = float(value[k] / np.sqrt(spread[k, k]))
                line["errors"][f"{family}{order}"] = [float(value[k]), float(np.sqrt(spread[k, k]))]
        for family in "cwfgm":
            mine = np.flatnonzero(rows & (problem.kind == family))
            if not len(mine):
                continue
            c = (noise if family == "m" else whole)[np.ix_(mine, mine)]
            found = float(left[mine] @ np.linalg.solve(c, left[mine]))
            dof = len(mine) - (6 if family == "m" else 0)
            line["chi2"][family] = [found, dof, float(chi2.sf(found, dof))]
        yield line


def recording_of(kind: str, seed: int, case: int, keep: Path | None) -> tuple[Recording, Values]:
    """One recording of a kind, rendered where it is not kept."""
    if kind == "other":
        return foreign(others()[case])
    folder = (keep or Path(tempfile.mkdtemp())) / f"{kind}-{seed}-{case}"
    folder.mkdir(parents=True, exist_ok=True)
    return rendered(kind, seed, case, folder)


def others() -> list[str]:
    """Recordings by other code whose board is not tilted."""
    out = []
    for path in sorted((OTHER / "truth").glob("*.json")):
        if not any(e["name"] == "screen-tilt" for e in json.loads(path.read_text())["effects"]):
            out.append(path.stem)
    return out


def run(options: argparse.Namespace) -> None:
    """Every case that is not in the files yet."""
    options.out.mkdir(parents=True, exist_ok=True)
    for kind in options.kinds.split(","):
        if kind == "other" and not OTHER.is_dir():
            print(f"{OTHER} is not there; other code's pictures are left out", file=sys.stderr)
            continue
        path = options.out / f"{kind}-{options.seed}.jsonl"
        done = {json.loads(line)["case"] for line in path.read_text().splitlines()} if path.is_file() else set()
        for case in range(len(others()) if kind == "other" else options.cases):
            if case in done:
                continue
            start = time.process_time()
            try:
                recording, truth = recording_of(kind, options.seed, case, options.keep)
                observed, lost = observables.observe(recording)
                lines = list(judged(build(recording, observed, attached=False), truth))
            except BenchsimError as error:
                lines, lost = [{"picture": "", "pulls": {}, "errors": {}, "chi2": {}}], (str(error),)
            with path.open("a") as file:
                for line in lines:
                    file.write(json.dumps({"kind": kind, "seed": options.seed, "case": case, **line}) + "\n")
            spent = time.process_time() - start
            print(f"{kind} {case}: {len(lines)} pictures, {spent:.0f} s of CPU {' '.join(lost)}", file=sys.stderr)


def table(files: list[Path]) -> None:
    """Standard deviations of the pulls about 0 with their sigma, and of χ² the mean per datum and the small p."""
    lines = [json.loads(x) for f in files for x in f.read_text().splitlines()]
    keys = [f"{family}{k}" for family, orders in ORDERS.items() for k in orders]
    print(f"{'kind':<8}{'n':>5}" + "".join(f"{k:>7}" for k in keys) + "   χ² per dof, share of p < 0.01: c w f g m")
    for kind in [*dict.fromkeys(x["kind"] for x in lines), "all"]:
        mine = [x for x in lines if kind in ("all", x["kind"])]
        row = f"{kind:<8}{len(mine):>5}"
        for key in keys:
            pulls = np.array([x["pulls"][key] for x in mine if key in x["pulls"]])
            row += f"{np.sqrt(np.mean(pulls**2)) if len(pulls) else np.nan:>7.2f}"
        for family in "cwfgm":
            found = np.array([x["chi2"][family] for x in mine if family in x["chi2"]])
            if len(found):
                small = 100 * np.mean(found[:, 2] < 0.01)
                row += f"   {family} {found[:, 0].sum() / found[:, 1].sum():.2f} {small:.0f} %"
        print(row)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(required=True, dest="command")
    go = commands.add_parser("run")
    go.add_argument("--kinds", default=",".join(KINDS))
    go.add_argument("--cases", type=int, default=8, help="recordings of six pictures, of each kind")
    go.add_argument("--seed", type=int, default=1)
    go.add_argument("--out", type=Path, required=True)
    go.add_argument("--keep", type=Path, help="keep the pictures here, and use those that are there")
    show = commands.add_parser("table")
    show.add_argument("files", type=Path, nargs="+")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    if options.command == "run":
        run(options)
    else:
        table(options.files)


if __name__ == "__main__":
    main()
