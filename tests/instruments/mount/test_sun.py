"""The sun of heliostats' recordings: its azimuth either way about, its elevation apparent or true, and its time.

The almanac is the low-precision one of the Astronomical Almanac (0.01 deg), the refraction Bennett's (1982): a few
lines each, and not what the package uses.
"""

import json
import re
import shutil
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_readers import RECORD, TOWER, changed, paint_folder, write

from benchsim.bench.errors import BenchsimError
from benchsim.instruments.mount import paint, solar
from benchsim.jobs.mount_diagnosis import diagnose_session

JUELICH = Path(__file__).resolve().parents[4] / "shared" / "recordings" / "heliostat-juelich"
real = pytest.mark.skipif(not JUELICH.is_dir(), reason="the real recordings are not beside the project")

LATITUDE, LONGITUDE, _ = TOWER["power_plant_properties"]["coordinates"]
TIMES = [datetime(2022, 6, 18 + k, 7 + 2 * k, 11 * k, 5, tzinfo=UTC) for k in range(6)]


def almanac(time, latitude=LATITUDE):
    """Azimuth from north through east and elevation of the sun without refraction [deg]."""
    n = (time - datetime(2000, 1, 1, 12, tzinfo=UTC)).total_seconds() / 86400
    g = np.radians(357.528 + 0.9856003 * n)
    longitude = np.radians(280.460 + 0.9856474 * n + 1.915 * np.sin(g) + 0.020 * np.sin(2 * g))
    tilt = np.radians(23.439 - 4e-7 * n)
    ascension = np.arctan2(np.cos(tilt) * np.sin(longitude), np.cos(longitude))
    d = np.arcsin(np.sin(tilt) * np.sin(longitude))
    h = np.radians((18.697374558 + 24.06570982441908 * n) * 15 + LONGITUDE) - ascension
    phi = np.radians(latitude)
    up = np.sin(phi) * np.sin(d) + np.cos(phi) * np.cos(d) * np.cos(h)
    north = np.sin(d) * np.cos(phi) - np.cos(d) * np.cos(h) * np.sin(phi)
    return np.degrees(np.arctan2(-np.cos(d) * np.sin(h), north)), np.degrees(np.arcsin(up))


def bennett(elevation):
    """Refraction [deg] at an apparent elevation."""
    return 1 / np.tan(np.radians(elevation + 7.31 / (elevation + 4.4))) / 60


def lifted(elevation):
    apparent = elevation
    for _ in range(4):
        apparent = elevation + bennett(apparent)
    return apparent


def recorded(times=TIMES, running=lambda a: 180 - a, raised=lifted):
    """Recordings of the sun at some times; azimuth as it is written, elevation apparent or not."""
    out = []
    for time in times:
        azimuth, elevation = almanac(time)
        out.append(
            changed(
                changed(RECORD, (running(azimuth) + 180) % 360 - 180, "sun_azimuth"), raised(elevation), "sun_elevation"
            )
        )
    return out


def stamped(folder, times, name="AA01"):
    """Write the table of stamps above a folder."""
    table = {f"{name}_{1000 + k}": t.strftime("%Y-%m-%dT%H:%M:%SZ") for k, t in enumerate(times)}
    write(folder.parent, "timestamps.json", json.dumps(table))
    return folder


def later(seconds, which=range(6)):
    return [t + timedelta(seconds=seconds if k in which else 0) for k, t in enumerate(TIMES)]


def sun_at(times=TIMES, raised=lifted):
    """Unit vectors, of the same few lines."""
    places = [almanac(t) for t in times]
    a, e = np.radians([p[0] for p in places]), np.radians([raised(p[1]) for p in places])
    return np.stack([np.sin(a) * np.cos(e), np.cos(a) * np.cos(e), np.sin(e)], axis=-1)


def clocks(session):
    return [r for r in session.remarks if r.startswith("clock") or "apart in" in r or "other days" in r]


def test_the_sun_stands_where_the_algorithm_s_own_example_has_it():
    """Reda & Andreas 2004: 2003-10-17 12:30:30 at UTC−7, 39.742476° N, 105.1786° W, 1830.14 m: azimuth 194.34024°,
    zenith 50.11162° with 820 mbar and 11 °C; pressure by height is that to 1 %."""
    time = datetime(2003, 10, 17, 19, 30, 30, tzinfo=UTC).timestamp()
    ((azimuth, elevation),) = solar.almanac(np.array([time]), np.array([39.742476, -105.1786, 1830.14]))
    assert azimuth == pytest.approx(194.34024, abs=1e-4)
    assert elevation == pytest.approx(90 - 50.11162, abs=5e-4)


def test_stamps_that_agree_are_passed_over_and_show_the_elevation_to_be_apparent(tmp_path):
    folder = stamped(paint_folder(tmp_path, records=recorded()), TIMES)
    session = paint.read(folder)
    assert not clocks(session)
    assert any(r.startswith("Azimuths of the sun are from south through east, as PAINT") for r in session.remarks)
    assert any(r.startswith("Elevations of the sun are apparent") for r in session.remarks)
    np.testing.assert_allclose(session.records.source, sun_at(), atol=1e-9)
    assert tmp_path / "timestamps.json" in session.files


@pytest.mark.parametrize(
    ("seconds", "wanted"),
    [
        (7200, r"clock: \+7200 s: CEST taken for UTC in all stamps"),
        (3600, r"clock: \+3600 s: CET taken for UTC in all stamps"),
        (-3600, "clock: -3600 s: UTC taken for CET in all stamps"),
        (-7200, "clock: -7200 s: UTC taken for CEST in all stamps"),
        (20, r"clock: the stamps are \+(19|20|21)\.\d s off"),
        (1500, r"clock: the stamps are \+(1499|1500|1501) s off .* by no whole hours"),
        (86400 * 90, "The stamps are of other days"),
    ],
)
def test_a_clock_that_is_wrong_is_named_and_changes_no_sun(tmp_path, seconds, wanted):
    session = paint.read(stamped(paint_folder(tmp_path, records=recorded()), later(seconds)))
    assert [r for r in clocks(session) if re.match(wanted, r)]
    np.testing.assert_allclose(session.records.source, sun_at(), atol=1e-9)


def test_single_stamps_that_are_wrong_are_named(tmp_path):
    """Summer time in two, a slip of five minutes in one."""
    times = later(7200, {1, 4})
    times[3] += timedelta(seconds=300)
    summer, single = clocks(paint.read(stamped(paint_folder(tmp_path, records=recorded()), times)))
    assert summer.startswith(
        "clock: +7200 s: CEST taken for UTC in the stamps of 1001-calibration-properties.json, 1004-"
    )
    assert (
        "1003-calibration-properties.json (+300 s)" in single or "1003-calibration-properties.json (+299 s)" in single
    )
    assert "1001" not in single


def test_true_elevations_are_told_and_refracted(tmp_path):
    session = paint.read(stamped(paint_folder(tmp_path, records=recorded(raised=lambda e: e)), TIMES))
    assert any(r.startswith("Elevations of the sun are true") for r in session.remarks)
    moved = np.degrees(np.arccos(np.sum(session.records.source * sun_at(raised=lambda e: e), axis=1)))
    wanted = [bennett(lifted(almanac(t)[1])) for t in TIMES]
    np.testing.assert_allclose(moved, wanted, rtol=0.05)
    assert (session.records.source[:, 2] > sun_at(raised=lambda e: e)[:, 2]).all()


@pytest.mark.parametrize(
    ("convention", "running", "stamps"),
    [
        ("from north through east", lambda a: a, False),
        ("from north through east", lambda a: a, True),
        ("from south through west", lambda a: a + 180, True),
    ],
)
def test_azimuths_of_another_convention_are_told(tmp_path, convention, running, stamps):
    """From north by the sun's declination; the sense by the stamps alone."""
    folder = paint_folder(tmp_path, records=recorded(running=running))
    session = paint.read(stamped(folder, TIMES) if stamps else folder)
    assert any(r.startswith(f"Azimuths of the sun are {convention}, not from south") for r in session.remarks)
    np.testing.assert_allclose(session.records.source, sun_at(), atol=1e-9)


def test_wrong_stamps_do_not_turn_the_sun_about(tmp_path):
    """Stamps mirrored about noon (11:36 UTC) and five minutes late would fit azimuths through west to 1.3 deg."""
    noon = [t.replace(hour=11, minute=36, second=0) for t in TIMES]
    times = [2 * (n - t) + t + timedelta(seconds=300) for n, t in zip(noon, TIMES, strict=True)]
    session = paint.read(stamped(paint_folder(tmp_path, records=recorded()), times))
    np.testing.assert_allclose(session.records.source, sun_at(), atol=1e-9)
    assert any("by no whole hours" in r for r in clocks(session))


def test_a_sun_that_can_stand_there_in_neither_convention_is_refused(tmp_path):
    records = [RECORD, *recorded(TIMES[2:3], running=lambda a: a)]
    with pytest.raises(BenchsimError, match=r"1001-.*azimuth from south through east.*azimuth from north through east"):
        paint.read(paint_folder(tmp_path, records=records))


def test_stamps_are_found_in_the_item_in_the_recording_and_by_number(tmp_path):
    late = [t.strftime("%Y-%m-%dT%H:%M:%SZ") for t in later(7200)]
    records = recorded()
    records[1]["datetime"] = late[1]
    folder = stamped(paint_folder(tmp_path, records=records), TIMES, name="ZZ99")
    write(folder, "1000-calibration-item-stac.json", json.dumps({"properties": {"datetime": late[0]}}))
    write(folder, "1002-calibration-item-stac.json", json.dumps({"properties": {"datetime": None}}))
    (said,) = clocks(paint.read(folder))
    assert "stamps of 1000-calibration-properties.json, 1001-calibration-properties.json;" in said


@pytest.mark.parametrize("stamp", ["yesterday", 1655040013, "", "9999-12-31T23:00:00Z"])
def test_a_stamp_that_is_no_time_is_said(tmp_path, stamp):
    folder = paint_folder(tmp_path)
    write(tmp_path, "timestamps.json", json.dumps({"AA01_1002": stamp}))
    with pytest.raises(BenchsimError, match=r"timestamps\.json: AA01_1002: .* is no time"):
        paint.read(folder)


def test_both_methods_of_finding_the_spot_are_compared(tmp_path):
    """0.3 and 0.4 m apart in height, and 0.1 m: rms of three."""
    apart = [0.3, 0.4, -0.1]
    records = [changed(RECORD, [50.913392, 6.387827, 130.67 + d], "focal_spot", "HeliOS") for d in apart]
    records.append(changed(RECORD, None, "focal_spot", "HeliOS"))
    session = paint.read(paint_folder(tmp_path, records=records))
    # Of two errors of s in each of two components the distance has a median of 2 √(ln 2) s.
    assert session.records.spot_sigma == pytest.approx(300 / (2 * np.log(2) ** 0.5), rel=1e-3)
    (said,) = (r for r in session.remarks if "HeliOS" in r)
    assert said.startswith(
        f"UTIS and HeliOS find spots {1e3 * np.sqrt(np.mean(np.square(apart))):.3g} mm apart (rms of 3 "
    )


@real
def test_the_methods_differ_on_aa39_by_what_their_own_coordinates_say():
    """Metres per degree at 50.91 deg, from the axes of the ellipsoid (WGS 84)."""
    north, east, apart = 111_249.0, 70_300.0, []
    for path in (JUELICH / "AA39").glob("*-calibration-properties.json"):
        spots = json.loads(path.read_text(encoding="utf-8"))["focal_spot"]
        d = np.subtract(spots["UTIS"], spots["HeliOS"]) * [north, east, 1.0]
        apart.append(np.linalg.norm(d))
    rms = 1e3 * np.sqrt(np.mean(np.square(apart)))
    (said,) = (r for r in paint.read(JUELICH / "AA39").remarks if r.startswith("UTIS and HeliOS"))
    assert float(said.split("spots ")[1].split()[0]) == pytest.approx(rms, rel=0.01)


@real
@pytest.mark.parametrize("name", ["BG15", "BL14"])
def test_a_field_s_stamps_agree_with_the_sun_and_two_hours_are_seen(tmp_path, name):
    session = paint.read(JUELICH / "field" / name)
    assert "timestamps.json" in {p.name for p in session.files}
    assert not clocks(session)
    assert any(r.startswith("Elevations of the sun are apparent") for r in session.remarks)
    stamps = json.loads((JUELICH / "field" / "timestamps.json").read_text(encoding="utf-8"))
    wrong = {k: (datetime.fromisoformat(v) + timedelta(hours=2)).isoformat() for k, v in stamps.items()}
    write(tmp_path, "timestamps.json", json.dumps(wrong))
    folder = Path(shutil.copytree(JUELICH / "field" / name, tmp_path / name))
    late = paint.read(folder, JUELICH / "field" / "tower-measurements.json")
    (said,) = clocks(late)
    assert said.startswith("clock: +7200 s: CEST taken for UTC in all stamps")
    np.testing.assert_array_equal(late.records.source, session.records.source)


@real
def test_a_sun_that_is_two_hours_late_is_named_clock_and_what_went_wrong():
    """The recorded suns turned on by 30 deg about the pole, westward: as if summer time had been taken for UTC."""
    session = paint.read(JUELICH / "AA39")
    phi = session.mount.latitude
    on = Rotation.from_rotvec(np.radians(-30) * np.array([0.0, np.cos(phi), np.sin(phi)]))
    late = replace(session.records, source=on.apply(session.records.source))
    found = diagnose_session(replace(session, records=late))
    assert "clock" in {f.name for f in found.diagnosis.effects}
    assert any(r.startswith("clock: +7200 s: CEST taken for UTC: so the spots have it") for r in found.remarks)
