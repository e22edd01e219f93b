"""From picture to trace, against photographs of known curves made without benchsim's optics."""

import functools
import importlib.util
import json
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from benchsim import rays
from benchsim.bench.curve import Curve, signed_distance
from benchsim.bench.errors import BenchsimError
from benchsim.bench.files import read
from benchsim.bench.model import Screen
from benchsim.bench.settings import from_vector
from benchsim.trace.extract import extract, extract_pixels, measure
from benchsim.trace.image import read_image
from benchsim.trace.table import covariance, only_ridge

ROOT = Path(__file__).resolve().parents[2]
OTHER = ROOT.parent / "shared" / "recordings" / "bench-other-code"


def _pictures():
    spec = importlib.util.spec_from_file_location("line_pictures", ROOT / "analysis" / "line_pictures.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


pictures = _pictures()


@functools.cache
def exposed(seed, bits):
    """One random geometry, its light, and where that leaves the random numbers."""
    rng = np.random.default_rng([77, seed])
    scene = pictures.random_scene(rng, bits)
    return scene, pictures.expose(scene), rng.bit_generator.state


def taken(folder, seed, bits, dark, jpeg=None, brighter=1.0, ghost=0.0):
    """Scene, photograph and dark (or None) of one random geometry."""
    scene, light, state = exposed(seed, bits)
    rng = np.random.default_rng()
    rng.bit_generator.state = state
    line = light.line * brighter
    if ghost:
        line = line + ghost * np.roll(light.line, 40, axis=1) * light.board
    image = pictures.encode(folder / "image", pictures.photograph(line + light.room, rng, bits), jpeg)
    photo = read_image(image, scene.camera)
    if not dark:
        return scene, photo, None
    ground = pictures.encode(folder / "dark", pictures.photograph(light.room, rng, bits), jpeg)
    return scene, photo, read_image(ground, scene.camera, dark=True)


def error_of(scene, trace):
    """Signed distance of the trace from the centre of the arc's light, along the trace's normal [mm]."""
    s, outward = pictures.to_arc(scene, trace.points)
    _, beyond = pictures.to_arc(scene, trace.points + 1e-3 * trace.normal)
    return (outward - pictures.beside_arc(scene, s)) * np.sign(beyond - outward)


def chi2_z(error, c):
    """(χ² - n)/√(2n), standard normal for honest covariances."""
    n = len(error)
    return float((error @ np.linalg.solve(c, error) - n) / np.sqrt(2 * n))


@pytest.mark.parametrize(
    ("seed", "bits", "dark", "jpeg"), [(0, 16, True, None), (1, 8, False, None), (2, 8, True, None), (3, 8, False, 90)]
)
def test_the_ridge_is_true_and_its_errors_honest(tmp_path, seed, bits, dark, jpeg):
    """Rationale: the bars of the ridge, on single pictures. `analysis/ridge_accuracy.py` holds 100.

    Expectation: bias within 0.01 mm (0.05 for JPEG); pulls' std within 0.9 … 1.15; χ² with the full covariance, the
    common errors included, within 4.5 sigma (false-alarm rate 1e-5 each).
    """
    scene, photo, ground = taken(tmp_path, seed, bits, dark, jpeg)
    trace = only_ridge(measure(photo, ground, pictures.true_pose(scene), Screen(), scene.blur))
    error = error_of(scene, trace)
    assert len(trace) > 600
    assert abs(error.mean()) < (0.05 if jpeg else 0.01)
    assert 0.9 < np.std(error / trace.sigma_mm) < 1.15
    assert abs(chi2_z(error, covariance(trace))) < 4.5
    assert np.all(np.diff(trace.s_mm) > 0)
    along = np.diff(trace.points, axis=0)
    assert np.all(along[:, 0] * trace.normal[1:, 1] - along[:, 1] * trace.normal[1:, 0] > 0)


def test_a_crest_saturated_over_a_long_stretch_does_not_bend_the_line(tmp_path):
    """Scenario. The crest of the last fifth of a line is saturated, and the curve that is followed drifts off the line
    there. A shape that may change along the line takes the drift for a change: nothing there shows the crest, and the
    centres of that stretch were 0.11 mm off in the mean.

    Expectation: the mean error of the profiles with saturated pixels within 0.015 mm.
    """
    rng = np.random.default_rng([1, 74])
    scene = pictures.random_scene(rng, 16)
    light = pictures.expose(scene)
    shot = pictures.photograph(light.line + light.room, rng, 16)
    photo = read_image(pictures.encode(tmp_path / "image", shot, None), scene.camera)
    trace = only_ridge(measure(photo, None, pictures.true_pose(scene), Screen(), scene.blur))
    cut = trace.saturated > 0
    assert cut.sum() > 200
    assert abs(error_of(scene, trace)[cut].mean()) < 0.015


@pytest.mark.parametrize("exposure", [pytest.param(0.7, marks=pytest.mark.slow), 1.0])
def test_speckle_does_not_narrow_the_line(tmp_path, exposure):
    """Scenario. Speckle of a fifth of the light, as large as a pixel. Weights and scales that follow a profile's own
    noise make lines narrower, by 2 % here, where profiles have few pixels: to a diagnosis, a beam of another curvature.
    A few of the brightest pixels are saturated; to leave out all that might have been widened the line.

    Expectation: the mean logarithm of the width, over four patterns, within 0.006 of that of the line without speckle,
    three times what four patterns scatter.
    """
    scene, light, _ = exposed(6, 16)
    pose, means = pictures.true_pose(scene), []
    for seed in range(5):
        rng = np.random.default_rng([5, seed])
        field = gaussian_filter(rng.standard_normal(light.line.shape), 0.48)
        line = exposure * light.line * np.maximum(1 + (0.2 if seed else 0.0) * field / field.std(), 0)
        shots = [pictures.photograph(part + light.room, rng, 16) for part in (line, 0.0 * line)]
        photo, ground = (
            read_image(pictures.encode(tmp_path / name, shot, None), scene.camera, dark=name == "dark")
            for name, shot in zip(("image", "dark"), shots, strict=True)
        )
        means.append(np.log(measure(photo, ground, pose, Screen(), scene.blur, ridges=1).width_mm).mean())
    assert abs(np.mean(means[1:]) - means[0]) < 0.006


def test_a_saturated_ridge_is_placed_by_its_flanks(tmp_path):
    """Set-up: light beyond what the sensor holds over a part. Expectation: bias within 0.05 mm, honest pulls."""
    scene, photo, ground = taken(tmp_path, 4, 16, True, brighter=1.25)
    trace = only_ridge(measure(photo, ground, pictures.true_pose(scene), Screen(), scene.blur))
    error = error_of(scene, trace)
    hit = trace.saturated > 0
    assert hit.mean() > 0.2
    assert abs(error[hit].mean()) < 0.05 and abs(error.mean()) < 0.05
    assert 0.85 < np.std(error / trace.sigma_mm) < 1.2


def test_a_ghost_is_a_second_ridge(tmp_path):
    """A copy of the line of 8 %, 40 px aside: found as ridge 1, fainter, and the trace not moved by it."""
    scene, photo, ground = taken(tmp_path, 2, 16, True, ghost=0.08)
    trace = measure(photo, ground, pictures.true_pose(scene), Screen(), scene.blur)
    assert set(trace.ridge) == {0, 1}
    first, second = only_ridge(trace, 0), only_ridge(trace, 1)
    assert abs(error_of(scene, first).mean()) < 0.01
    assert np.median(second.flux) == pytest.approx(0.08 * np.median(first.flux), rel=0.15)


def test_no_second_ridge_without_a_ghost(tmp_path):
    scene, photo, ground = taken(tmp_path, 2, 16, True)
    assert set(measure(photo, ground, pictures.true_pose(scene), Screen(), scene.blur).ridge) == {0}


def test_ridge_in_pixels_without_a_recording(tmp_path):
    """Expectation: within 0.03 px of the projected arc on average."""
    scene, photo, _ = taken(tmp_path, 2, 16, False)
    found = extract_pixels(tmp_path / "image.png")
    s = np.arange(-500.0, 500.0, 2.0)
    points = pictures.arc(scene, s)
    points = points[np.abs(points).max(axis=1) < 360]
    d, _ = signed_distance(Curve(pictures.to_pixels(scene, points)), np.stack([found.u_px, found.v_px], axis=1))
    assert abs(d.mean()) < 0.03 and photo.name == found.name


def test_no_trace_is_one_sentence(tmp_path):
    """Pictures without a laser: a lit board, with and without its dark picture."""
    rng = np.random.default_rng(9)
    scene, light, _ = exposed(0, 16)
    room = light.room
    photo = read_image(pictures.encode(tmp_path / "a", pictures.photograph(room, rng, 16)), scene.camera)
    ground = read_image(pictures.encode(tmp_path / "b", pictures.photograph(room, rng, 16)), scene.camera, dark=True)
    for dark in (ground, None):
        with pytest.raises(BenchsimError, match=r"a\.png: .*trace"):
            measure(photo, dark, pictures.true_pose(scene), Screen(), scene.blur)


def test_a_trace_beside_the_board_is_absent(tmp_path):
    """A board of 60 mm that the trace does not cross."""
    scene, photo, ground = taken(tmp_path, 0, 16, True)
    s = np.arange(-500.0, 500.0, 2.0)
    nearest = np.abs(pictures.arc(scene, s)).max(axis=1).min()
    small = Screen(size=(1.2 * nearest, 1.2 * nearest))
    with pytest.raises(BenchsimError, match=r"image\.png: .*trace"):
        measure(photo, ground, pictures.true_pose(scene), small, scene.blur)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda p: p.write_bytes(b""), "empty"),
        (lambda p: p.write_bytes(b"not a picture"), "not an image"),
        (lambda p: cv2.imwrite(str(p), np.zeros((300, 400), np.uint8)), "black"),
        (lambda p: cv2.imwrite(str(p), np.full((300, 400), 255, np.uint8)), "saturated"),
        (lambda p: None, "not there"),
    ],
)
def test_useless_pictures_are_refused_by_name(tmp_path, make, says):
    path = tmp_path / "useless.png"
    make(path)
    with pytest.raises(BenchsimError, match=says) as error:
        extract_pixels(path)
    assert "useless.png" in str(error.value)


def test_unknown_gamma_gives_no_flux_and_no_width(tmp_path):
    scene, photo, ground = taken(tmp_path, 0, 16, True)
    trace = measure(replace(photo, linear=False), ground, pictures.true_pose(scene), Screen(), scene.blur)
    assert np.isnan(trace.flux).all() and np.isnan(trace.width_mm).all() and np.isfinite(trace.sigma_mm).all()


@pytest.mark.skipif(not OTHER.is_dir(), reason="the recordings made by other code are not beside the project")
@pytest.mark.parametrize("number", [0, 1])
def test_photographs_of_other_code(number):
    """``clean-f7``: bias 0.01 mm, pulls 0.9 … 1.15, through marks and pose; the marks that it crosses left out.

    The truth is the mean of the light; how far its centre lies from that is the ray model's, at the true setting.
    """
    recording = read(OTHER / "clean-f7")
    exposure = recording.exposures[number]
    trace = only_ridge(extract(recording, exposure))
    y, z = np.load(OTHER / "truth" / "clean-f7.npz")[f"trace_{number}"][:2]
    off = json.loads((OTHER / "truth" / "clean-f7.json").read_text())["setting_errors"][exposure.setting]
    keys = {"n_cx": 1.0, "n_cy": 1.0, "n_cz": 1.0, "n_a1": 1e-3, "n_a2": 1e-3, "n_saz": 1e-3, "n_sel": 1e-3}
    errors = from_vector(np.array([off[k] * unit for k, unit in keys.items()] + [0.0] * 6))
    predicted = rays.predict(recording, exposure, errors, blur=trace.noise[0].blur_mm)
    true = Curve(np.stack([y, z], axis=1))
    s = signed_distance(true, trace.points)[1]
    on = (s > 0) & (s < true.arc_length()[-1])
    assert np.abs(signed_distance(predicted, true.points[5:-5])[0]).max() < 2e-3, "the means agree"
    error = signed_distance(predicted.at_centre(), trace.points)[0]
    assert abs(error[on].mean()) < 0.01
    assert 0.9 < np.std(error[on] / trace.sigma_mm[on]) < 1.15
    centres, half = np.array(recording.screen.marks.centres), np.array(recording.screen.marks.sides)[:, None, None] / 2
    assert not (np.abs(trace.points[None] - centres[:, None]) < half).all(axis=2).any()


def test_a_board_of_few_counts_without_noise_is_no_print(tmp_path):
    """Scenario. JPEG smooths a quiet picture until most pixels beside the line are alike; those one count darker were
    taken for print, and 561 of 590 profiles were dropped."""
    scene, light, _ = exposed(2, 8)
    counts = np.round((light.line + light.room) * 255 / pictures.FULL_WELL).astype(np.uint8)
    photo = read_image(pictures.encode(tmp_path / "image", counts, 90), scene.camera)
    trace = only_ridge(measure(photo, None, pictures.true_pose(scene), Screen(), scene.blur))
    assert len(trace) > 600


def test_a_wholly_saturated_ridge_is_refused(tmp_path):
    scene, photo, ground = taken(tmp_path, 4, 16, True, brighter=3.0)
    with pytest.raises(BenchsimError, match="saturated"):
        measure(photo, ground, pictures.true_pose(scene), Screen(), scene.blur)
