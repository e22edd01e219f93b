"""Collado's product of error functions: what follows from conservation, from the image of a sphere, and from limits."""

import math

import numpy as np
import pytest

from benchsim.bench.errors import BenchsimError
from benchsim.fluxes.collado import flux
from benchsim.fluxes.heliostat import Heliostat, Target, ideal_normal, landing
from benchsim.fluxes.table import sun_at
from benchsim.instruments.mount.axes import reflected

BIG = Target((0.0, 0.0, 32_000.0), 40_000.0, 40_000.0)


def field(seed: int):
    """A heliostat north of the tower, the sun at some hour."""
    rng = np.random.default_rng(seed)
    place = (rng.uniform(-60e3, 60e3), rng.uniform(40e3, 150e3), 0.0)
    return Heliostat(place, 6000.0, 4000.0, 2.5e-3, 1e-3, 0.9), sun_at(rng.uniform(8, 16))


def whole(h, target, sun, normal, cells=400):
    x, z = target.grid(cells)
    values = flux(h, target, sun, normal, x[:, None], z[None, :])
    return values, x, z, (x[1] - x[0]) * (z[1] - z[0])


@pytest.mark.parametrize("seed", range(6))
def test_no_light_is_lost_or_made(seed):
    """On a target that catches all: reflectance × mirror × cosine of incidence, however oblique the target."""
    h, sun = field(seed)
    normal = ideal_normal(h.position, BIG.centre, sun)
    values, _, _, cell = whole(h, BIG, sun, normal)
    assert values.sum() * cell == pytest.approx(0.9 * 24e6 * float(normal @ sun), rel=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_the_image_of_a_perfect_sphere_is_the_mirror_turned_and_shrunk(seed):
    """A small mirror (aberrations go with its square) and a sun almost a point: rays traced by hand from the mirror's
    corners land at those of the lit patch, and inside the flux is cos i / (1 − cos i)² times the obliquity."""
    h, sun = field(seed)
    h = Heliostat(h.position, 600.0, 400.0, 1e-7, 0.0)
    normal = ideal_normal(h.position, BIG.centre, sun)
    i, r = float(normal @ sun), reflected(normal, sun)
    distance = float(np.linalg.norm(np.array(BIG.centre) - h.position))
    across = np.cross([0, 0, 1.0], normal)
    across /= np.linalg.norm(across)
    up = np.cross(normal, across)
    level = i / (1 - i) ** 2 * -(r @ np.array(BIG.normal))
    for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        q = a * h.width / 2 * across + b * h.height / 2 * up
        centre = np.array(h.position) + 2 * distance * normal
        on_sphere = np.array(h.position) + q
        n = (centre - on_sphere) / np.linalg.norm(centre - on_sphere)
        corner = landing(on_sphere, reflected(n, sun), BIG)
        assert np.linalg.norm(corner) > 3, "the image has a size"
        inside, outside = flux(h, BIG, sun, normal, *(np.array([0.9, 1.1]) * corner[:, None]))
        assert inside == pytest.approx(level, rel=1e-3)
        assert outside < 1e-3 * level


def test_with_the_sun_behind_the_target_the_spot_is_a_gaussian():
    """At no incidence the image of the mirror is a point."""
    target = Target((0.0, 0.0, 0.0), 2000.0, 2000.0)
    h = Heliostat((0.0, 100e3, 0.0), 6000.0, 4000.0, 3e-3, 0.0)
    x = np.array([0.0, 300.0, 600.0])
    expected = 24e6 / (2 * math.pi * 300.0**2) * np.exp(-((x / 300) ** 2) / 2)
    south = np.array([0.0, -1.0, 0.0])
    np.testing.assert_allclose(flux(h, target, south, south, x, 0.0), expected, rtol=1e-6)


def test_a_deviated_normal_moves_the_spot_to_where_its_central_ray_lands():
    h, sun = field(2)
    normal = ideal_normal(h.position, BIG.centre, sun) + np.array([2e-3, 0.0, 1e-3])
    normal /= np.linalg.norm(normal)
    values, x, z, _ = whole(h, BIG, sun, normal)
    centroid = np.array([values.sum(axis=1) @ x, values.sum(axis=0) @ z]) / values.sum()
    place = landing(h.position, reflected(normal, sun), BIG)
    assert np.linalg.norm(place) > 300
    np.testing.assert_allclose(centroid, place, atol=0.05)


def test_light_from_behind_is_none():
    h, _ = field(0)
    down = np.array([0.0, 0.0, -1.0])
    assert flux(h, BIG, down, np.array([0.0, 0.0, 1.0]), 0.0, 0.0) == 0
    away = Target((0.0, 0.0, 32e3), 1000.0, 1000.0, (0.0, -1.0, 0.0))
    sun = sun_at(12)
    assert flux(h, away, sun, ideal_normal(h.position, away.centre, sun), 0.0, 0.0) == 0


def test_a_heliostat_without_size_or_error_is_refused():
    with pytest.raises(BenchsimError, match="no mirror"):
        Heliostat((0, 0, 0), 0.0, 1000.0, 1e-3, 0.0)
    with pytest.raises(BenchsimError, match="standard deviations"):
        Heliostat((0, 0, 0), 1000.0, 1000.0, 0.0, 0.0)
