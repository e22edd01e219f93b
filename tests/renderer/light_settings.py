"""Benches that the light tests share, and a float64 trace in the world frame, written apart from what is tested."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from benchsim.bench.files import read
from benchsim.bench.model import Physics
from benchsim.bench.place import SettingErrors

SCENES = Path(__file__).resolve().parents[2] / "scenes"


def bench(name="fig7a", **physics):
    recording = read(SCENES / f"{name}.toml", images=False)
    return replace(recording, physics=replace(Physics(), **physics))


def errors(rng, scale=1.0):
    """Setting errors of the stated uncertainties."""
    return SettingErrors(
        mirror_position=scale * rng.standard_normal(3),
        mirror_axis=scale * 1.745e-3 * rng.standard_normal(2),
        laser_direction=scale * 1.745e-3 * rng.standard_normal(2),
        screen_position=scale * 0.2 * rng.standard_normal(3),
        screen_angle=scale * 1e-3 * rng.standard_normal(3),
    )


def world_trace(recording, placement, phase, t, h, *, parallel=False):
    """(y, z) on the board, and power density on the facet, of the ray that meets it at (t, h): textbook vectors."""
    a, n0, laser = placement.axis, placement.normal, recording.laser
    n = np.cos(phase)[:, None] * n0 + np.sin(phase)[:, None] * np.cross(a, n0)
    x = placement.centre + recording.mirror.radius * n + t[:, None] * np.cross(a, n) + h[:, None] * a
    d = placement.laser_direction
    if parallel or laser.curvature == 0:
        g = np.broadcast_to(d, x.shape).copy()
    else:
        g = np.sign(laser.curvature) * (x - (placement.laser_point - d / laser.curvature))
        g /= np.linalg.norm(g, axis=1, keepdims=True)
    out = g - 2 * (g * n).sum(1)[:, None] * n
    front = placement.screen_rotation[:, 0]
    path = ((placement.screen_origin - x) @ front) / (out @ front)
    board = (x + path[:, None] * out - placement.screen_origin) @ placement.screen_rotation
    at_waist = x - g * (((x - placement.laser_point) @ d) / (g @ d))[:, None] - placement.laser_point
    zeta = (x - placement.laser_point) @ d
    gauss = 2 / (np.pi * laser.waist**2) * np.exp(-2 * (at_waist**2).sum(1) / laser.waist**2)
    density = gauss / (1 + laser.curvature * zeta) ** 2 * -(g * n).sum(1) / (g @ d)
    return board[:, 1], board[:, 2], density
