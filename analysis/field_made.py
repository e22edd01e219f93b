"""A plant of heliostats with concealed errors, each its own and some that all share, as a folder of PAINT files.

    python analysis/field_made.py OUT [--heliostats 1000] [--records 30] [--seed 1] [--shared target,clock]

Heliostats of the Jülich kind (first axis horizontal along east, second perpendicular, linear actuators) stand in rows
north of a tower with two targets. Each has none, one or two of the errors in `OWN`; ``--shared`` conceals besides what
all have in common: ``target`` (one target hangs elsewhere), ``tower`` (all do, alike), ``clock``, ``refraction``
(the sun's elevation lacks it or has it twice), ``camera`` (spots are recorded nearer to their target's centre),
``none``. Records lie on days that are spread over two years, some to a
day; a record's spot is off by 1 mrad, and by 0.3 mrad that its day shares. ``truth.json`` holds it all.

The optics are a few lines of vectors of their own, from the formulas of the data base's description: nothing of the
package is used, so that reading and judging such a field tests the package.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pvlib import spa
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

ORIGIN = (50.9134211, 6.3878248, 87.0)
"""Latitude, longitude [deg] and height [m] of the tower's foot."""

TARGETS = {"upper": (0.0, -3.0, 43.0), "lower": (0.0, -3.0, 36.0)}
"""Centres, east, north, up [m]; both face north."""

ACTUATORS = (
    {"increment": 154166.6667, "initial_stroke_length": 0.0765, "offset": 0.335308, "pivot_radius": 0.338095},
    {"increment": 154166.6667, "initial_stroke_length": 0.0774, "offset": 0.340771, "pivot_radius": 0.3191},
)
INITIAL = (0.03, 0.942)
CLOCKWISE = (0, 1)
ARM = 0.175
"""From the axes to the mirror, along its normal [m]."""

OWN = {
    "axis-tilt": {"tilt_n": 8e-3, "tilt_u": 8e-3},
    "encoder-offset": {"IA": 8e-3, "IE": 8e-3},
    "actuator-radius": {"radius_1": 3e-3, "radius_2": 3e-3},
    "actuator-length": {"length_1": 3e-3, "length_2": 3e-3},
    "non-perpendicular-axes": {"NPAE": 8e-3},
    "canting": {"CA": 8e-3},
}
"""Sigma of every error's terms [rad, m]."""

SHARED = {
    "target": {"target_e_2": 0.25, "target_u_2": -0.15},
    "tower": {"target_e_1": 0.2, "target_u_1": 0.3, "target_e_2": 0.2, "target_u_2": 0.3},
    "clock": {"dt": 40.0},
    "refraction": {"refr": 1.0},
    "camera": {"spot_scale": 0.08},
    "none": {},
}
"""What all have in common [m, s, parts of the refraction and of the scale]."""

ERROR, OF_THE_DAY = 1e-3, 0.3e-3
"""Errors of a spot, and what the records of a day share of them [rad of the beam]."""


def turned(vectors: Array, about: Array) -> Array:
    """Vectors (..., 3) turned by rotation vectors (..., 3) [rad]."""
    shape = np.broadcast_shapes(vectors.shape, about.shape)
    rotation, flat = (np.array(np.broadcast_to(x, shape)).reshape(-1, 3) for x in (about, vectors))
    return np.asarray(Rotation.from_rotvec(rotation).apply(flat)).reshape(shape)


def axis(k: int, steps: Array, radius: Array, length: Array) -> Array:
    """Angle of an axis [rad]: the triangle's corner, counted from step 0."""
    a = ACTUATORS[k]
    r, o = a["pivot_radius"] + radius, a["offset"]

    def corner(side: Array) -> Array:
        return np.arccos((o**2 + r**2 - side**2) / (2 * o * r))

    moved = corner(a["initial_stroke_length"] + length + steps / a["increment"]) - corner(
        a["initial_stroke_length"] + length
    )
    start = INITIAL[k] - (np.pi / 2 if k == 0 else 0.0)
    return np.asarray(start + (-moved if CLOCKWISE[k] else moved))


def mirror(steps: Array, place: Array, x: dict[str, Array]) -> tuple[Array, Array]:
    """Normal and centre of a mirror, (H, R, 3), for steps (H, R, 2) and errors (H, 1)."""
    first, second = (axis(k, steps[..., k], x[f"radius_{k + 1}"], x[f"length_{k + 1}"]) for k in (0, 1))
    first, second = first + x["IE"], second + x["IA"]
    none = np.zeros_like(first)

    def vector(e: Array, n: Array, u: Array) -> Array:
        return np.stack(np.broadcast_arrays(none + e, none + n, none + u), axis=-1)

    normal = vector(none, -np.cos(x["CA"]), np.sin(x["CA"]))
    front = vector(none, -1.0 + none, none)
    for about in (
        vector(none, none, second),
        vector(none, x["NPAE"], none),
        vector(first, none, none),
        vector(none, x["tilt_n"], x["tilt_u"]),
    ):
        normal, front = turned(normal, about), turned(front, about)
    return normal, place[:, None, :] + ARM * front


def spot(steps: Array, sun: Array, place: Array, north: float, x: dict[str, Array]) -> Array:
    """Where the beam meets the plane of the targets, (H, R, 3) [m]."""
    normal, centre = mirror(steps, place, x)
    beam = 2 * normal * (normal * sun).sum(axis=-1, keepdims=True) - sun
    return np.asarray(centre + beam * ((north - centre[..., 1:2]) / beam[..., 1:2]))


def aimed(goal: Array, sun: Array, place: Array, north: float, x: dict[str, Array]) -> Array:
    """Whole steps at which the beam meets the goal (H, R, 3), as an operator would steer it there: Newton's method."""
    steps = np.full((*goal.shape[:2], 2), 40000.0)
    for _ in range(12):
        here = spot(steps, sun, place, north, x)
        jacobian = np.stack(
            [(spot(steps + 50.0 * np.eye(2)[k], sun, place, north, x) - here)[..., [0, 2]] / 50.0 for k in (0, 1)],
            axis=-1,
        )
        miss = (goal - here)[..., [0, 2]]
        step = np.linalg.solve(jacobian + 1e-12 * np.eye(2), miss[..., None])[..., 0]
        steps = np.clip(steps + np.clip(step, -8000, 8000), 0.0, 75000.0)
    return np.asarray(np.round(steps))


def geodetic(enu: Array) -> list[float]:
    """Latitude, longitude [deg] and height [m] of a place (3,) [m] about the origin, on WGS 84."""
    a, f = 6378137.0, 1 / 298.257223563

    def centred(at: Array) -> Array:
        la, lo = np.radians(at[:2])
        across = a / np.sqrt(1 - f * (2 - f) * np.sin(la) ** 2)
        flat = (across + at[2]) * np.cos(la)
        return np.array([flat * np.cos(lo), flat * np.sin(lo), (across * (1 - f) ** 2 + at[2]) * np.sin(la)])

    la, lo = np.radians(ORIGIN[:2])
    axes = np.array(
        [
            [-np.sin(lo), np.cos(lo), 0.0],
            [-np.sin(la) * np.cos(lo), -np.sin(la) * np.sin(lo), np.cos(la)],
            [np.cos(la) * np.cos(lo), np.cos(la) * np.sin(lo), np.sin(la)],
        ]
    )
    at, scale = np.array(ORIGIN), np.array([np.degrees(1 / 6.37e6), np.degrees(1 / 6.37e6) / np.cos(la), 1.0])
    for _ in range(6):
        rest = enu - axes @ (centred(at) - centred(np.array(ORIGIN)))
        at = at + rest[[1, 0, 2]] * scale
    return [float(v) for v in at]


def sun_at(times: pd.DatetimeIndex, dt: float = 0.0, refraction: float = 1.0) -> tuple[Array, Array]:
    """Azimuth from north and elevation [rad], raised by a part of the refraction."""
    unix = times.as_unit("ns").asi8 / 1e9 + dt
    _, _, _, elevation, azimuth, _ = spa.solar_position(unix, *ORIGIN, 1010.0, 10.0, 67.0, 0.5667)[:6]
    lift = spa.atmospheric_refraction_correction(1010.0, 10.0, elevation, 0.5667)
    return np.radians(azimuth), np.radians(elevation + refraction * lift)


def toward(azimuth: Array, elevation: Array) -> Array:
    return np.stack(
        [np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)], axis=-1
    )


def make(out: Path, heliostats: int, records: int, seed: int, shared: list[str]) -> None:
    """Write the field."""
    rng = np.random.default_rng(seed)
    out.mkdir(parents=True, exist_ok=True)
    common = {k: v for name in shared for k, v in SHARED[name].items()}
    # Days on which the sun is up for hours at the plant, and hours between 8 and 15 UTC.
    days = rng.integers(0, 730, (heliostats, -(-records // 4)))
    day = np.sort(np.repeat(days, 4, axis=1)[:, :records], axis=1)
    hours = rng.uniform(8.5, 14.5, (heliostats, records))
    times = pd.Timestamp("2022-03-01", tz="UTC") + pd.to_timedelta(day.ravel() * 24 + hours.ravel(), unit="h")
    order = np.argsort(np.asarray(times).reshape(heliostats, records), axis=1)
    times = pd.DatetimeIndex(np.take_along_axis(np.asarray(times).reshape(heliostats, records), order, axis=1).ravel())
    azimuth, elevation = sun_at(times)
    true_sun = toward(*sun_at(times, common.get("dt", 0.0), 1.0 + common.get("refr", 0.0))).reshape(
        heliostats, records, 3
    )
    row = np.arange(heliostats) // 40
    place = np.column_stack(
        [
            (np.arange(heliostats) % 40 - 19.5) * 4.5 + rng.normal(0, 0.3, heliostats),
            30.0 + 6.0 * row,
            np.full(heliostats, 1.7),
        ]
    )
    x = {t: np.zeros((heliostats, 1)) for terms in OWN.values() for t in terms}
    truth: dict[str, dict[str, dict[str, float]]] = {}
    for h in range(heliostats):
        name = f"{chr(65 + row[h] // 26)}{chr(65 + row[h] % 26)}{h % 40 + 10}"
        many = rng.choice(3, p=[0.15, 0.5, 0.35])
        truth[name] = {}
        for own in rng.choice(list(OWN), many, replace=False):
            truth[name][own] = {t: float(rng.normal(0, s)) for t, s in OWN[own].items()}
            for t, v in truth[name][own].items():
                x[t][h] = v
    number = rng.integers(0, len(TARGETS), (heliostats, records))
    centres = np.array(list(TARGETS.values()))
    # Targets are numbered in the order of the alphabet.
    rank = [1 + sorted(TARGETS).index(t) for t in TARGETS]
    shift = np.array([[common.get(f"target_e_{k}", 0.0), 0.0, common.get(f"target_u_{k}", 0.0)] for k in rank])
    goal = centres[number] + rng.uniform(-0.8, 0.8, (heliostats, records, 3)) * [1.0, 0.0, 1.0]
    north = TARGETS["upper"][1]
    steps = aimed(goal + shift[number], true_sun, place, north, x)
    seen = spot(steps, true_sun, place, north, x) - shift[number]
    distance = np.linalg.norm(seen - place[:, None], axis=2, keepdims=True)
    of_day = {}
    for h in range(heliostats):
        for d in np.unique(day[h]):
            of_day[h, int(d)] = rng.normal(0, OF_THE_DAY, 2)
    own_day = np.array([[of_day[h, int(d)] for d in np.take(day[h], order[h])] for h in range(heliostats)])
    off = rng.normal(0, ERROR, (heliostats, records, 2)) + own_day
    seen[..., [0, 2]] += off * distance
    seen = centres[number] + (seen - centres[number]) * (1.0 - common.get("spot_scale", 0.0))
    plant = {"power_plant_properties": {"ID": "made", "coordinates": list(ORIGIN)}}
    for target, centre in TARGETS.items():
        plant[target] = {
            "type": "planar",
            "normal_vector": [0, 1, 0],
            "coordinates": {"center": geodetic(np.array(centre))},
        }
    (out / "tower-measurements.json").write_text(json.dumps(plant, indent=1))
    stamps = {}
    azimuth, elevation = (np.degrees(v).reshape(heliostats, records) for v in (azimuth, elevation))
    at = np.asarray(times).reshape(heliostats, records)
    for h, name in enumerate(truth):
        folder = out / name
        folder.mkdir(exist_ok=True)
        (folder / "heliostat-properties.json").write_text(json.dumps(properties(place[h])))
        for r in range(records):
            identity = 100000 + 1000 * h + r
            stamps[f"{name}_{identity}"] = f"{pd.Timestamp(at[h, r]):%Y-%m-%dT%H:%M:%S.%f}Z"
            record = {
                "motor_position": {f"axis_{k + 1}_motor_position": int(steps[h, r, k]) for k in (0, 1)},
                "target_name": list(TARGETS)[number[h, r]],
                "sun_elevation": float(elevation[h, r]),
                "sun_azimuth": float(180.0 - azimuth[h, r]),
                "focal_spot": {"UTIS": geodetic(seen[h, r])},
            }
            (folder / f"{identity}-calibration-properties.json").write_text(json.dumps(record))
    (out / "timestamps.json").write_text(json.dumps(stamps))
    (out / "truth.json").write_text(json.dumps({"seed": seed, "shared": common, "heliostats": truth}, indent=1))


def properties(place: Array) -> dict:
    """What a heliostat is stated to be."""
    actuators = [
        {
            "type_axis": "linear",
            **ACTUATORS[k],
            "initial_angle": INITIAL[k],
            "clockwise_axis_movement": CLOCKWISE[k],
        }
        for k in (0, 1)
    ]
    joints = {f"joint_translation_{e}_{k}": 0.0 for e in "enu" for k in (1, 2)}
    arm = {"concentrator_translation_e": 0.0, "concentrator_translation_n": ARM, "concentrator_translation_u": 0.0}
    return {
        "heliostat_position": geodetic(place),
        "kinematics_properties": {"actuators": actuators, **joints, **arm},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--heliostats", type=int, default=1000)
    parser.add_argument("--records", type=int, default=30)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--shared", default="none")
    options = parser.parse_args()
    make(options.out, options.heliostats, options.records, options.seed, options.shared.split(","))


if __name__ == "__main__":
    main()
