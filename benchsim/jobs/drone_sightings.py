"""Glints of a cluster's heliostats in a drone's pictures, by a camera file and where the mirrors are expected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchsim.bench.errors import BenchsimError
from benchsim.calibration import read_camera
from benchsim.drones.finding import find_glints, find_mirror, to_mirror
from benchsim.drones.flight import Sightings
from benchsim.drones.heliostat import axes
from benchsim.jobs.drone_cluster import Cluster
from benchsim.jobs.progress import Progress
from benchsim.trace.counts import read_counts

Array = NDArray[np.float64]

WINDOW = 60
"""Pixels around where a mirror is expected: a gimbal errs by some 25."""


@dataclass(frozen=True)
class Lens:
    """What of a camera file is used: [px]; ``gamma`` a number or "srgb"."""

    resolution: tuple[int, int]
    focal: float
    principal_point: tuple[float, float]
    distortion: tuple[float, ...]
    gamma: float | str
    black: float

    def project(self, eye: Array, turned: Array, points: Array) -> Array:
        """(n, 2) pixels of points (n, 3) [mm]; ``turned`` rows: right, down, forward."""
        matrix = np.array(
            [[self.focal, 0, self.principal_point[0]], [0, self.focal, self.principal_point[1]], [0, 0, 1]]
        )
        seen = (points - eye) @ turned.T
        return np.asarray(cv2.projectPoints(seen, np.zeros(3), np.zeros(3), matrix, np.array(self.distortion))[0][:, 0])

    def light(self, counts: NDArray) -> Array:
        """Of full scale, linear."""
        full = 65535.0 if counts.dtype == np.uint16 else 255.0
        grey = counts if counts.ndim == 2 else counts[..., :3] @ np.array([0.114, 0.587, 0.299])
        x = np.clip((np.asarray(grey, float) - self.black) / (full - self.black), 0, 1)
        if self.gamma == "srgb":
            return np.asarray(np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4))
        return np.asarray(x ** float(self.gamma))


def lens_of(path: Path) -> tuple[Lens, list[str]]:
    table, remarks = read_camera(path).table, []
    gamma = table.get("gamma", 1.0)
    if gamma == "unknown":
        gamma = "srgb"
        remarks.append(f"{path.name}: the tone curve is unknown; sRGB's is taken.")
    width, height = table["resolution_px"]
    middle = table.get("principal_point_px") or ((width - 1) / 2, (height - 1) / 2)
    black = float(table.get("black_level") or 0.0)
    bent = tuple(float(x) for x in table.get("distortion") or (0.0,) * 5)
    return Lens((int(width), int(height)), float(table["focal_px"]), tuple(middle), bent, gamma, black), remarks


def sightings_of(
    c: Cluster, lens: Lens, paths: Sequence[Path], eyes: Array, progress: Progress
) -> tuple[list[Sightings], list[int]]:
    """Glints of each heliostat in all pictures, and in how many its mirror was not found."""
    mounts = [c.mount(int(k)) for k in c.who]
    designs = [c.design(int(k)) for k in c.who]
    corners = [
        origin + d.outline @ turned[:, :2].T for d, (turned, origin) in zip(designs, map(axes, mounts), strict=True)
    ]
    frames: list[list[int]] = [[] for _ in c.who]
    points: list[list[Array]] = [[] for _ in c.who]
    missed = [0] * len(c.who)
    for f, (path, eye) in enumerate(zip(paths, eyes, strict=True)):
        progress("pictures", 0.95 * f / len(paths))
        counts, _ = read_counts(path, cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        if counts.shape[1::-1] != lens.resolution:
            raise BenchsimError(
                f"{path.name}: has {counts.shape[1]} x {counts.shape[0]} pixels, the camera file "
                f"{lens.resolution[0]} x {lens.resolution[1]}; give the camera's own calibration"
            )
        image, turned = lens.light(counts), _toward(eye)
        for i, (outline, design) in enumerate(zip(corners, designs, strict=True)):
            near = lens.project(eye, turned, outline)
            low = np.maximum(np.floor(near.min(axis=0)).astype(int) - WINDOW, 0)
            high = np.minimum(np.ceil(near.max(axis=0)).astype(int) + WINDOW, lens.resolution)
            if (high - low < 20).any():
                missed[i] += 1
                continue
            part = image[low[1] : high[1], low[0] : high[0]]
            try:
                there = find_mirror(part, near - low)
            except (BenchsimError, cv2.error, np.linalg.LinAlgError):
                missed[i] += 1
                continue
            spots = to_mirror(find_glints(part, there), there, design)
            frames[i] += [f] * len(spots)
            points[i] += list(spots)
    out = [
        Sightings(np.array(f, np.intp), np.array(x, float).reshape(-1, 2)) for f, x in zip(frames, points, strict=True)
    ]
    return out, missed


def _toward(eye: Array) -> Array:
    """Rows right, down, forward of a camera without roll that looks to the cluster's middle."""
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= max(float(np.linalg.norm(right)), 1e-9)
    return np.stack([right, np.cross(forward, right), forward])
