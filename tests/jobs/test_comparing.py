"""Photographs against the same exposures rendered again, in units of the photographs' noise."""

import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from benchsim.bench.errors import BenchsimError
from benchsim.bench.fields import FORMS, field
from benchsim.bench.files import read
from benchsim.bench.settings import prior_sigma, to_vector
from benchsim.diagnosis.result import Diagnosis, Law
from benchsim.instruments.bench import amended_file, effects, observables, problem
from benchsim.instruments.bench import pixels as about
from benchsim.instruments.bench.fitted_simulation import left_out, probable, state
from benchsim.jobs import comparing, diagnosing, diagnosis_drawing
from benchsim.renderer import charge
from benchsim.renderer import recording as rendering
from benchsim.renderer.effects import gather
from benchsim.reports import pixels

ROOT = Path(__file__).resolve().parents[2]
CLEAN = ROOT.parent / "shared" / "recordings" / "bench-other-code" / "clean-f7"

BOW = {"bow_y": 0.08, "bow_z": -0.08}

FEW = 1 << 22
"""Rays of a render that is held against speckle, which is far above what they scatter."""


def seen(recording):
    observed, lost = observables.observe(recording)
    assert not lost
    return observed, problem.build(recording, observed)


def parameters(built, effect):
    return [p for e in built.catalogue if e.name == effect for p in e.parameters]


@pytest.fixture(scope="module")
def bowed(tmp_path_factory):
    """Fig. 7(a) and two settings near it on a bowed board, by a camera of half the resolution; the file says nothing of
    the bow."""
    whole = read(ROOT / "scenes" / "fig7a.toml", images=False)
    (first,), camera = whole.exposures, whole.cameras["A"]
    (w, h), (cx, cy) = camera.resolution, camera.principal_point
    small = replace(
        camera, resolution=(w // 2, h // 2), focal=camera.focal / 2, principal_point=(cx / 2 - 0.25, cy / 2 - 0.25)
    )
    moves = ((0.0, 0.0), (0.05, 0.0), (-0.05, 0.05))
    exposures = tuple(
        replace(
            first,
            setting=f"s{k}",
            laser_azimuth=first.laser_azimuth + da,
            laser_elevation=first.laser_elevation + de,
        )
        for k, (da, de) in enumerate(moves)
    )
    # Without speckle the pixels of so bright a line show a twentieth of what its centre line is good to.
    speckled = replace(whole.render, speckle_px=0.8)
    bench = replace(whole, cameras={"A": small}, exposures=exposures, effects={"screen-bow": BOW}, render=speckled)
    made = rendering.render_recording(bench, tmp_path_factory.mktemp("bowed"), seed=11).recording
    return replace(made, effects={})


@pytest.fixture(scope="module")
def bowed_seen(bowed):
    return seen(bowed)


def test_a_setting_left_out_is_rendered_to_its_noise(bowed, bowed_seen):
    """Rationale: the bar, on photographs of our own: z of 0.9 … 1.15 after, larger before.

    Set-up: a bowed board in three settings with speckle, each rendered with the bow that the other two say; before:
    without it, all settings fitted. Expectation: the bow within a tenth of the truth, z within the bar, before above.
    """
    observed, built = bowed_seen
    own = parameters(built, "screen-bow")
    start = probable(built, [*built.nuisances, *own], {})
    after = left_out(built, ["screen-bow"], start)
    before = [probable(built, built.nuisances, {})] * 3
    for values in after:
        assert {k: values[k] for k in BOW} == pytest.approx(BOW, rel=0.1)
    # What a setting is predicted with may not come from itself.
    assert len({values["bow_y"] for values in after}) == 3
    old, new = ([state(built.predict, b, v[b]) for b in range(3)] for v in (before, after))
    done = comparing.compare(bowed, observed, old, new, rays=FEW)
    assert not done.lost and len(done.exposures) == 3
    assert 0.9 < done.pooled("after") < 1.15
    assert done.pooled("before") > done.pooled("after") + 0.05  # 1 sigma of 12,000 pixels is 0.0065
    assert done.pooled("after", core=True) < done.pooled("before", core=True)
    for x in done.exposures:
        assert x.noise_std == pytest.approx(1, abs=0.07)


def test_a_photograph_of_other_code_is_rendered_to_its_noise(tmp_path):
    """Rationale: with nothing missing, photograph less render is noise (the bar: z of 0.9 … 1.15).

    Set-up: geometric optics, settings fitted to the trace; before: a bow of a twentieth of its cap that is not there,
    settings fitted with it. Expectation: after within the bar, before larger.
    """
    if not CLEAN.exists():
        pytest.skip("../shared/recordings/bench-other-code is not there")
    recording = read(CLEAN, images=True)
    observed, built = seen(recording)
    values = probable(built, built.nuisances, {})
    wrong = probable(built, built.nuisances, {"bow_y": 0.01, "bow_z": -0.01})
    old, new = ([state(built.predict, 0, v)] for v in (wrong, values))
    done = comparing.compare(recording, observed[:1], old, new)
    (found,) = done.exposures
    assert found.noise_std == pytest.approx(1, abs=0.05)
    assert 0.9 < found.after.z_std < 1.15 and 0.9 < found.after.core_std < 1.15
    assert found.before.z_std > found.after.z_std + 0.1
    assert found.pixels > 5000 and 0.3 < found.after.blur < 1.0
    assert done.pooled("after") == pytest.approx(found.after.z_std)
    # Cells are pixels: all of the trace is shown but what marks hide.
    assert np.isfinite(found.after.z).mean() > 0.8
    (path,) = comparing.draw(done, tmp_path / "pixels.png", "clean")
    assert cv2.imread(str(path)).shape[1] > 500


@pytest.fixture(scope="module")
def laid(bowed, bowed_seen):
    """What is laid on the first photograph: the render with the bow that was fitted."""
    observed, built = bowed_seen
    s = state(built.predict, 0, probable(built, [*built.nuisances, *parameters(built, "screen-bow")], {}))
    kept = {}

    def keep(name, view, before, after):
        kept.update(render=after)
        raise BenchsimError("kept")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(comparing, "compare_exposure", keep)
        with pytest.raises(BenchsimError, match="kept"):
            comparing.compare(bowed, observed[:1], [s], [s], rays=FEW)
    return kept["render"]


def photographed(monkeypatch, light, seed, recording, observed):
    """Pixels about a trace if its photograph were this light, with noise."""
    light = np.random.default_rng(seed).normal(light + 100.0, 20 + 0.03 * light)
    seen = SimpleNamespace(linear=True, saturated=np.zeros(light.shape, bool), light=light)
    monkeypatch.setattr(about, "read_photographs", lambda *_: (seen, None))
    return about.pixels_of(recording, observed)


def test_gain_and_blur_are_those_of_the_photograph(bowed, bowed_seen, laid, monkeypatch):
    """A photograph that is a blurred multiple of the render, with noise: both come back, and z is 1."""
    light = 2e4 * cv2.GaussianBlur(laid.laser / laid.laser.max(), (0, 0), 0.8)
    found = comparing.compare_exposure("0", photographed(monkeypatch, light, 3, bowed, bowed_seen[0][0]), laid, laid)
    assert found.after is found.before
    assert found.after.gain * laid.laser.max() == pytest.approx(2e4, rel=0.01)
    assert found.after.blur == pytest.approx(0.8, abs=0.02)
    assert found.after.z_std == pytest.approx(1, abs=4 / math.sqrt(2 * found.pixels) + 0.02)


@pytest.mark.parametrize("kind", ["law", "blooming"])
def test_what_the_sensor_does_is_laid_on_the_photograph(bowed, bowed_seen, laid, monkeypatch, kind):
    """Rationale: a law of brightness and blooming belong to the sensor, which `renderer` draws after the lens's blur.

    Set-up: a photograph whose bright pixels are moved by a third of a pixel. Expectation: z of 1 where the state has
    that field or effect, far above where it has not; the lens's blur comes back, and is not put after the sensor.
    """
    level = np.array([0.0, 1.0])
    fields = {"brightness": field([level], np.stack([0.3 * level, -0.3 * level]))} if kind == "law" else {}
    of_sensor = {"saturation": {"sat": 0.5}} if kind == "blooming" else {}
    sensor = partial(charge.arrived, effects=of_sensor, fields=fields)
    light = 2e4 * sensor(cv2.GaussianBlur(laid.laser / laid.laser.max(), (0, 0), 0.8))
    view = photographed(monkeypatch, light, 4, bowed, bowed_seen[0][0])
    found = comparing.compare_exposure("0", view, laid, replace(laid, arrived=sensor))
    assert found.after.z_std == pytest.approx(1, abs=4 / math.sqrt(2 * found.pixels) + 0.02)
    assert found.before.z_std > 1.5
    assert found.after.blur == pytest.approx(0.8, abs=0.02)


def test_every_field_and_effect_that_may_be_found_is_rendered():
    drawn, fields = gather()
    assert fields == set(FORMS)
    assert {e.name for e in effects.CATALOGUE} <= set(drawn)


def test_a_law_is_rendered_like_an_effect(bowed, bowed_seen, tmp_path, monkeypatch):
    """Rationale: what a diagnosis found, a law without a name too, is in the renders "after" and not in those before.

    Set-up: the board's bow stated as a law of its height. Expectation: the states to be rendered are those of
    amended.toml and of the file; with the law the settings that fit are near the stated ones, without it they are not.
    """
    y, z = np.meshgrid(*[np.linspace(-350.0, 350.0, 15)] * 2, indexing="ij")
    height = 0.5e-3 * (BOW["bow_y"] * y**2 + BOW["bow_z"] * z**2)
    law = Law(
        "screen.height", "place on the board", {}, 0.9, 0.01,
        np.stack([y.ravel(), z.ravel()]), np.zeros(y.size, int), height.ravel(),
    )  # fmt: skip
    built = problem.build(bowed, bowed_seen[0][:1], attached=False)
    found = Diagnosis(
        verdict="located", effects=(), classes=(), law=law, rms={}, held_out=None, pulls={}, location=None, limits={},
        next=(), sigma_scale=1.0, correlation=0.0, setting_scale=1.0, probability={}, values={}, residuals=None,
    )  # fmt: skip
    amended = amended_file.amended(bowed, found)
    assert set(amended.fields) == {"height"} and not amended.effects
    result = diagnosing.DiagnosisResult(bowed, amended, found, built, (), (), "bench", tmp_path)
    kept = {}

    def keep(recording, observed, before, after, **_):
        kept.update(before=before[0], after=after[0])
        raise BenchsimError("kept")

    monkeypatch.setattr(comparing, "compare", keep)
    with pytest.raises(BenchsimError, match="kept"):
        diagnosis_drawing.draw_pixels(result, tmp_path)
    assert dict(kept["after"].recording.fields) == dict(amended.fields) and not kept["before"].recording.fields
    prior = prior_sigma(bowed.uncertainty, reseated=False)[:7]
    strain = {k: float(np.sum((to_vector(s.errors)[:7] / prior) ** 2)) for k, s in kept.items()}
    assert strain["after"] < 20 < strain["before"]


def test_a_render_that_is_not_to_be_had_costs_one_exposure(bowed, bowed_seen):
    observed, built = bowed_seen
    values = probable(built, built.nuisances, {})
    good = state(built.predict, 0, values)
    away = replace(good, errors=replace(good.errors, mirror_position=(0.0, 0.0, 500.0)))
    done = comparing.compare(bowed, observed[:2], [good, away], [good, away], rays=FEW)
    assert [x.name for x in done.exposures] == [observed[0].name]
    assert len(done.lost) == 1 and observed[1].name in done.lost[0]
    with pytest.raises(BenchsimError, match="no exposure can be compared"):
        comparing.compare(bowed, observed[1:2], [away], [away])


def test_photographs_of_unknown_gamma_are_not_rendered_again(bowed, bowed_seen, monkeypatch):
    camera = replace(bowed.cameras["A"], gamma="unknown")
    monkeypatch.setattr("benchsim.renderer.rerendered.expected", lambda *a, **k: pytest.fail("rendered"))
    with pytest.raises(BenchsimError, match=r"cameras\.A\.gamma: unknown"):
        comparing.compare(replace(bowed, cameras={"A": camera}), bowed_seen[0], [None] * 3, [None] * 3)


def test_switches_of_the_physics_stay_between_off_and_on(bowed, bowed_seen):
    vector = problem.build(bowed, bowed_seen[0], against="vector")
    s = state(vector.predict, 0, {"facets": 1.02, "beam": 0.7, "fresnel": -0.1})
    assert s.recording.effects == {"facets": {"facets": 1.0}, "finite-beam": {"beam": 0.7}}


def test_many_exposures_go_to_further_pages(tmp_path):
    grid = np.zeros((20, 5))
    one = pixels.Strip("x", np.arange(20.0), np.arange(-2.0, 3.0), grid, grid + 1, grid, grid, "nothing")
    written = pixels.strips(tmp_path / "pixels.png", [one] * 8, "eight")
    assert [p.name for p in written] == ["pixels.png", "pixels-2.png"]
    tall, short = (cv2.imread(str(p)).shape[0] for p in written)
    assert tall > 2 * short > 0
