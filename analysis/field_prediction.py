"""Does a diagnosis of a heliostat's past predict its future? Later records against what was learnt from earlier ones.

    python analysis/field_prediction.py [--folder ../shared/recordings/heliostat-juelich/field] [-o out/field]
        [--heliostats BE61,BF42] [--learn 0.7]

Of every heliostat the first 70 % of the records (in the order of their numbers, which is that of time) are diagnosed in
a folder of their own by the command's own job; ``benchsim predict`` then says by how much the mount of ``amended.toml``
misses in the remaining ones, here in mrad of the beam, twice those of the normal. Beside it: the mount as stated, and
plain least squares (soft-L1) of two tilts of the first axis and two encoder offsets to the same early records. Records
that both miss by more than 5 mrad had a wrong day and are left aside, but for the part that lies within the predicted
sigma (68 % wanted), which is of all. Nothing is chosen by looking at the later records.
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


def miss(session: Session, x: dict[str, float] | None = None) -> Array:
    """Predicted less recorded direction of every record, (n, 2) [mrad]; ``x``: further errors inside [rad, mm]."""
    predict = predicted(session, [])
    at = {name: np.full(1, value) for name, value in predict.stated.items()}
    at |= {name: at.get(name, 0.0) + np.full(1, value) for name, value in (x or {}).items()}
    return predict.inside(at, np.arange(len(session.records.names)))


def plain(early: Session) -> dict[str, float]:
    """Two tilts and two encoder offsets [rad] by robust least squares."""
    names = ("tilt_n", "tilt_u", "IA", "IE")

    def rest(x: Array) -> Array:
        return miss(early, dict(zip(names, 1e-3 * x, strict=True))).ravel()

    return dict(zip(names, 1e-3 * least_squares(rest, np.zeros(4), loss="soft_l1").x, strict=True))


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
        as_stated = paint.read(late)
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
            "plain": np.linalg.norm(miss(as_stated, plain(paint.read(early))), axis=1).tolist(),
        }


def table(rows: list[dict]) -> str:
    """Per heliostat and pooled: median and rms, records that both miss by more than `WRONG_DAY` aside."""
    lines = [
        "heliostat early late  aside | median: stated amended  plain | rms: stated amended  plain | within |  cpu | "
        "verdict: found"
    ]
    pooled: dict[str, list[float]] = {"stated": [], "amended": [], "plain": []}
    worse = []
    within: list[bool] = []
    for r in rows:
        both = {k: np.array(r[k]) for k in pooled}
        keep = ~((both["amended"] > WRONG_DAY) & (both["plain"] > WRONG_DAY))
        for k in pooled:
            pooled[k] += both[k][keep].tolist()
        use = keep if keep.any() else np.ones(len(keep), bool)
        mid = {k: float(np.median(v[use])) for k, v in both.items()}
        rms = {k: float(np.sqrt(np.mean(v[use] ** 2))) for k, v in both.items()}
        if rms["amended"] > rms["stated"]:
            worse.append(r["heliostat"])
        found = ", ".join(r["put_in"]) or "nothing"
        inside = [m <= s for m, s in zip(r["amended"], r["sigma"], strict=True)]
        within += inside
        lines.append(
            f"{r['heliostat']:9} {r['early']:5} {r['late']:4} {int((~keep).sum()):6} | {mid['stated']:14.2f} "
            f"{mid['amended']:7.2f} {mid['plain']:6.2f} | {rms['stated']:11.2f} {rms['amended']:7.2f} "
            f"{rms['plain']:6.2f} | {100 * np.mean(inside):4.0f} % | {r['cpu_s']:4.0f} | {r['verdict']}: {found}"
        )
    out = {k: np.array(v) for k, v in pooled.items()}
    mid = {k: float(np.median(v)) for k, v in out.items()}
    rms = {k: float(np.sqrt(np.mean(v**2))) for k, v in out.items()}
    lines.append(
        f"pooled, {len(out['plain'])} records: median stated {mid['stated']:.2f}, amended {mid['amended']:.3f}, plain "
        f"{mid['plain']:.3f} (ratio {mid['amended'] / mid['plain']:.3f}); rms {rms['stated']:.2f}, "
        f"{rms['amended']:.3f}, {rms['plain']:.3f} (ratio {rms['amended'] / rms['plain']:.3f})"
    )
    lines.append(f"within the predicted sigma: {100 * np.mean(within):.1f} % of {len(within)} (68 % wanted)")
    lines.append(f"worse than as stated (rms): {', '.join(worse) or 'none'}")
    return "\n".join(lines)


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
