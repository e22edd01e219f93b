"""Arcs of known conics: the exact cone of a bench setting cut by the board, in a few lines of its own."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from benchsim.bench import conic
from benchsim.bench.model import Exposure, Mirror
from benchsim.bench.place import SettingErrors, place

FIG7 = {"a": ((1500.0, -160.0, -1430.0), 101.0, 50.0), "b": ((1500.0, -450.0, -1430.0), 260.0, 48.0)}
PRIOR = np.array([1.0] * 3 + [1.745e-3] * 4 + [0.2] * 3 + [1e-3] * 3)


@dataclass(frozen=True)
class Setting:
    """One setting of Fig. 7 with r = 0; errors are in the order and units of PRIOR."""

    name: str
    stands_for: str = "elevation"

    def placement(self, errors=None):
        position, azimuth, elevation = FIG7[self.name]
        exposure = Exposure("A", "s", np.deg2rad(azimuth), np.deg2rad(elevation), position)
        t = np.zeros(13) if errors is None else errors
        e = SettingErrors(t[:3], t[3:5], t[5:7], t[7:10], t[10:])
        return place(Mirror(stands_for=self.stands_for), exposure, e, radius=0.0)

    def coefficients(self, errors=None):
        """Reflected rays keep the angle between laser and axis: (v·a)² = cos² |v|² for v from C to the board."""
        p = self.placement(errors)
        h = np.column_stack([p.screen_rotation[:, 1:], p.screen_origin - p.centre])
        cosine = p.axis @ p.laser_direction
        return conic.normalise(conic.from_matrix(h.T @ (np.outer(p.axis, p.axis) - cosine**2 * np.eye(3)) @ h))

    def points(self, n=1000, errors=None, half=325.0):
        """n points evenly along the trace within ±half of the board."""
        p = self.placement(errors)
        first = p.laser_direction - 2 * (p.normal @ p.laser_direction) * p.normal
        along = (p.axis @ p.laser_direction) * p.axis
        u = first - along
        phase = np.linspace(-0.5, 0.5, 20001)[:, None]
        rays = along + np.cos(phase) * u + np.sin(phase) * np.cross(p.axis, u)
        start = p.centre - p.screen_origin
        t = -(start @ p.screen_rotation[:, 0]) / (rays @ p.screen_rotation[:, 0])
        yz = (start + t[:, None] * rays) @ p.screen_rotation[:, 1:]
        yz = yz[(t > 0) & np.all(np.abs(yz) < half, axis=1)]
        s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(yz, axis=0), axis=1))])
        i = np.searchsorted(s, np.linspace(0, s[-1], n)).clip(0, len(s) - 1)
        return yz[i]


@pytest.fixture
def fig7() -> Callable[..., Setting]:
    return Setting


@pytest.fixture
def prior() -> np.ndarray:
    return PRIOR
