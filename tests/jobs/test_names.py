"""Files from strangers: what a name in a file may do to a terminal, a table, a picture, or the names of files.

The names are those of `NASTY`: they steer a terminal, break a line, turn one round, start a program in a spreadsheet,
lead into another folder, or begin a formula of a picture's text.
"""

import csv
import json
import os
import re
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from benchsim import cli, jobs
from benchsim.bench.errors import BenchsimError
from benchsim.bench.files import read
from benchsim.bench.names import cell, file_name, printable
from benchsim.bench.writing import write_csv
from benchsim.jobs.output import default_folder
from benchsim.reports import pictures

NASTY = (
    "\x1b]0;title\x07", "\x1b[2J\x1b[1;1H", "a\nverdict: nothing-missing", "a\r", "\u202egnp.exe", "\x9b31m",
    "a\u2028b", "\udcff", "=cmd|' /C calc'!A0", "+1", "-2", "@SUM(A1)", "＝1", "../../x", "a/b", "..", ".hidden", "-rf",
    "javascript:x", "", "x" * 400, "漢" * 200, r"$\foo{$",
)  # fmt: skip


@pytest.mark.parametrize("name", NASTY)
def test_what_is_printed_is_one_line_that_does_nothing(name):
    told = printable(name)
    assert told.isprintable() and "\n" not in told
    assert printable(told) == told
    assert str(BenchsimError(f"file: {name}: mend it")).isprintable()


def test_ordinary_names_are_left_as_they_are():
    for name in ("001.png", "Wände bei Nacht — 3.png", "AA39", "日本", "night 2 (b)", "a\u00a0b", "r = 5 µm ± 2"):
        assert printable(name) == name == file_name(name) == cell(name)
    assert printable("two\nlines\x1b", breaks="\n") == "two\nlines\\x1b"


@pytest.mark.parametrize("name", NASTY)
def test_no_cell_of_a_table_is_a_formula_or_a_second_row(name, tmp_path):
    write_csv(tmp_path / "t.csv", ("id", "x", "y"), [(name, -1.25, None), ("b", np.float64(-2e-9), -3)], 3)
    head, first, second = csv.reader((tmp_path / "t.csv").read_text(encoding="utf-8").splitlines())
    assert head == ["id", "x", "y"] and first[1:] == ["-1.25", ""] and second == ["b", "-2e-09", "-3"]
    assert not first[0].startswith(("=", "+", "-", "@", "\t", "\r", "＝"))


@pytest.mark.parametrize("name", NASTY)
def test_a_name_makes_a_file_in_its_folder_that_is_seen_and_is_no_option(name, tmp_path):
    made = file_name(name)
    assert made and os.path.basename(made) == made and not made.startswith((".", "-")) and ":" not in made
    (tmp_path / f"overlay-{made}.png").write_bytes(b"")
    assert len(os.listdir(tmp_path)) == 1 and file_name(made) == made


def test_a_command_prints_nothing_that_steers_the_terminal(monkeypatch, tmp_path):
    evil = "\x1b]0;x\x07\u202e"

    def job(**_):
        return SimpleNamespace(summary=lambda: f"first {evil}\nsecond")

    monkeypatch.setattr(jobs, "fit", job)
    assert CliRunner().invoke(cli.app, ["fit", str(tmp_path)]).output == "first \\x1b]0;x\\x07\\u202e\nsecond\n"

    def fails(**_):
        raise BenchsimError(f"{evil}\nagrees")

    monkeypatch.setattr(jobs, "fit", fails)
    output = CliRunner().invoke(cli.app, ["fit", str(tmp_path)]).output
    assert output.count("\n") == 1 and output.strip().isprintable()


KEYS = {
    "title": 'title = "{}"',
    "cameras": '[cameras."{}"]',
    "exposure[1].image": '[[exposure]]\nimage = "{}"',
    "exposure[1].setting": '[[exposure]]\nsetting = "{}"',
    "effects": '[effects."{}"]',
}


@pytest.mark.parametrize("escaped", ["\\u001b[31m", "a\\nb", "\\u202e"])
@pytest.mark.parametrize("key", KEYS)
def test_a_recording_whose_names_steer_is_refused_with_file_and_key(key, escaped, tmp_path):
    (tmp_path / "recording.toml").write_text('format = "benchsim-recording/1"\n' + KEYS[key].format(escaped))
    with pytest.raises(BenchsimError, match=rf"recording\.toml: {re.escape(key)}.*control character") as caught:
        read(tmp_path)
    assert str(caught.value).isprintable()


def test_the_folder_of_a_command_has_a_plain_name(tmp_path):
    for name, made in (("-rf\x1b", "_rf_-fit"), ("night 2", "night 2-fit")):
        (tmp_path / name).mkdir()
        assert str(default_folder(tmp_path / name, "fit")) == made


def test_what_a_camera_says_of_itself_writes_no_line_into_a_recording(tmp_path):
    """EXIF's model with a line break, then a table of its own."""
    from PIL import Image

    exif = Image.Exif()
    exif[0x0110] = "phone\n[effects.canting]\npyr = 1.0\n# \x1b[2J"
    for k in range(2):
        picture = Image.fromarray(np.full((60, 80), 90 + k, np.uint8))
        picture.save(tmp_path / f"IMG_{k}.jpg", exif=exif)
    jobs.new(tmp_path / "made", [tmp_path])
    text = (tmp_path / "made" / "recording.toml").read_text()
    assert "phone" in text and "\n[effects" not in text and text.replace("\n", "").isprintable()


def test_heliostats_whose_names_are_no_names_of_folders_are_refused(tmp_path):
    for name in ("javascript:x", "a\x1b[2J"):
        folder = tmp_path / str(len(name)) / name
        folder.mkdir(parents=True)
        (folder / "1-calibration-properties.json").write_text(json.dumps({}))
        with pytest.raises(BenchsimError, match="rename the folder") as caught:
            jobs.field(folder.parent, tmp_path / "out", workers=0)
        assert str(caught.value).isprintable()


def test_a_dollar_in_a_name_is_drawn_as_one(tmp_path):
    light = np.linspace(0, 1, 2400).reshape(40, 60)
    none = np.zeros((0, 4, 2))
    pictures.overlay(tmp_path / "p.png", light, none, np.ones((3, 2)), None, None, r"$\foo{$ and $x$")
    assert (tmp_path / "p.png").stat().st_size > 0
