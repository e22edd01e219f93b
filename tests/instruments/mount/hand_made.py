"""A heliostat of the Jülich kind made by hand: matrices in metres and radians, nothing of the code under test.

East, north, up. The normal is T R_east(θ1) R_north(NPAE) R_up(θ2) (0, −cos CA, sin CA), T the turn by the rotation
vector (0, tilt_n, tilt_u); an axis' angle is its initial one plus or minus the growth of acos((o² + r² − L²) / 2 o r).
"""

import json

import numpy as np

LATITUDE, LONGITUDE, HEIGHT = 50.9134, 6.3878, 87.0
TARGET = np.array([1.0, -2.0, 43.0])
"""Centre [m] of the one target, whose plane faces north."""

PLACE = np.array([13.0, 60.0, 1.7])
ACTUATORS = (
    {"increment": 154166.6667, "stroke": 0.0774, "offset": 0.3353, "radius": 0.3381, "angle": 0.039, "clockwise": 0},
    {"increment": 154166.6667, "stroke": 0.0775, "offset": 0.3408, "radius": 0.3191, "angle": 0.944, "clockwise": 1},
)
REACH = (70000, 76000)
IN_FRONT = 0.175


def turn(axis, angle):
    """Right-handed turn about east (0), north (1) or up (2)."""
    c, s = np.cos(angle), np.sin(angle)
    j, k = (axis + 1) % 3, (axis + 2) % 3
    out = np.eye(3)
    out[j, j], out[j, k], out[k, j], out[k, k] = c, -s, s, c
    return out


def turn_about(vector):
    """Rodrigues' formula."""
    angle = np.linalg.norm(vector)
    if angle == 0:
        return np.eye(3)
    x, y, z = np.asarray(vector) / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def corner(a, length):
    return np.arccos((a["offset"] ** 2 + a["radius"] ** 2 - length**2) / (2 * a["offset"] * a["radius"]))


def angle(k, steps, e):
    """Of axis k (0 or 1), with the first one's mirror flat where the file says 0."""
    a = dict(ACTUATORS[k])
    for key, name in (("stroke", "length"), ("offset", "offset"), ("radius", "radius")):
        a[key] += 1e-3 * e.get(f"{name}_{k + 1}", 0.0)
    grown = 1e-3 * e.get(f"step_{k + 1}", 0.0)
    finer = 1 + e.get(f"increment_{k + 1}", 0.0)
    way = corner(a, a["stroke"] + grown + steps / (a["increment"] * finer)) - corner(a, a["stroke"])
    first = -np.pi / 2 if k == 0 else 0.0
    return a["angle"] + first + (-way if a["clockwise"] else way) + 1e-3 * e.get(("IE", "IA")[k], 0.0)


def pose(steps, e=None):
    """Normal, and the mirror's centre [m], under errors in mrad and mm."""
    e = e or {}
    tilt = turn_about(1e-3 * np.array([0.0, e.get("tilt_n", 0.0), e.get("tilt_u", 0.0)]))
    whole = tilt @ turn(0, angle(0, steps[0], e)) @ turn(1, 1e-3 * e.get("NPAE", 0.0)) @ turn(2, angle(1, steps[1], e))
    ca = 1e-3 * e.get("CA", 0.0)
    normal = whole @ [0.0, -np.cos(ca), np.sin(ca)]
    moved = 1e-3 * np.array([e.get(f"mirror_{k}", 0.0) for k in "enu"])
    return normal, PLACE + moved + whole @ [0.0, -IN_FRONT, 0.0] + 1e-3 * e.get("dn", 0.0) * normal


def beam(steps, sun, e=None):
    """Unit vector of the reflected light, and where it starts [m]."""
    normal, centre = pose(steps, e)
    return 2 * normal * (normal @ sun) - sun, centre


def hit(steps, sun, e=None):
    """Where the beam meets the target's plane [m]."""
    way, start = beam(steps, sun, e)
    return start + way * (TARGET[1] - start[1]) / way[1]


def miss(steps, sun, spot, e=None):
    """Half the angle between the predicted beam and the spot [mrad]."""
    way, start = beam(steps, sun, e)
    seen = (spot - start) / np.linalg.norm(spot - start)
    return 1e3 * np.arctan2(np.linalg.norm(np.cross(way, seen)), way @ seen) / 2


def steps_for(normal):
    """Motor positions of the faultless mount for a normal: n = R_east(θ1) (sin θ2, −cos θ2, 0)."""
    second = np.arcsin(normal[0])
    first = np.arctan2(-normal[2], -normal[1])
    out = []
    for k, theta in enumerate((first + np.pi / 2, second)):
        a = ACTUATORS[k]
        way = (theta - a["angle"]) * (-1 if a["clockwise"] else 1)
        c = corner(a, a["stroke"]) + way
        length = np.sqrt(a["offset"] ** 2 + a["radius"] ** 2 - 2 * a["offset"] * a["radius"] * np.cos(c))
        out.append((length - a["stroke"]) * a["increment"])
    return np.array(out)


def direction(azimuth, elevation):
    """Unit vector of azimuth from north through east and elevation [deg]."""
    a, h = np.radians([azimuth, elevation])
    return np.array([np.sin(a) * np.cos(h), np.cos(a) * np.cos(h), np.sin(h)])


def geodetic(place):
    """Latitude, longitude [deg], height [m] of east, north, up [m] about the plant (WGS 84, by fixed points)."""
    semi, squared = 6378137.0, 0.00669437999014
    la, lo = np.radians([LATITUDE, LONGITUDE])

    def centred(la, lo, h):
        n = semi / np.sqrt(1 - squared * np.sin(la) ** 2)
        return np.array(
            [(n + h) * np.cos(la) * np.cos(lo), (n + h) * np.cos(la) * np.sin(lo), (n * (1 - squared) + h) * np.sin(la)]
        )

    east = np.array([-np.sin(lo), np.cos(lo), 0.0])
    up = np.array([np.cos(la) * np.cos(lo), np.cos(la) * np.sin(lo), np.sin(la)])
    x, y, z = centred(la, lo, HEIGHT) + np.column_stack([east, np.cross(up, east), up]) @ place
    flat, latitude, h = np.hypot(x, y), la, HEIGHT
    for _ in range(20):
        n = semi / np.sqrt(1 - squared * np.sin(latitude) ** 2)
        h = flat / np.cos(latitude) - n
        latitude = np.arctan2(z, flat * (1 - squared * n / (n + h)))
    return [float(np.degrees(latitude)), float(np.degrees(np.arctan2(y, x))), float(h)]


def suns(count, seed):
    """Azimuths and elevations [deg] at which the sun may stand there."""
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(110, 250, count), rng.uniform(22, 48, count)])


def recorded(count, e=None, seed=1, at=None):
    """Steps, sun's angles [deg] (``at``, or drawn) and spots of a heliostat that is aimed as if it were faultless."""
    rows = []
    for sun in suns(count, seed) if at is None else at:
        source, way = direction(*sun), TARGET - PLACE
        normal = source + way / np.linalg.norm(way)
        steps = steps_for(normal / np.linalg.norm(normal)).round()
        rows.append((steps, sun, hit(steps, source, e)))
    return rows


def properties():
    """The heliostat's file."""
    actuators = [
        {
            "type_axis": "linear",
            "min_increment": 0,
            "max_increment": reach,
            "increment": a["increment"],
            "initial_stroke_length": a["stroke"],
            "offset": a["offset"],
            "pivot_radius": a["radius"],
            "clockwise_axis_movement": a["clockwise"],
            "initial_angle": a["angle"],
        }
        for a, reach in zip(ACTUATORS, REACH, strict=True)
    ]
    joints = {f"joint_translation_{k}_{n}": 0.0 for k in "enu" for n in (1, 2)}
    middle = {
        "concentrator_translation_e": 0.0,
        "concentrator_translation_n": IN_FRONT,
        "concentrator_translation_u": 0.0,
    }
    return {
        "heliostat_position": geodetic(PLACE),
        "initial_orientation": [0.0, -1.0, 0.0],
        "kinematics_properties": {"actuators": actuators, **joints, **middle},
    }


def write_records(folder, rows, first=1000, stamps=()):
    """Recordings of the data base with stamps of theirs, if any, and the plant's tower above them."""
    folder.mkdir(parents=True, exist_ok=True)
    tower = {
        "power_plant_properties": {"coordinates": [LATITUDE, LONGITUDE, HEIGHT]},
        "upper": {"normal_vector": [0, 1, 0], "coordinates": {"center": geodetic(TARGET)}},
    }
    (folder.parent / "tower-measurements.json").write_text(json.dumps(tower), encoding="utf-8")
    for k, (steps, (azimuth, elevation), spot) in enumerate(rows):
        record = {
            "motor_position": {"axis_1_motor_position": steps[0], "axis_2_motor_position": steps[1]},
            "target_name": "upper",
            "sun_azimuth": 180.0 - azimuth,
            "sun_elevation": elevation,
            "focal_spot": {"UTIS": geodetic(spot)},
            **({"datetime": stamps[k]} if stamps else {}),
        }
        (folder / f"{first + k}-calibration-properties.json").write_text(json.dumps(record), encoding="utf-8")


def write_heliostat(folder, rows=(), first=1000, stamps=()):
    """A folder of recordings with the heliostat's file."""
    write_records(folder, rows, first, stamps)
    (folder / "heliostat-properties.json").write_text(json.dumps(properties()), encoding="utf-8")
    return folder


def write_amended(path, recordings, effects, prediction=""):
    """An amended.toml by hand; ``effects`` by name and parameter."""
    lines = ['format = "benchsim-mount/1"', f'recordings = "{recordings}"']
    for name, terms in effects.items():
        lines += [f"[effects.{name}]", *(f"{k} = {v!r}" for k, v in terms.items())]
    path.write_text("\n".join([*lines, prediction]) + "\n", encoding="utf-8")
    return path
