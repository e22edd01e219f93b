"""Records that do not belong to their mount, copies, and too few: a sentence or an honest verdict, never a name."""

import json
import shutil
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_diagnosing import night
from test_readers import ACTUATOR, HELIOSTAT, RECORD, TOWER, changed, paint_folder, without, write

from benchsim.bench.errors import BenchsimError
from benchsim.diagnosis.result import Found, Size
from benchsim.instruments.mount import paint, pointing, stated, witnesses
from benchsim.instruments.mount.records import toward
from benchsim.jobs import diagnose
from benchsim.jobs.mount_diagnosis import diagnose_session

RECORDINGS = Path(__file__).resolve().parents[4] / "shared" / "recordings"
real = pytest.mark.skipif(not RECORDINGS.is_dir(), reason="the real recordings are not beside the project")
KINEMATICS = "kinematics_properties"


def actuators(**values):
    return {"heliostat": changed(HELIOSTAT, [{**ACTUATOR, **values}] * 2, KINEMATICS, "actuators")}


@pytest.mark.parametrize(
    ("part", "wanted"),
    [
        ({"records": (changed(RECORD, 10**400, "motor_position", "axis_1_motor_position"),)}, "no finite number"),
        ({"records": (changed(RECORD, [True, 6.38, 130.0], "focal_spot", "UTIS"),)}, "UTIS"),
        ({"records": (changed(RECORD, "power_plant_properties", "target_name"),)}, "target_name"),
        ({"records": (changed(changed(RECORD, 0.367, "sun_elevation"), -0.185, "sun_azimuth"),)}, "never stands"),
        ({"records": (RECORD, changed(RECORD, 169.4, "sun_azimuth"))}, "1001-.*never stands"),
        ({"heliostat": changed(HELIOSTAT, None, KINEMATICS)}, "kinematics_properties"),
        ({"heliostat": changed(HELIOSTAT, [None, ACTUATOR], KINEMATICS, "actuators")}, "actuators.1"),
        ({"heliostat": changed(HELIOSTAT, 175, KINEMATICS, "concentrator_translation_n")}, "write metres"),
        ({"heliostat": changed(HELIOSTAT, "x", KINEMATICS, "joint_translation_e_1")}, "joint_translation_e_1"),
        ({"heliostat": changed(HELIOSTAT, [50.91364, 6.38801, 8868], "heliostat_position")}, "km from the tower"),
        (actuators(offset_shift=None), "offset_shift"),
        (actuators(initial_angle=54.1), "write radians"),
        (actuators(initial_stroke_length=77.4), "write metres"),
        (actuators(clockwise_axis_movement="false"), "neither 0 nor 1"),
        ({"heliostat": changed(HELIOSTAT, [without(ACTUATOR, "clockwise_axis_movement")] * 2, KINEMATICS, "actuators")},
         "clockwise_axis_movement: is missing"),
        ({"tower": [TOWER]}, "no JSON object"),
    ],
)  # fmt: skip
def test_values_of_paint_files_that_cannot_be(tmp_path, part, wanted):
    with pytest.raises(BenchsimError, match=wanted) as error:
        paint.read(paint_folder(tmp_path, **part))
    assert ".json" in str(error.value)


@pytest.mark.parametrize(
    ("data", "wanted"),
    [
        (b"", "no JSON"),
        (b"[" * 100_000, "no JSON"),
        (b"// a comment\n{}", "no JSON"),
        (b'{"name": "J\xfclich"}', "UTF-8"),
    ],
)
def test_bytes_that_are_no_record(tmp_path, data, wanted):
    folder = paint_folder(tmp_path)
    (folder / "1001-calibration-properties.json").write_bytes(data)
    with pytest.raises(BenchsimError, match=wanted) as error:
        paint.read(folder)
    assert "1001-" in str(error.value)


def test_folders_as_the_data_base_names_them(tmp_path):
    """A byte-order mark, the heliostat's name before its file, and the file in Properties beside, are all read."""
    folder = paint_folder(tmp_path)
    record = folder / "1000-calibration-properties.json"
    record.write_bytes(b"\xef\xbb\xbf" + record.read_bytes().replace(b"\n", b"\r\n"))
    (tmp_path / "Properties").mkdir()
    (folder / "heliostat-properties.json").rename(tmp_path / "Properties" / "AA01-heliostat-properties.json")
    assert len(paint.read(folder).records.names) == 4


def test_paths_that_are_nearly_a_folder_of_records(tmp_path):
    folder = paint_folder(tmp_path)
    for path, wanted in ((tmp_path, "AA01"), (folder / "heliostat-properties.json", "name the folder")):
        assert stated.recognises(path)
        with pytest.raises(BenchsimError, match=wanted):
            stated.read(path)


def test_two_files_that_may_be_the_tower_s(tmp_path):
    folder = paint_folder(tmp_path)
    tower = (tmp_path / "tower-measurements.json").rename(tmp_path / "a-tower.json")
    write(tmp_path, "b-tower.json", tower.read_text(encoding="utf-8"))
    with pytest.raises(BenchsimError, match="--tower"):
        paint.read(folder)
    assert paint.read(folder, tower).files[-1] == tower


def test_the_second_method_and_absent_lengths_are_said_once(tmp_path):
    record = without(RECORD, "focal_spot", "UTIS")
    remarks = paint.read(paint_folder(tmp_path, records=(record,) * 4)).remarks
    assert sum("UTIS" in r for r in remarks) == 1
    assert any("joint_translation_e_1" in r and "taken as 0" in r for r in remarks)


STARS = "120 45 119.7 44.999\n200 30 199.7 29.999\n300 60 299.7 59.999\n"


@pytest.mark.parametrize(
    "text",
    [
        "\ufeff" + STARS,
        STARS.replace("\n", "\r\n"),
        STARS.replace(" ", ";"),
        STARS.replace("\n", " # as seen\n"),
        STARS + "END\nwhat follows END is not read\n",
        "".join(f"TAA: {h} {a}\nRAA: {h} {a}\n" for a, h in ((120, 45), (200, 30), (300, 60))),
        "a long preamble\n" * 300 + STARS,
    ],
)
def test_three_stars_however_written(tmp_path, text):
    path = write(tmp_path, "run.dat", text)
    assert stated.recognises(path)
    records = pointing.read(path).records
    np.testing.assert_allclose(np.degrees(records.reading[:, 0]), [120, 200, 300], atol=0.4)


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        (STARS.replace("45", "-45").replace("44.999", "-44.999"), "line 1.*horizon"),
        (STARS + "120 45 119.7\n", "line 4, column 4"),
        ("RAA: 77 10\nTAA: 77 nan\n", "line 2"),
        ("RAA: 77 10\nTAA: 77 10\nLST: nan:0:0\n", "line 3"),
        ("RAA: 77 10\n", "no star has both"),
    ],
)
def test_stars_that_cannot_be(tmp_path, text, wanted):
    path = write(tmp_path, "run.dat", text)
    assert stated.recognises(path)
    with pytest.raises(BenchsimError, match=wanted):
        pointing.read(path)


def test_a_broken_first_star_and_hours_are_remarked(tmp_path):
    assert any("Line 1" in r for r in pointing.read(write(tmp_path, "a.dat", "120 45 xx 44.9\n" + STARS)).remarks)
    rows = "".join(f"{2 * k} {20 + 5 * k} {2 * k} {20 + 5 * k}\n" for k in range(10))
    assert any("hours" in r for r in pointing.read(write(tmp_path, "b.dat", rows)).remarks)


@pytest.mark.parametrize("line", ["effects = 3", "[effects]\naxis-tilt = 3", "tower = 3"])
def test_stated_effects_of_another_kind(tmp_path, line):
    paint_folder(tmp_path)
    path = write(tmp_path, "a.toml", f'format = "benchsim-mount/1"\nrecordings = "AA01"\n{line}\n')
    with pytest.raises(BenchsimError, match=r"effects|tower"):
        stated.read(path)


def test_azimuths_of_the_wrong_sense_get_no_name():
    session = night(7)
    reading = session.records.reading * [-1.0, 1.0]
    found = diagnose_session(replace(session, records=replace(session.records, reading=reading)))
    assert found.diagnosis.verdict == "unexplained"
    assert not found.diagnosis.effects
    assert not found.diagnosis.classes
    assert not found.found


def test_copies_are_one_witness_and_the_same_record_alone_is_refused():
    session = night(8, n=10)
    twice = session.records.chosen([*range(10), *range(10)])
    names = tuple(f"star {k + 1}" for k in range(20))
    found = diagnose_session(replace(session, records=replace(twice, names=names)))
    assert found.built.problem.names == names[:10]
    assert "star 11" in found.text()
    with pytest.raises(BenchsimError, match="1 record"):
        diagnose_session(replace(session, records=replace(session.records.chosen([0] * 6), names=names[:6])))


def test_from_few_clean_records_little_is_said():
    found = diagnose_session(night(9, n=4))
    assert found.diagnosis.verdict == "nothing-missing"
    assert "From 4 records little can be told" in found.text()


def test_records_that_agree_exactly_are_diagnosed_in_silence():
    """All at one place of the sky and equal but for their names' order: singular, yet no warning and no name."""
    session = night(10, n=8)
    star = toward(np.full(8, 1.0), np.full(8, 0.7))
    reading = np.column_stack([1.0 + 1e-9 * np.arange(8), np.full(8, 0.7)])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = diagnose_session(replace(session, records=replace(session.records, source=star, reading=reading)))
    assert not found.diagnosis.effects
    assert "nearly one place" in found.text()


@pytest.mark.parametrize(("mm", "confidence"), [(300.0, "named"), (-2400.0, "provisional")])
def test_a_place_that_no_survey_misses_by_needs_a_second_witness(mm, confidence):
    """A heliostat 0.3 m beside its place is named; 2.4 m are more than any plant is surveyed wrongly by."""
    sizes = {"mirror_e": Size(mm, 30.0, "mm"), "mirror_n": Size(10.0, 20.0, "mm")}
    named = Found("mirror-position", "mount", 1.0, "named", sizes, "It stands elsewhere.", "Survey it.")
    found, said = witnesses.doubted(replace(diagnose_session(night(1)).diagnosis, effects=(named,), verdict="named"))
    assert found.effects == (replace(named, confidence=confidence),)
    assert bool(said) == (confidence == "provisional")
    assert not said or "2.4 m: mirror-position needs a second witness" in said[0]


@pytest.mark.parametrize(("mm", "said"), [(300.0, ""), (-7000.0, "a target 7 m beside its place")])
def test_a_target_hangs_near_its_place(mm, said):
    sizes = {"target_e_1": Size(mm, 30.0, "mm")}
    named = Found("target-position", "target", 1.0, "provisional", sizes, "It hangs elsewhere.", "Survey it.")
    clean = diagnose_session(night(1)).diagnosis
    assert said in witnesses.far_target(replace(clean, effects=(named,), values={**clean.values, "target_e_1": mm}))
    assert not witnesses.far_target(replace(clean, values={**clean.values, "target_e_1": mm}))


@real
def test_no_target_is_stated_where_none_hangs(tmp_path):
    """By its first twenty records, wrong days among them, a heliostat of Jülich would have its target 7 m off."""
    source = RECORDINGS / "heliostat-juelich" / "field"
    folder = tmp_path / "BG16"
    shutil.copytree(source / "BG16", folder)
    files = sorted((folder / "calibration").iterdir(), key=lambda p: int(p.name.split("_")[0].split("-")[0]))
    for later in files[20:]:
        later.unlink()
    found = diagnose(folder, tmp_path / "out", tower=source / "tower-measurements.json", pictures=False)
    assert "target-position" not in (tmp_path / "out" / "amended.toml").read_text(encoding="utf-8")
    assert "without a second witness" in found.text()


@real
@pytest.mark.parametrize("fault", ["stamps", "position", "increment"])
def test_a_heliostat_with_foreign_data_is_unexplained(tmp_path, fault):
    """Each record with the sun of the next; the heliostat 50 m off; steps ten times as fine: no name, no place."""
    source = RECORDINGS / "heliostat-juelich" / "AA39"
    files = {p.name: json.loads(p.read_text(encoding="utf-8")) for p in sorted(source.glob("*.json"))}
    heliostat = files.pop("heliostat-properties.json")
    if fault == "position":
        heliostat["heliostat_position"][1] += 50 / 70.2e3  # deg of longitude
    for actuator in heliostat[KINEMATICS]["actuators"]:
        actuator["increment"] *= 10 if fault == "increment" else 1
    suns = [(r["sun_azimuth"], r["sun_elevation"]) for r in files.values()]
    folder = tmp_path / "AA39"
    folder.mkdir()
    for k, (name, record) in enumerate(files.items()):
        if fault == "stamps":
            record["sun_azimuth"], record["sun_elevation"] = suns[(k + 1) % len(suns)]
        write(folder, name, json.dumps(record))
    write(folder, "heliostat-properties.json", json.dumps(heliostat))
    tower = source.parent / "tower-measurements.json"
    found = diagnose(folder, tmp_path / "out", tower=tower, pictures=fault == "stamps")
    plain = json.loads((tmp_path / "out" / "diagnosis.json").read_text(encoding="utf-8"))
    assert plain["verdict"] == "unexplained"
    assert not plain["effects"]
    assert "do not belong together" in found.text()
    assert "effects" not in (tmp_path / "out" / "amended.toml").read_text(encoding="utf-8")
