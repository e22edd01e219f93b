"""Photographs against the same exposures rendered again, in units of the photographs' noise."""

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchsim.bench.errors import BenchsimError
from benchsim.bench.files import read
from benchsim.instruments.bench import observables, problem
from benchsim.instruments.bench import pixels as about
from benchsim.instruments.bench.probable import left_out, probable, state
from benchsim.jobs import comparing
from benchsim.render import recording as rendering
from benchsim.report import pixels

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
    assert done.pooled("before") > done.pooled("after") + 0.1
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


def test_gain_and_blur_are_those_of_the_photograph(bowed, bowed_seen, monkeypatch):
    """A photograph that is a blurred multiple of the render, with noise: both come back, and z is 1."""
    observed, built = bowed_seen
    s = state(built.predict, 0, probable(built, [*built.nuisances, *parameters(built, "screen-bow")], {}))
    kept = {}

    def keep(recording, o, before, after, free):
        kept.update(render=after, free=free)
        return compare_exposure(recording, o, before, after, free)

    compare_exposure = comparing.compare_exposure
    monkeypatch.setattr(comparing, "compare_exposure", keep)
    comparing.compare(bowed, observed[:1], [s], [s], rays=FEW)
    rng = np.random.default_rng(3)
    light = 2e4 * cv2.GaussianBlur(kept["render"].laser / kept["render"].laser.max(), (0, 0), 0.8)
    light = rng.normal(light + 100.0, 20 + 0.03 * light)

    class Photograph:
        linear, saturated = True, np.zeros(light.shape, bool)

    Photograph.light = light
    monkeypatch.setattr(about, "read_photographs", lambda *_: (Photograph, None))
    found = compare_exposure(bowed, observed[0], kept["render"], kept["render"], kept["free"])
    assert found.after is found.before
    assert found.after.gain * kept["render"].laser.max() == pytest.approx(2e4, rel=0.01)
    assert found.after.blur == pytest.approx(0.8, abs=0.02)
    assert found.after.z_std == pytest.approx(1, abs=4 / math.sqrt(2 * found.pixels) + 0.02)


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
    monkeypatch.setattr("benchsim.render.again.expected", lambda *a, **k: pytest.fail("rendered"))
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
