"""Real recordings of mounts: what is found, held against what their owners know, and what was concealed by hand.

    python analysis/real_recordings.py [--folder ../shared/recordings] [-o out/real]

The folder holds ``telescope-mmt/point_20210821.dat`` and ``point_20230702.dat`` (pointing runs of the MMT, from
pytelpoint) and ``heliostat-juelich/AA39`` (PAINT). Left-one-out misses: the diagnosis of all records chooses the
effects, each record is predicted by the parameters that the others give; printed beside them is the same with the
choice of effect made anew without every sixth record.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchsim.diagnosis import linear
from benchsim.diagnosis.evidence import amplitudes, shapes
from benchsim.diagnosis.result import chosen
from benchsim.instruments.mount import paint, pointing, sky
from benchsim.instruments.mount.problem import Built
from benchsim.instruments.mount.records import Session
from benchsim.jobs.mount_diagnosis import MountDiagnosis, diagnose_session

Array = NDArray[np.float64]

OBSERVATORY = {
    "IA": 1205.25, "IE": 2.91, "NPAE": -8.35, "AN": 2.47, "AW": -10.32, "TF": 21.42, "TX": -2.72,
}  # fmt: skip
"""The MMT's own fit of 2021-08-21 [arcsec]."""

EFFECT_OF = {
    "NPAE": "non-perpendicular-axes",
    "AN": "axis-tilt",
    "AW": "axis-tilt",
    "TF": "tube-flexure",
    "TX": "tube-flexure",
}


def left_out(built: Built, names: set[str]) -> tuple[Array, Array]:
    """Miss of every record predicted from the others, without effects and with those named, (n,) each.

    Nuisances and amplitudes with their priors, drift left out of the prediction, iterated to convergence.
    """
    problem = built.problem
    many = [p for p in problem.nuisances if not p.name.startswith("drift.")]
    own = [p for e in problem.catalogue if e.name in names for p in amplitudes(e)]
    fixed = {p.name for e in problem.catalogue if e.name in names for p in shapes(e)}
    assert not fixed, "a change in time predicts no record left out"
    out = []
    for fitted in (many, [*many, *own]):
        sigma = np.array([p.sigma for p in fitted])
        at: dict[str, float] = {}
        for _ in range(6):
            slopes = linear.columns(problem, at, tuple(fitted)) * sigma / built.sigma
            here = np.array([at.get(p.name, 0.0) for p in fitted]) / sigma
            target = (problem.data - linear.predict_all(problem, at)) / built.sigma + slopes @ here
            inner = slopes.T @ slopes + np.eye(len(fitted))
            x = np.linalg.solve(inner, slopes.T @ target)
            at = {p.name: float(v * s) for p, v, s in zip(fitted, x, sigma, strict=True)}
        hat = slopes @ np.linalg.solve(inner, slopes.T)
        rest = target - slopes @ x
        miss = []
        for b in range(len(problem.names)):
            rows = slice(2 * b, 2 * b + 2)
            miss.append(np.linalg.norm(np.linalg.solve(np.eye(2) - hat[rows, rows], rest[rows])) * built.sigma)
        out.append(np.array(miss))
    return out[0], out[1]


def said(r: MountDiagnosis) -> str:
    """A diagnosis in a line."""
    d = r.diagnosis
    effects = ", ".join(
        f"{f.name} ({f.confidence}; "
        + ", ".join(f"{k} {s.value:.2f} ± {s.sigma:.2f}" for k, s in f.parameters.items())
        + ")"
        for f in d.effects
    )
    classes = "; ".join(
        "one of {" + " | ".join("+".join(m) or "nothing" for m in c.members) + "}"
        + (f", split by: {c.split_by.what} ({c.split_by.separation_sigma:.1f} sigma)" if c.split_by else "")
        for c in d.classes
    )  # fmt: skip
    where = "" if d.location is None else f"; where: {d.location.element}{'' if d.location.claimed else '?'}"
    aside = f"; set aside: {', '.join(r.built.aside)}" if r.built.aside else ""
    return f"{d.verdict}: {'; '.join(t for t in (effects, classes) if t) or 'nothing'}{where}{aside}"


def telescope(path: Path, terms: dict[str, float] | None) -> tuple[str, tuple[Array, Array]]:
    """A pointing run: what is found, against the observatory's terms where they are known."""
    r = diagnose_session(pointing.read(path))
    d = r.diagnosis
    before, after = left_out(r.built, {f.name for f in d.effects} | set(chosen(d)))
    lines = [f"{path.name}: {said(r)}"]
    lines.append(f"  left one out: median {np.median(before):.2f} -> {np.median(after):.2f} arcsec")
    held = d.held_out
    assert held is not None
    lines.append(f"  excess chi2 of left-out folds {held.excess_chi2_before:.0f} -> {held.excess_chi2_after:.0f}")
    ranked = sorted(d.probability, key=lambda n: -d.probability[n])
    lines.append(f"  most probable first: {', '.join(ranked[:4])}")
    if terms is not None:
        sizes = {k: (s.value, s.sigma) for f in d.effects for k, s in f.parameters.items()}
        sizes |= dict(zip(("IA", "IE"), r.encoder_zeros, strict=True))
        in_class = {n for c in d.classes for m in c.members for n in m}
        for name, value in terms.items():
            if name in sizes:
                v, s = sizes[name]
                lines.append(
                    f"  {name:<5}{v:10.2f} ± {s:.2f}   observatory {value:8.2f}   {(v - value) / s:+.1f} sigma"
                )
            else:
                held_in = "in a class" if EFFECT_OF.get(name) in in_class else "NOT FOUND"
                lines.append(f"  {name:<5}{held_in}   observatory {value:8.2f}")
    return "\n".join(lines), (before, after)


def heliostat(folder: Path) -> tuple[str, tuple[Array, Array]]:
    """The calibration recordings of a heliostat."""
    r = diagnose_session(paint.read(folder))
    d = r.diagnosis
    before, after = left_out(r.built, {f.name for f in d.effects})
    plain = np.linalg.norm(linear.predict_all(r.built.problem, {}).reshape(-1, 2), axis=1)
    return (
        f"{folder.name}: {said(r)}\n  as stated: median miss {np.median(plain):.1f} mrad; left one out: median "
        f"{np.median(before):.1f} -> {np.median(after):.2f} mrad"
    ), (before, after)


def concealed(session: Session) -> dict[str, tuple[Session, set[str]]]:
    """The same recordings with an error put into them by hand, and the effects that would be right."""
    mount, records = session.mount, session.records
    n = len(records.names)

    def moved(east: float, north: float, up: float) -> Session:
        shift = 1500.0 * np.array([east, north, up])
        return replace(session, mount=replace(mount, position=mount.position + shift))

    def stroke(k: int, mm: float) -> Session:
        changed = tuple(replace(a, stroke=a.stroke + mm) if i == k else a for i, a in enumerate(mount.actuators))
        return replace(session, mount=replace(mount, actuators=changed))

    def hours(h: float) -> Session:
        light = sky.seen(mount, records.source, {"dt": np.full(n, 3600.0 * h)})
        return replace(session, records=replace(records, source=light))

    def slipped(first: int, steps: float) -> Session:
        late = (np.arange(n) >= first)[:, None] * np.array([steps, 0.0])
        return replace(session, records=replace(records, reading=records.reading + late))

    position = {"mirror-position", "target-position"}
    actuator = {"actuator-length", "actuator-offset", "actuator-radius"}
    return {
        "heliostat 1.5 m to the east": (moved(1, 0, 0), position),
        "heliostat 1.5 m to the north": (moved(0, 1, 0), position),
        "heliostat 1.5 m to the south": (moved(0, -1, 0), position),
        "heliostat 1.5 m up": (moved(0, 0, 1), position),
        **{
            f"actuator {k + 1} longer by {mm:g} mm": (stroke(k, mm), actuator)
            for k in (0, 1)
            for mm in (5.0, 10.0, 20.0, 30.0)
        },
        "sun an hour later": (hours(1.0), {"clock"}),
        "sun an hour earlier": (hours(-1.0), {"clock"}),
        "axis 1 lost 400 steps before record 8": (slipped(7, 400.0), {"change-point"}),
    }


def draw(path: Path, parts: dict[str, tuple[Array, Array]], units: dict[str, str]) -> None:
    """Misses of records left out, before and after, of every data set."""
    figure = Figure(figsize=(10, 3.2), layout="constrained")
    for k, (name, (before, after)) in enumerate(parts.items()):
        axes = figure.add_subplot(1, len(parts), k + 1)
        edges = np.geomspace(max(min(after.min(), before.min()), 1e-2), max(before.max(), after.max()) * 1.05, 24)
        axes.hist(before, edges, color="#b2182b", alpha=0.5, label=f"before: median {np.median(before):.2f}")
        axes.hist(after, edges, color="#2166ac", alpha=0.6, label=f"after: median {np.median(after):.2f}")
        axes.set_xscale("log")
        axes.set(xlabel=f"miss of a record left out ({units[name]})", ylabel="records", title=name)
        axes.legend(fontsize=7)
        axes.spines[["top", "right"]].set_visible(False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)


def main() -> None:
    """Print the tables and draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    default = Path(__file__).resolve().parents[2] / "shared" / "recordings"
    parser.add_argument("--folder", type=Path, default=default)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/real"))
    args = parser.parse_args()
    parts: dict[str, tuple[Array, Array]] = {}
    units: dict[str, str] = {}
    for name, terms in (("point_20210821.dat", OBSERVATORY), ("point_20230702.dat", None)):
        text, parts[name] = telescope(args.folder / "telescope-mmt" / name, terms)
        units[name] = "arcsec"
        print(text, flush=True)
    folder = args.folder / "heliostat-juelich" / "AA39"
    text, parts["AA39"] = heliostat(folder)
    units["AA39"] = "mrad"
    print(text, flush=True)
    draw(args.output / "left-out.png", parts, units)
    for what, (session, right) in concealed(paint.read(folder)).items():
        r = diagnose_session(session)
        d = r.diagnosis
        named = bool(right & {f.name for f in d.effects})
        held = any(right & set(m) for c in d.classes for m in c.members)
        print(f"{what}: {'found' if named else 'in a class' if held else 'MISSED'}; {said(r)}", flush=True)


if __name__ == "__main__":
    main()
