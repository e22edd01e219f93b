"""Does a diagnosis of a heliostat's past predict its future? Later records against what was learnt from earlier ones.

    python analysis/field_prediction.py [--folder ../shared/recordings/heliostat-juelich/field] [-o out/field]
        [--heliostats BE61,BF42] [--learn 0.7]

Of every heliostat the first 70 % of the records (in the order of their numbers, which is that of time) are diagnosed in
a folder of their own by the command's own job; ``benchsim predict`` then says by how much the mount of ``amended.toml``
misses in the remaining ones, here in mrad of the beam, twice those of the normal. Beside it the mount as stated, and
its peers, soft-L1 least squares to the same early records: *plain*, of two tilts of the first axis and two encoder
offsets, and *ten*, of these and length, offset and lever of both actuators. Records that all of them miss by more than
5 mrad had a wrong day and are left aside, but for the part that lies within the predicted sigma (68 % wanted), which is
of all. Nothing is chosen by looking at the later records.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from benchsim.instruments.mount import paint
from benchsim.instruments.mount.problem import predicted
from benchsim.instruments.mount.records import Session
from benchsim.jobs import mount_diagnosis, predict

Array = NDArray[np.float64]

WRONG_DAY = 5.0
"""mrad"""

ANGLES = ("tilt_n", "tilt_u", "IA", "IE")
LENGTHS = tuple(f"{kind}_{k}" for kind in ("length", "offset", "radius") for k in (1, 2))
METHODS = ("stated", "amended", "plain", "ten")
FITTED = METHODS[1:]


def miss(session: Session, x: dict[str, float] | None = None) -> Array:
    """Predicted less recorded direction of every record, (n, 2) [mrad]; ``x``: further errors inside [rad, mm]."""
    predict = predicted(session, [])
    at = {name: np.full(1, value) for name, value in predict.stated.items()}
    at |= {name: at.get(name, 0.0) + np.full(1, value) for name, value in (x or {}).items()}
    return predict.inside(at, np.arange(len(session.records.names)))


def peer(early: Session, angles: tuple[str, ...], lengths: tuple[str, ...] = ()) -> dict[str, float]:
    """Some angles [rad] and lengths [mm] of the mount by robust least squares."""
    names, unit = (*angles, *lengths), np.array([1e-3] * len(angles) + [1.0] * len(lengths))

    def rest(x: Array) -> Array:
        return miss(early, dict(zip(names, unit * x, strict=True))).ravel()

    found = least_squares(rest, np.zeros(len(names)), loss="soft_l1", x_scale="jac" if lengths else 1.0).x
    return dict(zip(names, unit * found, strict=True))


def parted(folder: Path, into: Path, part: float) -> tuple[Path, Path]:
    """Two folders of PAINT files: the early records, and the later ones."""
    session, records = paint.read(folder), paint.recorded(folder)
    count = round(part * len(records))
    out = []
    for name, files in (("early", records[:count]), ("late", records[count:])):
        place = into / name
        place.mkdir(parents=True)
        for file in (*files, *session.files[-2:]):
            shutil.copy(file, place)
        out.append(place)
    return out[0], out[1]


def one(folder: Path, part: float) -> dict[str, object]:
    """One heliostat: misses of the later records [mrad]."""
    with tempfile.TemporaryDirectory() as scratch:
        early, late = parted(folder, Path(scratch), part)
        began = time.process_time()
        result = mount_diagnosis.diagnose(early, Path(scratch) / "out", draw=False)
        spent = time.process_time() - began
        foretold = predict(Path(scratch) / "out" / "amended.toml", late, Path(scratch) / "predict", draw=False)
        as_stated, learnt = paint.read(late), paint.read(early)
        d = result.diagnosis
        return {
            "heliostat": folder.name,
            "early": len(result.session.records.names),
            "late": len(as_stated.records.names),
            "verdict": d.verdict,
            "effects": {f.name: f.confidence for f in d.effects},
            "classes": [[list(m) for m in c.members] for c in d.classes],
            "put_in": result.found,
            "set_aside": len(result.built.aside),
            "cpu_s": spent,
            "stated": [2 * r.stated_mrad for r in foretold.records],
            "amended": [2 * r.miss_mrad for r in foretold.records],
            "sigma": [2 * r.sigma_mrad for r in foretold.records],
            "plain": np.linalg.norm(miss(as_stated, peer(learnt, ANGLES)), axis=1).tolist(),
            "ten": np.linalg.norm(miss(as_stated, peer(learnt, ANGLES, LENGTHS)), axis=1).tolist(),
        }


def table(rows: list[dict]) -> str:
    """Per heliostat and pooled: median and rms, records that all fits miss by more than `WRONG_DAY` aside."""
    head = " ".join(f"{m:>7}" for m in METHODS)
    lines = [f"heliostat early late  aside | median: {head} | rms: {head} | within |  cpu | verdict: found"]
    pooled: dict[str, list[float]] = {m: [] for m in METHODS}
    worse = []
    within: list[bool] = []
    for r in rows:
        each = {m: np.array(r[m]) for m in METHODS}
        keep = np.min([each[m] for m in FITTED], axis=0) <= WRONG_DAY
        for m in METHODS:
            pooled[m] += each[m][keep].tolist()
        mid, rms = figures({m: v[keep] if keep.any() else v for m, v in each.items()})
        if rms["amended"] > rms["stated"]:
            worse.append(r["heliostat"])
        inside = [m <= s for m, s in zip(r["amended"], r["sigma"], strict=True)]
        within += inside
        lines.append(
            f"{r['heliostat']:9} {r['early']:5} {r['late']:4} {int((~keep).sum()):6} | "
            f"{' ' * 8}{' '.join(f'{mid[m]:7.2f}' for m in METHODS)} | {' ' * 5}"
            f"{' '.join(f'{rms[m]:7.2f}' for m in METHODS)} | {100 * np.mean(inside):4.0f} % | {r['cpu_s']:4.0f} | "
            f"{r['verdict']}: {', '.join(r['put_in']) or 'nothing'}"
        )
    mid, rms = figures({m: np.array(v) for m, v in pooled.items()})
    for word, of in (("median", mid), ("rms", rms)):
        best = min(of[m] for m in FITTED[1:])
        lines.append(
            f"pooled, {len(pooled['plain'])} records, {word}: {', '.join(f'{m} {of[m]:.3f}' for m in METHODS)} mrad; "
            f"{of['amended'] / of['plain']:.3f} of plain, {of['amended'] / best:.3f} of the better peer"
        )
    lines.append(f"within the predicted sigma: {100 * np.mean(within):.1f} % of {len(within)} (68 % wanted)")
    lines.append(f"worse than as stated (rms): {', '.join(worse) or 'none'}")
    return "\n".join(lines)


def figures(misses: dict[str, Array]) -> tuple[dict[str, float], dict[str, float]]:
    """Median and rms of every method."""
    return (
        {m: float(np.median(v)) for m, v in misses.items()},
        {m: float(np.sqrt(np.mean(v**2))) for m, v in misses.items()},
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=Path("../shared/recordings/heliostat-juelich/field"))
    parser.add_argument("-o", "--output", type=Path, default=Path("out/field"))
    parser.add_argument("--heliostats", default="")
    parser.add_argument("--learn", type=float, default=0.7)
    options = parser.parse_args()
    wanted = [n for n in options.heliostats.split(",") if n]
    folders = sorted(p for p in options.folder.iterdir() if p.is_dir() and (not wanted or p.name in wanted))
    options.output.mkdir(parents=True, exist_ok=True)
    rows = []
    for folder in folders:
        rows.append(one(folder, options.learn))
        print(table(rows[-1:]).splitlines()[1], flush=True)
    (options.output / "field.json").write_text(json.dumps(rows, indent=1) + "\n")
    text = table(rows)
    (options.output / "table.txt").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
