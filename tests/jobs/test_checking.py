"""``benchsim check``: a rendered recording passes; what is spoilt in it is named, with the mend."""

import json
import shutil

import numpy as np
import pytest

from benchsim import jobs
from benchsim.bench.errors import BenchsimError


def spoil(folder, old, new, count=1):
    file = folder / "recording.toml"
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, count))


def amiss(result):
    return [f for f in result.findings if f.kind != "remark"]


def test_a_good_recording_passes(recording, tmp_path):
    result = jobs.check(recording, tmp_path / "out")
    assert result.usable and not amiss(result)
    assert "nothing missing" in result.summary() and "held" not in result.summary()
    assert any(f.where == "settings" for f in result.findings), "one setting leaves none to test on, which is said"
    written = json.loads((tmp_path / "out" / "check.json").read_text())
    assert written["usable"] and written["format"] == "benchsim-check/1"


def test_everything_that_is_missing_is_named_at_once(recording):
    spoil(recording, "laser_azimuth_deg = 101.0", 'laser_azimuth_deg = "?"')
    spoil(recording, "wavelength_nm = 632.8", 'wavelength_nm = "?"')
    spoil(recording, 'camera = "A"\n', "")
    result = jobs.check(recording)
    assert not result.usable and not result.looked
    assert {f.where for f in amiss(result)} == {
        "exposure[1].laser_azimuth_deg",
        "laser.wavelength_nm",
        "exposure[1].camera",
    }
    assert all(f.kind == "missing" for f in amiss(result))


@pytest.mark.parametrize(
    "old, new, slip",
    [
        ("laser_azimuth_deg = 101.0", "laser_azimuth_deg = 259.0", "east and west"),
        ("laser_elevation_deg = 50.0", "laser_elevation_deg = 40.0", "zenith"),
        ("mirror_position_mm = [1500.0, -160.0,", "mirror_position_mm = [1500.0, 160.0,", "sign of y"),
    ],
)
def test_a_slip_of_the_pen_is_found_in_the_picture(recording, old, new, slip):
    """Rationale: a wrong sign turns the trace by degrees, hands by milliradians: no fit is needed to see it."""
    spoil(recording, old, new)
    (found,) = amiss(jobs.check(recording))
    assert found.where.startswith("001.png, setting") and slip in found.says


def test_hands_are_no_slip(recording):
    """2 mrad of the laser's azimuth, a little over one sigma, is what [uncertainty] is for."""
    spoil(recording, "laser_azimuth_deg = 101.0", "laser_azimuth_deg = 101.115")
    assert jobs.check(recording).usable


def test_a_laser_left_on_in_the_dark_picture(recording):
    shutil.copy(recording / "001.png", recording / "001-dark.png")
    (found,) = amiss(jobs.check(recording))
    assert found.where == "001.png" and "dark picture 001-dark.png shows its line" in found.says


def test_a_camera_that_moved_is_remarked(recording):
    import cv2

    path = str(recording / "001-dark.png")
    moved = np.roll(cv2.imread(path, cv2.IMREAD_UNCHANGED), (2, 3), axis=(0, 1))
    cv2.imwrite(path, moved)
    result = jobs.check(recording)
    (said,) = [f for f in result.findings if f.where == "001-dark.png"]
    assert result.usable and "moved by 3.6 px" in said.says


def test_a_damaged_picture_does_not_hide_the_rest(recording):
    data = (recording / "001.png").read_bytes()
    (recording / "001.png").write_bytes(data[: len(data) // 2])
    (found,) = amiss(jobs.check(recording))
    assert found.where == "001.png" and "truncated" in found.says


def test_a_slip_in_the_marks_names_their_file(recording):
    marks = recording / "marks.csv"
    lines = marks.read_text().splitlines()
    marks.write_text("\n".join([*lines[:2], "a,b,c", *lines[3:]]) + "\n")
    (finding,) = amiss(jobs.check(recording))
    assert finding.where == "marks.csv" and finding.says.startswith("line 3: 'a,b,c' is not id")


def test_no_recording_at_all(tmp_path):
    with pytest.raises(BenchsimError, match=r"no recording\.toml"):
        jobs.check(tmp_path)


def test_an_effect_that_does_not_exist_is_named_before_it_is_diagnosed(recording):
    (recording / "recording.toml").open("a").write("\n[effects.pivot-ofset]\ndr = 1.0\n")
    result = jobs.check(recording)
    assert not result.usable
    (found,) = amiss(result)
    assert found.where == "effects.pivot-ofset" and "nearest name is pivot-offset" in found.says


def test_a_file_of_another_name_is_what_is_to_be_mended(recording):
    (recording / "recording.toml").rename(recording / "mine.toml")
    spoilt = recording / "mine.toml"
    spoilt.write_text(spoilt.read_text().replace("wavelength_nm = 632.8", 'wavelength_nm = "?"'))
    assert jobs.check(spoilt).summary().endswith(f"mend {spoilt} or the pictures, then benchsim check {spoilt}")
