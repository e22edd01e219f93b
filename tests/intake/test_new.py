"""``benchsim new``: what photographs say is in the file, what they cannot say is marked, and nothing is overwritten."""

import re
import tomllib
from pathlib import Path

import pytest
from phone_pictures import picture, save

from benchsim import jobs
from benchsim.bench.errors import BenchsimError
from benchsim.bench.files import UNFILLED, read

MARKS = Path(__file__).resolve().parents[2] / "scenes" / "marks.csv"

CALIBRATED = """
format = "benchsim-camera/1"
[cameras.phone]
resolution_px = [320, 240]
focal_px = 251.0
principal_point_px = [160.5, 119.0]
distortion = [0.01, 0.0, 0.0, 0.0, 0.0]
bit_depth = 8
gamma = "unknown"
[uncertainty]
intrinsics_sigma = [0.001, 0.5, 0.002]
[calibration]
parameters = ["focal", "cu", "cv", "k1", "k2", "p1", "p2", "k3"]
covariance = [[]]
photographs = 12
marks = 400
rms_px = 0.1
"""


@pytest.fixture
def calibrated(tmp_path):
    from benchsim.calibration.solve import LENS

    rows = ", ".join("[" + ", ".join(["0.0"] * len(LENS)) + "]" for _ in LENS)
    text = CALIBRATED.replace("[[]]", f"[{rows}]")
    text = re.sub(r"parameters = .*", f"parameters = {list(LENS)}".replace("'", '"'), text)
    (tmp_path / "camera.toml").write_text(text)
    return tmp_path / "camera.toml"


def fill(folder):
    """What a person would write."""
    file = folder / "recording.toml"
    text = file.read_text()
    for key, value in {
        "wavelength_nm": "650.0", "beam_diameter_mm": "7.0", "divergence_mrad": "1.5", "shape": '"polygon"',
        "facets": "12", "diameter_mm": "35.0", "height_mm": "2.0", "stands_for": '"elevation"',
        "size_mm": "[700.0, 700.0]", "laser_azimuth_deg": "101.0", "laser_elevation_deg": "50.0",
        "mirror_position_mm": "[1500.0, -160.0, -1430.0]",
    }.items():  # fmt: skip
        text = text.replace(f'\n{key} = "?"', f"\n{key} = {value}")
    file.write_text(text)


def test_photographs_begin_a_recording(phone, tmp_path):
    result = jobs.new(tmp_path / "mine", [phone], marks=MARKS)
    data = tomllib.loads((tmp_path / "mine" / "recording.toml").read_text())
    exposures = data["exposure"]
    assert [(e["image"], e["dark"]) for e in exposures] == [
        ("IMG_8.jpg", "IMG_9.jpg"), ("IMG_10.jpg", "IMG_11.jpg"), ("IMG_12.jpg", "IMG_13.jpg")
    ]  # fmt: skip
    assert [e["time_s"] for e in exposures] == [0.0, 60.0, 120.0]
    camera = data["cameras"]["A"]
    assert camera["resolution_px"] == [320, 240] and camera["bit_depth"] == 8 and camera["gamma"] == "unknown"
    assert camera["focal_px"] == pytest.approx(26 / 43.27 * 400, abs=0.5)
    # Eight of laser and mirror, the board's size, and three for each of three exposures.
    assert len(result.unfilled) == 18 and "mirror.height_mm" in result.unfilled
    with pytest.raises(BenchsimError, match="not filled in"):
        read(tmp_path / "mine")
    fill(tmp_path / "mine")
    recording = read(tmp_path / "mine", images=True)
    assert len(recording.exposures) == 3 and recording.screen.marks is not None
    assert UNFILLED not in {e["setting"] for e in exposures}


def test_a_calibration_goes_in_as_it_stands(phone, calibrated, tmp_path):
    jobs.new(tmp_path / "mine", [phone], calibration=calibrated, marks=MARKS)
    fill(tmp_path / "mine")
    recording = read(tmp_path / "mine")
    assert recording.cameras["phone"].focal == 251.0 and recording.cameras["phone"].distortion[0] == 0.01
    assert recording.uncertainty.intrinsics_sigma == (0.001, 0.5, 0.002)


def test_a_calibration_of_another_size_or_lens_is_refused(phone, calibrated, tmp_path):
    save(phone / "IMG_20.jpg", picture(80), 300.0, zoom=2.0)
    with pytest.raises(BenchsimError, match=r"IMG_20\.jpg: taken with another lens or zoom"):
        jobs.new(tmp_path / "mine", [phone], calibration=calibrated)
    save(phone / "IMG_20.jpg", picture(80, size=(240, 320)), 300.0)
    with pytest.raises(BenchsimError, match="240 × 320 pixels, but camera phone was calibrated with 320 × 240"):
        jobs.new(tmp_path / "mine", [phone], calibration=calibrated)
    assert not (tmp_path / "mine").exists()


def test_pictures_that_lie_in_the_folder_stay_there(phone):
    result = jobs.new(phone, [phone])
    assert [s.image for s in result.shots] == ["IMG_8.jpg", "IMG_10.jpg", "IMG_12.jpg"]
    assert not result.marks and "marks.csv" in result.summary()


def test_what_a_person_filled_in_is_never_overwritten(phone, tmp_path):
    jobs.new(tmp_path / "mine", [phone])
    before = (tmp_path / "mine" / "recording.toml").read_text()
    with pytest.raises(BenchsimError, match=r"recording\.toml: is already there"):
        jobs.new(tmp_path / "mine", [phone])
    assert (tmp_path / "mine" / "recording.toml").read_text() == before


def test_another_picture_of_that_name_is_not_overwritten(phone, tmp_path):
    (tmp_path / "mine").mkdir()
    save(tmp_path / "mine" / "IMG_8.jpg", picture(55))
    before = (tmp_path / "mine" / "IMG_8.jpg").read_bytes()
    with pytest.raises(BenchsimError, match="differs"):
        jobs.new(tmp_path / "mine", [phone])
    assert (tmp_path / "mine" / "IMG_8.jpg").read_bytes() == before


def test_marks_that_are_not_there(phone, tmp_path):
    with pytest.raises(BenchsimError, match=r"none\.csv: not there; give --board"):
        jobs.new(tmp_path / "mine", [phone], marks=tmp_path / "none.csv")
    assert not (tmp_path / "mine").exists()


@pytest.mark.parametrize("what", ["heic", "empty", "none"])
def test_what_is_no_photograph_is_refused(tmp_path, what):
    folder = tmp_path / "photos"
    folder.mkdir()
    if what == "heic":
        (folder / "IMG_1.HEIC").write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic")
    word = {"heic": "export it as JPEG", "empty": "no photographs in this folder", "none": "no photographs; name them"}
    with pytest.raises(BenchsimError, match=word[what]):
        jobs.new(tmp_path / "mine", [] if what == "none" else [folder])
    assert not (tmp_path / "mine").exists()


def test_lenses_are_cameras_without_a_calibration(phone, tmp_path):
    save(phone / "IMG_20.jpg", picture(80), 300.0, focal=9.0, focal_35mm=77)
    jobs.new(tmp_path / "mine", [phone])
    data = tomllib.loads((tmp_path / "mine" / "recording.toml").read_text())
    assert list(data["cameras"]) == ["A", "B"] and data["exposure"][-1]["camera"] == "B"


def test_the_shells_expanded_list_is_understood(phone, tmp_path):
    from typer.testing import CliRunner

    from benchsim.cli import app

    names = sorted(map(str, phone.iterdir()))
    done = CliRunner().invoke(app, ["new", str(tmp_path / "mine"), "--photos", *names])
    assert done.exit_code == 0 and "3 exposures, 3 with a dark picture" in done.output
    checked = CliRunner().invoke(app, ["check", str(tmp_path / "mine")])
    assert checked.exit_code == 1 and "laser.wavelength_nm: not filled in" in checked.output


def test_what_another_file_of_the_bench_states_need_not_be_filled_in_again(tmp_path):
    """Scenario: the second recording of a bench; only what was set anew is asked for."""
    (tmp_path / "photos").mkdir()
    for k in range(3):
        save(tmp_path / "photos" / f"{k}.jpg", picture(100 + 40 * k), 10.0 * k)
    bench = MARKS.with_name("fig7a.toml")
    done = jobs.new(tmp_path / "second", [tmp_path / "photos"], marks=MARKS, like=bench)
    assert {key.rpartition(".")[2] for key in done.unfilled} - {"focal_px", "gamma"} == {
        "laser_azimuth_deg", "laser_elevation_deg", "mirror_position_mm"
    }  # fmt: skip
    mine, theirs = (tomllib.loads(f.read_text()) for f in (tmp_path / "second" / "recording.toml", bench))
    assert mine["mirror"] == theirs["mirror"] and mine["laser"].items() >= theirs["laser"].items()
    assert "# over the polygon's corners, by caliper" in (tmp_path / "second" / "recording.toml").read_text()


def test_what_is_missing_in_every_exposure_is_said_once_and_how_it_is_measured(tmp_path):
    (tmp_path / "photos").mkdir()
    for k in range(3):
        save(tmp_path / "photos" / f"{k}.jpg", picture(100 + 40 * k), 10.0 * k)
    jobs.new(tmp_path / "mine", [tmp_path / "photos"], marks=MARKS)
    lines = jobs.check(tmp_path / "mine").summary().splitlines()
    said = "of the direction toward the laser, from +x toward -y"
    assert f"  exposure[1–3].laser_azimuth_deg: not filled in; {said}" in lines
    assert "  mirror.diameter_mm: not filled in; over the polygon's corners, by caliper" in lines
