"""The recording format: what is read is what was written, defaults are listed, and bad input gets one sentence."""

import math
from dataclasses import replace
from pathlib import Path

import pytest

from benchsim.bench.errors import BenchsimError
from benchsim.bench.files import read, write

SCENES = Path(__file__).resolve().parents[2] / "scenes"
SHARED = Path(__file__).resolve().parents[3] / "shared" / "recordings" / "bench-other-code"

CORPUS = Path(__file__).resolve().parents[1] / "hostile" / "corpus" / "recording"
MINIMAL, MARKS = ((CORPUS / name).read_text() for name in ("recording.toml", "marks.csv"))


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "recording.toml").write_text(MINIMAL)
    (tmp_path / "marks.csv").write_text(MARKS)
    (tmp_path / "001.png").write_bytes(b"not looked at here")
    return tmp_path


def test_a_minimal_recording_takes_the_designs_defaults_and_lists_them(folder):
    r = read(folder)
    assert r.laser.wavelength == pytest.approx(632.8e-6)
    assert (r.laser.beam_diameter, r.laser.divergence) == (10.0, pytest.approx(4e-3))
    assert (r.mirror.facets, r.mirror.diameter, r.mirror.height) == (12, 35.0, 2.0)
    assert r.mirror.radius == pytest.approx(17.5 * math.cos(math.pi / 12))
    assert r.physics.facets and r.physics.beam and r.physics.diffraction
    assert r.uncertainty.mirror_axis == pytest.approx(1.745e-3)
    assert r.cameras["A"].saturation_level == 65535
    assert r.exposures[0].laser_azimuth == pytest.approx(math.radians(101))
    for line in (
        "laser.wavelength_nm = 632.8",
        "screen.size_mm = [700.0, 700.0]",
        "cameras.A.gamma = 1.0",
        "cameras.A.saturation_level = 65535",
        "uncertainty.divergence_fraction = 0.005",
        "exposure[1].time_s = 0.0",
    ):
        assert line in r.defaults_used
    assert not any(line.startswith(("cameras.A.focal_px", "exposure[1].setting")) for line in r.defaults_used)


@pytest.mark.parametrize("name", ["fig7a", "fig7b", "campaign12"])
def test_scenes_survive_a_round_trip(name, tmp_path):
    r = read(SCENES / f"{name}.toml")
    write(r, tmp_path / "recording.toml", render=True)
    again = read(tmp_path)
    assert replace(again, path=r.path, defaults_used=()) == replace(r, defaults_used=())


def test_render_options_never_travel_into_a_recording(tmp_path):
    r = read(SCENES / "fig7a.toml")
    write(replace(r, render=replace(r.render, seed=4711)), tmp_path / "recording.toml")
    assert "render" not in (tmp_path / "recording.toml").read_text()
    assert "4711" not in (tmp_path / "recording.toml").read_text()


def test_campaign12_is_diverse():
    """Twelve settings: suns, mirror positions, two cameras, screen moved and rolled, one setting repeated later."""
    e = read(SCENES / "campaign12.toml").exposures
    assert len(e) == 12
    assert len({x.camera for x in e}) == 2
    assert len({(x.laser_azimuth, x.laser_elevation) for x in e}) >= 8
    assert len({x.mirror_position for x in e}) >= 8
    assert len({x.screen_shift for x in e}) >= 2 and len({x.screen_roll for x in e}) >= 2
    names = [x.setting for x in e]
    repeated = [x for x in e if names.count(x.setting) > 1]
    assert repeated and repeated[0].time != repeated[-1].time


@pytest.mark.parametrize("name", ["clean-f7", "known-six"])
def test_recordings_of_other_code_are_read(name):
    if not (SHARED / name).is_dir():
        pytest.skip("the recordings made by other code are not beside this checkout")
    r = read(SHARED / name, images=True)
    assert all(x.image for x in r.exposures) and len(r.screen.marks.ids) == 40


BAD = {
    # what is replaced: (old, new, words that the sentence must hold)
    "unknown key": (
        "focal_px = 210.0",
        "focal_px = 210.0\nfocal_mm = 8.0",
        ["cameras.A.focal_mm", "unknown", "focal_px"],
    ),
    "unknown table": ("[cameras.A]", "[lazer]\nwavelength_nm = 1.0\n[cameras.A]", ["lazer", "unknown", "laser"]),
    "key without unit": (
        "[cameras.A]",
        "[laser]\nbeam_diameter = 10.0\n[cameras.A]",
        ["laser.beam_diameter", "beam_diameter_mm"],
    ),
    "no format": ('format = "benchsim-recording/1"', "", ["format", "required"]),
    "other format": ("recording/1", "recording/9", ["format", "benchsim-recording/1"]),
    "no camera": ("focal_px = 210.0", "", ["cameras.A.focal_px", "required"]),
    "camera not listed": ('camera = "A"', 'camera = "B"', ["exposure[1].camera", "'B'", "A"]),
    "text for a number": (
        "laser_elevation_deg = 50.0",
        'laser_elevation_deg = "50"',
        ["laser_elevation_deg", "number"],
    ),
    "nan": ("focal_px = 210.0", "focal_px = nan", ["cameras.A.focal_px", "nan"]),
    "infinite": ("[99.5, 74.5]", "[inf, 74.5]", ["principal_point_px", "finite"]),
    "nan in a position": ("[1500.0, -160.0, -1430.0]", "[nan, -160.0, -1430.0]", ["mirror_position_mm", "finite"]),
    "too few coordinates": ("[1500.0, -160.0, -1430.0]", "[1500.0, -160.0]", ["mirror_position_mm", "3"]),
    "a number for a list": ("[99.5, 74.5]", "99.5", ["principal_point_px", "brackets"]),
    "fractional pixels": ("[200, 150]", "[200.5, 150]", ["resolution_px", "whole"]),
    "negative focal length": ("focal_px = 210.0", "focal_px = -210.0", ["focal_px", "at least 1"]),
    "wrong bit depth": ("focal_px = 210.0", "focal_px = 210.0\nbit_depth = 12", ["bit_depth", "8"]),
    "elevation in rad or beyond": ("= 50.0", "= 500.0", ["laser_elevation_deg", "at most 90"]),
    "laser below the horizon": ("= 50.0", "= -5.0", ["laser_elevation_deg", "below the horizon"]),
    "laser on the horizon": ("= 50.0", "= 0.0", ["laser_elevation_deg", "below the horizon"]),
    "mirror behind the screen": (
        "[1500.0, -160.0, -1430.0]",
        "[-1500.0, -160.0, -1430.0]",
        ["mirror_position_mm", "x"],
    ),
    "facet that is not there": ('setting = "s1"', 'setting = "s1"\nfacet = 12', ["facet", "11"]),
    "negative facet": ('setting = "s1"', 'setting = "s1"\nfacet = -1', ["facet", "at least 0"]),
    "missing image": ('"001.png"', '"002.png"', ["002.png", "exposure[1].image"]),
    "image is a folder": ('"001.png"', '"."', ["exposure[1].image", "not a file"]),
    "missing dark": ('image = "001.png"', 'image = "001.png"\ndark = "d.png"', ["exposure[1].dark", "d.png"]),
    "no exposure": (MINIMAL[MINIMAL.index("[[exposure]]") :], "", ["exposure", "required"]),
    "not TOML": ("[cameras.A]", "[cameras.A", ["TOML"]),
    "effects without parameters": ("[cameras.A]", "[effects.canting]\n[cameras.A]", ["effects.canting", "empty"]),
    "gamma misspelt": ("focal_px = 210.0", 'focal_px = 210.0\ngamma = "sRGB"', ["gamma"]),
    "saturation below black": (
        "focal_px = 210.0",
        "focal_px = 210.0\nblack_level = 900.0\nsaturation_level = 800.0",
        ["saturation_level", "black_level"],
    ),
    "saturation beyond the bits": (
        "focal_px = 210.0",
        "focal_px = 210.0\nbit_depth = 8\nsaturation_level = 4095.0",
        ["8 bits"],
    ),
    "camera behind the screen": (
        "focal_px = 210.0",
        "focal_px = 210.0\nposition_mm = [-5.0, 0.0, 0.0]",
        ["position_mm"],
    ),
    "camera looks straight down": (
        "focal_px = 210.0",
        "focal_px = 210.0\nposition_mm = [900.0, 0.0, 900.0]\nlook_at_mm = [900.0, 0.0, 0.0]",
        ["look_at_mm"],
    ),
    "expander row": (
        "[cameras.A]",
        '[expander]\nsurfaces = [[1.0, 2.0, 3.0, "BK7"]]\n[cameras.A]',
        ["expander.surfaces[1]"],
    ),
    "fewer than three facets": ("[cameras.A]", "[mirror]\nfacets = 2\n[cameras.A]", ["mirror.facets", "at least 3"]),
    "cylinder with facets": (
        "[cameras.A]",
        '[mirror]\nshape = "cylinder"\n[physics]\nfacets = true\n[cameras.A]',
        ["physics.facets", "cylinder"],
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_gets_one_sentence_with_key_and_mend(case, folder):
    old, new, words = BAD[case]
    text = MINIMAL.replace(old, new)
    assert text != MINIMAL
    (folder / "recording.toml").write_text(text)
    with pytest.raises(BenchsimError) as caught:
        read(folder)
    message = str(caught.value)
    assert message.startswith("recording.toml") and "\n" not in message
    for word in words:
        assert word in message, message


BAD_MARKS = {
    "no header": "0,-318.0,318.0,32.0\n",
    "wrong header": "id,y,z,side\n0,-318.0,318.0,32.0\n",
    "text": "id,y_mm,z_mm,side_mm\nzero,-318.0,318.0,32.0\n",
    "nan": "id,y_mm,z_mm,side_mm\n0,nan,318.0,32.0\n",
    "too few columns": "id,y_mm,z_mm,side_mm\n0,-318.0,318.0\n",
    "no size": "id,y_mm,z_mm,side_mm\n0,-318.0,318.0,0.0\n",
    "twice the same": "id,y_mm,z_mm,side_mm\n0,-318.0,318.0,32.0\n0,318.0,318.0,32.0\n",
    "unknown tag": "id,y_mm,z_mm,side_mm\n9999,-318.0,318.0,32.0\n",
    "none": "id,y_mm,z_mm,side_mm\n",
    "empty file": "",
}


@pytest.mark.parametrize("case", BAD_MARKS)
def test_bad_marks_get_one_sentence_with_file_and_line(case, folder):
    (folder / "marks.csv").write_text(BAD_MARKS[case])
    with pytest.raises(BenchsimError, match=r"marks\.csv: (line \d|no marks)") as caught:
        read(folder)
    assert "\n" not in str(caught.value)


def test_a_name_or_content_with_nul_is_one_printable_sentence(folder):
    (folder / "marks.csv").write_text("id,y_mm,z_mm,side_mm\n0,\x00,318.0,32.0\n")
    with pytest.raises(BenchsimError, match=r"marks\.csv") as caught:
        read(folder)
    assert str(caught.value).isprintable()
    file = folder / "recording.toml"
    file.write_text('screen.marks = "\\u0000.csv"\n' + file.read_text())
    with pytest.raises(BenchsimError, match=r"screen\.marks: .* control character") as caught:
        read(folder)
    assert str(caught.value).isprintable()


def test_missing_files_are_named(folder, tmp_path):
    (folder / "marks.csv").unlink()
    with pytest.raises(BenchsimError, match=r"marks\.csv: not there"):
        read(folder)
    with pytest.raises(BenchsimError, match="no such file"):
        read(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(BenchsimError, match=r"no recording\.toml"):
        read(tmp_path / "empty")


def test_a_recording_needs_images_where_a_bench_does_not(folder):
    text = MINIMAL.replace('image = "001.png"\n', "")
    (folder / "recording.toml").write_text(text)
    assert read(folder).exposures[0].image is None
    with pytest.raises(BenchsimError, match=r"exposure\[1\]\.image: required"):
        read(folder, images=True)


def test_a_binary_file_is_not_a_recording(tmp_path):
    (tmp_path / "x.toml").write_bytes(b"\x89PNG\r\n\x1a\n\xff\xfe")
    with pytest.raises(BenchsimError, match="UTF-8"):
        read(tmp_path / "x.toml")
