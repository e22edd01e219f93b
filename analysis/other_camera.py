"""Printed board, camera and sensor of the laser bench, apart from the product's own (float64).

Board points are mm along the board, pixels OpenCV's.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from other_light import Trace
from other_optics import Board, rotation, unit
from scipy.interpolate import RectBivariateSpline

INK = 0.04  # of white paper's reflectance: printed black
ROOM_SLOPE = 0.1  # room light's change from the board's centre to its edge
SPILL_FRACTION = 0.6  # of the brightest pixel's laser charge spills at most: the tail's length makes up for the rest


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


def lay_marks(size: tuple[float, float]) -> np.ndarray:
    """A frame of 32 marks and eight within, rows (id, y, z, side) mm, for a board of `size`."""
    side = 32.0 * min(size) / 700
    half = np.array(size) / 2 - side
    steps = np.linspace(-1, 1, 9)
    frame = [(s, 1.0) for s in steps] + [(1.0, -s) for s in steps[1:]]
    frame += [(-s, -1.0) for s in steps[1:]] + [(-1.0, s) for s in steps[1:-1]]
    inner = [(y, z) for z in (0.5, 0.0, -0.5) for y in (-0.5, 0.0, 0.5) if y or z]
    return np.array([(i, round(y * half[0], 3), round(z * half[1], 3), side) for i, (y, z) in enumerate(frame + inner)])


def read_marks(path: Path) -> np.ndarray:
    """Rows (id, y, z, side) mm of a marks file."""
    rows = np.genfromtxt(path, delimiter=",", names=True)
    return np.stack([rows[key] for key in ("id", "y_mm", "z_mm", "side_mm")], -1)


def corners(marks: np.ndarray) -> np.ndarray:
    """Printed corners (n, 4, 2) mm of the black squares: top left, top right, bottom right, bottom left."""
    ring = np.array([(-1, 1), (1, 1), (1, -1), (-1, -1)]) / 2
    return marks[:, None, 1:3] + marks[:, None, 3:] * ring


class Print:
    """The printed board: reflectance relative to white paper at board points."""

    def __init__(self, marks: np.ndarray, grid: np.ndarray, size: tuple[float, float]):
        book = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        self.cells = np.array([cv2.aruco.generateImageMarker(book, int(m[0]), 8) > 0 for m in marks])
        self.marks, self.back, self.half = marks, np.linalg.inv(grid), np.array(size) / 2

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
