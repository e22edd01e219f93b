"""Beam, mirror, board and camera, each against its closed form."""

from dataclasses import replace

import numpy as np
import pytest

from benchsim.bench.model import Camera, Exposure, Laser, Mirror
from benchsim.bench.place import camera_pose, place
from benchsim.rays import board_points, laser, mirror, pixel_rays, project, screen

EXPOSURE = Exposure("A", "s", np.radians(101.0), np.radians(50.0), (1500.0, -160.0, -1430.0), 80.0, np.radians(30.0))


def unit(v):
    return np.asarray(v, float) / np.linalg.norm(v)


@pytest.mark.parametrize("divergence", [4e-3, 0.0, -4e-3])
def test_beam_carries_its_power_through_any_plane(divergence):
    """Rationale: power is conserved. Set-up: a plane tilted by 50°, 300 mm down the beam. Expectation: 1."""
    beam = Laser(divergence=divergence)
    axis, point = unit([1.0, -2.0, 0.5]), np.array([3.0, 4.0, 5.0])
    across = unit(np.cross(axis, [0.0, 0.0, 1.0]))
    normal = -unit(np.cos(np.radians(50)) * axis + np.sin(np.radians(50)) * across)
    e1, e2 = across - (across @ normal) * normal, np.cross(normal, across)
    e1, e2 = unit(e1), unit(e2)
    g = np.linspace(-40, 40, 401)
    x = point + 300.0 * axis + g[:, None, None] * e1 + g[None, :, None] * e2
    density = laser.Beam(point, axis, beam.waist, beam.curvature).light(x)[1]
    total = density(normal).sum() * (g[1] - g[0]) ** 2
    assert total == pytest.approx(1.0, abs=1e-10)


def test_light_from_behind_counts_as_none():
    axis = np.array([0.0, 0.0, -1.0])
    density = laser.Beam(np.zeros(3), axis, Laser().waist, Laser().curvature).light(np.zeros(3))[1]
    assert density(axis) == 0.0 and density(-axis) > 0.0


def test_flat_mirror_mirrors_the_source():
    """A homocentric beam off a flat facet seems to come from the mirrored virtual source: all lines pass through it."""
    m = Mirror()
    p = place(m, EXPOSURE)
    beam = laser.Beam(p.laser_point, p.laser_direction, Laser().waist, Laser().curvature)
    t, h = np.meshgrid(np.linspace(-4, 4, 5), np.linspace(-1, 1, 3))
    x, n, _ = mirror.surface(p, m.radius, 0.0, np.array(0.07), 0.0, t, h)
    out = mirror.reflect(beam.light(x)[0], n)
    virtual = p.laser_point - p.laser_direction / beam.curvature
    image = virtual - 2 * ((virtual - p.centre) @ n - m.radius) * n
    assert np.abs(np.cross(x - image, out)).max() < 1e-9 * np.linalg.norm(x - image, axis=-1).max()


def test_facet_turns_right_handed_and_keeps_its_distance():
    m = Mirror()
    p = place(m, EXPOSURE)
    t, h = np.array(3.0), np.array(0.5)
    quarter = mirror.surface(p, m.radius, 0.0, np.array(np.pi / 2), 0.0, t, h)[1]
    np.testing.assert_allclose(quarter, np.cross(p.axis, p.normal), atol=1e-15)
    x, n, _ = mirror.surface(p, m.radius, 0.0, np.linspace(0, 6, 7), 0.0, t, h)
    np.testing.assert_allclose(laser.dot(x - p.centre, n), m.radius, atol=1e-12)
    np.testing.assert_allclose((x - p.centre) @ p.axis, 0.5, atol=1e-12)


def test_board_and_world_are_inverse():
    p = place(Mirror(), EXPOSURE)
    board = np.array([[0.0, 0.0], [120.0, -300.0], [-350.0, 350.0]])
    world = screen.to_world(p, board)
    from_mirror, path = screen.meet(p, np.broadcast_to(p.centre, world.shape), world - p.centre)
    np.testing.assert_allclose(from_mirror, board, atol=1e-10)
    np.testing.assert_allclose(path, 1.0, atol=1e-13)
    assert world[0] @ [0, 1, 0] == 0 and world[0] @ [1, 0, 0] == 80.0


CAMERA = Camera("A", (1600, 1200), 1680.0, (803.0, 596.5), (-0.082, 0.031, 0.0006, -0.0004, 0.002))


def test_camera_follows_brown():
    """Brown's polynomial written out (OpenCV's documentation, k1 k2 p1 p2 k3) on points of the board."""
    rotation, translation = camera_pose(CAMERA)
    x = np.array([[0.0, 0.0, 0.0], [0.0, 200.0, -150.0], [0.0, -300.0, 250.0]])
    c = x @ rotation.T + translation
    a, b = c[:, 0] / c[:, 2], c[:, 1] / c[:, 2]
    k1, k2, p1, p2, k3 = CAMERA.distortion
    r2 = a * a + b * b
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = 1680.0 * (a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)) + 803.0
    v = 1680.0 * (b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b) + 596.5
    np.testing.assert_allclose(project(CAMERA, rotation, translation, x), np.stack([u, v], -1), atol=1e-9)
    # The camera looks at the origin, where distortion vanishes.
    np.testing.assert_allclose([u[0], v[0]], CAMERA.principal_point, atol=1e-9)


def test_pixels_return_to_the_board():
    rotation, translation = camera_pose(CAMERA)
    p = place(Mirror(), EXPOSURE)
    board = np.random.default_rng(0).uniform(-350, 350, (50, 2))
    pixels = project(CAMERA, rotation, translation, screen.to_world(p, board))
    np.testing.assert_allclose(board_points(CAMERA, rotation, translation, p, pixels), board, atol=1e-7)
    origin, rays = pixel_rays(CAMERA, rotation, translation, pixels)
    np.testing.assert_allclose(origin, CAMERA.position, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1.0, atol=1e-14)


def test_points_behind_the_camera_have_no_pixel():
    rotation, translation = camera_pose(CAMERA)
    assert np.isnan(project(CAMERA, rotation, translation, np.array([2000.0, 600.0, -250.0]))).all()


def test_cylinder_reflects_at_half_its_diameter():
    assert replace(Mirror(), shape="cylinder").radius == 17.5
