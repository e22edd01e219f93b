"""Where a lamp's reflection stands in a mirror as a camera sees it: every solution of the law of reflection, float64.

A point of the mirror glints when its normal bisects the directions to camera and lamp. With the middle q of the two at
distance D, that reads p − D ∇z(p) = q but for small terms: a map from the mirror to the plane of the drone. Its folds
make several glints, or none. All are found by asking which triangles of a grid on the mirror hold q once they are
mapped; Newton's method then solves the exact law.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchsim.drones.heliostat import Index, Mount, Surface, axes, bend, cells, normals, shape

Array = NDArray[np.float64]

PITCH = 40.0
"""Of the grid of first guesses [mm]: a sixth of the waves' length scale."""

_BEYOND = 2
"""Cells by which that grid goes beyond the facet, so that no glint near an edge is lost."""

_STEPS = 12

_TOLERANCE = 1e-9
"""Of a solution [rad]."""


@dataclass(frozen=True)
class Glints:
    """Reflections of the lamp, one row per glint.

    Attributes
    ----------
    frame : (n,) ndarray of int
        Which camera position.
    points : (n, 2) ndarray
        x, y in the concentrator's frame [mm].
    strength : (n,) ndarray
        Area of the lamp's image over that in a flat mirror.
    """

    frame: Index
    points: Array
    strength: Array


def bisector(points: Array, cameras: Array, lamps: Array) -> Array:
    """Unit normals (n, 3) that reflect the lamp into the camera at ``points``; all (n, 3) in one frame [mm]."""
    toward = (cameras - points) / np.linalg.norm(cameras - points, axis=-1, keepdims=True)
    toward = toward + (lamps - points) / np.linalg.norm(lamps - points, axis=-1, keepdims=True)
    return np.asarray(toward / np.linalg.norm(toward, axis=-1, keepdims=True))


def glints(surface: Surface, mount: Mount, cameras: Array, lamps: Array) -> Glints:
    """Every glint of the lamp in the mirror, for each position of the drone.

    Parameters
    ----------
    surface : Surface
    mount : Mount
    cameras, lamps : (frames, 3) array
        Field frame [mm]; a lamp is a point.

    Returns
    -------
    Glints
        In order of frames. No shadow, no blocking by other heliostats.
    """
    turned, origin = axes(mount)
    cameras, lamps = (cameras - origin) @ turned, (lamps - origin) @ turned
    middle = (cameras + lamps) / 2
    frame, facet, points = _guesses(surface, middle)
    points, slope_miss = _solved(surface, facet, points, cameras[frame], lamps[frame])
    inside = np.abs(points - surface.design.centres[facet]) <= np.array(surface.design.size) / 2
    kept = np.flatnonzero(inside.all(axis=1) & (slope_miss < _TOLERANCE))
    # neighbouring triangles can lead to one solution
    _, first = np.unique(np.column_stack([frame, facet, np.round(points, 3)])[kept], axis=0, return_index=True)
    kept = kept[first]
    kept = kept[np.argsort(frame[kept], kind="stable")]
    bent = bend(surface, facet[kept], points[kept])
    stretch = np.eye(2) - middle[frame[kept], 2, None, None] * bent
    return Glints(frame[kept], points[kept], 1 / np.abs(np.linalg.det(stretch)))


def _guesses(surface: Surface, middle: Array) -> tuple[Index, Index, Array]:
    """Frame, facet and first guess of every glint: triangles of the mirror's grid, mapped, that hold the frame's q."""
    design = surface.design
    grid = cells(design, PITCH)
    step = np.array([grid[0, 0, 1, 0] - grid[0, 0, 0, 0], grid[0, 1, 0, 1] - grid[0, 0, 0, 1]])
    ny, nx = (n + 2 * _BEYOND for n in grid.shape[1:3])
    j, i = np.meshgrid(np.arange(nx) - (nx - 1) / 2, np.arange(ny) - (ny - 1) / 2)
    nodes = design.centres[:, None, None] + np.stack([j, i], axis=-1) * step
    facet = np.repeat(np.arange(len(nodes)), nx * ny)
    flat = nodes.reshape(-1, 2)
    height, slopes = shape(surface, facet, flat)
    mapped = flat - slopes * (middle[:, 2].mean() - height)[:, None]
    index = np.arange(len(flat)).reshape(len(nodes), ny, nx)
    a, b, c, d = index[:, :-1, :-1], index[:, :-1, 1:], index[:, 1:, :-1], index[:, 1:, 1:]
    corners = np.stack([np.stack([a, b, c]), np.stack([d, c, b])], axis=1).reshape(3, -1).T
    (x0, y0), (x1, y1) = mapped[corners].min(axis=1).T, mapped[corners].max(axis=1).T
    frames, triangles = [], []
    for f, (x, y) in enumerate(middle[:, :2]):
        near = np.flatnonzero((x0 <= x) & (x <= x1) & (y0 <= y) & (y <= y1))
        frames.append(np.full(len(near), f))
        triangles.append(near)
    frame, triangle = np.concatenate(frames), np.concatenate(triangles)
    p, q = mapped[corners[triangle]], middle[frame, :2]
    edges = np.stack([p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]], axis=-1)
    weight = np.linalg.solve(edges, (q - p[:, 0])[..., None])[..., 0]
    weight = np.column_stack([1 - weight.sum(axis=1), weight])
    held = (weight >= -0.05).all(axis=1)
    guess = np.einsum("nk,nki->ni", weight[held], flat[corners[triangle[held]]])
    return frame[held], facet[corners[triangle[held], 0]], guess


def _solved(surface: Surface, facet: Index, points: Array, cameras: Array, lamps: Array) -> tuple[Array, Array]:
    """Points (n, 2) where the normal bisects, by Newton's method, and the angle (n,) that is still missed [rad]."""
    far = ((cameras + lamps) / 2)[:, 2, None, None]
    for _ in range(_STEPS):
        height, slopes = shape(surface, facet, points)
        needed = bisector(np.column_stack([points, height]), cameras, lamps)
        miss = slopes + needed[:, :2] / needed[:, 2:]
        step = np.linalg.solve(bend(surface, facet, points) - np.eye(2) / far, miss[..., None])[..., 0]
        points = points - np.clip(step, -PITCH, PITCH)
    height, slopes = shape(surface, facet, points)
    needed = bisector(np.column_stack([points, height]), cameras, lamps)
    return points, np.linalg.norm(normals(slopes) - needed, axis=1)
