"""The aim and the placement: closed forms of the conventions that every room shares."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Camera, Exposure, Mirror
from benchsim.bench.place import SettingErrors, aim, camera_pose, ideal_normal, place, places, toward_source


def exposure(azimuth=101.0, elevation=50.0, centre=(1500.0, -160.0, -1430.0), **more):
    return Exposure("A", "s", math.radians(azimuth), math.radians(elevation), centre, **more)


def reflect(direction, normal):
    return direction - 2 * (direction @ normal) * normal


def test_azimuth_runs_from_north_toward_east():
    """North is +x, west +y, so azimuth 90 degrees (east) points along −y."""
    np.testing.assert_allclose(toward_source(0, 0), [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(toward_source(math.pi / 2, 0), [0, -1, 0], atol=1e-15)
    np.testing.assert_allclose(toward_source(0, math.pi / 2), [0, 0, 1], atol=1e-15)


@given(
    st.floats(0, 2 * math.pi), st.floats(0.05, 1.5), st.floats(800, 2500), st.floats(-800, 800), st.floats(-2000, -200)
)
def test_the_aimed_ray_hits_the_screens_centre(azimuth, elevation, x, y, z):
    """Eq. (17) converged: light along the laser's axis, reflected at P, passes through the origin."""
    source, centre = toward_source(azimuth, elevation), np.array([x, y, z])
    n = ideal_normal(centre, source, 17.5)
    point = centre + 17.5 * n
    ray = reflect(-source, n)
    miss = np.cross(-point, ray)
    assert np.linalg.norm(miss) < 1e-9
    assert ray @ -point > 0


@pytest.mark.parametrize("stands_for", ["elevation", "azimuth"])
def test_axes_are_perpendicular_to_the_normal(stands_for):
    mirror = Mirror(stands_for=stands_for)
    a = aim(mirror, exposure())
    assert abs(a.axis @ a.normal) < 1e-15 and np.linalg.norm(a.axis) == pytest.approx(1)
    assert (abs(a.axis[2]) < 1e-15) == (stands_for == "elevation")


def test_setting_errors_do_not_re_aim_the_laser():
    mirror, e = Mirror(), exposure()
    moved = place(mirror, e, SettingErrors(mirror_position=np.array([1.0, 2.0, 3.0])))
    nominal = place(mirror, e)
    np.testing.assert_allclose(moved.centre - nominal.centre, [1, 2, 3])
    np.testing.assert_array_equal(moved.laser_point, nominal.laser_point)
    np.testing.assert_array_equal(moved.laser_direction, nominal.laser_direction)


def test_axis_errors_turn_the_body_about_n_and_about_n_cross_axis():
    mirror, e = Mirror(), exposure()
    nominal = place(mirror, e)
    about_n = place(mirror, e, SettingErrors(mirror_axis=np.array([1e-3, 0.0])))
    np.testing.assert_allclose(about_n.normal, nominal.normal, atol=1e-15)
    np.testing.assert_allclose(about_n.axis - nominal.axis, 1e-3 * np.cross(nominal.normal, nominal.axis), atol=1e-6)
    about_b = place(mirror, e, SettingErrors(mirror_axis=np.array([0.0, 1e-3])))
    b = np.cross(nominal.normal, nominal.axis)
    np.testing.assert_allclose(about_b.axis - nominal.axis, 1e-3 * np.cross(b, nominal.axis), atol=1e-6)


def test_the_screen_rolls_right_handed_about_x_and_shifts_along_x():
    p = place(Mirror(), exposure(screen_shift=100.0, screen_roll=math.pi / 2))
    np.testing.assert_allclose(p.screen_origin + p.screen_rotation @ [0, 1, 0], [100, 0, 1], atol=1e-12)


def test_the_camera_sees_y_to_the_right_and_z_up():
    camera = Camera("A", (100, 100), 100.0, (50.0, 50.0), position=(1000.0, 200.0, -100.0))
    rotation, shift = camera_pose(camera)
    assert np.linalg.det(rotation) == pytest.approx(1)
    centre, right, up = (rotation @ np.array(p) + shift for p in ([0, 0, 0], [0, 10, 0], [0, 0, 10]))
    np.testing.assert_allclose(centre[:2], 0, atol=1e-9)
    assert right[0] > 0 and up[1] < 0
    assert abs(up[0]) < 1e-9, "without roll the world's z stays upright in the picture"


def test_a_laser_straight_behind_cannot_be_aimed():
    with pytest.raises(BenchsimError, match="behind"):
        ideal_normal(np.array([1000.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]), 0.0)


def test_settings_placed_together_stand_where_each_stands_alone():
    """Of several exposures, with and without errors, some of them twice."""
    rng = np.random.default_rng(6)
    mirror = Mirror("polygon", 12, 35.0, 2.0, "elevation")
    first, second = exposure(), exposure(95.0, 42.0, screen_shift=3.0, screen_roll=0.02)
    off = [SettingErrors(*(0.1 * rng.normal(size=n) for n in (3, 2, 2, 3, 3))) for _ in range(3)]
    settings = [(first, off[0]), (second, off[1]), (first, None), (second, off[2])]
    for one, together in zip(settings, places(mirror, settings), strict=True):
        alone = place(mirror, *one)
        for name in alone.__dataclass_fields__:
            np.testing.assert_allclose(getattr(together, name), getattr(alone, name), atol=1e-12)
        np.testing.assert_allclose(together.screen_rotation @ together.screen_rotation.T, np.eye(3), atol=1e-14)
        error = one[1] or SettingErrors()
        np.testing.assert_allclose(together.centre, np.asarray(one[0].mirror_position) + error.mirror_position)
