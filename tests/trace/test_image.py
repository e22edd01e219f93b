"""Reading photographs: counts to light, channels, and every way in which a file can be of no use."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Camera
from benchsim.trace.image import read_image

H, W = 120, 160


def camera(**changes):
    settings = {"bit_depth": 16, "saturation_level": 65535.0, "principal_point": (80.0, 60.0)} | changes
    return Camera("A", (W, H), 200.0, **settings)


def scene(seed=0):
    """Board with a dark square and a bright line, 0 … 1."""
    light = np.full((H, W), 0.3)
    light[40:80, 30:70] = 0.02
    light[:, 100:104] += 0.6
    return light + np.random.default_rng(seed).normal(0, 1e-3, light.shape)


def counts(light, bits, black=0.0, full=None):
    top = 2**bits - 1
    x = black + light * ((full or top) - black)
    return np.clip(np.rint(x), 0, top).astype(np.uint8 if bits == 8 else np.uint16)


def save(path, picture):
    assert cv2.imwrite(str(path), picture)
    return path


@pytest.mark.parametrize("suffix", ["png", "tiff"])
@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("gamma", [1.0, 2.2, "srgb"])
def test_light_is_linear_and_free_of_black(tmp_path, suffix, bits, gamma):
    light = np.clip(scene(), 0, 1)
    shown = (
        np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
        if gamma == "srgb"
        else (light ** (1 / gamma))
    )
    full = 2.0**bits - 1
    black = full / 50
    cam = camera(bit_depth=bits, saturation_level=full, black_level=black, gamma=gamma)
    p = read_image(save(tmp_path / f"a.{suffix}", counts(shown, bits, black)), cam)
    assert p.linear and p.channel == "mono" and not p.lossy and p.shape == (H, W)
    # Half a count of rounding, through the slope that the photograph states for it.
    assert np.all(np.abs(p.light - light * (full - black)) <= 0.51 * p.light_per_count + 0.05)


@pytest.mark.parametrize("bits, read_as", [(8, "srgb"), (16, 1.0)])
def test_unknown_gamma_is_read_as_what_is_usual_and_said(tmp_path, bits, read_as):
    path = save(tmp_path / "a.png", counts(scene(), bits))
    cam = camera(bit_depth=bits, saturation_level=2.0**bits - 1)
    p, known = (read_image(path, replace(cam, gamma=gamma)) for gamma in ("unknown", read_as))
    assert not p.linear and known.linear and np.array_equal(p.light, known.light)


def test_twelve_bits_in_the_upper_of_sixteen(tmp_path):
    picture = (counts(scene(), 16) >> 4) << 4
    p = read_image(save(tmp_path / "a.png", picture), camera(saturation_level=65520.0, black_level=800.0))
    assert p.light.max() <= 65520 - 800
    assert np.array_equal(p.light, picture.astype(np.float32) - 800)


def test_saturation_is_marked(tmp_path):
    light = scene()
    light[:, 100:104] = 1.4
    p = read_image(save(tmp_path / "a.png", counts(light, 16)), camera(saturation_level=60000.0))
    assert p.saturated.sum() == 4 * H and p.saturated[:, 100:104].all()


def test_jpeg(tmp_path):
    light = scene()
    light[:, 100:104] = 1.2
    p = read_image(save(tmp_path / "a.jpg", counts(light, 8)), camera(bit_depth=8, saturation_level=255.0))
    assert p.lossy and p.saturated[:, 101:103].mean() > 0.9


def colour(red, green=0.03, seed=1, room=(0.7, 1.0, 0.9)):
    """A red laser over white room light, (h, w, 3) BGR light 0 … 1: its part in green and in red."""
    rng = np.random.default_rng(seed)
    board = np.full((H, W), 0.25)
    board[40:80, 30:70] = 0.01
    u = np.arange(W)
    line = np.exp(-0.5 * ((u - 102) / 2.0) ** 2)
    planes = [board * c + line * s for c, s in zip(room, (0.0, green, red), strict=True)]
    return np.stack(planes, axis=-1) + rng.normal(0, 2e-3, (H, W, 3))


def test_the_trace_is_taken_from_the_channel_that_shows_it_best(tmp_path):
    """Rationale: nobody should have to say which channel; a laser that is far too bright for red is still seen in
    green. Expect red for a red laser below saturation, green when red is clipped flat over the whole line."""
    cam = camera()
    good = read_image(save(tmp_path / "a.png", counts(colour(0.5), 16)), cam)
    assert good.channel == "red" and not good.saturated.any()
    flooded = read_image(save(tmp_path / "b.png", counts(colour(3e4, 0.4), 16)), cam)
    assert flooded.channel == "green" and not flooded.saturated.any()
    assert flooded.marks_channel in ("green", "blue")
    assert read_image(tmp_path / "b.png", cam, channel="red").saturated.any()


def test_a_channel_saturated_all_along_the_line_is_left(tmp_path):
    """Rationale: flanks of a flooded red line hold more light than the faint green one, but the shape of a crest that
    is saturated everywhere cannot be known. Red stays where a tenth of the line is so."""
    cam = camera(bit_depth=8, saturation_level=255.0)
    flooded = read_image(save(tmp_path / "a.png", counts(colour(1.5, 0.3), 8)), cam)
    assert flooded.channel == "green" and not flooded.saturated.any()
    tall = np.concatenate([colour(0.5, 0.1), colour(0.5, 0.1, seed=2)])
    tall[:25] = colour(1.5, 0.3)[:25]
    twice = camera(bit_depth=8, saturation_level=255.0)
    twice = replace(twice, resolution=(W, 2 * H))
    mixed = read_image(save(tmp_path / "b.png", counts(tall, 8)), twice)
    assert mixed.channel == "red" and mixed.saturated.any()


@pytest.mark.parametrize("along", ["column", "row"])
def test_of_two_faint_channels_the_one_with_more_laser_light_is_taken(tmp_path, along):
    """Rationale: under a lamp with little blue the blue channel sees, relative to the room, more of a red laser than
    green does; in units of its noise it sees a half. Red is flooded, so green is asked for, whichever way the line
    runs."""
    lamp = (0.2, 1.0, 1.0)
    picture = colour(3.0, 0.4, room=lamp)
    picture[..., 0] += 0.5 * (picture[..., 1] - colour(0.0, 0.0, room=lamp)[..., 1])
    picture = np.concatenate([picture, colour(0.0, 0.0, room=lamp, seed=2)], axis=1)
    cam = replace(camera(bit_depth=8, saturation_level=255.0), resolution=(2 * W, H))
    if along == "row":
        picture, cam = picture.transpose(1, 0, 2), replace(cam, resolution=(H, 2 * W))
    seen = read_image(save(tmp_path / "a.png", counts(picture, 8)), cam)
    assert seen.channel == "green" and not seen.saturated.any()


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_pixels_are_the_sensors_whatever_exif_says(tmp_path, orientation):
    from PIL import Image

    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(counts(scene(), 8)).save(tmp_path / "a.jpg", quality=95, exif=exif)
    p = read_image(tmp_path / "a.jpg", camera(bit_depth=8, saturation_level=255.0))
    assert p.shape == (H, W) and p.light[60, 102] > p.light[102, 60] + 50


def test_grey_saved_as_colour_is_mono(tmp_path):
    grey = counts(scene(), 8)
    p = read_image(save(tmp_path / "a.png", np.dstack([grey] * 3)), camera(bit_depth=8, saturation_level=255.0))
    assert p.channel == "mono"


def test_a_jpeg_ends_where_its_picture_ends(tmp_path):
    """Rationale: phones put a thumbnail before the picture, with an end mark of its own, and a short film behind it."""
    cam = camera(bit_depth=8, saturation_level=255.0)
    picture, small = (cv2.imencode(".jpg", x)[1].tobytes() for x in (counts(scene(), 8), counts(scene(), 8)[::4, ::4]))
    data = picture[:2] + b"\xff\xe1" + (len(small) + 2).to_bytes(2, "big") + small + picture[2:]
    (tmp_path / "a.jpg").write_bytes(data)
    assert data.count(b"\xff\xd9") == 2
    (tmp_path / "half.jpg").write_bytes(data[: len(data) * 2 // 3])
    with pytest.raises(BenchsimError, match="truncated"):
        read_image(tmp_path / "half.jpg", cam)
    (tmp_path / "moving.jpg").write_bytes(data + b"\0\0\0\x18ftypmp42" + bytes(100_000))
    assert np.array_equal(read_image(tmp_path / "moving.jpg", cam).light, read_image(tmp_path / "a.jpg", cam).light)


def bad_inputs(folder):
    whole = counts(scene(), 16)
    data = cv2.imencode(".png", whole)[1].tobytes()
    jpeg = cv2.imencode(".jpg", counts(scene(), 8))[1].tobytes()
    tiff = cv2.imencode(".tiff", whole)[1].tobytes()
    noise = np.random.default_rng(0).normal(0, 30, (H, W))
    eight = camera(bit_depth=8, saturation_level=255.0)
    return {
        "missing": (None, camera(), "not there"),
        "empty": (b"", camera(), "empty"),
        "text": (b"hello, this is no picture", camera(), "not an image"),
        "half.png": (data[: len(data) // 2], camera(), "truncated"),
        "tail.png": (data[:-20], camera(), "truncated"),
        "head.png": (data[:40], camera(), "truncated"),
        "half.jpg": (jpeg[: len(jpeg) // 2], eight, "truncated"),
        "half.tiff": (tiff[: len(tiff) // 2], camera(), "truncated"),
        "IMG_1.HEIC": (b"\0\0\0\x18ftypheic\0\0\0\0mif1heic", camera(), "JPEG"),
        "IMG_2.DNG": (tiff, camera(), "develop it as TIFF"),
        "turned.png": (cv2.imencode(".png", np.rot90(whole))[1].tobytes(), camera(), "as the camera wrote it"),
        "size.png": (cv2.imencode(".png", whole[:, :-1])[1].tobytes(), camera(), "resolution_px"),
        "bits.png": (data, eight, "bit_depth"),
        "bits8.png": (cv2.imencode(".png", counts(scene(), 8))[1].tobytes(), camera(), "bit_depth"),
        "float.tiff": (cv2.imencode(".tiff", scene().astype(np.float32))[1].tobytes(), camera(), "8 or 16 bit"),
        "black.png": (cv2.imencode(".png", np.zeros((H, W), np.uint16))[1].tobytes(), camera(), "black"),
        "noise.png": (
            cv2.imencode(".png", (800 + noise).astype(np.uint16))[1].tobytes(),
            camera(black_level=800.0),
            "black",
        ),
        "grey.png": (cv2.imencode(".png", (20000 + noise).astype(np.uint16))[1].tobytes(), camera(), "uniform"),
        "white.png": (cv2.imencode(".png", np.full((H, W), 65535, np.uint16))[1].tobytes(), camera(), "saturated"),
    }


@pytest.mark.parametrize("name", list(bad_inputs(None)))
def test_bad_input_is_one_sentence_that_names_the_image(tmp_path, capfd, name):
    content, cam, word = bad_inputs(tmp_path)[name]
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(BenchsimError, match=word) as error:
        read_image(tmp_path / name, cam)
    message = str(error.value)
    assert name in message and "\n" not in message
    assert "Traceback" not in capfd.readouterr().err


def test_a_dark_picture_may_be_black(tmp_path):
    path = save(tmp_path / "dark.png", np.zeros((H, W), np.uint16))
    assert not read_image(path, camera(), dark=True).light.any()
