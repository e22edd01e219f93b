"""Recordings of the laser bench by code that shares nothing with benchsim, to judge its diagnosis.

    python analysis/bench_other_code.py TRUTH.toml FOLDER --seed N [--truth FILE.json] [--exact FILE.json]

TRUTH.toml is a bench file with `[effects]` and `[render]`; FOLDER gets the recording without them. `[render]` reads
the keys of RENDER. `--truth` writes what was drawn, and beside it an .npz of corners (px) and traces: rows y, z (mm by
the marks), u, v (px), rms width within 12 mm (mm on the board), flux (relative, per mm). `--exact` takes such a file.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import tomllib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tomlkit
from other_camera import Print, camera, corners, develop, expose, lay_marks, read_marks, spill
from other_light import Trace
from other_optics import DN_DT, Air, Beam, Board, Mirror, Scene, rotation, to_source, turned_plane, unit
from scipy.ndimage import gaussian_filter

Table = dict[str, Any]  # of a TOML or JSON file
EFFECTS = """
pivot-offset: dr, canting: pyr, facet-tilts: tilt_rms tilt_\\d+, axis-wobble: wob_c wob_s, axis-tilt: ped_x ped_y,
azimuth-offset: az_enc, second-surface: glass, facet-curvature: fcurv, beam-direction: saz sel, beam-offset: bu bv,
wavefront-curvature: curv, astigmatism: astig0 astig45, coma: coma_u coma_v, window: win, window-tilt: win wty wtz,
air-gradient: air airh, plume: plume plume_y plume_z plume_width, screen-distance: sx, screen-tilt: st_y st_z,
screen-bow: bow_y bow_z, screen-rotation: srot, grid-scale: gs, grid-aspect: ga, grid-shear: gsh,
radial-distortion: k1 k2, tangential-distortion: p1 p2, rolling-shutter: rs_s rs_c rs_period, saturation: sat,
drift: dry drz"""
PARAMETERS = {name: words.split() for name, words in (one.strip().split(": ") for one in EFFECTS.split(","))}
UNCERTAINTY = {
    "mirror_position_mm": 1.0,
    "mirror_axis_mrad": 1.745,
    "laser_direction_mrad": 1.745,
    "screen_position_mm": 0.2,
    "screen_angle_mrad": 1.0,
    "beam_diameter_fraction": 0.02,
    "divergence_fraction": 0.005,
    "intrinsics_sigma": [0.0, 0.0, 0.0],
}
RENDER = {
    "peak_fraction": 0.7,
    "room_fraction": 0.15,
    "full_well_e": 12000.0,
    "read_noise_e": 6.0,
    "blur_px": 0.7,
    "speckle_px": 0.0,
    "speckle_contrast": 0.05,
    "noise": True,
    "ghost": True,
    "pose_mm": 1.5,
    "pose_mrad": 1.0,
}
SHAPE_SIGMA = (0.02, 0.05, 0.05)  # c4, e+, ex (design 2.3, Light)


def parameters(bench: Table, rng: np.random.Generator) -> dict[str, float]:
    """Effect parameters of the file, zero where not given; random facet tilts are drawn here."""
    known = {one: 0.0 for words in PARAMETERS.values() for one in words if "\\" not in one}
    known |= {"plume_width": 30.0, "rs_period": 1400.0}
    for name, values in bench.get("effects", {}).items():
        if name not in PARAMETERS:
            raise SystemExit(f"effect {name}: this program does not make it.")
        for key, value in values.items():
            if not any(re.fullmatch(one, key) for one in PARAMETERS[name]):
                raise SystemExit(f"effect {name}: no parameter {key}; it has {' '.join(PARAMETERS[name])}.")
            known[key] = float(value)
    if "window-tilt" in bench.get("effects", {}) and not known["win"]:
        known["win"] = 4.0
    count = int(bench.get("mirror", {}).get("facets", 12))
    if known["tilt_rms"]:
        tilts = known["tilt_rms"] * rng.standard_normal(count)
        tilts -= tilts.mean()
        known |= {f"tilt_{k}": float(t) for k, t in enumerate(tilts)}
    return known


def moves(exposures: list[Table]) -> list[int]:
    """Seat of the screen for every exposure: 0 in the earliest, one more at each change of shift or roll."""
    order = sorted(range(len(exposures)), key=lambda i: (exposures[i].get("time_s", 0.0), i))
    seats, seat, last = [0] * len(exposures), -1, None
    for i in order:
        here = exposures[i].get("screen_shift_mm", 0.0), exposures[i].get("screen_roll_deg", 0.0)
        seat += here != last
        seats[i], last = seat, here
    return seats


def draw(bench: Table, rng: np.random.Generator) -> Table:
    """Everything that a recording's hands and parts add: setting, seat, beam, lens and pose errors (mm, mrad)."""
    sigma = UNCERTAINTY | bench.get("uncertainty", {})
    exposures = bench["exposure"]
    names = ["n_cx", "n_cy", "n_cz", "n_a1", "n_a2", "n_saz", "n_sel"]
    scales = [sigma["mirror_position_mm"]] * 3 + [sigma["mirror_axis_mrad"]] * 2 + [sigma["laser_direction_mrad"]] * 2
    settings = dict.fromkeys(e["setting"] for e in exposures)
    errors = {s: dict(zip(names, (rng.standard_normal(7) * scales).tolist(), strict=True)) for s in settings}
    seats = moves(exposures)
    seat_names = ["r_x", "r_y", "r_z", "r_rot", "r_ty", "r_tz"]
    seat_scales = [sigma["screen_position_mm"]] * 3 + [sigma["screen_angle_mrad"]] * 3
    seat_errors: dict[str, dict[str, float]] = {"0": {}}
    for seat in range(1, max(seats) + 1):
        seat_errors[str(seat)] = dict(zip(seat_names, (rng.standard_normal(6) * seat_scales).tolist(), strict=True))
    render = RENDER | bench.get("render", {})
    shape = rng.standard_normal(5) * [*SHAPE_SIGMA, sigma["beam_diameter_fraction"], sigma["divergence_fraction"]]
    lens = {c: rng.standard_normal(4) * np.array(sigma["intrinsics_sigma"])[[0, 1, 1, 2]] for c in bench["cameras"]}
    poses = rng.standard_normal((len(exposures), 2, 3)) * np.array([render["pose_mm"], render["pose_mrad"]])[:, None]
    return {
        "setting_errors": errors,
        "seats": seats,
        "seat_errors": seat_errors,
        "beam": dict(zip(["c4", "e_plus", "e_cross", "diameter", "divergence"], shape.tolist(), strict=True)),
        "intrinsics": {c: d.tolist() for c, d in lens.items()},
        "camera_pose_errors": poses.tolist(),
    }


def scene(bench: Table, number: int, p: dict[str, float], drawn: Table) -> Scene:
    """The bench as it stood during one exposure."""
    laser = {"wavelength_nm": 632.8, "beam_diameter_mm": 10.0, "divergence_mrad": 4.0} | bench.get("laser", {})
    body = {"facets": 12, "diameter_mm": 35.0, "height_mm": 2.0, "stands_for": "elevation"} | bench.get("mirror", {})
    physics = {"facets": True, "beam": True, "diffraction": True} | bench.get("physics", {})
    if body.get("shape", "polygon") != "polygon" or not (physics["facets"] and physics["beam"]):
        raise SystemExit("only a polygon with [physics] facets and beam true is made here.")
    exposure = bench["exposure"][number]
    count, error = int(body["facets"]), drawn["setting_errors"][exposure["setting"]]
    inscribed = body["diameter_mm"] / 2 * np.cos(np.pi / count)
    nominal = np.array(exposure["mirror_position_mm"], float)
    sun = to_source(exposure["laser_azimuth_deg"], exposure["laser_elevation_deg"])
    normal = unit(sun - unit(nominal))
    for _ in range(50):  # Eq. (17)
        normal = unit(sun - unit(nominal + inscribed * normal))
    aim = nominal + inscribed * normal
    axis = unit(np.cross([0.0, 0, 1], normal))
    if body["stands_for"] == "azimuth":
        axis = np.cross(normal, axis)
    turn = rotation(1e-3 * np.array([p["ped_x"], p["ped_y"], p["az_enc"]]))
    turn = turn @ rotation(1e-3 * (error["n_a1"] * normal + error["n_a2"] * np.cross(normal, axis)))
    axis, normal = turn @ axis, turn @ normal
    centre = nominal + np.array([error["n_cx"], error["n_cy"], error["n_cz"]])
    sides = inscribed + p["dr"], inscribed * np.tan(np.pi / count), body["height_mm"] / 2
    mirror = Mirror(centre, axis, normal, *sides, 1e-3 * p["fcurv"], p["glass"])
    dials = np.degrees(1e-3 * np.array([error["n_saz"] + p["saz"], error["n_sel"] + p["sel"]]))
    d = -to_source(exposure["laser_azimuth_deg"] + dials[0], exposure["laser_elevation_deg"] + dials[1])
    v = unit(axis - (axis @ d) * d)
    u = np.cross(v, d)
    shape = drawn.get("beam", {})
    diameter = laser["beam_diameter_mm"] * (1 + shape.get("diameter", 0.0))
    spread = 1e-3 * laser["divergence_mrad"] * (1 + shape.get("divergence", 0.0)) / diameter
    bend = 1e-3 * np.array([[p["curv"] + p["astig0"], p["astig45"]], [p["astig45"], p["curv"] - p["astig0"]]])
    profile = tuple(shape.get(key, 0.0) for key in ("c4", "e_plus", "e_cross"))
    start, coma = aim + p["bu"] * u + p["bv"] * v, (1e-3 * p["coma_u"], 1e-3 * p["coma_v"])
    beam = Beam(start, u, v, d, diameter / 2, spread * np.eye(2) + bend, coma, profile)
    k = np.arange(count)
    leans = p["pyr"] + p["wob_c"] * np.cos(2 * np.pi * k / count) + p["wob_s"] * np.sin(2 * np.pi * k / count)
    leans = 1e-3 * (leans + np.array([p.get(f"tilt_{i}", 0.0) for i in k]))
    chosen = leans[[exposure["facet"]]] if "facet" in exposure else leans[:1] if np.ptp(leans) == 0 else leans
    shift = exposure.get("screen_shift_mm", 0.0)
    slab = (rotation(np.radians([0, 0, p["wtz"]])) @ rotation(np.radians([0, p["wty"], 0])))[:, 0]
    plume = (1e-3 * p["plume"], p["plume_y"], p["plume_z"], p["plume_width"], 0.5 * (nominal[0] + shift))
    air = Air(shift, 1e-3 * DN_DT * np.array([0.0, p["airh"], p["air"]]), plume, p["win"], slab)
    times = [e.get("time_s", 0.0) for e in bench["exposure"]]
    hours = (exposure.get("time_s", 0.0) - min(times)) / 3600
    board = stand(exposure, p, drawn["seat_errors"][str(drawn["seats"][number])], hours)
    blur = 1e-3 * laser.get("incoherent_divergence_mrad", 0.0) / 4
    size = tuple(bench.get("screen", {}).get("size_mm", [700.0, 700.0]))
    wave = 1e-6 * laser["wavelength_nm"]
    return Scene(beam, mirror, air, board, tuple(chosen), wave, physics["diffraction"], blur, size)


def stand(exposure: Table, p: dict[str, float], seat: dict[str, float], hours: float) -> Board:
    """The board in its seat: tilt and re-seating tilt are slopes of one plane, along the board's own y and z."""
    off = {"r_x": 0.0, "r_y": 0.0, "r_z": 0.0, "r_rot": 0.0, "r_ty": 0.0, "r_tz": 0.0} | seat
    roll, more = np.radians(exposure.get("screen_roll_deg", 0.0)), 1e-3 * (p["srot"] + off["r_rot"])
    tilt = turned_plane(1e-3 * (p["st_z"] + off["r_tz"]), 1e-3 * (p["st_y"] + off["r_ty"]))
    origin = np.array([exposure.get("screen_shift_mm", 0.0) + p["sx"] + off["r_x"], off["r_y"], off["r_z"]])
    turn = rotation(np.array([roll, 0, 0])) @ tilt @ rotation(np.array([more, 0, 0]))
    drift = np.array([0.0, p["dry"], p["drz"]]) * hours
    grid = np.eye(2) + 1e-3 * np.array([[p["gs"] + p["ga"], p["gsh"]], [p["gsh"], p["gs"] - p["ga"]]])
    return Board(origin, turn, (1e-3 * p["bow_y"], 1e-3 * p["bow_z"]), drift, grid)


def picture(
    bench: Table, number: int, p: dict[str, float], drawn: Table, marks: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Picture, dark picture and truth (corners, trace) of one exposure."""
    render = RENDER | bench.get("render", {})
    stage = scene(bench, number, p, drawn)
    trace = Trace(stage, bool(render["ghost"]))
    eye = camera(bench, number, p, drawn)
    paper, laser = expose(eye, stage.board, Print(marks, stage.board.grid, stage.size), trace)
    if render["blur_px"]:
        paper, laser = (gaussian_filter(a, render["blur_px"], mode="nearest") for a in (paper, laser))
    laser = spill(laser, p["sat"])
    if render["speckle_px"]:
        grain = gaussian_filter(rng.standard_normal(laser.shape), render["speckle_px"])
        laser = laser * np.clip(1 + render["speckle_contrast"] * grain / grain.std(), 0, None)
    paper = render["room_fraction"] * paper
    bright = laser > 0.3 * laser.max()
    if not bright.any() or laser.max() <= 0:
        raise SystemExit(f"exposure {number + 1}: the camera does not see the trace.")
    laser = laser * np.min((render["peak_fraction"] - paper[bright]) / laser[bright])
    given = bench["cameras"][bench["exposure"][number]["camera"]]
    lit, dark = develop(paper + laser, given, render, rng), develop(paper, given, render, rng)
    at = np.linspace(trace.phase[1], trace.phase[-2], 240)
    line = trace.line(at)
    inside = (np.abs(line["yz"]) < np.array(stage.size) / 2).all(1)
    yz = line["yz"][inside]
    printed = yz @ np.linalg.inv(stage.board.grid).T
    rows = np.column_stack([printed, eye.project(stage.board.world(yz)), line["width"][inside], line["flux"][inside]])
    square = eye.project(stage.board.world(corners(marks).reshape(-1, 2) @ stage.board.grid.T))
    return lit, dark, {"corners": square.reshape(-1, 4, 2), "trace": rows.T}


def conceal(text: str) -> str:
    """The recording's file: the bench file without its `[effects]` and `[render]`, its pictures named."""
    document = tomlkit.parse(text)
    dark = document.get("render", {}).get("dark", True)
    for number, exposure in enumerate(document["exposure"], 1):
        if "image" not in exposure:
            exposure.update({"image": f"{number:03d}.png"} | ({"dark": f"{number:03d}-dark.png"} if dark else {}))
    for table in ("effects", "render"):
        document.pop(table, None)
    return tomlkit.dumps(document)


def main() -> None:
    """Read the bench, draw what is hidden, write the folder."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("bench", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--truth", type=Path, help="write what was drawn here, its .npz beside it")
    parser.add_argument("--exact", type=Path, help="take what is drawn from this file instead")
    options = parser.parse_args()
    text = options.bench.read_text()
    bench = tomllib.loads(text)
    effects_rng, errors_rng, noise_rng = (np.random.default_rng([options.seed, k]) for k in range(3))
    p = parameters(bench, effects_rng)
    drawn = json.loads(options.exact.read_text()) if options.exact else draw(bench, errors_rng)
    p |= drawn.get("parameters", {})
    options.folder.mkdir(parents=True, exist_ok=True)
    size = tuple(bench.get("screen", {}).get("size_mm", [700.0, 700.0]))
    name = bench.get("screen", {}).get("marks", "marks.csv")
    (options.folder / name).parent.mkdir(parents=True, exist_ok=True)
    if (options.bench.parent / name).exists():
        marks = read_marks(options.bench.parent / name)
        if (options.bench.parent / name).resolve() != (options.folder / name).resolve():
            shutil.copyfile(options.bench.parent / name, options.folder / name)
    else:
        marks = lay_marks(size)
        lines = ["id,y_mm,z_mm,side_mm", *(f"{i:.0f},{y:.3f},{z:.3f},{s:.3f}" for i, y, z, s in marks)]
        (options.folder / name).write_text("\n".join(lines) + "\n")
    concealed = conceal(text)
    (options.folder / "recording.toml").write_text(concealed)
    truth: Table = {}
    for number, exposure in enumerate(tomllib.loads(concealed)["exposure"]):
        lit, dark, known = picture(bench, number, p, drawn, marks, noise_rng)
        truth |= {f"{key}_{number}": value for key, value in known.items()}
        for key, image in (("image", lit), ("dark", dark)):
            if key in exposure:
                (options.folder / exposure[key]).parent.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(options.folder / exposure[key]), image)
    if options.truth:
        used = {key: value for key, value in p.items() if value}
        record = {"format": "bench-truth/1", "seed": options.seed, "parameters": used, **drawn}
        options.truth.write_text(json.dumps(record, indent=1))
        np.savez_compressed(options.truth.with_suffix(".npz"), **truth)


if __name__ == "__main__":
    main()
