"""Conic geometry: parameters → coefficients → geometry, to 1e-9 relative wherever the coefficients hold that much."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchsim.bench import conic
from benchsim.bench.errors import BenchsimError

angles = st.floats(-1.57, 1.57)
log_sizes = st.floats(-2, 4)


def check(geometry, kind, centre, a, b, angle, tolerance=1e-9):
    axis = np.array([np.cos(angle), np.sin(angle)])
    e = np.sqrt(1 - (b / a) ** 2) if kind == "ellipse" else np.hypot(1, b / a)
    scale = max(np.hypot(*centre), a)
    assert geometry.kind == kind
    assert np.allclose(geometry.semi_axes, [a, b], rtol=tolerance, atol=0)
    assert np.allclose(geometry.centre, centre, rtol=0, atol=tolerance * scale)
    assert abs(geometry.eccentricity - e) < tolerance * e
    assert abs(geometry.semi_latus_rectum - b * b / a) < tolerance * b * b / a
    assert abs(abs(geometry.direction @ axis) - 1) < tolerance
    for got, distance in ((geometry.vertices, a), (geometry.foci, a * e)):
        expected = np.array([centre + distance * axis, centre - distance * axis])
        order = np.argsort(got @ axis)[::-1]
        assert np.allclose(got[order], expected, rtol=0, atol=tolerance * max(scale, a * e))


@settings(max_examples=300)
@given(st.sampled_from(["ellipse", "hyperbola"]), log_sizes, st.floats(-1.3, 1.3), angles, st.floats(0, 30), angles)
def test_round_trip(kind, log_a, log_ratio, angle, distance, bearing):
    """Axes from 1e-2 to 1e4, ratios 1:20, centres up to thirty times the smaller axis away."""
    a = 10**log_a
    b = a * 10 ** (-abs(log_ratio) if kind == "ellipse" else log_ratio)
    if kind == "ellipse" and b / a > 0.999:  # the axis of a circle has no direction
        b = 0.999 * a
    centre = distance * min(a, b) * np.array([np.cos(2 * bearing), np.sin(2 * bearing)])
    check(conic.geometry(conic.from_axes(kind, centre, (a, b), angle)), kind, centre, a, b, angle)


@settings(max_examples=100)
@given(st.sampled_from(["ellipse", "hyperbola"]), st.floats(1, 6), st.floats(0.3, 0.99), angles, angles)
def test_far_away_conic_in_near_coordinates(kind, log_distance, ratio, angle, bearing):
    """A conic a million axes from the origin: held near the curve and moved, nothing is lost."""
    near = np.array([0.2, -0.1])
    shift = 10**log_distance * np.array([np.cos(2 * bearing), np.sin(2 * bearing)])
    g = conic.geometry(conic.from_axes(kind, near, (1.0, ratio), angle)).moved(3.0, shift)
    check(g, kind, 3.0 * near + shift, 3.0, 3.0 * ratio, angle)


@pytest.mark.parametrize("kind, sign", [("ellipse", 1.0), ("hyperbola", -1.0)])
@pytest.mark.parametrize("a", [1e2, 1e4, 1e6])
def test_near_parabola(kind, sign, a):
    """Vertex and near focus stay exact while the centre leaves for infinity (vertex at 0, semi-latus rectum 2)."""
    b = np.sqrt(2 * a)
    e = np.sqrt(1 - sign * (b / a) ** 2)
    g = conic.geometry([b * b / a**2 * sign, 0.0, 1.0, -2 * b * b / a, 0.0, 0.0])
    assert g.kind == kind
    assert np.allclose(g.vertices[0], 0, atol=1e-12)
    assert np.allclose(g.foci[0], [2 / (1 + e), 0], rtol=1e-12, atol=1e-12)
    assert np.allclose(g.semi_axes, [a, b], rtol=1e-12)
    assert abs(g.eccentricity - e) < 1e-12
    assert np.allclose(g.centre, [sign * a, 0], rtol=1e-12, atol=1e-9)


def test_parabola_turned_and_moved():
    turn = np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
    g = conic.geometry(conic.transform([1.0, 0, 0, 0, -4.0, 0], turn, (5.0, 7.0)))
    assert g.kind == "parabola" and g.eccentricity == pytest.approx(1, abs=1e-12)
    assert np.allclose(g.vertices[0], [5, 7], atol=1e-9)
    assert np.allclose(g.foci[0], np.array([5, 7]) + turn @ [0, 1], atol=1e-9)
    assert np.all(np.isnan(g.centre)) and np.all(np.isinf(g.semi_axes))


@pytest.mark.parametrize(
    "coefficients, kind",
    [
        ([1, 0, -1, 0, 0, 0], "degenerate"),  # crossing lines
        ([1, 0, 0, 0, 0, -1], "degenerate"),  # parallel lines
        ([0, 0, 0, 1, 2, 3], "degenerate"),  # one line
        ([1, 0, 1, 0, 0, 0], "degenerate"),  # a point
        ([0, 0, 0, 0, 0, 0], "degenerate"),
        ([1, 0, 2, 0, 0, 1], "imaginary"),
        ([-1, 0, -2, 0, 0, 1], "ellipse"),
        ([0, 1, 0, 0, 0, -1], "hyperbola"),
        ([3, 0, 3, 0, 0, -1], "ellipse"),
    ],
)
def test_kinds(coefficients, kind):
    g = conic.geometry(coefficients)
    assert g.kind == kind
    assert np.all(np.isnan(g.foci)) == (kind in ("degenerate", "imaginary"))


def test_batch_agrees_with_single():
    rng = np.random.default_rng(5)
    c = rng.normal(size=(50, 6))
    batch = conic.geometry(c)
    for i in range(50):
        one = conic.geometry(c[i])
        assert one.kind == batch.kind[i]
        assert np.array_equal(one.foci, batch.foci[i], equal_nan=True)


@settings(max_examples=100)
@given(st.sampled_from(["ellipse", "hyperbola"]), st.floats(0.2, 0.99), angles, st.floats(-1.2, 1.2))
def test_points_asymptotes_and_curvature(kind, b, angle, parameter):
    """A point of the parametric form lies on the curve and has the textbook curvature there."""
    c = conic.from_axes(kind, (0.3, -0.2), (1.0, b), angle)
    ca, sa = np.cos(angle), np.sin(angle)
    f, g = (np.cos, np.sin) if kind == "ellipse" else (np.cosh, np.sinh)
    u, w = f(parameter), b * g(parameter)
    point = np.array([0.3 + ca * u - sa * w, -0.2 + sa * u + ca * w])
    assert abs(conic.value(c, point)) < 1e-13 * (1 + u * u)
    speed2 = g(parameter) ** 2 + b * b * f(parameter) ** 2
    assert abs(conic.curvature(c, point)) == pytest.approx(b / speed2**1.5, rel=1e-9)
    step = 1e-6
    along = np.array([step, 0.0])
    assert conic.gradient(c, point)[0] == pytest.approx(
        (conic.value(c, point + along) - conic.value(c, point - along)) / (2 * step), abs=1e-8
    )
    geometry = conic.geometry(c)
    if kind == "hyperbola":
        far = geometry.centre + 1e6 * geometry.asymptote_directions
        assert np.all(np.abs(conic.value(c, far)) < 1e-3 * 1e6)  # a point off the asymptote has value ~ 1e12
        assert np.cos(geometry.asymptote_half_angle) == pytest.approx(1 / geometry.eccentricity, rel=1e-12)
    else:
        assert np.all(np.isnan(geometry.asymptote_directions))


def test_curvature_sign():
    assert conic.curvature([1, 0, 1, 0, 0, -4], [2.0, 0.0]) == pytest.approx(0.5)


@settings(max_examples=100)
@given(st.lists(st.floats(-2, 2), min_size=4, max_size=4), st.lists(st.floats(-5, 5), min_size=2, max_size=2))
def test_affine_change_of_coordinates(entries, shift):
    linear = np.array(entries).reshape(2, 2)
    if abs(np.linalg.det(linear)) < 0.1:
        linear = linear + 3 * np.eye(2)
    if abs(np.linalg.det(linear)) < 0.1:
        return
    c = conic.from_axes("hyperbola", (0.4, 0.1), (1.0, 0.6), 0.7)
    u = np.linspace(-1, 1, 9)
    points = np.stack([np.cosh(u), 0.6 * np.sinh(u)], axis=-1)
    points = points @ np.array([[np.cos(0.7), np.sin(0.7)], [-np.sin(0.7), np.cos(0.7)]]) + [0.4, 0.1]
    moved = conic.transform(c, linear, shift)
    assert np.linalg.norm(moved) == pytest.approx(1)
    image = points @ linear.T + shift
    size = np.abs(conic.monomials(image)) @ np.abs(moved)
    assert np.all(np.abs(conic.value(moved, image)) < 1e-12 * size + 1e-13)
    back = conic.transform(moved, np.linalg.inv(linear), -np.linalg.inv(linear) @ np.asarray(shift))
    assert np.allclose(back, conic.normalise(c), atol=1e-8)


@pytest.mark.parametrize("bad", [[1, 2, 3], [1, 2, 3, 4, 5, np.nan], 3.0])
def test_bad_coefficients(bad):
    with pytest.raises(BenchsimError, match="six finite coefficients"):
        conic.geometry(bad)


def test_bad_axes():
    with pytest.raises(BenchsimError, match="positive semi-axes"):
        conic.from_axes("ellipse", (0, 0), (1.0, -1.0), 0.0)
