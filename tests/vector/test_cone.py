"""The exact conic of r = 0, and what design and paper say about the hyperbolas of Fig. 7."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from benchsim.bench import conic
from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Exposure, Mirror, Screen
from benchsim.bench.place import SettingErrors, ideal_normal, place, rotation_axis, toward_source
from benchsim.vector import (
    Cone,
    cone,
    deviation,
    heliostat_tilt,
    mirror_misalignment,
    positions,
    project,
    reflect,
    section,
    trace,
    trace_conic,
)

FIG7A = Exposure("A", "7a", math.radians(101), math.radians(50), (1500.0, -160.0, -1430.0))
FIG7B = Exposure("A", "7b", math.radians(260), math.radians(48), (1500.0, -450.0, -1430.0))
fig7 = pytest.mark.parametrize("exposure", [FIG7A, FIG7B], ids=["7a", "7b"])
both = pytest.mark.parametrize("stands_for", ["elevation", "azimuth"])


def distance_from(coefficients, points):
    """First-order distance of points from a conic."""
    return conic.value(coefficients, points) / np.linalg.norm(conic.gradient(coefficients, points), axis=-1)


@both
@fig7
def test_the_trace_without_r_is_the_conic(exposure, stands_for):
    """r = 0: every point of the trace lies on the section of the cone, to 1e-9 relative (found: 1e-12 mm of 350)."""
    m = Mirror(stands_for=stands_for)
    exact = trace_conic(m, exposure)
    points = trace(m, exposure, radius=0.0, screen=Screen()).points
    assert np.abs(distance_from(exact.coefficients, points)).max() < 1e-9 * 350


@given(
    st.floats(0, 2 * math.pi),
    st.floats(0.1, 1.4),
    st.tuples(st.floats(800, 2500), st.floats(-800, 800), st.floats(-2000, -200)),
    st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-3, 3)),
    st.floats(-1.5, 1.5),
    st.sampled_from(["elevation", "azimuth"]),
)
def test_real_and_virtual_rays_lie_on_their_branches(azimuth, elevation, centre, pose, phase, stands_for):
    """Any board pose and phase: the ray's line meets the conic, real rays on the real nappe, others on the other."""
    source, c = toward_source(azimuth, elevation), np.array(centre)
    n = ideal_normal(c, source, 0.0)
    assume(abs(n[2]) < 0.999)
    mirror = mirror_misalignment(c, n, 0.0, stands_for)
    rays = cone(c, mirror.axis, n, -source)
    assume(abs(rays.cosine) > 1e-3)
    rotation, origin = Rotation.from_rotvec(pose).as_matrix(), np.array([20.0, -10.0, 5.0])
    p, normal = positions(mirror, phase)
    r = reflect(-source, normal)
    point, real = project(p, r, rotation, origin)
    assume(abs(rotation[:, 0] @ r) > 0.02)
    coefficients = section(rays, rotation, origin)
    assert abs(distance_from(coefficients, point)) < 1e-9 * max(2000.0, np.linalg.norm(point))
    # On the nappe of the cone that the rays go along, or on the other.
    assert ((rotation[:, 1:] @ point + origin - c) @ rays.axis * rays.cosine > 0) == real


def test_placement_with_errors_has_its_own_conic():
    """Setting errors move apex, axis, light and board; the exact conic of that placement carries its trace."""
    m = Mirror()
    errors = SettingErrors(
        np.array([1.0, -2.0, 0.5]),
        np.array([2e-3, -1e-3]),
        np.array([1e-3, 3e-3]),
        np.array([0.2, 0.1, -0.3]),
        np.array([1e-3, -2e-3, 1e-3]),
    )
    shifted = Exposure(
        "A", "s", FIG7A.laser_azimuth, FIG7A.laser_elevation, FIG7A.mirror_position, screen_shift=30.0, screen_roll=0.2
    )
    where = place(m, shifted, errors)
    exact = trace_conic(m, shifted, where)
    points = trace(m, shifted, radius=0.0, placement=where, screen=Screen()).points
    assert np.abs(distance_from(exact.coefficients, points)).max() < 1e-9 * 350


@both
@fig7
def test_with_r_the_trace_is_almost_a_conic(exposure, stands_for):
    """A free conic hides r: some conic comes within 2e-6 mm of the trace (algebraic fit, 700 mm board)."""
    x = trace(Mirror(stands_for=stands_for), exposure, screen=Screen()).points / 350
    fitted = np.linalg.svd(conic.monomials(x), full_matrices=False)[2][-1]
    assert np.abs(distance_from(fitted, x)).max() * 350 < 2e-6


@pytest.mark.parametrize(
    ("exposure", "stands_for", "half_angle", "radius", "side"),
    [
        (FIG7A, "elevation", 62.5, 7.1e3, "+y"),
        (FIG7B, "elevation", 68.3, 7.0e3, "-y"),
        (FIG7A, "azimuth", None, 26e3, "-y"),
        (FIG7B, "azimuth", None, 52e3, "+y"),
    ],
)
def test_the_hyperbolas_of_fig_7(exposure, stands_for, half_angle, radius, side):
    """Published facts, aimed by Eq. (17) with the mirror's own r. Hyperbolas in all four cases; half-angles to 0.05°;
    the radius of curvature at the centre within 2 % (found 6.98, 6.90, 25.8 and 51.6 m); foci of (a) and (b) on
    opposite sides, and those of the two cylinders too, so that "focus at the left in (a)" is the elevation cylinder
    seen from behind the screen or the azimuth cylinder seen from the mirror's side.
    """
    m = Mirror(stands_for=stands_for)
    exact = trace_conic(m, exposure, place(m, exposure))
    assert exact.geometry.kind == "hyperbola"
    assert np.linalg.norm(exact.curvature_centre - exact.point) == pytest.approx(radius, rel=0.02)
    assert exact.focus_side == side
    assert np.sign(exact.focus[0] - exact.point[0]) == (1 if side == "+y" else -1)
    if half_angle is not None:
        assert math.degrees(exact.cone.half_angle) == pytest.approx(half_angle, abs=0.05)


@both
@fig7
def test_the_curvature_is_that_of_the_trace(exposure, stands_for):
    """Circle through three near points of the trace (ε = ±2 mrad) against the conic's osculating circle."""
    m = Mirror(stands_for=stands_for)
    exact = trace_conic(m, exposure)
    a, b, c = trace(m, exposure, [-2e-3, 0.0, 2e-3], radius=0.0).points
    # the circle's centre has the same distance from all three
    lhs = 2 * np.array([a - b, c - b])
    rhs = np.array([a @ a - b @ b, c @ c - b @ b])
    centre = np.linalg.solve(lhs, rhs)
    assert np.linalg.norm(centre - exact.curvature_centre) < 2e-3 * np.linalg.norm(exact.curvature_centre - exact.point)


@both
@fig7
def test_the_focus_belongs_to_the_real_branch(exposure, stands_for):
    """|X − F| − |X − F'| = −2a on the real branch: the focus reported is the one inside it; the centre is half-way."""
    m = Mirror(stands_for=stands_for)
    exact = trace_conic(m, exposure)
    other = 2 * exact.geometry.centre - exact.focus
    x = trace(m, exposure, radius=0.0, screen=Screen()).points
    difference = np.linalg.norm(x - exact.focus, axis=1) - np.linalg.norm(x - other, axis=1)
    np.testing.assert_allclose(difference, -2 * exact.geometry.semi_axes[0], rtol=1e-9)


def test_an_elevation_trace_is_symmetric_about_the_mirrors_height():
    """The elevation axis is horizontal, so cone and conic are symmetric about z = z_C: both foci lie there."""
    exact = trace_conic(Mirror(), FIG7A)
    np.testing.assert_allclose(exact.geometry.foci[:, 1], -1430.0, rtol=1e-9)


def test_dandelin():
    """Closed forms: a cone of half-angle 30° about the plane's normal is cut in a circle; tilted less than 60°, in an
    ellipse, more, in a hyperbola; eccentricity sin(tilt)/cos(half-angle).
    """
    circle = conic.geometry(section(Cone(np.array([100.0, 3.0, 4.0]), np.array([1.0, 0, 0]), -math.cos(math.pi / 6))))
    assert circle.kind == "ellipse"
    np.testing.assert_allclose(circle.centre, [3, 4], atol=1e-9)
    np.testing.assert_allclose(circle.semi_axes, 100 * math.tan(math.pi / 6), rtol=1e-9)
    for tilt, kind in ((55.0, "ellipse"), (65.0, "hyperbola")):
        a = math.radians(tilt)
        axis = np.array([math.cos(a), math.sin(a), 0.0])
        g = conic.geometry(section(Cone(np.array([100.0, 0.0, 0.0]), axis, -math.cos(math.pi / 6))))
        assert g.kind == kind
        assert g.eccentricity == pytest.approx(math.sin(a) / math.cos(math.pi / 6), rel=1e-9)


@both
def test_only_a_normal_across_the_axis_makes_a_cone(stands_for):
    """A sideways lean makes no cone, and its trace no conic: refused, and shown by the best conic's miss."""
    c, s = np.array(FIG7A.mirror_position), toward_source(FIG7A.laser_azimuth, FIG7A.laser_elevation)
    n = ideal_normal(c, s, 0.0)
    assert cone(c, rotation_axis(n, stands_for), n, -s).cosine == pytest.approx(rotation_axis(n, stands_for) @ -s)
    lean = heliostat_tilt(c, n, 0.0, "azimuth", 0.0)
    with pytest.raises(BenchsimError, match="no cone"):
        cone(c, lean.axis, n, -s)
    x = deviation(lean, s, np.linspace(-0.4, 0.4, 201))[0] / 1000
    fitted = np.linalg.svd(conic.monomials(x), full_matrices=False)[2][-1]
    assert np.abs(distance_from(fitted, x)).max() * 1000 > 0.01


def test_an_aimed_ray_that_misses_is_an_error():
    m = Mirror()
    with pytest.raises(BenchsimError, match="7a: the aimed ray"):
        trace_conic(m, FIG7A, place(m, FIG7A, SettingErrors(screen_angle=np.array([0.0, math.pi, 0.0]))))
