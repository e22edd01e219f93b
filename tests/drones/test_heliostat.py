"""Frames, the mirror's shape and the map of it."""

import math

import numpy as np
import pytest

from benchsim.bench.errors import BenchsimError
from benchsim.drones.heliostat import (
    Mount,
    aimed,
    axes,
    bend,
    design_map,
    distorted,
    four_facets,
    mapped_slopes,
    mean_normal,
    measured_map,
    random_surface,
    shape,
)

DESIGN = four_facets()


def points(rng, n):
    facet = rng.integers(0, 4, n)
    return facet, DESIGN.centres[facet] + rng.uniform(-0.5, 0.5, (n, 2)) * DESIGN.size


def test_axes_by_hand():
    """Looking east, 30° up: z is (0, −cos 30°, sin 30°); x horizontal, to the right of who stands in front: north."""
    turned, origin = axes(
        Mount(np.array([1.0, 2.0, 3.0]), math.pi / 2, math.pi / 6, np.array([0, 0, 200.0]), np.zeros(2))
    )
    c = math.sqrt(3) / 2
    np.testing.assert_allclose(turned.T, [[1, 0, 0], [0, 0.5, c], [0, -c, 0.5]], atol=1e-15)
    np.testing.assert_allclose(origin, [1, 2 - 200 * c, 103])


def test_a_pylon_leaning_toward_west_lowers_a_mirror_that_looks_west():
    upright = Mount(np.zeros(3), -math.pi / 2, 0.2, DESIGN.offset, np.zeros(2))
    leaning = Mount(np.zeros(3), -math.pi / 2, 0.2, DESIGN.offset, np.array([-2e-3, 0.0]))
    down = axes(upright)[0][:, 2] - axes(leaning)[0][:, 2]
    assert down[2] == pytest.approx(2e-3 * math.cos(0.2), rel=0.01)


def test_the_aimed_axis_passes_through_its_target():
    target = np.array([-9e4, 6e4, 4e4])
    turned, origin = axes(aimed(DESIGN, [3e3, -2e3, 100.0], target))
    toward = (target - origin) / np.linalg.norm(target - origin)
    np.testing.assert_allclose(turned[:, 2], toward, atol=1e-14)


def test_a_target_in_the_zenith_is_refused():
    with pytest.raises(BenchsimError, match=r"zenith.*move the camera point"):
        aimed(DESIGN, np.zeros(3), [10.0, 0, 1e5])


def test_slopes_and_bends_are_the_heights_derivatives():
    rng = np.random.default_rng(1)
    surface = random_surface(DESIGN, 1e-3, 250.0, 0.5e-3, rng)
    facet, at = points(rng, 20)
    for axis in range(2):
        h = 0.05 * np.eye(2)[axis]
        up, down = shape(surface, facet, at + h), shape(surface, facet, at - h)
        np.testing.assert_allclose((up[0] - down[0]) / 0.1, shape(surface, facet, at)[1][:, axis], atol=1e-9)
        np.testing.assert_allclose((up[1] - down[1]) / 0.1, bend(surface, facet, at)[:, :, axis], atol=1e-11)


def test_slope_errors_have_the_stated_size():
    """60 facets of about 30 patches each: 2.4 % on a standard deviation; 12 % is five sigma (1e-6)."""
    rng = np.random.default_rng(2)
    slopes = [(measured_map(random_surface(DESIGN, 1e-3, 250.0, 0.0, rng)).slopes).ravel() for _ in range(15)]
    cant = np.broadcast_to(design_map(DESIGN).slopes, (4, 51, 64, 2)).ravel()
    assert np.std(np.concatenate(slopes) - np.tile(cant, 15)) == pytest.approx(1e-3, rel=0.12)


def test_the_map_between_its_cells():
    rng = np.random.default_rng(3)
    surface = random_surface(DESIGN, 1e-3, 250.0, 0.5e-3, rng)
    facet, at = points(rng, 300)
    found, slopes = mapped_slopes(measured_map(surface), at)
    np.testing.assert_array_equal(found, facet)
    inner = (np.abs(at - DESIGN.centres[facet]) < np.array(DESIGN.size) / 2 - 60).all(axis=1)
    off = np.abs(slopes - shape(surface, facet, at)[1])
    assert off[inner].max() < 5e-6
    assert off.max() < 2e-4, "half a cell beyond the outermost middles the map takes the edge's value"


def test_a_map_with_errors_differs_by_them():
    rng = np.random.default_rng(4)
    exact = measured_map(random_surface(DESIGN, 1e-3, 250.0, 0.0, rng))
    off = distorted(exact, 0.1e-3, 100.0, rng).slopes - exact.slopes
    assert off.std() == pytest.approx(0.1e-3, rel=0.2)
    assert not np.array_equal(mean_normal(exact), mean_normal(distorted(exact, 0.1e-3, 100.0, rng)))


def test_by_design_the_optical_axis_is_z():
    np.testing.assert_allclose(mean_normal(design_map(DESIGN)), [0, 0, 1], atol=1e-16)
