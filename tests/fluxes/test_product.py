"""Many heliostats at once against one by one."""

import numpy as np
import pytest

from benchsim.fluxes import collado, product
from benchsim.fluxes.heliostat import Heliostat, Target, ideal_normal, unit
from benchsim.fluxes.product import Beams

TARGET = Target((1e3, -2e3, 32e3), 6e3, 5e3, tuple(unit(np.array([0.1, 1.0, -0.2]))))


def beams(seed, n=7):
    rng = np.random.default_rng(seed)
    place = np.c_[rng.uniform(-60e3, 60e3, n), rng.uniform(20e3, 150e3, n), rng.uniform(0, 5e3, n)]
    sun = unit(np.array([rng.uniform(-1, 1), rng.uniform(-1, 0.5), rng.uniform(0.2, 1)]))
    sizes = rng.uniform(2e3, 8e3, (2, n))
    distance = np.linalg.norm(np.array(TARGET.centre) - place, axis=1)
    return Beams(place, ideal_normal(place, TARGET.centre, sun), *sizes, rng.uniform(2e-3, 5e-3, n), distance, sun)


def points(cells=21):
    x, z = TARGET.grid(cells)
    across, up = TARGET.axes
    return x, z, (np.array(TARGET.centre) + x[:, None, None] * across + z[None, :, None] * up).reshape(-1, 3)


@pytest.mark.parametrize("seed", range(5))
def test_each_is_as_one_by_one(seed):
    b = beams(seed)
    x, z, at = points()
    found = product.flux(b, at, np.array([TARGET.normal]))
    for k in range(len(b.width)):
        h = Heliostat(tuple(b.position[k]), b.width[k], b.height[k], b.spread[k], 0.0)
        expected = collado.flux(h, TARGET, b.sun, b.normal[k], x[:, None], z[None, :]).ravel()
        np.testing.assert_allclose(found[k], expected, rtol=1e-10, atol=1e-14 * expected.max())


def test_batches_give_every_heliostat_and_every_lit_point_once(monkeypatch):
    b = beams(9)
    _, _, at = points()
    normals = np.where(np.arange(len(at))[:, None] % 3 == 0, -1.0, 1.0) * np.array(TARGET.normal)
    whole = product.flux(b, at, normals)
    monkeypatch.setattr(product, "AT_ONCE", 2 * len(at))
    found = np.zeros_like(whole)
    seen = []
    for some, lit, values in product.batches(b, at, normals):
        found[np.ix_(some, lit)] += values
        seen += list(some)
    assert sorted(seen) == list(range(7))
    np.testing.assert_allclose(found, whole, rtol=1e-12)
