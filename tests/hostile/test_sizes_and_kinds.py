"""Files from strangers: nothing that is read hangs or eats the machine, and what is refused is told in one sentence."""

import json
import os
import resource
import shutil
import struct
import subprocess
import sys
import time
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from benchsim.bench import reading, schema
from benchsim.bench.errors import BenchsimError
from benchsim.bench.files import complaints, read
from benchsim.bench.marks import read_marks
from benchsim.bench.reading import MIB, load_json
from benchsim.bench.toml_file import load_toml
from benchsim.calibration import is_camera, read_camera
from benchsim.cli import app
from benchsim.instruments.mount import pointing, stated
from benchsim.instruments.mount.json_values import load
from benchsim.instruments.mount.mark_templates import read_templates
from benchsim.plant import files as plants
from benchsim.trace import extract_pixels
from benchsim.trace.counts import read_counts

READERS = {
    "toml": load_toml,
    "recording": read,
    "keys": complaints,
    "camera": read_camera,
    "marks": read_marks,
    "json": load_json,
    "PAINT": load,
    "pointing": pointing.read,
    "picture": read_counts,
    "ridge": extract_pixels,
}


def sentence(reader, path):
    start = time.process_time()  # what else the machine does is no fault of the reader
    with pytest.raises(BenchsimError) as caught:
        reader(path)
    assert time.process_time() - start < 2
    assert str(caught.value).isprintable() and path.name in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("name", READERS)
def test_pipes_and_devices_are_refused_at_once(name, tmp_path):
    os.mkfifo(tmp_path / "pipe.png")
    assert "ordinary file" in sentence(READERS[name], tmp_path / "pipe.png")
    (tmp_path / "zero.png").symlink_to("/dev/zero")
    assert "ordinary file" in sentence(READERS[name], tmp_path / "zero.png")


@pytest.mark.parametrize("name", READERS)
def test_a_file_of_absurd_size_is_refused_unread(name, tmp_path):
    with (tmp_path / "large.png").open("wb") as file:
        file.truncate(2**40)
    assert "MiB" in sentence(READERS[name], tmp_path / "large.png")


def test_what_only_looks_whether_a_file_is_its_own_waits_for_no_pipe(tmp_path):
    os.mkfifo(tmp_path / "a.toml")
    for looks in (pointing.recognises, stated.recognises, is_camera):
        assert not looks(tmp_path / "a.toml")


@pytest.mark.parametrize("command", ["run", "fit", "validate", "diagnose", "check", "render", "fit --pixels"])
def test_a_command_given_a_pipe_says_one_sentence(command, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    done = CliRunner().invoke(app, [*command.split(), str(tmp_path / "pipe")])
    assert done.exit_code == 1 and done.output.startswith("benchsim: ") and done.output.count("\n") == 1


def png(width, height):
    """A whole picture of zeros, some kilobytes."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packer = zlib.compressobj(9)
    rows = b"".join(packer.compress(bytes(2 * width + 1)) for _ in range(min(height, 100))) + packer.flush()
    header = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def tiff(width, height):
    entries = [(256, 4, width), (257, 4, height), (258, 3, 16), (259, 3, 1), (262, 3, 1), (273, 4, 8), (277, 3, 1)]
    entries += [(278, 4, height), (279, 4, 8)]
    body = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in entries)
    return b"II*\0" + struct.pack("<IH", 8, len(entries)) + body + bytes(4)


def jpeg(width, height):
    whole = cv2.imencode(".jpg", np.zeros((16, 16), np.uint8))[1].tobytes()
    at = whole.index(b"\xff\xc0") + 5
    return whole[:at] + struct.pack(">HH", height, width) + whole[at + 4 :]


def test_many_heliostats_at_one_place_are_one_sentence(tmp_path):
    """Forty thousand: pairs of them would take as many steps as there are pairs."""
    shutil.copytree(Path(__file__).parent / "corpus" / "plant-soltrace", tmp_path / "plant")
    (tmp_path / "plant" / "layout.csv").write_text("1,10,60,1,0,0,30,0,r,5,6\n" * 40_000)
    start = time.process_time()
    with pytest.raises(BenchsimError, match=r"layout.csv: 2 and another stand 0 m apart"):
        plants.read(tmp_path / "plant" / "plant.toml")
    assert time.process_time() - start < 2.0


@pytest.mark.parametrize("made", [png, tiff, jpeg])
@pytest.mark.parametrize("side", [8000, 16000])
def test_a_small_file_of_many_pixels_is_not_unpacked(made, side, tmp_path):
    (tmp_path / "p.png").write_bytes(made(side, side))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert "50 million pixels" in sentence(read_counts, tmp_path / "p.png")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000


@pytest.mark.parametrize("suffix", ["png", "tif", "jpg"])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [(), (3,)])
def test_pictures_of_every_kind_are_read_as_they_are(suffix, kind, channels, tmp_path):
    if suffix == "jpg" and kind is np.uint16:
        return
    counts = np.full((20, 30, *channels), 77, kind)
    cv2.imwrite(str(tmp_path / f"a.{suffix}"), counts)
    assert np.array_equal(read_counts(tmp_path / f"a.{suffix}")[0], counts)


def test_templates_of_marks_are_read_alike(tmp_path):
    for corner in ("left_top", "right_top", "left_bottom", "right_bottom"):
        (tmp_path / f"sta_{corner}.png").write_bytes(png(16000, 16000))
    with pytest.raises(BenchsimError, match="pixels"):
        read_templates(tmp_path, "sta", ("left_top", "right_top", "left_bottom", "right_bottom"))


MINIMAL = (Path(__file__).parent / "corpus" / "recording" / "recording.toml").read_text()
EXPOSURE = MINIMAL[MINIMAL.index("[[exposure]]") :].replace("001.png", "{}.png")

TOMLS = {
    "exposures": ("MiB", "".join(EXPOSURE.format(k) for k in range(100_000))),
    "bare exposures": ("2000", "[[exposure]]\n" * 70_000),
    "exposures in brackets": ("2000", f"exposure = [{'{},' * 100_000}]"),
    "digits": ("digits", f"title = {'1' * 5000}"),
    "hexadecimal digits": ("64 bits", f"title = 0x{'f' * 5000}"),
    "more than 64 bits": ("64 bits", "time_s = 18446744073709551616"),
    "brackets": ("nest", f"title = {'[' * 100_000}"),
    "closed brackets": ("nests", f"title = {'[' * 200}{']' * 200}"),
    "tables in braces": ("nest", f"title = {'{a=' * 50_000}"),
    "dotted keys": ("nests", f"{'a.' * 3000}a = 1"),
    "dotted tables": ("nests", f"[{'a.' * 3000}a]"),
}


@pytest.mark.parametrize("case", TOMLS)
def test_a_recording_that_is_too_much_is_refused_in_two_seconds(case, tmp_path):
    word, text = TOMLS[case]
    (tmp_path / "recording.toml").write_text(text)
    said = sentence(read, tmp_path / "recording.toml")
    if word == "2000":
        assert any(key == "exposure" and word in mend for key, mend in complaints(tmp_path))
    else:
        assert word in said


JSONS = {
    "brackets": "[" * 1_000_000,
    "objects": '{"a":' * 1_000_000,
    "closed brackets": "[" * 100_000 + "]" * 100_000,
    "digits": f'{{"a": {"1" * 5000}}}',
    "not UTF-8": "\udcff",
    "no JSON": "{",
}


@pytest.mark.parametrize("case", JSONS)
@pytest.mark.parametrize("reader", [load, load_json])
def test_json_that_cannot_be_read_is_one_sentence(case, reader, tmp_path):
    (tmp_path / "a.json").write_bytes(JSONS[case].encode(errors="surrogateescape"))
    assert len(sentence(reader, tmp_path / "a.json")) < 400


def test_a_diagnosis_given_nested_json_says_one_sentence(tmp_path):
    (tmp_path / "1-calibration-properties.json").write_text("[" * 100_000)
    (tmp_path / "1-heliostat-properties.json").write_text(json.dumps({"a": 1}))
    done = CliRunner().invoke(app, ["diagnose", str(tmp_path), "-o", str(tmp_path / "out")])
    assert done.exit_code == 1 and done.output.count("\n") == 1, done.output


def test_what_may_be_read_is_what_the_page_says():
    page = Path(reading.__file__).with_name("README.md").read_text(encoding="utf-8")
    said = page.split("## What is too large")[1].split("## ")[0]
    for number in (reading.TOML_BYTES, reading.TABLE_BYTES, reading.JSON_BYTES, reading.PICTURE_BYTES):
        assert f"{number // MIB} MiB" in said
    assert f"{schema.MOST_EXPOSURES} exposures" in said and f"{reading.MOST_PIXELS // 10**6} million" in said


def test_a_variable_raises_the_limits(tmp_path):
    (tmp_path / "p.png").write_bytes(png(8000, 8000))
    (tmp_path / "001.png").write_bytes(b"not looked at here")
    marks = (Path(__file__).parent / "corpus" / "recording" / "marks.csv").read_text()
    (tmp_path / "marks.csv").write_text(marks)
    (tmp_path / "recording.toml").write_text(MINIMAL + EXPOSURE.replace('image = "{}.png"', "") * 2500)
    tries = (
        "import sys\nfrom pathlib import Path\nfrom benchsim.bench.errors import BenchsimError\n"
        "from benchsim.bench.files import read\nfrom benchsim.trace.counts import read_counts\n"
        "for name, reader in (('recording.toml', read), ('p.png', read_counts)):\n"
        "    try:\n        reader(Path(sys.argv[1]) / name)\n"
        "    except BenchsimError as error:\n        print(error)\n"
    )
    said = {}
    for factor in ("1", "2", "none"):
        said[factor] = subprocess.run(
            [sys.executable, "-c", tries, str(tmp_path)], env={**os.environ, reading.RAISE: factor},
            stdout=subprocess.PIPE, text=True, check=True,
        ).stdout  # fmt: skip
    assert "2000" in said["1"] and "50 million" in said["1"] and said["none"] == said["1"]
    assert said["2"] == "p.png: truncated or damaged; copy the image again\n"
