"""How often is the drift of a mount named? Concealed cases on simulated telescopes and heliostats, with intervals.

    python analysis/mount_study.py run --cases 60 --seed 1 --out out/mounts
    python analysis/mount_study.py table out/mounts/*.jsonl
    python analysis/mount_study.py time --records 8,30,100,300,1000 --seed 1

The truth is put into the records themselves (spots where the beam meets the target, stars where the tube points), with
noise, drift, zeros of the encoders and survey errors; judged is what `benchsim diagnose` judges, outlying records and
the errors of a record included. Every case is drawn from (seed, row, number) alone and written as it ends; a stopped
study resumes.
"""

from __future__ import annotations

import argparse
import time
import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from diagnosis_study import read, run, tell, verdict_of
from numpy.typing import NDArray

from benchsim.diagnosis.linear import whiten
from benchsim.diagnosis.problem import Effect, Problem
from benchsim.instruments.mount import axes, effects, history, posing, sky, witnesses
from benchsim.instruments.mount import problem as mount_problem
from benchsim.instruments.mount.next_recordings import OBLIQUITY, aimed, sun_at
from benchsim.instruments.mount.prediction import INPUTS, STEPS
from benchsim.instruments.mount.records import UNITS, Actuator, Mount, Records, Session, toward
from benchsim.jobs.mount_diagnosis import diagnose_session
from benchsim.trial.draws import as_effects, draw_effect
from benchsim.trial.hashing import code
from benchsim.trial.visibility import Sight

Array = NDArray[np.float64]

ROWS = ("single", "pair", "clean", "clean-outlier", "removed", "stranger")

STRANGERS = {"bearing": "mount", "sag": "mount", "warm": "time", "ephemeris": "sky"}
"""Causes that no catalogue holds, and the element where each sits."""

ACTUATORS = (
    Actuator(77.4, 335.3, 338.1, 154.1667, 0.039 - np.pi / 2, False),
    Actuator(77.5, 340.8, 319.1, 154.1667, 0.944, True),
)
"""Of a mount like those at Jülich [mm]."""


@dataclass(frozen=True)
class Scene:
    """A mount without errors and its records, how it is noisy, and what of it a person would see."""

    session: Session
    sigma: float
    problem: Problem


def rng_of(seed: int, row: str, case: int) -> np.random.Generator:
    """Its own stream for every case."""
    return np.random.default_rng([seed, zlib.crc32(row.encode()), case])


def scene(rng: np.random.Generator, count: int | None = None) -> Scene:
    """A telescope or a heliostat, az-el or with linear actuators; with so many records, or as many as usual."""
    kind = str(rng.choice(["telescope", "heliostat", "actuators"]))
    if kind == "telescope":
        session = telescope(rng, count or int(rng.integers(30, 81)))
    else:
        session = heliostat(rng, kind == "actuators", count or int(rng.integers(12, 41)))
    sigma = float(np.exp(rng.uniform(np.log(0.3), np.log(2.0))))
    catalogue = effects.candidates(session.mount, session.records)
    predict = mount_problem.predicted(session, catalogue)
    drift = sigma * mount_problem.shared(session.mount, session.records)
    return Scene(session, sigma, posing.problem_of(replace(predict, drift=drift), catalogue, sigma))


def telescope(rng: np.random.Generator, n: int) -> Session:
    """Stars all over the sky in an order that jumps about."""
    azimuth = rng.uniform(0, 2 * np.pi, n)
    elevation = np.arcsin(rng.uniform(np.sin(np.radians(18)), np.sin(np.radians(84)), n))
    reading = np.column_stack([azimuth, elevation])
    latitude = float(np.radians(rng.uniform(-45, 60)))
    mount, stars = Mount("az-el", "sky", latitude=latitude), toward(azimuth, elevation)
    records = Records(
        tuple(f"star {k + 1}" for k in range(n)), reading, stars, np.full((n, 3), np.nan), ("",) * n,
        travel=history.travel(mount, reading, stars),
        warmth=history.warmth(np.linspace(0.0, rng.uniform(-12.0, 12.0), n)),
    )  # fmt: skip
    return Session("telescope", Path("telescope"), (), mount, records)


def heliostat(rng: np.random.Generator, driven: bool, n: int) -> Session:
    """Records of a year, up to four of a day, on one to three targets of a tower to the south."""
    latitude = float(np.radians(rng.uniform(30, 52)))
    position = np.array([rng.uniform(-60e3, 60e3), rng.uniform(30e3, 160e3), rng.uniform(0, 3e3)])
    count = int(rng.integers(1, 4))
    centres = np.array([[rng.uniform(-15e3, 15e3), 0.0, rng.uniform(25e3, 60e3)] for _ in range(count)])
    joints = np.zeros((3, 3))
    joints[2, 1] = 175.0
    mount = Mount("east-west" if driven else "az-el", "spot", position, joints, ACTUATORS if driven else (), latitude)
    reading, source, spot, target, when = [], [], [], [], []
    hours: list[float] = []
    start = np.array([[25000.0, 48000.0], [35000.0, 60000.0]]) if driven else None
    while len(reading) < n:
        if not hours:
            day, hours = rng.integers(365), sorted(rng.uniform(-4.5, 4.5, rng.integers(1, 5)), reverse=True)
        hour = hours.pop()
        sun = sun_at(latitude, OBLIQUITY * np.sin(2 * np.pi * (day - 80) / 365), hour)
        if sun[2] < np.sin(np.radians(12)):
            continue
        k = int(rng.integers(count))
        if start is None:
            toward_spot = (centres[k] - position) / np.linalg.norm(centres[k] - position)
            middle = sun + toward_spot
            begin = np.array([[np.arctan2(middle[0], middle[1]), np.arcsin(middle[2] / np.linalg.norm(middle))]])
        else:
            begin = start
        (found,) = aimed(mount, sun[None], centres[k][None], begin)
        if not np.isfinite(found).all():
            if driven and rng.uniform() < 0.02:
                return heliostat(rng, driven, n)  # this place cannot be served by these actuators
            continue
        reading.append(np.round(found) if driven else found)
        source.append(sun)
        spot.append(centres[k])
        target.append(f"target {k + 1}")
        when.append(86400.0 * day + 3600.0 * hour)
    names = tuple(str(1000 + 7 * k) for k in range(n))
    order = np.argsort(when)
    read, sun, place, times = (np.array(v)[order] for v in (reading, source, spot, when))
    records = Records(
        names, read, sun, place, tuple(target[k] for k in order), times,
        travel=history.travel(mount, read, sun, times), warmth=history.season(times, latitude),
    )  # fmt: skip
    session = Session("heliostat", Path("heliostat"), (), mount, records)
    # Steps are whole: the spot is where the nominal mount really sends the light.
    return recorded(session, {}, None, np.zeros((n, 2)))


def recorded(session: Session, inside: dict[str, Array], bent: Array | None, noise: Array) -> Session:
    """The records of a mount with errors (rad and mm, (n,) each), a stranger's displacement and noise [rad], (n, 2)."""
    mount, r = session.mount, session.records
    n = len(r.names)
    catalogue = effects.candidates(mount, r)
    predict = mount_problem.predicted(session, catalogue)
    x = dict(inside)
    i = np.arange(n)
    if "change" in x:
        # Abruptly, unlike the fit's own description of it.
        for name, step in STEPS.items():
            if step in x:
                x[name] = x.get(name, 0.0) + (i > x["change"]) * x[step]
    for axis, (name, k) in INPUTS.items():
        back, grown = x.pop(f"backlash_{axis}", None), x.pop(f"thermal_{axis}", None)
        x[name] = x.get(name, np.zeros(n)) - (0.0 if back is None else back * r.travel[:, k] / 2)
        x[name] += 0.0 if grown is None else grown * r.warmth
    normal, centre = axes.pointing(mount, r.reading, x)
    moved = noise if bent is None else noise + bent
    if mount.observes == "sky":
        seen = displaced(normal, moved)
        back = {k: -v for k, v in x.items() if k in ("dt", "refr")}
        return replace(session, records=replace(r, source=sky.seen(mount, seen, back)))
    light = sky.seen(mount, r.source, x)
    beam = displaced(axes.reflected(normal, light), moved)
    none = np.zeros(n)
    shift = np.column_stack([x.get(f"mirror_{k}", none) + x.get(f"survey_{k}", none) for k in "enu"])
    start = centre + shift
    # Targets are vertical planes that face north.
    reach = (r.spot[:, 1] - start[:, 1]) / beam[:, 1]
    spot = start + reach[:, None] * beam
    return replace(session, records=replace(r, spot=spot - predict._moved(x, i)))


def displaced(direction: Array, by: Array) -> Array:
    """Unit vectors moved across and up by angles, (n, 2)."""
    right = np.stack([direction[:, 1], -direction[:, 0], 0 * direction[:, 0]], axis=-1)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    out = direction + by[:, :1] * right + by[:, 1:] * np.cross(right, direction)
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


def hung(effect: Effect) -> Effect:
    """An effect as plants may have it: targets hang within a metre of their places, beyond which none is looked for."""
    if effect.name != "target-position":
        return effect
    return replace(effect, parameters=tuple(replace(p, sigma=500 * witnesses.FAR_M) for p in effect.parameters))


def stranger(kind: str, s: Session, sigma: float, rng: np.random.Generator) -> Array:
    """Displacement of every record by a cause without a name, in the mount's unit, (n, 2)."""
    r = s.records
    n = len(r.names)
    size = sigma * float(np.exp(rng.uniform(np.log(0.7), np.log(6.0))))
    normal = axes.pointing(s.mount, r.reading, {})[0]
    azimuth, elevation = np.arctan2(normal[:, 0], normal[:, 1]), np.arcsin(normal[:, 2])
    phase = rng.uniform(0, 2 * np.pi)
    if kind == "bearing":  # three waves of the azimuth bearing
        wave = np.sqrt(2) * size * np.sin(3 * azimuth + phase)
        return np.column_stack([wave * np.cos(elevation), 0 * wave])
    if kind == "sag":
        return np.column_stack([np.zeros(n), np.sqrt(2) * size * np.sin(5 * elevation + phase)])
    if kind == "warm":
        t = np.arange(n) / n
        return np.sqrt(2) * size * np.column_stack([np.sin(2 * np.pi * t + phase), np.cos(3 * np.pi * t + phase)])
    sun = r.source
    wave = np.sqrt(2) * size * np.sin(4 * np.arctan2(sun[:, 0], -sun[:, 1]) + phase)
    return np.column_stack([0.5 * wave, wave])


def one(row: str, seed: int, case: int) -> dict[str, Any]:
    """A case, or the complaint that ended it."""
    try:
        return _case(row, seed, case)
    except Exception as error:  # a study goes on; the line says what happened and counts as no verdict
        return {"row": row, "seed": seed, "case": case, "error": f"{type(error).__name__}: {error}"}


def _case(row: str, seed: int, case: int, count: int | None = None) -> dict[str, Any]:
    rng = rng_of(seed, row, case)
    on = scene(rng, count)
    s, problem = on.session, on.problem
    mount, n = s.mount, len(s.records.names)
    unit = UNITS[mount.unit]
    sight = Sight.of(problem)
    values: dict[str, float] = {}
    truth: dict[str, dict[str, float]] = {}
    for k in rng.choice(len(problem.catalogue), {"single": 1, "removed": 1, "pair": 2}.get(row, 0), replace=False):
        effect = problem.catalogue[int(k)]
        drawn = draw_effect(sight, hung(effect), rng)
        values |= drawn
        truth |= as_effects(drawn, effect)
    of = {p.name: UNITS[p.unit] for e in problem.catalogue for p in e.parameters}
    inside = {k: np.full(n, v * of[k]) for k, v in values.items()}
    if mount.observes == "sky":
        for name, wide in (("IA", 3600.0), ("IE", 120.0)):
            inside[name] = inside.get(name, 0.0) + np.full(n, rng.uniform(-wide, wide) * unit)
    else:
        inside |= {f"survey_{k}": np.full(n, rng.normal(0, posing.SURVEY_SIGMA)) for k in "enu"}
    noise = on.sigma * unit * rng.standard_normal((n, 2))
    modes = mount_problem.drift(mount, n)
    noise += on.sigma * unit * rng.uniform(0, 0.6) * modes @ rng.standard_normal((modes.shape[1], 2))
    strange = ""
    bent = None
    if row == "stranger":
        choice = [k for k in STRANGERS if mount.observes == "spot" or STRANGERS[k] in ("mount", "time")]
        strange = str(rng.choice(choice))
        bent = stranger(strange, s, on.sigma, rng) * unit
    wrong: list[int] = []
    if row == "clean-outlier":
        wrong = sorted(int(k) for k in rng.choice(n, int(rng.integers(1, 3)), replace=False))
        noise[wrong] += on.sigma * unit * rng.uniform(12, 60, (len(wrong), 1)) * direction(rng, len(wrong))
    judged = recorded(s, inside, bent, noise)
    snr = {e: float(np.linalg.norm(sight.change(v))) for e, v in truth.items()}
    rival, lone = ("", float("inf")), float("inf")
    if bent is not None:
        change = sight.through(whiten(problem, problem.covariance, bent.ravel() / unit)[0])
        snr[strange], rival = float(np.linalg.norm(change)), sight.imitation(change)
    if truth:
        rival, lone = sight.rival(values, tuple(truth)), sight.alone(values, tuple(truth))
    start = time.process_time()
    without = tuple(truth) if row == "removed" else ()
    found = diagnose_session(judged, without=without)
    d = found.diagnosis
    element = STRANGERS.get(strange) or next((e.element for e in problem.catalogue if e.name in truth), "")
    pulls = [
        (size.value - truth[f.name][name]) / size.sigma
        for f in d.effects
        for name, size in f.parameters.items()
        if name in truth.get(f.name, {}) and size.sigma > 0 and name != "change"
    ]
    return {
        "tier": "mounts", "row": row, "seed": seed, "case": case, "code": code()[:12],
        "mount": f"{mount.axes} {mount.observes}", "n": n,
        "truth": {"effects": truth, "stranger": strange}, "truth_element": element, "snr": snr, "rival": rival,
        "alone": lone,
        **verdict_of(d), "parameter_pulls": pulls, "aside": list(found.built.aside),
        "wrong": [s.records.names[k] for k in wrong], "sigma": on.sigma, "sigma_found": found.built.sigma,
        "cpu_s": time.process_time() - start,
    }  # fmt: skip


def direction(rng: np.random.Generator, n: int) -> Array:
    """Unit vectors of the plane, (n, 2)."""
    angle = rng.uniform(0, 2 * np.pi, n)
    return np.column_stack([np.cos(angle), np.sin(angle)])


def outliers(cases: list[dict[str, Any]]) -> str:
    """How wrong records, and how many right ones, were set aside."""
    own = [c for c in cases if c["row"] == "clean-outlier" and "aside" in c]
    caught = sum(set(c["wrong"]) <= set(c["aside"]) for c in own)
    others = [c for c in cases if "aside" in c and c["row"] != "clean-outlier"]
    lost = sum(bool(c["aside"]) for c in others)
    return (
        f"wrong records set aside, all of them: {caught}/{len(own)} sessions; "
        f"sessions without a wrong record that lost one: {lost}/{len(others)}"
    )


def main() -> None:
    """Run the study, or print its table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    sub = parser.add_subparsers(dest="command", required=True)
    go = sub.add_parser("run", help="run cases that are not there yet")
    go.add_argument("--rows", default=",".join(ROWS))
    go.add_argument("--cases", type=int, default=60, help="per row")
    go.add_argument("--seed", type=int, required=True)
    go.add_argument("--out", type=Path, default=Path("out/mounts"))
    go.add_argument("--workers", type=int, default=2)
    clock = sub.add_parser("time", help="print CPU seconds against the number of records")
    clock.add_argument("--records", default="8,30,100,300,1000")
    clock.add_argument("--rows", default="clean,single,pair")
    clock.add_argument("--cases", type=int, default=2, help="per row and number of records")
    clock.add_argument("--seed", type=int, required=True)
    show = sub.add_parser("table", help="print rates, confusion and reliability")
    show.add_argument("files", type=Path, nargs="+")
    args = parser.parse_args()
    if args.command == "run":
        run(one, args.rows.split(","), args.cases, args.seed, args.out / f"mounts-{args.seed}.jsonl", args.workers)
        return
    if args.command == "time":
        for n in (int(x) for x in args.records.split(",")):
            for row in args.rows.split(","):
                done = [_case(row, args.seed, k, n) for k in range(args.cases)]
                print(
                    f"{n:5d} records, {row:8s}",
                    *(f"{c['mount']} {c['cpu_s']:.1f} s {c['verdict']}" for c in done),
                    sep="   ",
                )
        return
    cases = read(args.files)
    tell(cases, outliers(cases))


if __name__ == "__main__":
    main()
