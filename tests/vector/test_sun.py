"""The sun: Eqs (1)-(6) against closed forms, and solar time against an ephemeris."""

import math

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pvlib import solarposition

from benchsim.bench.errors import BenchsimError
from benchsim.bench.place import toward_source
from benchsim.vector import solar_vector, sun_angles, to_tower, turn_y, turn_z

angles = st.floats(-math.pi, math.pi)


@given(angles)
def test_turns_are_the_matrices_of_the_paper(angle):
    """Eqs (4) and (5) written out."""
    c, s = math.cos(angle), math.sin(angle)
    np.testing.assert_allclose(turn_y(angle), [[c, 0, s], [0, 1, 0], [-s, 0, c]], atol=1e-15)
    np.testing.assert_allclose(turn_z(angle), [[c, -s, 0], [s, c, 0], [0, 0, 1]], atol=1e-15)


@given(angles, st.floats(-1.5, 1.5))
def test_solar_vector_is_the_bench_source_direction(azimuth, elevation):
    """Eq. (1) for arrays is the same convention as the bench's for one laser."""
    many = solar_vector([azimuth, 0.0], [elevation, 0.0])
    np.testing.assert_allclose(many[0], toward_source(azimuth, elevation), atol=1e-15)
    np.testing.assert_array_equal(many[1], [1, 0, 0])


@given(angles, angles, st.floats(-1.5, 1.5))
def test_a_tower_that_faces_the_sun_has_it_on_its_normal(facing, azimuth, elevation):
    """Eq. (6): in the tower's frame the sun's azimuth is counted from the direction the target looks to."""
    local = to_tower(solar_vector(azimuth, elevation), facing)
    np.testing.assert_allclose(local, solar_vector(azimuth - facing, elevation), atol=1e-14)


@pytest.mark.parametrize("latitude", [-33.0, 0.0, 40.4, 60.0])
def test_solar_noon_is_the_meridian(latitude):
    """At 12 h the sun stands on the meridian at 90° − |latitude − declination|; the day is symmetric about it."""
    hours = np.array([8.0, 12.0, 16.0])
    azimuth, elevation = sun_angles(math.radians(latitude), 172, hours)
    declination = solarposition.declination_spencer71(172)
    assert elevation[1] == pytest.approx(math.pi / 2 - abs(math.radians(latitude) - declination), abs=1e-7)
    noon = math.pi if math.radians(latitude) > declination else 0.0
    assert math.cos(azimuth[1] - noon) == pytest.approx(1.0, abs=1e-12)
    assert elevation[0] == pytest.approx(elevation[2], abs=1e-12)
    assert math.cos(azimuth[0] + azimuth[2]) == pytest.approx(1.0, abs=1e-12)
    assert math.sin(azimuth[0]) > 0, "the morning sun stands in the east"


@pytest.mark.parametrize("latitude", [-33.0, 0.0, 40.4, 60.0])
def test_angles_are_those_of_pvlib(latitude):
    """pvlib's analytical zenith and azimuth for the same declination and hour angle; not at noon, where it fails."""
    hour = np.array([5.0, 8.0, 11.5, 13.0, 16.0, 19.0])
    w, d, p = np.radians(15 * (hour - 12)), solarposition.declination_spencer71(172), math.radians(latitude)
    zenith = solarposition.solar_zenith_analytical(p, w, d)
    azimuth, elevation = sun_angles(p, 172, hour)
    np.testing.assert_allclose(elevation, math.pi / 2 - zenith, atol=1e-12)
    expected = solarposition.solar_azimuth_analytical(p, w, d, zenith)
    np.testing.assert_allclose(np.cos(azimuth - expected), 1.0, atol=1e-12)


def test_declination_and_hour_angle_do_not_go_into_eq_1():
    """Rationale: the paper names the angles of Eq. (1) declination and hour angle and means elevation and azimuth.
    Taken at their names they miss the sun by tens of degrees at any latitude but the pole.
    """
    declination, hour_angle = solarposition.declination_spencer71(172), math.radians(15 * (16 - 12))
    named = solar_vector(hour_angle, declination)
    assert named @ solar_vector(*sun_angles(math.radians(40.4), 172, 16.0)) < math.cos(math.radians(30))


def test_solar_time_agrees_with_an_ephemeris():
    """Rationale: solar time must be true solar time. Set-up: NREL's SPA at a clock time, its own equation of time.
    Expectation: within 0.3 mrad of declination within the day plus 0.6 mrad of Spencer's series.
    """
    longitude, latitude = -3.7, 40.4
    time = pd.DatetimeIndex(["2019-06-21 08:00", "2019-06-21 12:30", "2019-06-21 17:00"], tz="UTC")
    spa = solarposition.get_solarposition(time, latitude, longitude)
    hour = time.hour + time.minute / 60 + longitude / 15 + spa["equation_of_time"].to_numpy() / 60
    azimuth, elevation = sun_angles(math.radians(latitude), 172, hour.to_numpy())
    reference = solar_vector(np.radians(spa["azimuth"].to_numpy()), np.radians(spa["elevation"].to_numpy()))
    assert np.linalg.norm(solar_vector(azimuth, elevation) - reference, axis=-1).max() < 1e-3


def test_impossible_places_and_days_are_refused():
    with pytest.raises(BenchsimError, match="pole"):
        sun_angles(40.4, 172, 12.0)
    with pytest.raises(BenchsimError, match="day"):
        sun_angles(0.7, 0, 12.0)
