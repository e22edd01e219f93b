"""Files from strangers: names that no file can have, and what a picture says of itself that is no number."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from benchsim.bench.errors import BenchsimError
from benchsim.bench.marks import read_marks
from benchsim.calibration.exif import lens_tags
from benchsim.cli import app
from benchsim.intake.photo import read_photo

LONG = "x" * 300
ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("name", [LONG + ".png", "a/" * 3000 + "b", "a\\u0000.png"])
@pytest.mark.parametrize("key", ["image", "marks"])
def test_a_name_that_no_file_can_have_is_one_finding(key, name, tmp_path):
    text = (ROOT / "scenes" / "fig7a.toml").read_text(encoding="utf-8")
    old, new = ('camera = "A"', f'camera = "A"\nimage = "{name}"') if key == "image" else ("marks.csv", name)
    (tmp_path / "recording.toml").write_text(text.replace(old, new))
    (tmp_path / "marks.csv").write_bytes((ROOT / "scenes" / "marks.csv").read_bytes())
    for command in ("fit", "check"):
        done = CliRunner().invoke(app, [command, str(tmp_path)])
        assert done.exit_code == 1 and isinstance(done.exception, SystemExit)
        assert key in done.output and len(done.output) < 1000


@pytest.mark.parametrize("command", ["run", "fit", "validate", "diagnose", "check", "render", "report"])
def test_a_name_too_long_on_the_command_line_is_one_sentence(command):
    done = CliRunner().invoke(app, [command, LONG])
    assert done.exit_code == 1 and isinstance(done.exception, SystemExit) and done.output.count("\n") == 1


@pytest.mark.parametrize("row", ["0\0,1,2,3", "0,1\0,2,3", "1" * 5000 + ",1,2,3", "0,1e308,2,3", "0,nan,2,3"])
def test_a_mark_that_is_none_is_told_by_its_line(row, tmp_path):
    (tmp_path / "marks.csv").write_text(f"id,y_mm,z_mm,side_mm\n{row}\n")
    with pytest.raises(BenchsimError, match=r"marks\.csv: line 2: ") as caught:
        read_marks(tmp_path / "marks.csv")
    assert len(str(caught.value)) < 200


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("value", ["NaN", "x", "0", 0, 9, 65535, "\0", "6x", (6, 1)])
@pytest.mark.parametrize("tag", [0x0112, 0x0110, 0x010F])
def test_whatever_exif_says_a_picture_is_read(tag, value, tmp_path):
    exif = Image.Exif()
    exif[tag] = value
    try:
        Image.fromarray(np.full((60, 80), 90, np.uint8)).save(tmp_path / "p.jpg", exif=exif)
    except Exception:
        pytest.skip("cannot be written")
    photo, counts = read_photo(tmp_path / "p.jpg")
    assert counts.shape == (60, 80) and isinstance(photo.orientation, int) and photo.model.isprintable()
    assert lens_tags(tmp_path / "p.jpg") == {}
