"""The sensor: statistics of its noise, its curve, its limits, and the files it writes."""

import cv2
import numpy as np
import pytest

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Camera, RenderOptions
from benchsim.renderer.picture import Picture
from benchsim.renderer.sensor import Signals, develop, encode, expose, signals, speckle, write_image

OPTIONS = RenderOptions()


def camera(**changes):
    values = {"gamma": 1.0, "black_level": 800.0, "bit_depth": 16, "saturation_level": 65535.0} | changes
    return Camera("A", (400, 300), 440.0, (199.5, 149.5), **values)


def flat(value, shape=(300, 400)):
    return np.full(shape, value, np.float32)


def test_exposure_puts_line_and_room_where_the_options_say():
    laser, room = np.zeros((60, 80), np.float32), flat(0.8, (60, 80))
    laser[:, 38:42] = 3e-5
    light = signals(Picture(laser, room), OPTIONS, 0.8)
    assert light.laser.max() == pytest.approx(0.7, rel=1e-5)
    assert light.room.max() == pytest.approx(0.21, rel=1e-5)
    assert (light.laser + light.room).max() < 1


def test_blur_keeps_light_and_widens_by_its_variance():
    laser = np.zeros((41, 41), np.float32)
    laser[20, 20] = 1
    light = signals(Picture(laser, flat(0.0, (41, 41))), RenderOptions(blur_px=1.3), 0.8).laser.astype(float)
    x = np.arange(41) - 20
    assert (light.sum(axis=0) @ x**2) / light.sum() == pytest.approx(1.3**2, rel=2e-3)


def test_a_picture_without_laser_light_is_refused():
    with pytest.raises(BenchsimError, match="none of the laser's light"):
        signals(Picture(flat(0.0), flat(0.8)), OPTIONS, 0.8)


@pytest.mark.parametrize("level", [0.02, 0.3, 0.9])
def test_noise_has_the_mean_and_variance_of_shot_and_read_noise(level):
    """Set-up: 120000 equal pixels, fixed seed. Expectation: the mean within 5 of its sigmas, the variance within 5 of
    its own; a false alarm in 1e6 each."""
    n, well, read = 120_000, 12000.0, 6.0
    span = 65535.0 - 800
    counts = develop(flat(level), camera(), OPTIONS, np.random.default_rng(5)).astype(float)
    variance = (level * well + read**2) * (span / well) ** 2 + 1 / 12
    assert counts.mean() == pytest.approx(800 + span * level, abs=5 * np.sqrt(variance / n))
    assert counts.var() == pytest.approx(variance, rel=5 * np.sqrt(2.1 / n))


def test_without_noise_only_quantisation_is_left():
    for depth, saturation, kind in ((8, 255.0, np.uint8), (16, 65535.0, np.uint16)):
        c = camera(bit_depth=depth, saturation_level=saturation, black_level=10.0)
        ramp = np.linspace(0, 1.2, 1000, dtype=np.float32).reshape(20, 50)
        counts = develop(ramp, c, OPTIONS, None)
        assert counts.dtype == kind
        want = 10 + (saturation - 10) * np.minimum(ramp.astype(float), 1)
        assert np.abs(counts - want).max() <= 0.5 + 1e-2
        assert counts.max() == saturation


@pytest.mark.parametrize("gamma", [1.0, 2.2, 0.5])
def test_gamma_is_the_one_the_contract_inverts(gamma):
    """Light is proportional to (counts − black level) ** gamma."""
    ramp = np.linspace(0.1, 0.99, 1000, dtype=np.float32)[None, :]
    counts = develop(ramp, camera(gamma=gamma), OPTIONS, None).astype(float)
    np.testing.assert_allclose(((counts - 800) / (65535 - 800)) ** gamma, ramp, rtol=2e-3)


def test_srgb_is_the_standards_curve():
    ramp = np.linspace(0, 1, 1001, dtype=np.float32)[None, :]
    shown = encode(ramp, "srgb").astype(float)
    back = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(back, ramp, atol=1e-6)
    assert encode(np.float32([[-0.1]]), "srgb")[0, 0] == 0


def test_unknown_gamma_is_refused():
    with pytest.raises(BenchsimError, match='"unknown" cannot be rendered'):
        develop(flat(0.5), camera(gamma="unknown"), OPTIONS, None)


def test_noise_below_black_is_kept_where_counts_have_room_for_it():
    counts = develop(flat(0.0), camera(), OPTIONS, np.random.default_rng(1)).astype(float)
    assert counts.min() < 800 - 32
    assert counts.mean() == pytest.approx(800, abs=5 * 6 * (65535 - 800) / 12000 / np.sqrt(counts.size))


def test_speckle_has_its_contrast_and_correlation():
    """Expectation: mean 1, contrast as asked, correlation 1/e at ``size``, to what 120000 pixels can say; none on room
    light."""
    size, contrast = 3.0, 0.15
    lit = speckle(flat(0.5, (400, 400)), size, np.random.default_rng(11), contrast).astype(float) / 0.5
    # Independent grains: area over π size², here 5600; their scatter over the mean of 400 × 400.
    grains = 400 * 400 / (np.pi * size**2 * 2)
    assert lit.mean() == pytest.approx(1, abs=5 * contrast / np.sqrt(grains))
    assert lit.std() == pytest.approx(contrast, rel=5 / np.sqrt(2 * grains))
    d = lit - lit.mean()
    assert (d[:, 3:] * d[:, :-3]).mean() / d.var() == pytest.approx(np.exp(-1), abs=0.06)
    light = Signals(flat(0.0), flat(0.3))
    quiet = RenderOptions(speckle_px=2.0, full_well_e=1e9, read_noise_e=0.0)
    counts = expose(light, camera(), quiet, np.random.default_rng(1))
    assert counts.std() < 5


def test_the_dark_picture_has_the_same_room_and_other_noise():
    light = Signals(flat(0.5), flat(0.2))
    rng = np.random.default_rng(3)
    lit, dark = (expose(light, camera(), OPTIONS, rng, laser=on).astype(float) for on in (True, False))
    assert dark.mean() == pytest.approx(800 + 0.2 * (65535 - 800), rel=1e-3)
    assert lit.mean() == pytest.approx(800 + 0.7 * (65535 - 800), rel=1e-3)
    assert abs(np.corrcoef(lit.ravel(), dark.ravel())[0, 1]) < 5 / np.sqrt(lit.size)


@pytest.mark.parametrize("name, depth, colour", [("a.png", 16, False), ("a.tif", 16, True), ("a.png", 8, True)])
def test_pictures_come_back_as_they_were_written(tmp_path, name, depth, colour):
    shape = (20, 30, 3) if colour else (20, 30)
    counts = np.random.default_rng(0).integers(0, 2**depth, shape).astype(np.uint16 if depth == 16 else np.uint8)
    write_image(tmp_path / name, counts)
    back = cv2.imread(str(tmp_path / name), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(back[..., ::-1] if colour else back, counts)
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_jpeg_is_written_in_8_bits_only(tmp_path):
    ramp = np.tile(np.linspace(0, 255, 256).astype(np.uint8), (64, 1))
    write_image(tmp_path / "a.jpg", ramp, jpeg_quality=90)
    back = cv2.imread(str(tmp_path / "a.jpg"), cv2.IMREAD_UNCHANGED)
    assert np.abs(back.astype(int) - ramp).max() < 4
    with pytest.raises(BenchsimError, match=r"a\.jpg: JPEG holds 8 bits"):
        write_image(tmp_path / "a.jpg", ramp.astype(np.uint16))
    with pytest.raises(BenchsimError, match=r"a\.bmp: unknown kind"):
        write_image(tmp_path / "a.bmp", ramp)
    with pytest.raises(BenchsimError, match="cannot be written"):
        write_image(tmp_path / "none" / "a.png", ramp)
