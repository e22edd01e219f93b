"""Bad input through the commands: one sentence with file, key or image and the mend, and nothing half-written."""

import os
import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchsim import jobs
from benchsim.bench.errors import BenchsimError

IMAGE, DARK = "001.png", "001-dark.png"


def counts(folder, name=IMAGE):
    return cv2.imread(str(folder / name), cv2.IMREAD_UNCHANGED)


def save(folder, picture, name=IMAGE):
    assert cv2.imwrite(str(folder / name), picture)


def edit(folder, old, new):
    file = folder / "recording.toml"
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


def edit_marks(folder, change):
    """Rewrite every row (id, y, z, side) of the marks; rows for which ``change`` gives None are dropped."""
    header, *rows = (folder / "marks.csv").read_text().splitlines()
    new = [change(int(i), float(y), float(z), float(side)) for i, y, z, side in (row.split(",") for row in rows)]
    lines = [header, *(",".join(map(str, row)) for row in new if row is not None)]
    (folder / "marks.csv").write_text("\n".join(lines) + "\n")


def truncate(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def each(folder, change):
    for name in (IMAGE, DARK):
        save(folder, np.ascontiguousarray(change(counts(folder, name))), name)


def line_of_light(folder, start, end):
    """A trace drawn where there is none: the dark picture with a bright line."""
    picture = counts(folder, DARK)
    cv2.line(picture, start, end, 60000, 2)
    save(folder, picture)


def one_channel_more(folder):
    save(folder, counts(folder).astype(np.float32), "x.tiff")
    edit(folder, f'"{IMAGE}"', '"x.tiff"')


def half_a_jpeg(folder):
    save(folder, (counts(folder) >> 8).astype(np.uint8), "x.jpg")
    truncate(folder / "x.jpg")
    edit(folder, f'"{IMAGE}"', '"x.jpg"')


def noise_alone(folder):
    picture = np.random.default_rng(1).normal(5000, 100, counts(folder).shape)
    save(folder, picture.astype(np.uint16))


MISSES = "mirror_position_mm = [1500.0, -160.0, -1430.0]"

SPOILT = {
    # what is done to the recording, and words that the sentence must hold
    "image missing": (lambda f: (f / IMAGE).unlink(), ["exposure[1].image", IMAGE, "not there"]),
    "image truncated": (lambda f: truncate(f / IMAGE), [IMAGE, "truncated"]),
    "image is text": (lambda f: (f / IMAGE).write_text("a picture"), [IMAGE, "not an image"]),
    "image is a GIF": (lambda f: (f / IMAGE).write_bytes(b"GIF89a" + bytes(100)), [IMAGE, "not an image"]),
    "image empty": (lambda f: (f / IMAGE).write_bytes(b""), [IMAGE, "empty"]),
    "image is a folder": (lambda f: edit(f, f'"{IMAGE}"', '"."'), ["exposure[1].image", "not a file"]),
    "half a JPEG": (half_a_jpeg, ["x.jpg", "truncated"]),
    "pixels in floating point": (one_channel_more, ["x.tiff", "float32", "16 bit"]),
    "image of another size": (lambda f: save(f, counts(f)[:-10]), [IMAGE, "1000 × 740", "resolution_px"]),
    "image of another depth": (lambda f: save(f, (counts(f) >> 8).astype(np.uint8)), [IMAGE, "8 bit", "bit_depth"]),
    "image black": (lambda f: save(f, np.full_like(counts(f), 800)), [IMAGE, "black"]),
    "image grey": (lambda f: save(f, np.full_like(counts(f), 30000)), [IMAGE, "uniform"]),
    "image white": (lambda f: save(f, np.full_like(counts(f), 65535)), [IMAGE, "100 %", "saturated"]),
    "board saturated": (
        lambda f: save(f, np.minimum(counts(f).astype(float) * 40, 65535).astype(np.uint16)),
        [IMAGE, "marks", "overexposed"],
    ),
    "noise alone": (noise_alone, [IMAGE]),
    "dark missing": (lambda f: (f / DARK).unlink(), ["exposure[1].dark", DARK, "not there"]),
    "dark of another size": (lambda f: save(f, counts(f, DARK)[:, 10:], DARK), [DARK, "990 × 750"]),
    "dark of another depth": (lambda f: save(f, (counts(f) >> 8).astype(np.uint8), DARK), [DARK, "8 bit"]),
    "dark is the image": (lambda f: save(f, counts(f), DARK), [IMAGE, "no trace"]),
    "trace absent": (lambda f: save(f, counts(f, DARK)), [IMAGE, "no trace", "laser"]),
    "trace off the screen": (lambda f: line_of_light(f, (100, 100), (150, 700)), [IMAGE, "no trace", "off the screen"]),
    "trace of a few pixels": (lambda f: line_of_light(f, (500, 375), (503, 380)), [IMAGE, "profiles", "needed"]),
    "lens that folds the picture": (
        lambda f: edit(f, "distortion = [-0.08", "distortion = [-80.0"),
        [IMAGE, "lens of camera A", "distortion"],
    ),
    "marks missing": (lambda f: (f / "marks.csv").unlink(), ["marks.csv", "not there"]),
    "two marks": (
        lambda f: edit_marks(f, lambda i, *r: (i, *r) if i < 2 else None),
        [IMAGE, "2 marks", "3 are needed"],
    ),
    "marks mirrored in the file": (
        lambda f: edit_marks(f, lambda i, y, z, s: (i, -y, z, s)),
        [IMAGE, "behind"],
    ),
    "marks in inches": (lambda f: edit_marks(f, lambda i, y, z, s: (i, y / 25.4, z / 25.4, s)), [IMAGE, "fit no pose"]),
    "marks of another board": (lambda f: edit_marks(f, lambda i, *r: (i + 100, *r)), [IMAGE, "not the board's"]),
    "picture mirrored": (lambda f: each(f, lambda p: p[:, ::-1]), [IMAGE, "none of the board's marks", "mirrored"]),
    "laser below the horizon": (
        lambda f: edit(f, "laser_elevation_deg = 50.0", "laser_elevation_deg = -5.0"),
        ["exposure[1].laser_elevation_deg", "below the horizon"],
    ),
    "laser behind the mirror": (
        lambda f: (
            edit(f, "[1500.0, -160.0, -1430.0]", "[1500.0, 1600.0, 0.0]")
            or edit(f, "laser_azimuth_deg = 101.0", "laser_azimuth_deg = 315.0")
            or edit(f, "laser_elevation_deg = 50.0", "laser_elevation_deg = 0.5")
        ),
        ["exposure[1].laser_azimuth_deg", "behind"],
    ),
    "mirror behind the screen": (
        lambda f: edit(f, "[1500.0, -160.0", "[-1500.0, -160.0"),
        ["exposure[1].mirror_position_mm", "x > 0"],
    ),
    "mirror far to the side": (
        lambda f: edit(f, "[1500.0, -160.0, -1430.0]", "[1500.0, -6000.0, -1430.0]"),
        [IMAGE, "mirror", "position"],
    ),
    "saturation level below black": (
        lambda f: edit(f, "saturation_level = 65535.0", "saturation_level = 500.0"),
        ["cameras.A.saturation_level", "black_level"],
    ),
    "unknown key": (lambda f: edit(f, "focal_px", "focal_mm"), ["cameras.A.focal_mm", "unknown"]),
    "TOML empty": (lambda f: (f / "recording.toml").write_text(""), ["recording.toml", "required"]),
    "TOML missing": (lambda f: (f / "recording.toml").unlink(), ["recording.toml", "no recording"]),
    "no image for one of two": (
        lambda f: (f / "recording.toml").write_text(
            (f / "recording.toml").read_text()
            + '\n[[exposure]]\ncamera = "A"\nsetting = "x"\nlaser_azimuth_deg = 101.0\nlaser_elevation_deg = 50.0\n'
            + MISSES
            + "\n"
        ),
        ["exposure[2].image", "missing"],
    ),
    "image named twice": (
        lambda f: (f / "recording.toml").write_text(
            (f / "recording.toml").read_text()
            + f'\n[[exposure]]\nimage = "{IMAGE}"\ncamera = "A"\nsetting = "x"\nlaser_azimuth_deg = 101.0\n'
            + f"laser_elevation_deg = 50.0\n{MISSES}\n"
        ),
        ["exposure[2].image", "already"],
    ),
}


def complaint(job, *args, **options):
    """The one sentence that a job complains with."""
    with pytest.raises(BenchsimError) as caught:
        job(*args, **options)
    sentence = str(caught.value)
    assert "\n" not in sentence and len(sentence) < 450, sentence
    assert re.search(r"; |: (write|choose) |, but (needs|camera)", sentence), f"no mend: {sentence}"
    return sentence


def entries(folder):
    return sorted(p.name for p in folder.iterdir())


@pytest.mark.parametrize("case", SPOILT)
def test_a_spoilt_recording_gets_one_sentence(case, recording, tmp_path):
    spoil, words = SPOILT[case]
    spoil(recording)
    before = entries(recording)
    sentence = complaint(jobs.run, recording, tmp_path / "out")
    for word in words:
        assert word in sentence, sentence
    assert entries(tmp_path) == ["recording"], "nothing is written, no temporary folder stays"
    assert entries(recording) == before


@pytest.mark.parametrize("job", ["fit", "validate"])
def test_fit_and_validate_need_images(job, small_bench, tmp_path):
    sentence = complaint(getattr(jobs, job), small_bench, tmp_path / "out")
    assert "exposure[1].image" in sentence and "benchsim render" in sentence
    assert entries(tmp_path) == []


def test_an_image_alone_is_told_what_it_needs(rendered, tmp_path):
    sentence = complaint(jobs.fit, rendered / IMAGE, tmp_path / "out")
    assert all(word in sentence for word in (IMAGE, "recording.toml", "marks.csv", "--pixels"))


@pytest.mark.parametrize("job", ["run", "validate", "render"])
def test_an_image_in_place_of_a_recording(job, rendered, tmp_path):
    assert "TOML" in complaint(getattr(jobs, job), rendered / IMAGE, tmp_path / "out")
    assert entries(tmp_path) == []


def test_pixels_takes_an_image_only(recording, tmp_path):
    assert "--pixels takes one image" in complaint(jobs.fit, recording, tmp_path / "out", pixels=True)
    assert "no such image" in complaint(jobs.fit, tmp_path / "no.png", tmp_path / "out", pixels=True)
    (tmp_path / "text.png").write_text("a picture")
    assert "not an image" in complaint(jobs.fit, tmp_path / "text.png", tmp_path / "out", pixels=True)
    save(tmp_path, np.zeros((300, 400), np.uint8), "black.png")
    assert "black" in complaint(jobs.fit, tmp_path / "black.png", tmp_path / "out", pixels=True)
    assert entries(tmp_path) == ["black.png", "recording", "text.png"]


@pytest.mark.parametrize(
    "change", ["", "canting", "canting=1", "canting.pyr", "canting.pyr=", "canting.pyr=x", ".pyr=1", "canting.pyr=nan"]
)
def test_an_effect_that_does_not_read(change, small_bench, tmp_path):
    sentence = complaint(jobs.render, small_bench, tmp_path / "out", effects=[change])
    assert "--effect" in sentence and "NAME.PARAMETER=VALUE" in sentence
    assert entries(tmp_path) == []


def test_an_unknown_effect_is_named(small_bench, tmp_path):
    sentence = complaint(jobs.render, small_bench, tmp_path / "out", effects=["warp-drive.speed=9"])
    assert "warp-drive" in sentence
    assert entries(tmp_path) == []


def test_an_unknown_variant_is_named(small_bench, tmp_path):
    sentence = complaint(jobs.render, small_bench, tmp_path / "out", variant="abacus_rgb")
    assert "abacus_rgb" in sentence and "llvm_ad_mono" in sentence
    assert entries(tmp_path) == []


@pytest.mark.parametrize("job", ["run", "fit", "validate", "render"])
def test_a_folder_of_somebody_elses_is_refused(job, recording, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "precious.txt").write_text("mine")
    assert "not empty" in complaint(getattr(jobs, job), recording, out)
    assert entries(out) == ["precious.txt"]


def test_a_recording_is_never_its_own_output(recording):
    """``render`` wrote the folder and would replace it: a recording that is being rendered anew holds its own input."""
    before = entries(recording)
    assert "holds the input" in complaint(jobs.render, recording, recording)
    assert "not empty" in complaint(jobs.run, recording, recording)
    assert entries(recording) == before


def test_a_file_where_the_folder_should_be(recording, tmp_path):
    (tmp_path / "out").write_text("a file")
    assert "is a file" in complaint(jobs.run, recording, tmp_path / "out")
    assert "cannot be written" in complaint(jobs.run, recording, tmp_path / "out" / "below")
    assert (tmp_path / "out").read_text() == "a file"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_may_not_be_written(recording, tmp_path):
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o500)
    assert "ermission" in complaint(jobs.run, recording, locked / "out")


def shell(*args, cwd):
    """The console script in a process of its own, its output in pipes."""
    script = Path(sys.executable).with_name("benchsim")
    command = [str(script)] if script.exists() else [sys.executable, "-m", "benchsim"]
    return subprocess.run([*command, *map(str, args)], cwd=cwd, capture_output=True, text=True, timeout=120)


@pytest.mark.parametrize(
    "args, word",
    [
        (["run", "nowhere.toml"], "nowhere.toml"),
        (["fit", "recording/001.png"], "--pixels"),
        (["render", "recording", "--effect", "canting"], "--effect canting"),
        (["validate", "recording", "-o", "/proc/benchsim"], "/proc/benchsim"),
        (["run", "recording", "-o", "recording"], "not empty"),
    ],
)
def test_the_console_script_says_one_line_and_exits_1(args, word, recording):
    done = shell(*args, cwd=recording.parent)
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr.startswith("benchsim: ") and done.stderr.count("\n") == 1 and word in done.stderr
    assert entries(recording.parent) == ["recording"]


@pytest.mark.parametrize(
    "args",
    [
        ["fly"],
        ["fit"],
        ["run", "--colour"],
        ["render", "x.toml", "--seed", "one"],
        ["render", "x.toml", "--seed", "-1"],
    ],
)
def test_usage_errors_exit_2(args, tmp_path):
    done = shell(*args, cwd=tmp_path)
    assert done.returncode == 2
    assert "Usage" in done.stderr and "Traceback" not in done.stderr
    assert entries(tmp_path) == []
