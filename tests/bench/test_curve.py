"""Distances from a curve, against closed forms."""

import numpy as np

from benchsim.bench.curve import Curve, signed_distance


def test_distance_from_a_circle_is_exact_and_signed():
    """A circle run through counter-clockwise: inside is to the left, hence positive."""
    phi = np.linspace(0, np.pi, 400)
    circle = Curve(7000 * np.column_stack([np.cos(phi), np.sin(phi)]))
    at = np.linspace(0.3, 2.8, 50)
    offsets = np.linspace(-20, 20, 50)
    points = (7000 - offsets)[:, None] * np.column_stack([np.cos(at), np.sin(at)])
    distance, s = signed_distance(circle, points)
    np.testing.assert_allclose(distance, offsets, atol=1e-6)
    np.testing.assert_allclose(s, 7000 * at, rtol=2e-5)


def test_points_beyond_the_ends_get_feet_beyond_the_range():
    line = Curve(np.column_stack([np.linspace(0, 10, 11), np.zeros(11)]))
    distance, s = signed_distance(line, np.array([[12.0, 0.5], [-1.0, -0.5]]))
    np.testing.assert_allclose(distance, [0.5, -0.5], atol=1e-12)
    np.testing.assert_allclose(s, [12.0, -1.0], atol=1e-12)
