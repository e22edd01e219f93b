"""From JPEGs to camera.toml; and what is refused before any mark is looked for."""

import json
import re
import sys
import tomllib
from contextlib import nullcontext
from types import SimpleNamespace

import cv2
import lens_sets as sets
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from benchsim import jobs
from benchsim.bench.errors import BenchsimError
from benchsim.bench.schema import CameraTable
from benchsim.bench.writing import write_marks
from benchsim.boards import lay_out
from benchsim.calibration import read_camera
from benchsim.calibration.exif import changed, lens_tags
from benchsim.jobs import calibrating

pipeline = sys.modules["benchsim.calibration.calibrate"]  # the function of the package has the module's name

SIZE, FOCAL, POINT = (840, 640), 700.0, (428.0, 314.0)
BOARD, SIDE, PITCH, FINE = (400.0, 300.0), 28.0, 0.5, 3
VIEWS = [(0, 5), (35, 40), (35, 130), (35, 220), (35, 310), (25, 0), (25, 90)]
"""Tilt and its direction [deg]."""


def texture(marks):
    nz, ny = round(BOARD[1] / PITCH), round(BOARD[0] / PITCH)
    out = np.full((nz, ny), 0.8, np.float32)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    each = round(SIDE / 8 / PITCH)
    for tag, (y, z) in zip(marks.ids, marks.centres, strict=True):
        cells = np.kron(cv2.aruco.generateImageMarker(dictionary, tag, 8, borderBits=1) > 0, np.ones((each, each)))
        i, j = round((BOARD[1] / 2 - z - SIDE / 2) / PITCH), round((y - SIDE / 2 + BOARD[0] / 2) / PITCH)
        out[i : i + 8 * each, j : j + 8 * each] = np.where(cells, 0.8, 0.05)
    return out


def paint(board, tilt, way, distance, rng):
    """A phone's picture through a pinhole: the board warped on a grid three times finer, blurred, with shot noise.

    One lamp stands beside the board; the tone curve is sRGB's with contrast, and the picture is sharpened.
    """
    axis = np.radians(tilt) * np.array([np.cos(np.radians(way)), np.sin(np.radians(way)), 0])
    rotation = Rotation.from_rotvec(axis).as_matrix()
    # Texel (0, 0) is centred at half a pitch from the board's upper left; columns run along y, rows along −z.
    texel = np.array([[PITCH, 0, PITCH / 2 - BOARD[0] / 2], [0, PITCH, PITCH / 2 - BOARD[1] / 2], [0, 0, 1]])
    place = np.column_stack([rotation[:, :2], [*rng.uniform(-20, 20, 2), distance]])
    matrix = np.array([[FOCAL, 0, POINT[0]], [0, FOCAL, POINT[1]], [0, 0, 1.0]])
    fine = np.array([[FINE, 0, (FINE - 1) / 2], [0, FINE, (FINE - 1) / 2], [0, 0, 1]])
    shape = (SIZE[0] * FINE, SIZE[1] * FINE)
    light = cv2.warpPerspective(board, fine @ matrix @ place @ texel, shape, flags=cv2.INTER_LINEAR, borderValue=0.3)
    light = cv2.resize(cv2.GaussianBlur(light, (0, 0), 0.8 * FINE), SIZE, interpolation=cv2.INTER_AREA)
    light = light * np.linspace(1.0, 0.3, SIZE[0]).astype(np.float32)
    electrons = 5000 * light[..., None] * [0.9, 1, 0.95]
    electrons = electrons + rng.normal(size=electrons.shape) * np.sqrt(np.maximum(electrons, 0) + 25)
    linear = np.clip(electrons / 5000, 0, 1)
    tone = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    tone = tone - 0.06 * np.sin(2 * np.pi * tone)
    tone = tone + 0.3 * (tone - cv2.GaussianBlur(tone, (0, 0), 1.0))
    return np.rint(255 * np.clip(tone, 0, 1)).astype("u1")


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photographs")
    marks = lay_out(BOARD, SIDE).marks
    write_marks(folder / "marks.csv", marks)
    rng = np.random.default_rng(6)
    board = texture(marks)
    for k, (tilt, way) in enumerate(VIEWS):
        picture = paint(board, tilt, way, 380 + 20 * k, rng)
        cv2.imwrite(str(folder / f"{k}.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, 90])
    cv2.imwrite(str(folder / "wall.jpg"), rng.integers(90, 160, (*SIZE[::-1], 3), np.uint8))
    return folder


@pytest.fixture(scope="module")
def result(photographs, tmp_path_factory):
    out = tmp_path_factory.mktemp("out") / "phone.toml"
    with pytest.MonkeyPatch.context() as patch:
        # In this process: to start others takes longer than the work.
        patch.setattr(calibrating, "workers", lambda: nullcontext(SimpleNamespace(each=map)))
        return jobs.calibrate([photographs], out, board=photographs / "marks.csv", name="phone")


def test_the_lens_is_found_and_a_wall_is_left_out(result):
    """Seven JPEGs with an unknown tone curve; each parameter within 4 σ of the truth: false alarm 1 in 2000."""
    found = result.calibration
    truth = np.array([FOCAL, *POINT, 0, 0, 0, 0, 0])
    assert (np.abs(found.bundle.lens - truth) < 4 * found.bundle.sigma[:8]).all()
    assert abs(found.bundle.lens[0] / FOCAL - 1) < 3e-3
    assert [name for name, _ in found.left_out] == ["wall.jpg"]
    assert not found.focal.seen and not found.principal_point.seen
    # The tone curve is guessed so that black does not spread; the file keeps what the user said of it.
    assert found.bundle.spread[:, 0] == pytest.approx(0, abs=0.03)
    assert found.camera.gamma == "unknown"


def test_the_file_is_what_a_recording_wants(result):
    data = tomllib.loads(result.file.read_text())
    table = CameraTable.model_validate(data["cameras"]["phone"])
    assert (table.resolution_px, table.bit_depth, table.gamma) == (list(SIZE), 8, "unknown")
    record = read_camera(result.file)
    assert record.name == "phone" and dict(record.table) == data["cameras"]["phone"]
    sigma = np.sqrt(np.diag(record.covariance))
    assert record.intrinsics_sigma == pytest.approx((sigma[0] / table.focal_px, max(sigma[1:3]), sigma[3]), rel=1e-3)
    assert record.intrinsics_sigma == pytest.approx(result.calibration.intrinsics_sigma, rel=1e-3)


def test_the_summary_says_what_to_believe(result):
    text = result.summary()
    assert re.search(r"focal length +(699\.\d\d|700\.\d\d) ± 0\.\d+ px", text)
    assert "not used: wall.jpg: " in text
    assert "--calibration" in text
    picture = cv2.imread(str(result.picture))
    assert min(picture.shape[:2]) > 800
    plain = json.loads(json.dumps(result.as_dict(), allow_nan=False))
    assert plain["lens"]["focal_px"]["value"] == pytest.approx(FOCAL, rel=3e-3)
    assert len(plain["focal_by_view"]) == len(VIEWS)


def test_only_a_camera_file_is_overwritten(photographs, tmp_path):
    other = tmp_path / "recording.toml"
    other.write_text('format = "benchsim-recording/1"\n')
    with pytest.raises(BenchsimError, match="another file of this name"):
        jobs.calibrate([photographs], other, board=photographs / "marks.csv")
    with pytest.raises(BenchsimError, match=r"ends in \.toml"):
        jobs.calibrate([photographs], tmp_path / "camera", board=photographs / "marks.csv")
    with pytest.raises(BenchsimError, match="there is no folder"):
        jobs.calibrate([photographs], tmp_path / "a" / "camera.toml", board=photographs / "marks.csv")
    assert other.read_text() == 'format = "benchsim-recording/1"\n'


def small(path, size=(64, 48), **tags):
    image = Image.fromarray(np.random.default_rng(1).integers(0, 255, (*size[::-1], 3), np.uint8))
    exif = Image.Exif()
    exif[0x8769] = tags
    image.save(path, exif=exif)
    return path


FOCAL_LENGTH, ZOOM, LENS_MODEL = 37386, 41988, 42036


@pytest.mark.parametrize(
    ("last", "says"),
    [
        ({FOCAL_LENGTH: 2.2}, "EXIF says FocalLength 4.2 mm in 0.jpg and 2.2 mm in 3.jpg"),
        ({FOCAL_LENGTH: 4.2, ZOOM: 1.4}, "DigitalZoomRatio"),
        ({FOCAL_LENGTH: 4.2, LENS_MODEL: "back wide"}, "LensModel main in 0.jpg and back wide in 3.jpg"),
    ],
)
def test_a_lens_that_was_changed_is_refused_by_what_the_phone_says(tmp_path, photographs, last, says):
    common = {FOCAL_LENGTH: 4.2, ZOOM: 0.0, LENS_MODEL: "main"}
    tags = [common, common, common | {ZOOM: 1.0}, common | last]
    paths = [small(tmp_path / f"{k}.jpg", **{}) for k in range(4)]
    for path, one in zip(paths, tags, strict=True):
        image = Image.open(path)
        image.load()
        exif = Image.Exif()
        exif[0x8769] = one
        image.save(path, exif=exif)
    with pytest.raises(BenchsimError, match=says):
        jobs.calibrate(paths, tmp_path / "c.toml", board=photographs / "marks.csv")
    assert changed({str(p): lens_tags(p) for p in paths[:3]}, [str(p) for p in paths[:3]]) == ""


def test_pictures_that_do_not_belong_together_are_refused(tmp_path, photographs):
    board = photographs / "marks.csv"
    paths = [small(tmp_path / f"{k}.jpg") for k in range(4)]
    with pytest.raises(BenchsimError, match="3 photographs of the board, and 4 are the least"):
        jobs.calibrate(paths[:3], tmp_path / "c.toml", board=board)
    with pytest.raises(BenchsimError, match="not there"):
        jobs.calibrate([tmp_path / "none"], tmp_path / "c.toml", board=board)
    with pytest.raises(BenchsimError, match=r"3\.jpg: 48 × 64 pixels of 8 bit, turned by a quarter"):
        jobs.calibrate([*paths[:3], small(tmp_path / "3.jpg", (48, 64))], tmp_path / "c.toml", board=board)
    (tmp_path / "4.heic").write_bytes(b"\0\0\0\x18ftypheic" + bytes(64))
    with pytest.raises(BenchsimError, match="HEIC"):
        jobs.calibrate([*paths[:3], tmp_path / "4.heic"], tmp_path / "c.toml", board=board)
    with pytest.raises(BenchsimError, match=r"none\.csv: not there; give --board"):
        jobs.calibrate([*paths, small(tmp_path / "3.jpg")], tmp_path / "c.toml", board=tmp_path / "none.csv")
    with pytest.raises(BenchsimError, match="would be replaced"):
        jobs.calibrate([*paths[:3], small(tmp_path / "c.png")], tmp_path / "c.toml", board=board)
    assert not (tmp_path / "c.toml").exists()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("benchsim-camera/1", "benchsim-camera/2"), "format"),
        (("focal_px", "focal_mm"), r"cameras\.phone\.focal_px"),
        (('"k1"', '"q1"'), r"calibration\.covariance"),
        (("[cameras", "[[cameras"), "not valid TOML"),
    ],
)
def test_a_damaged_camera_file_is_refused(result, tmp_path, change, says):
    path = tmp_path / "camera.toml"
    path.write_text(result.file.read_text().replace(*change, 1))
    with pytest.raises(BenchsimError, match=rf"camera\.toml: .*{says}"):
        read_camera(path)


@pytest.fixture
def told(monkeypatch, tmp_path):
    """`calibrate` of views whose marks were found beforehand: the pictures themselves are black."""

    def run(views, **options):
        paths = [tmp_path / f"{k:02d}.jpg" for k in range(len(views))]
        for path in paths:
            cv2.imwrite(str(path), np.zeros(sets.SIZE[::-1], np.uint8))
        found = {path: view for path, view in zip(paths, views, strict=True)}
        monkeypatch.setattr(pipeline, "_find", lambda path, name, camera, marks: found[path])
        return pipeline.calibrate(paths, sets.board(), **options)

    return run


def test_autofocus_that_breathes_is_refused_and_says_how_it_is_known(told):
    rng = np.random.default_rng(21)
    poses = sets.poses(rng)
    with pytest.raises(BenchsimError, match=r"follows the distance, \+0\.\d+ ± .* autofocus .*lock focus"):
        told(sets.views(rng, poses, focal=1 + 0.006 * 700 / poses[:, 5]))


def test_a_lens_that_moves_a_little_is_less_certain_not_refused(told):
    """0.02 % of zoom and 2 px of stabilisation: seen, and part of what the file says is uncertain."""
    rng = np.random.default_rng(22)
    own, point = 1 + 2e-4 * rng.standard_normal(8), rng.normal(0, 2.0, (8, 2))
    found = told(sets.views(rng, sets.poses(rng), focal=own, point=point, noise=0.005))
    assert found.principal_point.seen
    focal, centre, _ = found.intrinsics_sigma
    assert centre == pytest.approx(2.0, rel=0.5)
    assert focal > found.bundle.sigma[0] / found.bundle.lens[0] or not found.focal.seen


def test_views_that_leave_the_focal_length_open_are_refused_with_those_that_would_not(told):
    rng = np.random.default_rng(23)
    with pytest.raises(BenchsimError, match=r"open by \d+ %; add photographs: from .*40° off the board's normal"):
        told(sets.views(rng, sets.poses(rng, 4, tilt=(0, 0.5)), noise=0.3))
