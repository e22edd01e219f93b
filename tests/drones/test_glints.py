"""Every glint obeys the law of reflection, and none is lost."""

import math

import numpy as np
import pytest

from benchsim.drones import glints as module
from benchsim.drones.flight import Errors, camera_point, fly, pattern, seen, stand
from benchsim.drones.glints import glints
from benchsim.drones.heliostat import aimed, axes, four_facets, normals, random_surface, shape

DESIGN = four_facets()


@pytest.fixture(scope="module")
def flown():
    rng = np.random.default_rng(11)
    target = camera_point(150e3, 2.0, 0.4)
    errors = Errors(slope=1.0e-3)
    flight = fly(target, pattern(target, (2000.0, 2000.0), 400.0), errors, rng)
    return flight, stand([[4e3, -3e3, 0.0]], DESIGN, target, errors, rng)[0]


def test_light_from_the_lamp_reaches_the_camera(flown):
    """Each ray is reflected by I − 2 (I·n) n in the field frame and must pass the camera within a micrometre."""
    flight, h = flown
    g = seen(h, flight)
    assert len(g.frame) > 40
    facet = np.abs(g.points[:, None] - DESIGN.centres).sum(axis=-1).argmin(axis=1)
    height, slopes = shape(h.surface, facet, g.points)
    turned, origin = axes(h.mount)
    places = origin + np.column_stack([g.points, height]) @ turned.T
    n = normals(slopes) @ turned.T
    travel = places - flight.lamps[g.frame]
    travel /= np.linalg.norm(travel, axis=1, keepdims=True)
    out = travel - 2 * (travel * n).sum(axis=1, keepdims=True) * n
    to = flight.cameras[g.frame] - places
    assert np.linalg.norm(to - (to * out).sum(axis=1, keepdims=True) * out, axis=1).max() < 1e-3


def test_a_finer_grid_of_guesses_finds_the_same_glints(flown, monkeypatch):
    flight, h = flown
    coarse = seen(h, flight)
    monkeypatch.setattr(module, "PITCH", 15.0)
    fine = seen(h, flight)
    np.testing.assert_array_equal(coarse.frame, fine.frame)
    order = [np.lexsort([*np.round(g.points, 1).T, g.frame]) for g in (coarse, fine)]
    np.testing.assert_allclose(coarse.points[order[0]], fine.points[order[1]], atol=1e-5)


def test_a_flat_facet_glints_where_its_normal_meets_the_drone():
    """Without errors: p = q − D ∇z by hand, for a lamp at the camera."""
    surface = random_surface(DESIGN, 0.0, 250.0, 0.0, np.random.default_rng(0))
    mount = aimed(DESIGN, np.zeros(3), [0.0, 150e3, 0.0])
    turned, origin = axes(mount)
    q = np.array([200.0, -150.0])
    eye = (origin + turned @ [*q, 150e3])[None]
    g = glints(surface, mount, eye, eye)
    expected = DESIGN.centres * 0 + q + 150e3 * DESIGN.cant  # normal is −∇z
    inside = (np.abs(expected - DESIGN.centres) < np.array(DESIGN.size) / 2).all(axis=1)
    assert inside.any() and len(g.points) == inside.sum()
    np.testing.assert_allclose(np.sort(g.points, axis=0), np.sort(expected[inside], axis=0), atol=0.05)
    np.testing.assert_allclose(g.strength, 1.0)


def test_strength_is_the_area_of_the_lamps_image(flown):
    """A lamp moved along two small steps moves the glint over an area: half steps of the midpoint, so a quarter."""
    flight, h = flown
    k = [int(np.bincount(seen(h, flight).frame).argmax())]
    cameras, lamps = flight.cameras[k], flight.lamps[k]
    turned = axes(h.mount)[0]
    base = glints(h.surface, h.mount, cameras, lamps)
    for i in range(len(base.frame)):
        moved = [glints(h.surface, h.mount, cameras, lamps + 2 * turned[:, a]).points for a in range(2)]
        steps = [m[np.linalg.norm(m - base.points[i], axis=1).argmin()] - base.points[i] for m in moved]
        area = abs(steps[0][0] * steps[1][1] - steps[0][1] * steps[1][0])
        assert area == pytest.approx(base.strength[i], rel=0.05)
    assert len(base.frame) and math.isfinite(base.strength.sum())
