"""The page of `check`'s messages: each can be provoked, and every sentence of the code stands on it."""

import ast
import os
import re
import shutil
from datetime import datetime, timedelta
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from benchsim import jobs
from benchsim.bench import reading
from benchsim.bench.errors import BenchsimError

ROOT = Path(__file__).resolve().parents[2]
SAID = [
    says
    for row in re.findall(r"^\| (`.*?) \|", (ROOT / "docs" / "messages.md").read_text(encoding="utf-8"), re.M)
    for says in re.findall(r"`([^`]+)`", row)
]
IMAGE, DARK, LENS = "001.png", "001-dark.png", "resolution_px = [1000, 750]"
FIRST = "[[exposure]]"


def edit(old, new, folder):
    file = folder / "recording.toml"
    text = file.read_text()
    assert old in text, old
    file.write_text(text.replace(old, new, 1))


def add(text, folder):
    """Behind the end of the file: keys of the exposure, or tables."""
    with (folder / "recording.toml").open("a") as file:
        file.write(text + "\n")


def key(line):
    """A key of the exposure."""
    return partial(edit, 'camera = "A"\n', f'camera = "A"\n{line}\n')


def camera(line):
    return partial(edit, LENS, f"{LENS}\n{line}")


def value(name, new):
    """Another value of a key that is there, where it stands last: position and angles are those of the exposure."""

    def change(folder):
        file = folder / "recording.toml"
        before, found, after = file.read_text().rpartition(f"\n{name} = ")
        assert found, name
        file.write_text(f"{before}{found}{new}\n{after.partition(chr(10))[2]}")

    return change


def again(folder, **changes):
    """The exposure once more, with a picture of its own."""
    text = (folder / "recording.toml").read_text()
    table = text[text.index(FIRST) :].replace(f'dark = "{DARK}"\n', "")
    for name, new in {"image": '"2.png"', **changes}.items():
        table = re.sub(rf"^{name} = .*$", f"{name} = {new}", table, flags=re.M)
    add(table, folder)
    shutil.copy(folder / IMAGE, folder / "2.png")


def counts(folder, name=IMAGE):
    return cv2.imread(str(folder / name), cv2.IMREAD_UNCHANGED)


def picture(change, name=IMAGE):
    def spoil(folder):
        assert cv2.imwrite(str(folder / name), np.ascontiguousarray(change(counts(folder, name))))

    return spoil


def body(data, name=IMAGE):
    return lambda folder: (folder / name).write_bytes(data)


def other_image(name, data):
    def spoil(folder):
        (folder / name).write_bytes(data)
        edit(IMAGE, name, folder)

    return spoil


def marks(change):
    """Lines of marks.csv, changed."""

    def spoil(folder):
        lines = (folder / "marks.csv").read_text().splitlines()
        (folder / "marks.csv").write_text("\n".join(change(lines)) + "\n")

    return spoil


def numbers(change):
    """Rows (id, y, z, side) of marks.csv, changed."""

    def rows(lines):
        split = (line.split(",") for line in lines[1:])
        return [lines[0], *(",".join(map(str, change(int(r[0]), *map(float, r[1:])))) for r in split)]

    return marks(rows)


def with_exif(*taken):
    """Photographs of 8 bits with EXIF, one exposure each; ``taken``: what differs, and seconds after nine."""

    def spoil(folder):
        value("bit_depth", 8)(folder)
        value("saturation_level", 255.0)(folder)
        value("black_level", 0.0)(folder)
        edit(f'dark = "{DARK}"\n', "", folder)
        for n, said in enumerate(taken):
            if n:
                again(folder, time_s=60.0 * n)
            name = "2.png" if n else IMAGE
            jpeg(counts(folder), folder / f"{n}.jpg", **said)
            edit(name, f"{n}.jpg", folder)

    return spoil


def jpeg(light, path, seconds=0, **said):
    exif = Image.Exif()
    exif[0x0110] = said.pop("model", "P1")
    own = exif[0x8769] = {}
    own[0x9003] = (datetime(2026, 5, 4, 9) + timedelta(seconds=seconds)).strftime("%Y:%m:%d %H:%M:%S")
    for tag, number in {"time": 0x829A, "focal_35mm": 0xA405, "rendered": 0xA401}.items():
        if tag in said:
            own[number] = said[tag]
    Image.fromarray((light >> 8).astype(np.uint8)).save(path, quality=95, exif=exif)


def dark_exposed_otherwise(folder):
    with_exif({"time": 0.5})(folder)
    jpeg(counts(folder, DARK), folder / "dark.jpg", time=0.1)
    key('dark = "dark.jpg"')(folder)


def far_behind(folder):
    """A mirror far to the west of the screen, and a laser beyond it on the horizon."""
    value("mirror_position_mm", "[1500.0, 1600.0, 0.0]")(folder)
    value("laser_azimuth_deg", 315.0)(folder)
    value("laser_elevation_deg", 0.5)(folder)


def above(height, folder):
    """A mirror so high before the screen's centre, the laser behind it at 45 degrees."""
    value("mirror_position_mm", f"[1000.0, 0.0, {height}]")(folder)
    value("laser_azimuth_deg", 0.0)(folder)
    value("laser_elevation_deg", 45.0)(folder)


def saturated_line(folder):
    line = counts(folder).astype(float) - counts(folder, DARK)
    picture(lambda light: np.where(line > 0.2 * line.max(), np.uint16(65535), light))(folder)


def blurred(folder):
    """Twice as many pixels each way: marks are found that are blurred by more than 3 px."""
    for name in (IMAGE, DARK):
        picture(lambda light: cv2.GaussianBlur(cv2.resize(light, None, fx=2, fy=2), (0, 0), 3.2), name)(folder)
    value("resolution_px", "[2000, 1500]")(folder)
    value("focal_px", 2200.0)(folder)
    value("principal_point_px", "[999.5, 749.5]")(folder)


def gated_cylinder(folder):
    value("shape", '"cylinder"')(folder)
    edit("facets = true", "facets = false", folder)
    key("facet = 1")(folder)


def pipe(folder):
    (folder / "marks.csv").unlink()
    os.mkfifo(folder / "marks.csv")


def half_the_marks(light):
    light[:, :520] = np.median(light)
    return light


PROVOKED = {
    "not filled in": value("laser_azimuth_deg", '"?"'),
    "required and missing": partial(edit, 'camera = "A"\n', ""),
    "unknown key": camera("focal_mm = 8.0"),
    "… is not a number": value("laser_azimuth_deg", '"101"'),
    "… is not a whole number": value("resolution_px", "[1000.5, 750]"),
    "… is not finite": value("mirror_position_mm", "[nan, -160.0, -1430.0]"),
    "… is not text": value("setting", 3),
    "… is neither true nor false": value("beam", 1),
    "… is not known": value("bit_depth", 12),
    "… is not a list": value("principal_point_px", 99.5),
    "… has … entries": value("mirror_position_mm", "[1500.0, -160.0]"),
    "… is not a table": partial(edit, "[laser]", "render = 3\n[laser]"),
    "… is out of range": value("laser_elevation_deg", 500.0),
    'true contradicts mirror.shape = "cylinder"': value("shape", '"cylinder"'),
    "no such field": partial(add, "[fields.warp]\nx = [1.0]"),
    "the table needs exactly …": partial(add, "[fields.time]\nt_h = [0.0, 1.0]"),
    "give at least two growing numbers": partial(
        add, "[fields.time]\nt_h = [1.0, 0.0]\ndy_mm = [0.0, 0.0]\ndz_mm = [0.0, 0.0]"
    ),
    "needs … numbers, as many as the knots": partial(
        add, "[fields.time]\nt_h = [0.0, 1.0]\ndy_mm = [0.0]\ndz_mm = [0.0, 0.0]"
    ),
    "empty": partial(add, "[effects.canting]"),
    'write [radius_mm, thickness_mm, "glass", semi_diameter_mm]': partial(add, "[expander]\nsurfaces = [[1.0, 2.0]]"),
    "the radius must not be 0 (inf is flat), the thickness not negative and the semi-diameter positive": partial(
        add, '[expander]\nsurfaces = [[0.0, 2.0, "BK7", 1.0]]'
    ),
    "more than … million pixels": value("resolution_px", "[50000, 50000]"),
    "not above black_level": value("saturation_level", 5.0),
    "more than … bits hold": value("bit_depth", 8),
    "straight above, below or at the camera": value("look_at_mm", "[1200.0, 350.0, -900.0]"),
    "x must be above 0, on the mirror's side of the screen, to see it": value("position_mm", "[-5.0, 0.0, 0.0]"),
    "'…' is not among the cameras (…)": value("camera", '"B"'),
    "… but the mirror has facets 0 … …": key("facet = 12"),
    "a cylinder has no facets": gated_cylinder,
    "'…' is already another exposure's": lambda f: again(f) or edit("2.png", IMAGE, f),
    "is the same picture as …": again,
    "setting … has other angles or another position in an earlier exposure": partial(again, laser_azimuth_deg=101.1),
    "…, the laser is below the horizon": value("laser_elevation_deg", -5.0),
    "x = … is behind or in the screen": value("mirror_position_mm", "[-1500.0, -160.0, -1430.0]"),
    "the laser stands behind the mirror as seen from the screen and cannot be reflected to it": far_behind,
    "the laser shines from behind the mirror straight at the screen": partial(above, 1000.0),
    "the mirror's normal is vertical, so its elevation axis is not defined": partial(
        above, -1000.0 - 17.5 * np.cos(np.pi / 12)
    ),
    "'…' is not there (looked in …)": lambda f: (f / IMAGE).unlink(),
    "'…' is not a file": partial(edit, f'"{IMAGE}"', '"."'),
    "not there (looked in …)": lambda f: (f / "marks.csv").unlink(),
    "'…' leads out of …": partial(edit, f'"{IMAGE}"', '"../x.png"'),
    "… cannot be followed": partial(edit, f'"{IMAGE}"', f'"{"a" * 300}.png"'),
    "line 1 must read …": marks(lambda lines: lines[1:]),
    "line …: … is not id (0 … …), y, z, side > 0 in mm": marks(lambda lines: [*lines, "a,b,c"]),
    "line …: id … stands twice": marks(lambda lines: [*lines, lines[1]]),
    "cannot be read as a CSV file": body(b"\xff\xfe", "marks.csv"),
    "no marks in it": marks(lambda lines: lines[:1]),
    "an empty file": body(b""),
    "truncated or damaged": lambda f: (f / IMAGE).write_bytes((f / IMAGE).read_bytes()[:5000]),
    "not an image": body(b"a picture"),
    "more than … million pixels, which is the most": lambda f: cv2.imwrite(
        str(f / IMAGE), np.zeros((8000, 8000), np.uint8)
    ),
    "a HEIC (or AVIF) picture, which is not read": other_image("x.heic", b"\0\0\0\x18ftypheic" + bytes(16)),
    "a raw picture, which is not read": other_image("x.dng", b"II*\0" + bytes(16)),
    "pixels are …": lambda f: (
        cv2.imwrite(str(f / "x.tiff"), counts(f).astype(np.float32)) and edit(f'"{IMAGE}"', '"x.tiff"', f)
    ),
    "… bit a pixel, but camera … has bit_depth = …": picture(lambda light: (light >> 8).astype(np.uint8)),
    "… × … pixels, but camera … has resolution_px …": picture(lambda light: light[:-10]),
    "…, and … is said to be by the same camera …": with_exif({}, {"model": "P2", "seconds": 60}),
    "…, but EXIF of … means about …": with_exif({"focal_35mm": 200}),
    "is not exposed as its photograph: …": dark_exposed_otherwise,
    "… merged from several exposures (HDR, night mode), whose light is no longer that of one": with_exif(
        {"rendered": 3}
    ),
    "… stands before …, but their clocks say the reverse": with_exif({"seconds": 90}, {"seconds": 0}),
    "… % of the picture is saturated": picture(lambda light: np.full_like(light, 65535)),
    "the picture is …, nothing stands above its noise": picture(lambda light: np.full_like(light, 800)),
    "none of the board's marks found…": picture(lambda light: light[:, ::-1]),
    "… of the board's … marks can be used and … are needed…": marks(lambda lines: lines[:3]),
    "the lens of camera … cannot be undone at the marks": value("distortion", "[-80.0, 0.0, 0.0, 0.0, 0.0]"),
    "the marks fit no pose of the board (…)": numbers(lambda i, y, z, s: (i, y / 25.4, z / 25.4, s)),
    "the marks are seen from behind the board": numbers(lambda i, y, z, s: (i, -y, z, s)),
    "no line of light found on the board": value("size_mm", "[10.0, 10.0]"),
    "its dark picture … shows its line as well": lambda f: shutil.copy(f / IMAGE, f / DARK),
    "… % of the line is saturated in every channel that shows it, so its shape is lost": saturated_line,
    "the line lies up to … mm from where its settings put it, more than [uncertainty] explains": value(
        "laser_azimuth_deg", 259.0
    ),
    "… of them: a diagnosis cannot be tested on settings left out": lambda f: None,
    "unknown: the light's place is used, its width and flux are not": value("gamma", '"unknown"'),
    "stated as exact and without distortion": value("distortion", "[0.0, 0.0, 0.0, 0.0, 0.0]"),
    "taken where the file is silent: …": partial(edit, "wavelength_nm = 632.8\n", ""),
    "… of the board's … marks are found": picture(half_the_marks),
    "blurred by … px rms": blurred,
    "shows marks that marks.csv does not list (id …)": marks(lambda lines: lines[:-1]),
    "the camera moved by … px since …": picture(lambda light: np.roll(light, (2, 3), axis=(0, 1)), DARK),
    "… exposures have none (first: …)": partial(edit, f'dark = "{DARK}"\n', ""),
    "no recording.toml in this folder": lambda f: (f / "recording.toml").unlink(),
    "no such file or folder": shutil.rmtree,
    "not valid TOML: …": partial(edit, "[laser]", "[laser"),
    "not a text file in UTF-8": body(b"\x89PNG\xff", "recording.toml"),
    "… has a line break or a control character": value("title", r'"a\u0007b"'),
    "…: nests deeper than … tables": partial(add, f"x = {'[' * 20}{']' * 20}"),
    "…: is larger than integers of TOML (64 bits)": value("bit_depth", 2**70),
    "is no ordinary file": pipe,
    "has … bytes, … may have … MiB": lambda f: (f / "recording.toml").write_bytes(b"#" * (reading.TOML_BYTES + 1)),
}


def pattern(says):
    return "".join(".*" if part == "…" else re.escape(part) for part in re.split("(…)", says))


def test_each_message_of_the_page_has_a_recording_that_provokes_it():
    assert len(SAID) > 80 and set(SAID) == set(PROVOKED)
    assert len(SAID) == len(set(SAID))


@pytest.mark.slow
@pytest.mark.parametrize("says", PROVOKED)
def test_a_message_of_the_page_is_given(says, recording):
    PROVOKED[says](recording)
    try:
        said = [f.says for f in jobs.check(recording).findings]
    except BenchsimError as error:
        said = [str(error).partition(": ")[2]]
    assert any(re.match(pattern(says) + r"($|[;,(. ])", s) for s in said), said


CODE = [
    *(
        "jobs/checking",
        "intake/metadata",
        "intake/picture_content",
        "intake/trace_placement",
        "bench/files",
        "bench/complaints",
    ),
    *("bench/marks", "bench/paths", "bench/place", "bench/toml_file", "trace/counts", "trace/image", "trace/marks"),
]


NEVER = (
    "the recording lists no marks to look for",
    "given without an image",
    "its settings put no trace on the board",
    "not found beside the package",
)
"""`check` comes to none of these: it reads marks and asks for images before, a mirror that can be aimed is aimed at the
board, and what comes with the package is no recording."""


def sentences(node):
    """Heads, up to the mend, of what code says of a recording; what is filled in reads "…"."""
    if isinstance(node, ast.JoinedStr | ast.Constant):
        parts = node.values if isinstance(node, ast.JoinedStr) else [node]
        text = "".join(str(p.value) if isinstance(p, ast.Constant) else "…" for p in parts)
        if "; " in text[2:] and not any(said in text for said in NEVER):
            yield text.partition("; ")[0]
    elif not (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)):
        for child in ast.iter_child_nodes(node):
            yield from sentences(child)


@pytest.mark.parametrize("module", CODE)
def test_every_sentence_of_the_code_stands_on_the_page(module):
    filled = [s.replace("…", "x") for s in SAID]
    code = ast.parse((ROOT / "benchsim" / f"{module}.py").read_text(encoding="utf-8"))
    for head in sentences(code):
        ends = [head.split(": ", n)[-1] for n in range(head.count(": ") + 1)]
        assert any(re.fullmatch(pattern(e), s) or re.match(pattern(s), e) for e in ends for s in (filled + SAID)), (
            f"'{head}' is not on docs/messages.md"
        )
