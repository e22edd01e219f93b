"""Files of mounts: what they mean, and one sentence with file, line or key where they cannot be used."""

import json
from dataclasses import replace

import numpy as np
import pytest

from benchsim.bench.errors import BenchsimError
from benchsim.instruments.mount import paint, pointing, problem, stated
from benchsim.instruments.mount.records import Function, angles

COLUMNS = """! a header
MMT test
120.0 45.0 119.7 44.999
200.0 30.0 199.7 29.999
300.0 60.0 299.7 59.999
END
"""

STAR = """CAT: FK5-1   18:55:20 +43:56:45
RAA:   77.0   347.2
AA:   77.0   347.6
TAA:   77.001   -12.4
LST: 19:11:22.950
ARD:   18.9334263   43.9779932
"""


def write(folder, name, text):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_four_columns_are_azimuth_altitude_true_then_raw(tmp_path):
    session = pointing.read(write(tmp_path, "run.dat", COLUMNS))
    assert len(session.records.names) == 3
    azimuth, elevation = angles(session.records.source)
    np.testing.assert_allclose(np.degrees(azimuth), [120, 200, 300])
    np.testing.assert_allclose(np.degrees(elevation), [45, 30, 60])
    np.testing.assert_allclose(np.degrees(session.records.reading[:, 0]), [119.7, 199.7, 299.7])
    assert session.mount.latitude is None
    assert "clock" in session.remarks[0]


def test_columns_without_a_header_and_with_commas(tmp_path):
    text = "120, 45, 119.7, 44.999\n200, 30, 199.7, 29.999\n"
    assert len(pointing.read(write(tmp_path, "a.txt", text)).records.names) == 2


def test_the_log_gives_altitude_before_azimuth(tmp_path):
    session = pointing.read(write(tmp_path, "log.dat", STAR * 3))
    np.testing.assert_allclose(np.degrees(session.records.reading[0]), [347.2, 77.0])
    azimuth, elevation = angles(session.records.source)
    assert np.degrees(azimuth[0]) == pytest.approx(347.6)
    assert np.degrees(elevation[0]) == pytest.approx(77.001)


def test_the_log_tells_the_latitude(tmp_path):
    """Stars as they stand at a latitude of 31.7 deg are found to be of 31.7 deg."""
    latitude, stars = np.radians(31.7), []
    for k in range(6):
        hour, declination = np.radians(-50 + 20 * k), np.radians(10 * k - 5)
        altitude = np.arcsin(
            np.sin(latitude) * np.sin(declination) + np.cos(latitude) * np.cos(declination) * np.cos(hour)
        )
        azimuth = np.degrees(
            np.arctan2(
                -np.cos(declination) * np.sin(hour),
                np.cos(latitude) * np.sin(declination) - np.sin(latitude) * np.cos(declination) * np.cos(hour),
            )
        )
        ascension = (6.0 - np.degrees(hour) / 15) % 24
        stars.append(
            f"CAT: {k}\nRAA: {np.degrees(altitude):.7f} {azimuth}\nTAA: {np.degrees(altitude):.7f} {azimuth}\n"
            f"LST: 06:00:00\nARD: {ascension:.7f} {np.degrees(declination):.7f}\n"
        )
    session = pointing.read(write(tmp_path, "log.dat", "".join(stars)))
    assert np.degrees(session.mount.latitude) == pytest.approx(31.7, abs=1e-4)


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("120 45 119.7 44.999\n200 30 xx 29.999\n300 60 299.7 59.9\n", "line 2"),
        ("120 45 119.7 44.999\n200 95 199 94\n", "line 2"),
        ("2.1 0.7 2.1 0.7\n1.1 0.5 1.1 0.5\n0.3 0.2 0.3 0.2\n", "radians"),
        ("45 120 44.9 119.7\n30 200 29.9 199.7\n", "no directions"),
        ("120 45 44.9 20\n20 30 29.9 60\n30 60 59.9 20\n", "altitudes differ"),
        ("words only\n", "neither RAA"),
        ("RAA: 77.0\nTAA: 77.0 10.0\n", "line 1"),
    ],
)
def test_pointing_files_that_cannot_be_used(tmp_path, text, wanted):
    path = write(tmp_path, "run.dat", text)
    with pytest.raises(BenchsimError, match=wanted) as error:
        pointing.read(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


TOWER = {
    "power_plant_properties": {"coordinates": [50.9134, 6.3878, 87.0]},
    "upper": {"coordinates": {"center": [50.91339, 6.38782, 130.0]}},
}
ACTUATOR = {
    "type_axis": "linear",
    "increment": 154166.6667,
    "initial_stroke_length": 0.0774,
    "offset": 0.3353,
    "pivot_radius": 0.3381,
    "clockwise_axis_movement": 0,
    "initial_angle": 0.039,
}
HELIOSTAT = {
    "heliostat_position": [50.91364, 6.38801, 88.7],
    "kinematics_properties": {
        "actuators": [ACTUATOR, {**ACTUATOR, "clockwise_axis_movement": 1, "initial_angle": 0.944}],
        "concentrator_translation_n": 0.175,
    },
}
RECORD = {
    "motor_position": {"axis_1_motor_position": 41583, "axis_2_motor_position": 53180},
    "target_name": "upper",
    "sun_elevation": 21.0,
    "sun_azimuth": -10.6,
    "focal_spot": {"HeliOS": [50.913392, 6.387826, 130.52], "UTIS": [50.913392, 6.387827, 130.67]},
}


def paint_folder(tmp_path, tower=TOWER, heliostat=HELIOSTAT, records=(RECORD,) * 4):
    folder = tmp_path / "AA01"
    folder.mkdir()
    write(tmp_path, "tower-measurements.json", json.dumps(tower))
    write(folder, "heliostat-properties.json", json.dumps(heliostat))
    for k, record in enumerate(records):
        write(folder, f"{1000 + k}-calibration-properties.json", json.dumps(record))
    return folder


def test_a_paint_folder_in_millimetres_about_the_plant(tmp_path):
    session = paint.read(paint_folder(tmp_path))
    assert session.records.names == ("1000", "1001", "1002", "1003")
    # 1e-5 deg of latitude is 1.1 m, of longitude at 51 deg 0.7 m.
    np.testing.assert_allclose(session.mount.position / 1e3, [14.8, 26.7, 1.7], atol=0.05)
    azimuth, elevation = angles(session.records.source)
    assert np.degrees(azimuth[0]) == pytest.approx(180 + 10.6)  # west of south
    assert np.degrees(elevation[0]) == pytest.approx(21.0)
    assert session.mount.actuators[0].offset == pytest.approx(335.3)
    assert session.mount.joints[2, 1] == pytest.approx(175.0)


def test_the_tower_file_can_be_named(tmp_path):
    folder = paint_folder(tmp_path)
    other = (tmp_path / "tower-measurements.json").rename(tmp_path / "elsewhere.json")
    with pytest.raises(BenchsimError, match="--tower"):
        paint.read(folder)
    assert len(paint.read(folder, other).records.names) == 4


def without(data, *keys):
    copy = json.loads(json.dumps(data))
    at = copy
    for key in keys[:-1]:
        at = at[key]
    del at[keys[-1]]
    return copy


def changed(data, value, *keys):
    copy = json.loads(json.dumps(data))
    at = copy
    for key in keys[:-1]:
        at = at[key]
    at[keys[-1]] = value
    return copy


@pytest.mark.parametrize(
    ("part", "wanted"),
    [
        ({"records": (without(RECORD, "sun_azimuth"),)}, "sun_azimuth"),
        ({"records": (without(RECORD, "motor_position", "axis_2_motor_position"),)}, "axis_2_motor_position"),
        ({"records": (changed(RECORD, "many", "sun_elevation"),)}, "sun_elevation"),
        ({"records": (changed(RECORD, 210.0, "sun_elevation"),)}, "no place of the sun"),
        ({"records": (changed(RECORD, "nowhere", "target_name"),)}, "target_name"),
        ({"records": (changed(RECORD, [50.91339, 6.389, 130.0], "focal_spot", "UTIS"),)}, "off the target"),
        ({"records": (changed(RECORD, [0.91339, 6.389], "focal_spot", "UTIS"),)}, "UTIS"),
        ({"heliostat": without(HELIOSTAT, "heliostat_position")}, "heliostat_position"),
        ({"heliostat": changed(HELIOSTAT, [51.2, 6.38801, 88.7], "heliostat_position")}, "km from the tower"),
        ({"heliostat": changed(HELIOSTAT, [ACTUATOR], "kinematics_properties", "actuators")}, "two are needed"),
        (
            {
                "heliostat": changed(
                    HELIOSTAT, [{**ACTUATOR, "offset": 335.3}] * 2, "kinematics_properties", "actuators"
                )
            },
            "write metres",
        ),
        (
            {
                "heliostat": changed(
                    HELIOSTAT, [without(ACTUATOR, "increment")] * 2, "kinematics_properties", "actuators"
                )
            },
            "actuators.1.increment",
        ),
        ({"tower": without(TOWER, "upper", "coordinates")}, "upper.coordinates.center"),
    ],
)
def test_paint_folders_that_cannot_be_used(tmp_path, part, wanted):
    folder = paint_folder(tmp_path, **part)
    with pytest.raises(BenchsimError, match=wanted) as error:
        paint.read(folder)
    assert ".json" in str(error.value)
    assert "\n" not in str(error.value)


def test_a_record_without_a_spot_is_left_out_and_said(tmp_path):
    records = (RECORD, changed(RECORD, {}, "focal_spot"), RECORD, RECORD)
    session = paint.read(paint_folder(tmp_path, records=records))
    assert session.records.names == ("1000", "1002", "1003")
    assert "1001-calibration-properties.json" in session.remarks[0]


LAW = Function(np.array([[1000.0], [1002.0]]), {"IA_mrad": np.zeros(2), "IE_mrad": np.array([0.0, 2.0])})


def test_a_law_of_time_holds_of_the_records_between_and_stays_level_after_them(tmp_path):
    session = replace(paint.read(paint_folder(tmp_path)), fields={"time.order": LAW})
    predict = problem.build(session).problem.predict
    assert predict.moved["IE"] == pytest.approx(np.array([0.0, 1e-3, 2e-3, 2e-3])[: len(session.records.names)])


def test_what_was_found_is_written_and_read_again(tmp_path):
    session = paint.read(paint_folder(tmp_path))
    target = tmp_path / "out"
    target.mkdir()
    stated.write(session, {"axis-tilt": {"tilt_n": -18.25}}, {"time.order": LAW}, target / "amended.toml", target)
    again = stated.read(target / "amended.toml")
    assert again.effects == {"axis-tilt": {"tilt_n": -18.25}}
    assert again.fields["time.order"].values["IE_mrad"].tolist() == [0.0, 2.0]
    assert again.records.names == session.records.names
    assert stated.recognises(target / "amended.toml")


@pytest.mark.parametrize(
    ("line", "wanted"),
    [
        ("[effects.wobble]\nx = 1.0", "wobble"),
        ("[effects.axis-tilt]\nAN = 1.0", "effects.axis-tilt.AN"),
        ('[effects.axis-tilt]\ntilt_n = "much"', "no finite number"),
        ("speed = 3", "speed"),
        ('[fields."mount.speed"]\nknots = [[1.0]]', "fields.mount.speed: is no function"),
        ('[fields."time.order"]\nknots = [[1.0]]\nIA_mrad = [1.0]', "IE_mrad"),
        ('[fields."time.order"]\nknots = [[1.0]]\nIA_mrad = [1.0]\nIE_mrad = [1.0, 2.0]', "IE_mrad: write a number"),
        ('[fields."time.order"]\nknots = [1.0]\nIA_mrad = [1.0]\nIE_mrad = [1.0]', "knots: write a list of 1"),
        ("fields = 3", "fields: is no table"),
    ],
)
def test_stated_effects_that_cannot_be_used(tmp_path, line, wanted):
    paint_folder(tmp_path)
    path = write(tmp_path, "a.toml", 'format = "benchsim-mount/1"\nrecordings = "AA01"\n' + line + "\n")
    with pytest.raises(BenchsimError, match=wanted):
        stated.read(path)


def test_recordings_are_told_by_content(tmp_path):
    assert stated.recognises(paint_folder(tmp_path))
    assert stated.recognises(write(tmp_path, "run", COLUMNS))
    assert stated.recognises(write(tmp_path, "log", STAR))
    assert not stated.recognises(write(tmp_path, "notes.txt", "nothing of the kind\n"))
    assert not stated.recognises(tmp_path / "absent")
