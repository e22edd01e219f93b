"""Does a diagnosis of a heliostat's past predict its future? Later records against what was learnt from earlier ones,
beside what its peers learn from them.

    python analysis/field_peers.py [--folder ../shared/recordings/heliostat-juelich/field] [-o out/field]
        [--heliostats BE61,BF42] [--learn 0.7]

Of every heliostat the first 70 % of the records (in the order of their numbers, which is that of time) are learnt from;
the remaining ones are predicted. A miss is the angle between the predicted beam and the recorded spot as seen from the
mirror, in mrad of the beam; half of it is the normal's. Nothing is chosen by looking at the later records.

stated      the mount as its file has it
amended     the early records are diagnosed in a folder of their own by the command's own job, and ``benchsim predict``
            says by how much ``amended.toml`` misses
plain       soft-L1 least squares of two tilts of the first axis and two encoder offsets
ten         the same of these and length, offset and lever of both actuators
four        the same of the four tilts that ARTIST learns, two of each axis, in ARTIST's kinematics
artist      ARTIST's own reconstruction with the settings of its tutorial
artist_600  the same with 600 epochs in the place of 200

ARTIST is artist-csp (run with 2.0.0; ``pip install --no-deps artist-csp paint-csp torchvision``, then torch, colorlog,
h5py, pyproj); without it its two columns are left out. Its ``KinematicsReconstructor`` runs by the method "alignment",
as in its tutorial: ``AngleLoss`` between the normals of its rigid body at the motors' positions and those that sun and
spot ask for; Adam at 3e-4 for the four tilts, 200 epochs, the rate reduced on plateaus (factor 1e-4, not below 1e-6,
patience 50, threshold 1e-3, cooldown 10), single precision; no rays are traced. Other than there it is given all early
records (not 15, a quarter of them held back), the sun and the spots as benchsim reads them, and the first actuator's
angle from the horizontal mirror, as the files mean it. In its loss the mirror lies where the axes meet: *four* and its
own are learnt and predicted so, the latter by benchsim's mount (``test_artist_itself_reads_it``: they agree).

Records that all fits miss by more than 5 mrad had a wrong day and are left aside, but for the part that lies within the
predicted sigma (68 % wanted), which is of all.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import importlib.metadata
import json
import shutil
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from benchsim.instruments.mount import paint, paint_heliostat
from benchsim.instruments.mount.problem import predicted
from benchsim.instruments.mount.records import Mount, Session
from benchsim.jobs import mount_diagnosis, predict

Array = NDArray[np.float64]

WRONG_DAY = 5.0
"""mrad"""

ANGLES = ("tilt_n", "tilt_u", "IA", "IE")
LENGTHS = tuple(f"{kind}_{k}" for kind in ("length", "offset", "radius") for k in (1, 2))
OF_ARTIST = ("tilt_n", "tilt_u", "IE", "NPAE")
"""ARTIST's tilts of the first joint about north and up, of the second about east and north, under their names here."""

EPOCHS = {"artist": 200, "artist_600": 600}
"""Of ARTIST's reconstruction; the first is its tutorial's."""

METHODS = ("stated", "amended", "plain", "ten", "four", *EPOCHS)

ADAM = {"initial_learning_rate_rotation_deviation": 3e-4, "tolerance": 0.0, "log_step": 0}
STOPPING = {"early_stopping_delta": 1e-8, "early_stopping_patience": 1000, "early_stopping_window": 2000}
PLATEAU = {"reduce_factor": 1e-4, "lr_min": 1e-6, "patience": 50, "threshold": 1e-3, "cooldown": 10}
"""All of ``tutorials/04_kinematics_reconstruction_tutorial.py`` of ARTIST 2.0.0, but for what it logs."""


def miss(session: Session, x: dict[str, float] | None = None) -> Array:
    """Predicted less recorded direction of every record, (n, 2) [mrad]; ``x``: further errors inside [rad, mm]."""
    x, number = x or {}, np.arange(len(session.records.names))
    predict = replace(predicted(session, []), units=dict.fromkeys(x, 1.0))
    return predict.at([x] * len(number), number)


def peer(early: Session, angles: tuple[str, ...], lengths: tuple[str, ...] = ()) -> dict[str, float]:
    """Some angles [rad] and lengths [mm] of the mount by robust least squares."""
    names, unit = (*angles, *lengths), np.array([1e-3] * len(angles) + [1.0] * len(lengths))

    def rest(x: Array) -> Array:
        return miss(early, dict(zip(names, unit * x, strict=True))).ravel()

    found = least_squares(rest, np.zeros(len(names)), loss="soft_l1", x_scale="jac" if lengths else 1.0).x
    return dict(zip(names, unit * found, strict=True))


def version_of_artist(log: Path) -> str | None:
    """ARTIST's version; it opens a file in ``log`` once imported. None, said, where it cannot be."""
    try:
        with contextlib.chdir(log):
            importlib.import_module("artist.optim")
    except ImportError as error:
        print(f"ARTIST is left out: {error} (artist-csp, extra peers).")
        return None
    return importlib.metadata.version("artist-csp")


def in_artist(session: Session, tilts: Array | None = None) -> Session:
    """The mount as ARTIST's loss has it, its mirror where the axes meet; ``tilts`` [rad] in its order and signs."""
    mount = session.mount
    tilts = mount.tilts if tilts is None else paint_heliostat.SIGNS * tilts
    return replace(session, mount=replace(mount, joints=np.zeros((3, 3)), tilts=tilts))


def artist_group(mount: Mount) -> Any:
    """ARTIST's group of one heliostat [m, rad], in single precision; its surface is never used."""
    import torch
    from artist.field import HeliostatGroupRigidBody
    from artist.util import constants

    kind = constants.linear_actuator_int
    fixed = [(kind, a.clockwise, *a.reach, 1e3 * a.increment, a.offset / 1e3, a.radius / 1e3) for a in mount.actuators]
    free = [(a.initial_angle, a.stroke / 1e3) for a in mount.actuators]
    none = torch.zeros(1, 1, 4)
    return HeliostatGroupRigidBody(
        names=["heliostat"],
        positions=_single([[*mount.position / 1e3, 1.0]]),
        **dict.fromkeys(("surface_points", "surface_normals", "facet_translations"), none),
        canting=none[:, :, None],
        initial_orientations=_single([[0.0, -1.0, 0.0, 0.0]]),
        nurbs_control_points=none[None, None],
        nurbs_degrees=torch.ones(2, dtype=torch.int32),
        kinematics_translation_deviation_parameters=_single(mount.joints.reshape(1, 9) / 1e3),
        kinematics_rotation_deviation_parameters=_single([paint_heliostat.SIGNS * mount.tilts]),
        actuator_parameters_non_optimizable=_single([np.transpose(fixed)]),
        actuator_parameters_optimizable=_single([np.transpose(free)]),
        device=torch.device("cpu"),
    )


def _single(values: Any) -> Any:
    import torch

    return torch.tensor(np.array(values, np.float32))


def reconstructed(session: Session, epochs: int) -> Array:
    """The four tilts of a heliostat by ARTIST's own reconstruction [rad], in its order and signs."""
    import torch
    from artist.optim import AngleLoss, KinematicsReconstructor

    group, records, cpu = artist_group(session.mount), session.records, torch.device("cpu")
    # It holds back the last quarter of what it is given, here copies, to trace rays to them, which is left out.
    n = len(records.names)
    given = np.r_[:n, : max(1, n // 3)]

    def four(vectors: Array, last: float) -> Any:
        return _single(np.column_stack([vectors[given], np.full(len(given), last)]))

    data = (
        torch.zeros(len(given), 1, 1),
        four(records.spot / 1e3, 1.0),
        four(-records.source, 0.0),
        _single(records.reading[given]),
        torch.tensor([len(given)], dtype=torch.int32),
        torch.zeros(len(given), dtype=torch.int64),
    )
    parser = SimpleNamespace(parse_data_for_reconstruction=lambda **_: data)
    field = SimpleNamespace(heliostat_groups=[group], number_of_heliostats_per_group=torch.tensor([1]))
    scheduler = {"scheduler_type": "reduce_on_plateau", **PLATEAU}
    learner = KinematicsReconstructor(
        ddp_setup={"rank": 0, "groups_to_ranks_mapping": {0: [0]}},
        scenario=SimpleNamespace(heliostat_field=field),
        data={"data_parser": parser, "heliostat_data_mapping": []},
        optimization_configuration={"optimization": {**ADAM, **STOPPING, "max_epoch": epochs}, "scheduler": scheduler},
        reconstruction_method="alignment",
    )
    learner._validate = lambda **_: {}
    learner.reconstruct_kinematics(loss_definition=AngleLoss(), device=cpu)
    return group.kinematics.rotation_deviation_parameters[0].double().numpy()


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


def one(folder: Path, part: float, *, by_artist: bool) -> dict[str, Any]:
    """One heliostat: misses of the later records [mrad]."""
    with tempfile.TemporaryDirectory() as scratch:
        early, late = parted(folder, Path(scratch), part)
        began = time.process_time()
        result = mount_diagnosis.diagnose(early, Path(scratch) / "out", draw=False)
        spent = time.process_time() - began
        foretold = predict(Path(scratch) / "out" / "amended.toml", late, Path(scratch) / "predict", draw=False)
        as_stated, learnt = paint.read(late), paint.read(early)
        d = result.diagnosis
        shown = {
            "plain": miss(as_stated, peer(learnt, ANGLES)),
            "ten": miss(as_stated, peer(learnt, ANGLES, LENGTHS)),
            "four": miss(in_artist(as_stated), peer(in_artist(learnt), OF_ARTIST)),
        }
        if by_artist:
            shown |= {name: miss(in_artist(as_stated, reconstructed(learnt, n))) for name, n in EPOCHS.items()}
        return {
            "heliostat": folder.name,
            "early": len(result.session.records.names),
            "late": len(as_stated.records.names),
            "verdict": d.verdict,
            "effects": {f.name: f.confidence for f in d.effects},
            "classes": [[list(m) for m in c.members] for c in d.classes],
            "put_in": {n: terms for n, terms in result.found.items() if n in result.claimed},
            "small_terms": bool(result.small.parameters),
            "set_aside": len(result.built.aside),
            "cpu_s": spent,
            "stated": [2 * r.stated_mrad for r in foretold.records],
            "amended": [2 * r.miss_mrad for r in foretold.records],
            "sigma": [2 * r.sigma_mrad for r in foretold.records],
            **{name: np.linalg.norm(rest, axis=1).tolist() for name, rest in shown.items()},
        }


def pooled(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Median and rms [mrad] of every method; records that all fits miss by more than `WRONG_DAY` are left aside, but
    not where that is all of them."""
    misses = {m: np.concatenate([r[m] for r in rows]) for m in METHODS if m in rows[0]}
    keep = np.min([v for m, v in misses.items() if m != "stated"], axis=0) <= WRONG_DAY
    keep = keep if keep.any() else ~keep
    return {
        "aside": int((~keep).sum()),
        "median": {m: float(np.median(v[keep])) for m, v in misses.items()},
        "rms": {m: float(np.sqrt(np.mean(v[keep] ** 2))) for m, v in misses.items()},
    }


def table(rows: list[dict[str, Any]]) -> str:
    """Per heliostat and pooled."""
    every = pooled(rows)
    head = " ".join(f"{m:>10}" for m in every["rms"])
    lines = [f"heliostat early late aside | median: {head} | rms: {head} | within |  cpu | verdict: found"]
    worse = []
    within: list[bool] = []
    for r in rows:
        of = pooled([r])
        mid, rms = (" ".join(f"{v:10.2f}" for v in of[word].values()) for word in ("median", "rms"))
        if of["rms"]["amended"] > of["rms"]["stated"]:
            worse.append(r["heliostat"])
        inside = [m <= s for m, s in zip(r["amended"], r["sigma"], strict=True)]
        within += inside
        lines.append(
            f"{r['heliostat']:9} {r['early']:5} {r['late']:4} {of['aside']:5} | {' ' * 7} {mid} | {' ' * 4} {rms} | "
            f"{100 * np.mean(inside):4.0f} % | {r['cpu_s']:4.0f} | "
            f"{r['verdict']}: {', '.join(r['put_in']) or 'nothing'}{'; small terms' if r['small_terms'] else ''}"
        )
    for word in ("median", "rms"):
        of = every[word]
        best = min(v for m, v in of.items() if m not in METHODS[:2])
        lines.append(
            f"pooled, {len(within) - every['aside']} records, {word}: "
            f"{', '.join(f'{m} {v:.3f}' for m, v in of.items())} mrad; "
            f"amended {of['amended'] / of['plain']:.3f} of plain, {of['amended'] / best:.3f} of the best peer"
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
    version = version_of_artist(options.output)
    rows = []
    for folder in folders:
        rows.append(one(folder, options.learn, by_artist=version is not None))
        print("\n".join(table(rows[-1:]).splitlines()[len(rows) > 1 : 2]), flush=True)
    found = {"artist-csp": version, "pooled": pooled(rows), "heliostats": rows}
    (options.output / "peers.json").write_text(json.dumps(found, indent=1) + "\n")
    text = table(rows)
    (options.output / "table.txt").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
