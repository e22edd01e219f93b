"""The product of error functions against what it is in closed form, and many heliostats at once."""

from dataclasses import replace

import numpy as np
import pytest

from benchsim.fluxes import product
from benchsim.fluxes.heliostat import Target, ideal_normal, unit
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


def image_of(b, k, q):
    """Where a perfect sphere, focused at its distance, sends the mirror's points q (..., 2) on the image plane.

    Rays by hand: the sphere's normal at the point, the law of reflection, the plane. To first order in the size.
    """
    n, sun = b.normal[k], b.sun
    across = unit(np.cross([0, 0, 1.0], n))
    place = q[..., :1] * across + q[..., 1:] * np.cross(n, across)
    own = unit(n - place / (2 * b.distance[k]))
    ray = 2 * (own @ sun)[..., None] * own - sun
    central = 2 * float(n @ sun) * n - sun
    way = (b.distance[k] - place @ central) / (ray @ central)
    return place + way[..., None] * ray - b.distance[k] * central, central


@pytest.mark.parametrize("seed", range(4))
def test_flux_is_the_mirrors_image_laid_under_a_gaussian(seed):
    """The convolution by quadrature over small mirrors, on planes across their central rays."""
    b = beams(seed, 3)
    b = replace(b, width=0.05 * b.width, height=0.05 * b.height, spread=b.spread / 40)
    nodes, weights = np.polynomial.legendre.leggauss(40)
    for k in range(3):
        q = np.stack(np.meshgrid(nodes * b.width[k] / 2, nodes * b.height[k] / 2, indexing="ij"), axis=-1)
        image, ray = image_of(b, k, q)
        a = unit(np.cross(ray, [1.0, 0.2, 0.3]))
        at = np.random.default_rng(seed).normal(0, 15, (30, 2)) @ np.array([a, np.cross(ray, a)])
        sigma = b.spread[k] * b.distance[k]
        apart = ((at[:, None, None] - image) ** 2).sum(axis=-1) - ((at[:, None, None] - image) @ ray) ** 2
        gauss = np.exp(-apart / 2 / sigma**2) / (2 * np.pi * sigma**2)
        power = np.outer(weights, weights) * b.width[k] * b.height[k] / 4 * b.cosine[k]
        found = product.flux(b.chosen([k]), b.position[k] + b.distance[k] * ray + at, -ray[None])[0]
        np.testing.assert_allclose(found, (gauss * power).sum(axis=(1, 2)), rtol=0.02, atol=2e-3 * found.max())


def test_all_that_mirrors_reflect_is_in_the_integral():
    """Over the image plane H integrates to its whole edge: cos i times the mirror, whatever its spread."""
    b = beams(3, 4)
    for k in range(4):
        ray = b.ray[k]
        a = unit(np.cross(ray, [0.0, 0.0, 1.0]))
        reach = 8 * b.spread[k] * b.distance[k] + np.hypot(b.width[k], b.height[k])
        x = np.linspace(-reach, reach, 301)
        at = x[:, None, None] * a + x[None, :, None] * np.cross(ray, a)
        values = product.flux(b.chosen([k]), b.position[k] + b.distance[k] * ray + at.reshape(-1, 3), -ray[None])
        assert values.sum() * (x[1] - x[0]) ** 2 == pytest.approx(b.cosine[k] * b.width[k] * b.height[k], rel=1e-9)


def test_without_width_the_image_is_an_even_rectangle():
    b = beams(5, 4)
    b = replace(b, spread=np.full(4, 1e-10), width=0.01 * b.width, height=0.01 * b.height)
    for k in range(4):
        corners = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1], [0.3, -0.6]]) * [b.width[k] / 2, b.height[k] / 2]
        image, ray = image_of(b, k, corners)
        inside, outside = (
            product.flux(b.chosen([k]), b.position[k] + b.distance[k] * ray + f * image, -ray[None])[0]
            for f in (0.97, 1.03)
        )
        level = b.cosine[k] / (1 - b.cosine[k]) ** 2
        np.testing.assert_allclose(inside, level, rtol=1e-9)
        assert not outside[:4].any()


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
    # Differences of error functions: in a beam's wings what rounds in them is a larger part of what is left.
    np.testing.assert_allclose(found, whole, rtol=1e-12, atol=1e-12 * whole.max())
