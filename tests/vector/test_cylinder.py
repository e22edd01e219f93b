"""The mirror's motion, reflection and projection: Eqs (7)-(18) and the three sources of error."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from benchsim.bench.errors import BenchsimError
from benchsim.bench.place import ideal_normal, rotation_axis, toward_source
from benchsim.vector import (
    Cylinder,
    deviation,
    encoder_offset,
    heliostat_tilt,
    mirror_misalignment,
    positions,
    project,
    reflect,
)

CENTRE = np.array([1500.0, -160.0, -1430.0])
SOURCE = toward_source(math.radians(101), math.radians(50))
RADIUS = 16.9
NORMAL = ideal_normal(CENTRE, SOURCE, RADIUS)
HEIGHT = 40.0
SOURCES = {
    "encoder": lambda s: encoder_offset(CENTRE, NORMAL, RADIUS, s),
    "misalignment": lambda s: mirror_misalignment(CENTRE, NORMAL, RADIUS, s),
    "tilt": lambda s: heliostat_tilt(CENTRE, NORMAL, RADIUS, s, HEIGHT),
}
every_source = pytest.mark.parametrize("source", SOURCES)
both = pytest.mark.parametrize("stands_for", ["elevation", "azimuth"])

azimuths = st.floats(0, 2 * math.pi)
elevations = st.floats(0.05, 1.5)
centres = st.tuples(st.floats(800, 2500), st.floats(-800, 800), st.floats(-2000, -200)).map(np.array)
radii = st.floats(0, 50)
errors = st.floats(-0.1, 0.1)


@given(azimuths, elevations, centres, radii, st.sampled_from(list(SOURCES)), st.sampled_from(["elevation", "azimuth"]))
def test_without_error_the_central_ray_hits_the_origin(azimuth, elevation, centre, radius, source, stands_for):
    """Eqs (11)-(17) closed: whatever the source of error, ε = 0 is the aimed mirror; 1e-9 mm."""
    s = toward_source(azimuth, elevation)
    n = ideal_normal(centre, s, radius)
    assume(abs(n[2]) < 0.999)
    make = {"encoder": encoder_offset, "misalignment": mirror_misalignment}.get(source)
    cylinder = make(centre, n, radius, stands_for) if make else heliostat_tilt(centre, n, radius, stands_for, HEIGHT)
    point, real = deviation(cylinder, s, 0.0)
    assert real
    # rays that arrive at a grazing angle stretch the rounding on the plane
    ray = reflect(-s, n)
    assert np.linalg.norm(point) < 1e-9 * max(1.0, 0.1 / abs(ray[0]))


@given(azimuths, elevations, centres, st.floats(1e-3, 50))
def test_first_approximation_of_the_normal_errs_by_r_over_distance(azimuth, elevation, centre, radius):
    """Eq. (16) against Eq. (17). P lies r off C, so the direction to the target turns by at most r/|P| and the bisector
    by half of that over the cosine of incidence, which bounds the angle between the two normals.
    """
    s = toward_source(azimuth, elevation)
    exact, first = ideal_normal(centre, s, radius), ideal_normal(centre, s, 0.0)
    cosine = exact @ s
    assume(cosine > 0.2)
    angle = math.atan2(np.linalg.norm(np.cross(exact, first)), exact @ first)
    turned = math.asin(radius * np.linalg.norm(np.cross(exact, centre)) / np.linalg.norm(centre) ** 2 * 1.2)
    assert angle <= turned / (2 * cosine) * 1.1 + 1e-15


def test_iterations_of_eq_17_converge_by_r_over_distance():
    """The n-th iteration errs by less than (r/|C|)ⁿ: the first by 1.9 mrad in Fig. 7(a), each next 120 times less."""
    miss = [np.linalg.norm(ideal_normal(CENTRE, SOURCE, RADIUS, k) - NORMAL) for k in range(1, 6)]
    # Eq. (17)'s first step from n = 0 is Eq. (16)
    np.testing.assert_array_equal(ideal_normal(CENTRE, SOURCE, RADIUS, 1), ideal_normal(CENTRE, SOURCE, 0.0))
    assert miss[0] == pytest.approx(1.9e-3, abs=0.05e-3)
    for before, after in itertools.pairwise(miss):
        assert after <= before * RADIUS / np.linalg.norm(CENTRE) + 1e-15


def test_as_printed_the_ideal_normal_is_perpendicular_to_the_right_one():
    """The trap of the paper: its sum S + C/|C| with S *toward* the sun of Eq. (1) is the wrong bisector. With the
    direction of travel, I = −S, the same sum is the (negative) right one.
    """
    to_c = CENTRE / np.linalg.norm(CENTRE)
    right = ideal_normal(CENTRE, SOURCE, 0.0)
    printed, mended = SOURCE + to_c, -SOURCE + to_c
    assert abs(printed @ right) < 1e-15 * np.linalg.norm(printed) + 1e-15
    np.testing.assert_allclose(np.cross(mended, right), 0, atol=1e-15)
    assert mended @ right < 0


@both
@every_source
def test_motion_is_a_rigid_turn(source, stands_for):
    """P(ε), n(ε) against scipy's rotation about the pivot, over a whole turn."""
    c = SOURCES[source](stands_for)
    phases = np.linspace(-3, 3, 41)
    points, normals = positions(c, phases)
    for e, p, n in zip(phases, points, normals, strict=True):
        turn = Rotation.from_rotvec(e * c.axis)
        np.testing.assert_allclose(p, c.pivot + turn.apply(c.point - c.pivot), atol=1e-11)
        np.testing.assert_allclose(n, turn.apply(c.normal), atol=1e-14)


@both
def test_where_the_three_cylinders_lie(stands_for):
    """Centres and radii: C and r; the mirror's own centre and 0; the pedestal's foot and r + h sin E.
    All three carry the mirror's centre to the same place when there is no error.
    """
    encoder, misalignment, tilt = (SOURCES[k](stands_for) for k in ("encoder", "misalignment", "tilt"))
    np.testing.assert_array_equal(encoder.pivot, CENTRE)
    assert encoder.radius == pytest.approx(RADIUS, abs=1e-12)
    np.testing.assert_allclose(misalignment.pivot, CENTRE + RADIUS * NORMAL, atol=1e-12)
    assert misalignment.radius == 0
    np.testing.assert_allclose(tilt.pivot, CENTRE - [0, 0, HEIGHT], atol=1e-12)
    assert tilt.radius == pytest.approx(RADIUS + HEIGHT * NORMAL[2], abs=1e-12)
    for c in (encoder, misalignment, tilt):
        np.testing.assert_allclose(c.point, CENTRE + RADIUS * NORMAL, atol=1e-12)
    for c in (encoder, misalignment):
        np.testing.assert_array_equal(c.axis, rotation_axis(NORMAL, stands_for))
        assert abs(c.axis @ NORMAL) < 1e-15
    assert abs(tilt.axis[2]) < 1e-15


@pytest.mark.parametrize("source", ["encoder", "misalignment", "tilt"])
def test_the_planes_of_the_mirror_envelope_the_cylinder(source):
    """The plane that moves with n(ε) keeps the radius' distance from the axis: n(ε)·(P(ε) − pivot) is constant."""
    c = SOURCES[source]("elevation")
    points, normals = positions(c, np.linspace(-1, 1, 21))
    np.testing.assert_allclose(((points - c.pivot) * normals).sum(-1), c.radius, atol=1e-11)


@both
@given(errors)
def test_misalignment_is_an_encoder_offset_at_the_mirrors_own_centre(stands_for, error):
    """Radius 0: the same curve as an encoder's with C at P and r = 0."""
    own = encoder_offset(CENTRE + RADIUS * NORMAL, NORMAL, 0.0, stands_for)
    expected, _ = deviation(own, SOURCE, error)
    found, _ = deviation(SOURCES["misalignment"](stands_for), SOURCE, error)
    np.testing.assert_allclose(found, expected, atol=1e-10)


@both
@given(errors)
def test_a_tilted_heliostat_is_a_counter_turned_world(stands_for, error):
    """Tilting the heliostat by ε about its foot gives the beam that the upright one gives when sun and tower are turned
    by −ε about the foot: the same point on the turned tower.
    """
    c = SOURCES["tilt"](stands_for)
    tilted, _ = deviation(c, SOURCE, error)
    back = Rotation.from_rotvec(-error * c.axis)
    ray = reflect(back.apply(-SOURCE), NORMAL)
    foot = CENTRE - [0, 0, HEIGHT]
    expected, _ = project(CENTRE + RADIUS * NORMAL, ray, back.as_matrix(), foot + back.apply(-foot))
    np.testing.assert_allclose(tilted, expected, atol=1e-9)


def test_a_tilt_without_height_is_an_encoder_offset_in_elevation():
    """h = 0 puts the foot at C; the lean in the plane of n then is the elevation encoder's error."""
    phases = np.linspace(-0.1, 0.1, 11)
    lean = heliostat_tilt(CENTRE, NORMAL, RADIUS, "elevation", 0.0)
    np.testing.assert_array_equal(
        deviation(lean, SOURCE, phases)[0], deviation(SOURCES["encoder"]("elevation"), SOURCE, phases)[0]
    )


def test_a_sideways_lean_is_an_azimuth_error_times_sin_elevation():
    """To first order n turns by −ε sin E about n × (z × n): the next order is ε²."""
    error = 1e-4
    leaned = positions(SOURCES["tilt"]("azimuth"), error)[1]
    azimuth = positions(SOURCES["misalignment"]("azimuth"), -error * NORMAL[2])[1]
    assert np.linalg.norm(leaned - azimuth) < error**2
    assert np.linalg.norm(leaned - NORMAL) > 0.3 * error


def test_signs_of_the_errors():
    """ε > 0 lowers n about the elevation axis, and turns it from north to west about the azimuth cylinder's."""
    n = positions(SOURCES["encoder"]("elevation"), 1e-3)[1]
    assert n[2] < NORMAL[2]
    n = positions(SOURCES["encoder"]("azimuth"), 1e-3)[1]
    assert math.atan2(n[1], n[0]) > math.atan2(NORMAL[1], NORMAL[0])


@both
@given(errors)
def test_the_reflected_ray_turns_twice_as_fast_about_the_axis(stands_for, error):
    """n ⟂ axis: R(ε) is R(0) turned by 2ε about the axis of rotation, hence a cone."""
    c = SOURCES["misalignment"](stands_for)
    rays = reflect(-SOURCE, positions(c, np.array([0.0, error]))[1])
    np.testing.assert_allclose(Rotation.from_rotvec(2 * error * c.axis).apply(rays[0]), rays[1], atol=1e-14)


@given(st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(-5, 5)), azimuths, st.floats(-1.5, 1.5))
def test_reflection_keeps_length_and_tangent(normal, azimuth, elevation):
    """Eq. (11): |R| = |I|, the part along n changes sign, the part across stays, and n and −n reflect alike."""
    assume(np.linalg.norm(normal) > 1e-3)
    n = np.array(normal) / np.linalg.norm(normal)
    travel = toward_source(azimuth, elevation)
    r = reflect(travel, n)
    assert np.linalg.norm(r) == pytest.approx(1, abs=1e-14)
    np.testing.assert_allclose(r @ n, -(travel @ n), atol=1e-14)
    np.testing.assert_allclose(np.cross(r, n), np.cross(travel, n), atol=1e-14)
    np.testing.assert_array_equal(r, reflect(travel, -n))


@given(
    st.tuples(st.floats(-300, 300), st.floats(-300, 300)),
    st.tuples(st.floats(100, 3000), st.floats(-2000, 2000), st.floats(-2000, 2000)),
    st.booleans(),
    st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-3, 3)),
)
def test_real_and_virtual_rays_meet_the_same_point_and_are_told_apart(target, start, forward, pose):
    """Eq. (12) on a board in any pose: a ray through a known point of it, run forward (real) or backward (virtual)."""
    rotation = Rotation.from_rotvec(pose).as_matrix()
    origin = np.array([50.0, -20.0, 10.0])
    on_plane = origin + rotation @ np.array([0.0, *target])
    p = origin + rotation @ np.array(start)
    direction = (on_plane - p) / np.linalg.norm(on_plane - p) * (1 if forward else -1)
    found, real = project(p, direction, rotation, origin)
    np.testing.assert_allclose(found, target, atol=1e-8)
    assert real == forward


def test_a_ray_along_the_plane_reaches_nothing():
    """Neither real nor virtual: the point is not finite and the flag is False, without a warning."""
    point, real = project([100.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    assert not real and not np.isfinite(point).all()


def test_a_mirror_turned_away_reflects_nothing():
    """Half a turn shows the mirror's back to the light: Eq. (11) gives the same ray, which is not real."""
    c = SOURCES["misalignment"]("elevation")
    points, real = deviation(c, SOURCE, np.array([0.0, math.pi]))
    np.testing.assert_allclose(points[1], points[0], atol=1e-9)
    assert real[0] and not real[1]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: encoder_offset(CENTRE, NORMAL, RADIUS, "roll"), "stands_for"),
        (lambda: encoder_offset(CENTRE, NORMAL, -1.0, "azimuth"), "r: "),
        (lambda: mirror_misalignment(CENTRE, NORMAL, math.nan, "azimuth"), "r: "),
        (lambda: heliostat_tilt(CENTRE, NORMAL, RADIUS, "azimuth", -2.0), "pedestal height"),
        (lambda: encoder_offset(CENTRE, [0.0, 0.0, 1.0], RADIUS, "azimuth"), "vertical"),
    ],
)
def test_impossible_cylinders_are_refused(make, message):
    with pytest.raises(BenchsimError, match=message):
        make()


def test_a_cylinder_may_stand_anywhere():
    """Only differences enter the radius."""
    c = Cylinder(np.array([1.0, 2.0, 3.0]), np.array([0.0, 1.0, 0.0]), np.array([4.0, 2.0, 3.0]), np.array([1.0, 0, 0]))
    assert c.radius == 3.0
