"""The model's trace on the board: aim, placement, clipping, and the published facts about r."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from benchsim.bench.curve import signed_distance
from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Exposure, Mirror, Screen
from benchsim.bench.place import SettingErrors, place
from benchsim.vector import bench_cylinder, on_board, positions, reflect, trace

FIG7A = Exposure("A", "7a", math.radians(101), math.radians(50), (1500.0, -160.0, -1430.0))
FIG7B = Exposure("A", "7b", math.radians(260), math.radians(48), (1500.0, -450.0, -1430.0))
BOARD = Screen()
LARGE = Screen((900.0, 900.0))
ARC = Screen((650.0, 650.0))
fig7 = pytest.mark.parametrize("exposure", [FIG7A, FIG7B], ids=["7a", "7b"])
stands_for = pytest.mark.parametrize("mirror", [Mirror(stands_for=s) for s in ("elevation", "azimuth")])

azimuths = st.one_of(st.floats(60, 140), st.floats(220, 300))
exposures = st.builds(
    lambda az, el, c, shift, roll: Exposure("A", "s", math.radians(az), math.radians(el), c, shift, math.radians(roll)),
    azimuths,
    st.floats(30, 65),
    st.tuples(st.floats(1200, 1900), st.floats(-500, 500), st.floats(-1600, -900)),
    st.floats(-30, 30),
    st.floats(-20, 20),
)
small = st.floats(-2e-3, 2e-3)
setting_errors = st.builds(
    lambda c, a, d, s, t: SettingErrors(*(np.array(v) for v in (c, a, d, s, t))),
    st.tuples(*[st.floats(-2, 2)] * 3),
    st.tuples(small, small),
    st.tuples(small, small),
    st.tuples(*[st.floats(-1, 1)] * 3),
    st.tuples(small, small, small),
)


def largest_gap(exposure, mirror, within, **other):
    """Largest perpendicular distance of the true-r trace within a board from another trace, and its rms [mm]."""
    d, _ = signed_distance(
        trace(mirror, exposure, screen=LARGE, **other), trace(mirror, exposure, screen=within).points
    )
    return np.abs(d).max(), math.sqrt(np.mean(d**2))


@stands_for
@fig7
def test_the_trace_passes_the_boards_centre_at_phase_zero(exposure, mirror):
    for radius in (None, 0.0, 30.0):
        assert np.linalg.norm(trace(mirror, exposure, [0.0], radius=radius).points) < 1e-9


@settings(max_examples=50)
@given(exposures, setting_errors, st.floats(0, 30), st.sampled_from(["elevation", "azimuth"]))
def test_every_point_is_on_its_reflected_ray_and_on_the_board(exposure, errors, radius, stands_for):
    """Back to the world: the point lies on the line from P(ε) along R(ε), forward, and in the plane of the moved board;
    the angle of incidence is that of reflection. Set-up: random settings with errors, board shifted and rolled.
    """
    mirror = Mirror(stands_for=stands_for)
    where = place(mirror, exposure, errors)
    curve = trace(mirror, exposure, radius=radius, placement=where, screen=BOARD, count=11)
    world = where.screen_origin + curve.points @ where.screen_rotation[:, 1:].T
    turn = Rotation.from_rotvec(curve.phase[:, None] * where.axis)
    normal = turn.apply(where.normal)
    p = where.centre + radius * normal
    ray = (world - p) / np.linalg.norm(world - p, axis=1, keepdims=True)
    bisector = ray - where.laser_direction
    np.testing.assert_allclose(bisector / np.linalg.norm(bisector, axis=1, keepdims=True), normal, atol=1e-12)
    assert np.all(np.abs(curve.points) <= 350.0)
    assert np.all(np.diff(curve.phase) > 0)


@fig7
def test_it_ends_at_the_edge_of_the_board(exposure):
    """The default phases span the board: the first and last point lie on its edge, and a further step is beyond."""
    m = Mirror()
    curve = trace(m, exposure, screen=BOARD)
    assert len(curve.points) == 1001
    assert np.abs(curve.points[[0, -1]]).max(axis=1) == pytest.approx([350.0, 350.0], abs=1e-6)
    step = curve.phase[1] - curve.phase[0]
    beyond = trace(m, exposure, [curve.phase[0] - step, 0.0, curve.phase[-1] + step], screen=BOARD)
    np.testing.assert_array_equal(beyond.phase, [0.0])


@fig7
def test_without_a_screen_it_spans_the_mirrors_distance(exposure):
    curve = trace(Mirror(), exposure)
    reach = np.linalg.norm(exposure.mirror_position)
    assert np.linalg.norm(curve.points, axis=1).max() == pytest.approx(reach, rel=1e-9)


@stands_for
@fig7
def test_virtual_rays_are_left_out(exposure, mirror):
    """Over a whole turn of the mirror only rays survive that start on the lit front and run toward the board's face."""
    where = place(mirror, exposure)
    phases = np.linspace(-math.pi, math.pi, 721)
    points, normals = positions(bench_cylinder(where, mirror.radius), phases)
    rays = reflect(where.laser_direction, normals)
    forward = (-points[:, 0] / rays[:, 0] > 0) & (normals @ where.laser_direction < 0)
    kept = trace(mirror, exposure, phases).phase
    np.testing.assert_array_equal(kept, phases[forward])
    assert 0 < len(kept) < len(phases)
    # dropped on both counts: the line of a virtual ray does meet the plane, at a finite point
    board_points, real = on_board(where, mirror.radius, phases)
    assert np.isfinite(board_points[~real]).all()


def test_a_board_nobody_lights_is_an_error():
    """The mirror behind the board; the board turned away; a trace that misses the board."""
    m = Mirror()
    with pytest.raises(BenchsimError, match="7a: no reflected ray reaches"):
        trace(m, FIG7A, placement=place(m, Exposure("A", "x", 0.0, 1.0, (-1500.0, 0.0, -1000.0))), screen=BOARD)
    away = place(m, FIG7A, SettingErrors(screen_angle=np.array([0.0, math.pi, 0.0])))
    with pytest.raises(BenchsimError, match="no reflected ray"):
        trace(m, FIG7A, placement=away)
    aside = place(m, FIG7A, SettingErrors(screen_position=np.array([0.0, 2000.0, 0.0])))
    with pytest.raises(BenchsimError, match="no reflected ray reaches the board;"):
        trace(m, FIG7A, placement=aside, screen=BOARD)
    with pytest.raises(BenchsimError, match="radius"):
        trace(m, FIG7A, radius=-1.0)


@pytest.mark.parametrize(("exposure", "kept", "own"), [(FIG7A, 8.1, 0.12), (FIG7B, 7.3, 0.09)], ids=["7a", "7b"])
def test_neglecting_r_both_ways(exposure, kept, own):
    """Published facts. Set-up: elevation cylinder, r the polygon's inscribed radius (16.90 mm), the arc of a 650 mm
    board, distances across the curve. Expectation: the figures are the largest distances (not rms); the rms with n and
    axis kept is 0.1 mm less, since that gap is nearly the same along the arc.
    """
    m = Mirror()
    largest, rms = largest_gap(exposure, m, ARC, radius=0.0, placement=place(m, exposure))
    assert largest == pytest.approx(kept, abs=0.05)
    assert largest - 0.2 < rms < largest - 0.1
    largest, rms = largest_gap(exposure, m, ARC, radius=0.0)
    assert largest == pytest.approx(own, abs=0.005)
    assert rms < own / 2


@pytest.mark.parametrize(
    ("mirror", "exposure", "moved"),
    [
        (Mirror(), FIG7A, 8.2),
        (Mirror(), FIG7B, 7.4),
        (Mirror(stands_for="azimuth"), FIG7A, 2.7),
        (Mirror(stands_for="azimuth"), FIG7B, 1.7),
    ],
)
def test_bisecting_at_c_moves_the_trace_by_millimetres(mirror, exposure, moved):
    """Eq. (16) in place of Eq. (17) for the aim, r kept for the reflection; largest distance on a 650 mm board."""
    largest, _ = largest_gap(exposure, mirror, ARC, placement=place(mirror, exposure, radius=0.0))
    assert largest == pytest.approx(moved, abs=0.06)


def test_moving_the_board_moves_the_trace():
    """A board moved along y and z within its plane sees the light at −(dy, dz); rolled, at coordinates turned back."""
    m, phases = Mirror(), np.linspace(-0.05, 0.05, 11)
    plain = trace(m, FIG7A, phases).points
    moved = place(m, FIG7A, SettingErrors(screen_position=np.array([0.0, 3.0, -2.0])))
    np.testing.assert_allclose(trace(m, FIG7A, phases, placement=moved).points, plain - [3.0, -2.0], atol=1e-10)
    a = math.radians(15)
    rolled = Exposure("A", "r", FIG7A.laser_azimuth, FIG7A.laser_elevation, FIG7A.mirror_position, screen_roll=a)
    turn = np.array([[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]])
    np.testing.assert_allclose(trace(m, rolled, phases).points, plain @ turn, atol=1e-10)


def test_moving_the_board_nearer_shrinks_along_the_rays():
    """A shift along x slides every point along its ray: the point moves by shift · R_yz/R_x."""
    m, phases = Mirror(), np.linspace(-0.05, 0.05, 11)
    shifted = Exposure("A", "s", FIG7A.laser_azimuth, FIG7A.laser_elevation, FIG7A.mirror_position, screen_shift=40.0)
    where = place(m, FIG7A)
    rays = reflect(where.laser_direction, positions(bench_cylinder(where, m.radius), phases)[1])
    expected = trace(m, FIG7A, phases).points + 40.0 * rays[:, 1:] / rays[:, :1]
    np.testing.assert_allclose(trace(m, shifted, phases).points, expected, atol=1e-10)


def test_the_curve_is_dense_enough_for_its_spline():
    """signed_distance() runs a spline through the default points: points between them lie within 1e-9 mm of it."""
    m = Mirror()
    curve = trace(m, FIG7A, screen=BOARD)
    between = trace(m, FIG7A, (curve.phase[1:] + curve.phase[:-1]) / 2).points
    d, _ = signed_distance(curve, between[5:-5])
    assert np.abs(d).max() < 1e-9
