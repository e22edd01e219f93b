"""Recordings of the laser bench by code that shares nothing with benchsim, to judge its diagnosis.

    python analysis/bench_other_code.py TRUTH.toml FOLDER --seed N [--truth FILE.json] [--exact FILE.json]

TRUTH.toml is a bench file with `[effects]` and `[render]`; FOLDER gets the recording without them. `[render]` reads
the keys of RENDER. `--truth` writes what was drawn, and beside it an .npz of corners (px) and traces: rows y, z (mm by
the marks), u, v (px), rms width within 12 mm (mm on the board), flux (relative, per mm). `--exact` takes such a file.
"""

from __future__ import annotations

import argparse
import csv
import json
import re
import shutil
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tomlkit
from other_optics import DN_DT, Air, Beam, Board, Mirror, Scene, Trace, rotation, to_source, turned_plane, unit
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import gaussian_filter

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
INK = 0.04  # of white paper's reflectance: printed black
ROOM_SLOPE = 0.1  # room light's change from the board's centre to its edge
SHAPE_SIGMA = (0.02, 0.05, 0.05)  # c4, e+, ex (design 2.3, Light)
SPILL_FRACTION = 0.6  # of the brightest pixel's laser charge spills at most: the tail's length makes up for the rest


def parameters(bench: dict[str, Any], rng: np.random.Generator) -> dict[str, float]:
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


def moves(exposures: list[dict[str, Any]]) -> list[int]:
    """Seat of the screen for every exposure: 0 in the earliest, one more at each change of shift or roll."""
    order = sorted(range(len(exposures)), key=lambda i: (exposures[i].get("time_s", 0.0), i))
    seats, seat, last = [0] * len(exposures), -1, None
    for i in order:
        here = exposures[i].get("screen_shift_mm", 0.0), exposures[i].get("screen_roll_deg", 0.0)
        seat += here != last
        seats[i], last = seat, here
    return seats


def draw(bench: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
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


def scene(bench: dict[str, Any], number: int, p: dict[str, float], drawn: dict[str, Any]) -> Scene:
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


def stand(exposure: dict[str, Any], p: dict[str, float], seat: dict[str, float], hours: float) -> Board:
    """The board in its seat: tilt and re-seating tilt are slopes of one plane, along the board's own y and z."""
    off = {"r_x": 0.0, "r_y": 0.0, "r_z": 0.0, "r_rot": 0.0, "r_ty": 0.0, "r_tz": 0.0} | seat
    roll, more = np.radians(exposure.get("screen_roll_deg", 0.0)), 1e-3 * (p["srot"] + off["r_rot"])
    tilt = turned_plane(1e-3 * (p["st_z"] + off["r_tz"]), 1e-3 * (p["st_y"] + off["r_ty"]))
    origin = np.array([exposure.get("screen_shift_mm", 0.0) + p["sx"] + off["r_x"], off["r_y"], off["r_z"]])
    turn = rotation(np.array([roll, 0, 0])) @ tilt @ rotation(np.array([more, 0, 0]))
    drift = np.array([0.0, p["dry"], p["drz"]]) * hours
    grid = np.eye(2) + 1e-3 * np.array([[p["gs"] + p["ga"], p["gsh"]], [p["gsh"], p["gs"] - p["ga"]]])
    return Board(origin, turn, (1e-3 * p["bow_y"], 1e-3 * p["bow_z"]), drift, grid)


@dataclass(frozen=True)
class Camera:
    """One camera in its place: OpenCV's pinhole with Brown's distortion, rows read in order."""

    size: tuple[int, int]
    matrix: np.ndarray
    distortion: np.ndarray
    turn: np.ndarray  # world to camera
    position: np.ndarray
    wave: tuple[float, float, float]  # rolling shutter: sine, cosine px, period rows

    def sway(self, row: np.ndarray) -> np.ndarray:
        """Shift (px) of the content of an image row toward +u."""
        turn = 2 * np.pi * (row - self.matrix[1, 2]) / self.wave[2]
        return np.asarray(self.wave[0] * np.sin(turn) + self.wave[1] * np.cos(turn))

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels (n, 2) of world points (n, 3)."""
        rotation_vector = cv2.Rodrigues(self.turn)[0]
        shift = -self.turn @ self.position
        flat = cv2.projectPoints(points.reshape(-1, 1, 3), rotation_vector, shift, self.matrix, self.distortion)[0]
        pixels = flat.reshape(-1, 2)
        return pixels + np.stack([self.sway(pixels[:, 1]), 0 * pixels[:, 1]], -1)

    def board_map(self, board: Board) -> tuple[RectBivariateSpline, RectBivariateSpline]:
        """Board y and z as functions of (row, column): exact every 16 px, quintic between (1e-6 px)."""
        u, v = (np.arange(-16.0, n + 32, 16) for n in self.size)
        vv, uu = np.meshgrid(v, u, indexing="ij")
        seen = np.stack([uu - self.sway(vv), vv, np.ones_like(uu)], -1).reshape(-1, 3) @ np.linalg.inv(self.matrix).T
        flat = seen.copy()
        for _ in range(60):  # contracts by a tenth at these lenses
            bent = cv2.projectPoints(flat, np.zeros(3), np.zeros(3), np.eye(3), self.distortion)[0].reshape(-1, 2)
            flat[:, :2] += seen[:, :2] - bent
        sight = flat @ self.turn
        yz = board.meet(np.broadcast_to(self.position, sight.shape), sight).reshape(*vv.shape, 2)
        return RectBivariateSpline(v, u, yz[..., 0], kx=5, ky=5), RectBivariateSpline(v, u, yz[..., 1], kx=5, ky=5)


def camera(bench: dict[str, Any], number: int, p: dict[str, float], drawn: dict[str, Any]) -> Camera:
    """Camera of an exposure with effects, lens errors and the error of its pose."""
    name = bench["exposure"][number]["camera"]
    given = bench["cameras"][name]
    focal, du, dv, dk = drawn.get("intrinsics", {}).get(name, [0.0] * 4)
    f = given["focal_px"] * (1 + focal)
    cx, cy = given["principal_point_px"]
    lens = np.array([*given.get("distortion", []), *[0.0] * 5][:5])
    lens[:4] += p["k1"] + dk, p["k2"], p["p1"], p["p2"]
    step, spin = (np.array(e) for e in drawn["camera_pose_errors"][number])
    position = np.array(given["position_mm"], float)
    forward = unit(np.array(given.get("look_at_mm", [0.0, 0, 0]), float) - position)
    right = unit(np.cross(forward, [0.0, 0, 1]))
    turn = rotation(1e-3 * spin) @ np.stack([right, np.cross(forward, right), forward])
    matrix = np.array([[f, 0, cx + du], [0, f, cy + dv], [0, 0, 1]])
    wave = (p["rs_s"], p["rs_c"], p["rs_period"])
    return Camera(tuple(given["resolution_px"]), matrix, lens, turn, position + step, wave)


def lay_marks(size: tuple[float, float]) -> list[tuple[int, float, float, float]]:
    """A frame of 32 marks and eight within, (id, y, z, side) mm, for a board of `size`."""
    side = 32.0 * min(size) / 700
    half = np.array(size) / 2 - side
    steps = np.linspace(-1, 1, 9)
    frame = [(s, 1.0) for s in steps] + [(1.0, -s) for s in steps[1:]]
    frame += [(-s, -1.0) for s in steps[1:]] + [(-1.0, s) for s in steps[1:-1]]
    inner = [(y, z) for z in (0.5, 0.0, -0.5) for y in (-0.5, 0.0, 0.5) if y or z]
    return [(i, round(y * half[0], 3), round(z * half[1], 3), side) for i, (y, z) in enumerate(frame + inner)]


def read_marks(path: Path) -> list[tuple[int, float, float, float]]:
    """Marks (id, y, z, side) mm of a marks file."""
    with path.open(newline="") as lines:
        return [(int(r["id"]), *(float(r[k]) for k in ("y_mm", "z_mm", "side_mm"))) for r in csv.DictReader(lines)]


def corners(marks: list[tuple[int, float, float, float]]) -> np.ndarray:
    """Printed corners (n, 4, 2) mm of the black squares: top left, top right, bottom right, bottom left."""
    ring = np.array([(-1, 1), (1, 1), (1, -1), (-1, -1)]) / 2
    return np.array([[y, z] + s * ring for _, y, z, s in marks])


class Print:
    """The printed board: reflectance relative to white paper at board points."""

    def __init__(self, marks: list[tuple[int, float, float, float]], grid: np.ndarray, size: tuple[float, float]):
        book = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        self.cells = np.array([cv2.aruco.generateImageMarker(book, int(m[0]), 8) > 0 for m in marks])
        self.marks, self.back, self.half = np.array(marks), np.linalg.inv(grid), np.array(size) / 2

    def paper(self, yz: np.ndarray) -> np.ndarray:
        """Unprinted board (...) at board points (..., 2): 1 on it, 0 off it."""
        return (np.abs(yz[..., 0]) <= self.half[0]) * (np.abs(yz[..., 1]) <= self.half[1]) * 1.0

    def white(self, yz: np.ndarray) -> np.ndarray:
        """Reflectance (n, m) at the board points (n, m, 2) of n small patches, each near one mark at most."""
        printed, places = yz @ self.back.T, self.marks[:, 1:3]
        first = printed[:, 0]
        far = np.maximum(*(np.abs(first[:, None, k] - places[:, k]) for k in (0, 1)))
        mark = np.argmin(far, axis=1)[:, None]
        side = self.marks[mark, 3]
        column = np.floor(((printed[..., 0] - places[mark, 0]) / side + 0.5) * 8).astype(int)
        row = np.floor((0.5 - (printed[..., 1] - places[mark, 1]) / side) * 8).astype(int)
        on = (row >= 0) & (row < 8) & (column >= 0) & (column < 8)
        bare = self.cells[mark, np.where(on, row, 0), np.where(on, column, 0)]
        return self.paper(yz) * np.where(on & ~bare, INK, 1.0)


def expose(eye: Camera, board: Board, sheet: Print, trace: Trace, fine: int = 4) -> np.ndarray:
    """Room-lit and laser-lit radiance (2, rows, columns), each the mean over a pixel's area; white paper is 1.

    Pixels near a mark, the board's edge or the trace are sampled fine x fine, with a linear map in each: 1e-4 mm.
    """
    grid = [np.arange(n, dtype=float) for n in eye.size[::-1]]
    yz = np.stack([m(*grid) for m in eye.board_map(board)], -1)
    white = sheet.paper(yz)
    light = np.stack([white * room(yz), 0 * white])
    down, across = np.gradient(yz, axis=(0, 1))
    near = np.zeros(white.shape, np.uint8)
    step = 1 / float(np.median(np.linalg.norm(across[white > 0], axis=-1)))  # px per mm
    frame = np.array([(-1, 1), (1, 1), (1, -1), (-1, -1)]) * sheet.half
    for ring in [frame, *corners(sheet.marks) @ np.linalg.inv(sheet.back).T]:
        outline = [np.rint(eye.project(board.world(ring))).astype(np.int32)]
        if ring is not frame:
            cv2.fillPoly(near, outline, 1)
        cv2.polylines(near, outline, True, 1, 7)
    path = eye.project(board.world(trace.base(trace.phase)))
    band = np.zeros_like(near)
    cv2.polylines(band, [np.rint(path).astype(np.int32)], False, 1, int(2.2 * trace.edges[-1] * step))
    inner = (np.arange(fine) + 0.5) / fine - 0.5
    dv, du = (a.ravel()[:, None] for a in np.meshgrid(inner, inner, indexing="ij"))
    for mask in (near & ~band, band):
        at = np.nonzero(mask)
        centre, right, below = yz[at], across[at], down[at]
        spots = centre[:, None] + dv * below[:, None] + du * right[:, None]
        paper = sheet.white(spots)
        light[0][at] = (paper * room(spots)).mean(1)
        if mask is band:
            here, there, under = (
                np.stack(trace.chart(q)) for q in (centre, centre + 0.5 * right, centre + 0.5 * below)
            )
            chart = (
                here[..., None] + 2 * (there - here)[..., None] * du[:, 0] + 2 * (under - here)[..., None] * dv[:, 0]
            )
            light[1][at] = (paper * trace.lookup(chart[0].ravel(), chart[1].ravel()).reshape(paper.shape)).mean(1)
    return light


def room(yz: np.ndarray) -> np.ndarray:
    """Room light on the board, brighter toward its lower right."""
    return 1 + ROOM_SLOPE * (yz[..., 0] - 0.5 * yz[..., 1]) / 500


def spill(laser: np.ndarray, shift: float) -> np.ndarray:
    """Laser picture after charge spilt toward +v: its centroid moves by `shift` px at the peak, as brightness squared.

    Each pixel loses a share of its charge that goes as its brightness squared, laid down after it over a uniform tail.
    """
    if not shift:
        return laser
    row, column = np.unravel_index(np.argmax(laser), laser.shape)
    profiles = laser[max(row - 12, 0) : row + 13, column], laser[row, max(column - 12, 0) : column + 13]
    share = (laser / laser[row, column]) ** 2
    ratio = max(a.sum() / (a * (a / a.max()) ** 2).sum() for a in profiles)  # across the line
    tail = max(int(np.ceil(2 * abs(shift) * ratio / SPILL_FRACTION)) - 1, 1)
    lost = laser * share * abs(shift) * ratio / ((tail + 1) / 2)
    laid = sum(np.roll(lost, int(np.sign(shift)) * k, axis=0) for k in range(1, tail + 1))
    return np.asarray(laser - lost + laid / tail)


def develop(light: np.ndarray, given: dict[str, Any], render: dict[str, Any], rng: np.random.Generator) -> np.ndarray:
    """Counts of a picture whose light is a fraction of saturation."""
    if render["noise"]:
        electrons = rng.poisson(np.clip(light, 0, None) * render["full_well_e"])
        light = (electrons + render["read_noise_e"] * rng.standard_normal(light.shape)) / render["full_well_e"]
    gamma = given.get("gamma", 1.0)
    depth = given.get("bit_depth", 16)
    black, top = given.get("black_level", 0.0), given.get("saturation_level", 2**depth - 1)
    if gamma == "srgb":
        positive = np.clip(light, 0, 1)
        light = np.where(positive < 0.0031308, 12.92 * positive, 1.055 * positive ** (1 / 2.4) - 0.055)
    elif gamma != 1.0:
        light = np.clip(light, 0, 1) ** (1 / (2.2 if gamma == "unknown" else gamma))
    counts = np.clip(np.rint(black + (top - black) * light), 0, top)
    return counts.astype(np.uint8 if depth == 8 else np.uint16)


def picture(
    bench: dict[str, Any],
    number: int,
    p: dict[str, float],
    drawn: dict[str, Any],
    marks: list,
    rng: np.random.Generator,
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
    """The recording's file: the bench file without its `[effects]` and `[render]`."""
    document = tomlkit.parse(text)
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
        lines = ["id,y_mm,z_mm,side_mm", *(f"{i},{y:.3f},{z:.3f},{s:.3f}" for i, y, z, s in marks)]
        (options.folder / name).write_text("\n".join(lines) + "\n")
    (options.folder / "recording.toml").write_text(conceal(text))
    truth = {}
    for number, exposure in enumerate(bench["exposure"]):
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
