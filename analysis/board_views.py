"""Photographs of the board as a phone would make them, cheaply: for `calibration_sets.py`.

No ray is traced. A board of exact texels is looked up along the line of sight of 3 × 3 points a pixel through a lens
with Brown's distortion (inverted here, not by benchsim), blurred, lit unevenly, given shot and read noise, put through
sRGB's curve and saved as JPEG with subsampled colour.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.spatial.transform import Rotation

from benchsim.bench.model import Camera, Marks

PITCH, FINE = 0.25, 3
INK, PAPER, BESIDE = 0.05, 0.8, 0.25
FULL_WELL, READ_NOISE = 5000.0, 5.0
CELLS = 8


def texture(marks: Marks, size: tuple[float, float]) -> np.ndarray:
    """Reflectance on texels of `PITCH` mm; row 0 at the top. Marks must lie on whole texels."""
    nz, ny = round(size[1] / PITCH), round(size[0] / PITCH)
    out = np.full((nz, ny), PAPER, np.float32)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    for tag, (y, z), side in zip(marks.ids, marks.centres, marks.sides, strict=True):
        cells = cv2.aruco.generateImageMarker(dictionary, tag, CELLS, borderBits=1)
        each = round(side / CELLS / PITCH)
        image = np.kron(np.where(cells > 0, PAPER, INK), np.ones((each, each)))
        j, i = round((y - side / 2 + size[0] / 2) / PITCH), round((size[1] / 2 - z - side / 2) / PITCH)
        out[i : i + len(image), j : j + len(image)] = image
    return out


@dataclass(frozen=True)
class Set:
    """A true camera and where it stood: rotation and translation of board points (x, y, z) mm into the camera."""

    camera: Camera
    poses: tuple[tuple[np.ndarray, np.ndarray], ...]
    focal: tuple[float, ...]


def draw_set(rng: np.random.Generator, views: int = 12, breathing: float = 0.0, zoom: float = 0.0) -> Set:
    """A phone's camera whose focal length is known to 5 %, and views as the walk-through asks for.

    ``breathing``: relative change of the focal length per (700 mm / distance); ``zoom``: its 1 σ from view to view.
    """
    width, height = 1600, 1200
    focal = 1200.0 * (1 + 0.05 * rng.standard_normal())
    k1, k2 = 0.10 + 0.02 * rng.standard_normal(), -0.22 + 0.03 * rng.standard_normal()
    k3 = 0.10 + 0.02 * rng.standard_normal()
    point = (width / 2 + 12 * rng.standard_normal(), height / 2 + 12 * rng.standard_normal())
    p1, p2 = 5e-4 * rng.standard_normal(2)
    camera = Camera("A", (width, height), focal, point, (k1, k2, p1, p2, k3), bit_depth=8, saturation_level=255.0)
    poses, focals = [], []
    first = rng.uniform(0, 360)
    for k in range(views):
        tilt = np.radians(rng.uniform(15, 45)) if k % 4 else np.radians(rng.uniform(0, 8))
        round_board = np.radians(first + 360 * 5 * k / views + rng.normal(0, 8))
        distance = rng.uniform(680, 1150)
        back = np.array([
            np.cos(tilt), np.sin(tilt) * np.cos(round_board), np.sin(tilt) * np.sin(round_board)
        ])  # fmt: skip
        target = np.array([0.0, *rng.uniform(-90, 90, 2)])
        forward = -back
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        roll = np.radians(rng.choice([0, 0, 90]) + rng.normal(0, 4))
        rotation = Rotation.from_rotvec([0, 0, roll]).as_matrix() @ rotation
        poses.append((rotation, -rotation @ (target + distance * back)))
        focals.append(focal * (1 + breathing * 700 / distance) * (1 + zoom * rng.standard_normal()))
    return Set(camera, tuple(poses), tuple(focals))


def _undistorted(camera: Camera, focal: float) -> tuple[np.ndarray, np.ndarray]:
    """Slopes x, y of the lines of sight of every fine pixel, float32."""
    w, h = camera.resolution
    (cu, cv), (k1, k2, p1, p2, k3) = camera.principal_point, camera.distortion
    u, v = np.linspace(-1, w, 161), np.linspace(-1, h, 121)
    xd, yd = np.meshgrid((u - cu) / focal, (v - cv) / focal)
    x, y = xd.copy(), yd.copy()
    for _ in range(200):
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        ex = xd - (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x))
        ey = yd - (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y)
        x, y = x + 0.8 * ex, y + 0.8 * ey
    assert max(np.abs(ex).max(), np.abs(ey).max()) < 1e-9, "the lens folds"
    fine_u, fine_v = ((np.arange(n * FINE) + 0.5) / FINE - 0.5 for n in (w, h))
    return tuple(RectBivariateSpline(v, u, a)(fine_v, fine_u).astype(np.float32) for a in (x, y))


def photographs(one: Set, board: np.ndarray, rng: np.random.Generator, quality: int = 90):
    """Pictures (h, w, 3) uint8 of a set, one after the other, as they stand before JPEG; see `save`."""
    w, h = one.camera.resolution
    size = np.array(board.shape[::-1]) * PITCH
    rays: dict[float, tuple[np.ndarray, np.ndarray]] = {}
    for (rotation, translation), focal in zip(one.poses, one.focal, strict=True):
        if focal not in rays:
            rays = {focal: _undistorted(one.camera, focal)}
        x, y = rays[focal]
        # Column 1, 2 of the rotation carry y, z; the plane's homography takes lines of sight back to them.
        back = np.linalg.inv(np.column_stack([rotation[:, 1], rotation[:, 2], translation])).astype(np.float32)
        depth = back[2, 0] * x + back[2, 1] * y + back[2, 2]
        at_y = (back[0, 0] * x + back[0, 1] * y + back[0, 2]) / depth
        at_z = (back[1, 0] * x + back[1, 1] * y + back[1, 2]) / depth
        column = (at_y + np.float32(size[0] / 2)) / np.float32(PITCH) - np.float32(0.5)
        row = (np.float32(size[1] / 2) - at_z) / np.float32(PITCH) - np.float32(0.5)
        light = cv2.remap(board, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=BESIDE)
        light = cv2.GaussianBlur(light, (0, 0), FINE * rng.uniform(0.6, 1.1))
        light = cv2.resize(light, (w, h), interpolation=cv2.INTER_AREA)
        u, v = np.meshgrid(np.linspace(-1, 1, w), np.linspace(-1, 1, h))
        slope = rng.normal(0, 0.12, 2)
        light = light * (0.62 / PAPER) * (1 + slope[0] * u + slope[1] * v) * (1 - 0.12 * (u * u + v * v))
        balance = np.array([0.9, 1.0, 0.95])
        electrons = light[..., None] * balance * FULL_WELL
        electrons = electrons + rng.normal(size=electrons.shape) * np.sqrt(np.maximum(electrons, 0) + READ_NOISE**2)
        linear = np.clip(electrons / FULL_WELL, 0, 1)
        srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        yield np.rint(255 * srgb).astype(np.uint8)


def save(one: Set, board: np.ndarray, folder: Path, seed: int, quality: int = 90) -> list[Path]:
    """Write the set's photographs as JPEG."""
    rng = np.random.default_rng(seed)
    paths = []
    for k, picture in enumerate(photographs(one, board, rng)):
        paths.append(folder / f"{k + 1:02d}.jpg")
        cv2.imwrite(str(paths[-1]), picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return paths
