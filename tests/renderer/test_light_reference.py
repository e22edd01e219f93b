"""The fast path against the two-scene integrator, and the scene files for plain Mitsuba."""

import re
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from light_settings import SCENES, bench
from scipy import stats

from benchsim.bench.errors import BenchsimError
from benchsim.bench.files import read
from benchsim.bench.model import Camera
from benchsim.bench.place import place
from benchsim.renderer import backend, reference
from benchsim.renderer.irradiance import irradiance
from benchsim.renderer.picture import photograph

FALSE_ALARM = 0.01
RUNS = 16


def close_up(name="fig7a"):
    """A board of 160 mm of which a film of 40 × 40 pixels sees the middle; geometric optics, the reference's own."""
    recording = bench(name, diffraction=False)
    return replace(
        recording,
        cameras={"A": Camera("A", (40, 40), 40 * 1300 / 100, (19.5, 19.5))},
        screen=replace(recording.screen, size=(160.0, 160.0), marks=None),
    )


def photographs(recording, runs, rays, shift=0.0):
    """Pictures of the fast path, (runs, rows, columns), in the reference's units; the light shifted along y [mm]."""
    exposure = recording.exposures[0]
    placement = place(recording.mirror, exposure)
    pictures = []
    for k in range(runs):
        light = irradiance(recording, exposure, seed=1000 + k, rays=rays, pitch=0.1)
        if shift:
            light = replace(light, values=np.roll(light.values, round(shift / light.pitch), axis=1))
        picture = photograph(
            recording.screen, recording.cameras["A"], light, placement=placement, samples=50, effects=recording.effects
        )
        pictures.append(picture.laser / np.pi)
    return np.array(pictures, float)


def smallest_p(a, b):
    """Smallest p-value of Welch's test per pixel, and the limit at which all pixels together are rejected (Šidák).

    Pixels with less than 2 % of the brightest pixel's light are left out: too few rays meet them for a normal law.
    """
    lit = a.mean(axis=0) > 0.02 * a.mean(axis=0).max()
    p = stats.ttest_ind(a[:, lit], b[:, lit], equal_var=False).pvalue
    return p.min(), 1 - (1 - FALSE_ALARM) ** (1 / lit.sum()), lit.sum()


@pytest.fixture(scope="module")
def rendered():
    backend.use()
    recording = close_up()
    xml = reference.scene_xml(recording, recording.exposures[0])
    return recording, np.stack([reference.render(xml, samples=2048, seed=k) for k in range(RUNS)])


def test_fast_path_and_reference_draw_the_same_picture(rendered):
    """Rationale: two tracers with nothing in common but the bench. The fast path samples the facet and bins on the
    board in differences from one ray; the reference sends rays from the laser through Mitsuba's shapes to its camera.

    Set-up: 16 pictures of the reference and 8 of the fast path, their scatter is the noise; Welch's test in every lit
    pixel, Šidák-corrected. Expectation: no pixel differs, at a false-alarm rate of 1 % for the picture; nor does the
    whole light, at 1 %.
    """
    recording, slow = rendered
    fast = photographs(recording, RUNS // 2, 1 << 19)
    p, limit, pixels = smallest_p(slow, fast)
    assert pixels > 60
    assert p > limit
    light = stats.ttest_ind(slow.sum(axis=(1, 2)), fast.sum(axis=(1, 2)), equal_var=False)
    assert light.pvalue > FALSE_ALARM


def test_the_comparison_sees_a_tenth_of_a_pixel(rendered):
    """The same with the light moved by 0.2 mm, a tenth of a pixel: rejected, so the comparison can fail."""
    recording, slow = rendered
    p, limit, _ = smallest_p(slow, photographs(recording, RUNS // 2, 1 << 19, shift=0.2))
    assert p < limit


def test_effects_that_place_and_turn_are_the_same_picture():
    """Facets that lean, further from a tilted axis, under a beam beside its aim, before a board that is turned and
    moved: Mitsuba's own shapes.

    Expectation: as above without effects, no pixel differs at a false-alarm rate of 1 % for the picture; against a
    beam that differs by 0.1 mrad it does.
    """
    backend.use()
    own = {
        "canting": {"pyr": 1.0},
        "pivot-offset": {"dr": 2.0},
        "axis-tilt": {"ped_x": 1.0},
        "beam-offset": {"bu": 1.0, "bv": -0.5},
        "screen-rotation": {"srot": 5.0},
        "screen-tilt": {"st_y": 15.0, "st_z": -18.0},
        "screen-distance": {"sx": 4.0},
    }
    recording = replace(close_up(), effects=own)
    xml = reference.scene_xml(recording, recording.exposures[0])
    slow = np.stack([reference.render(xml, samples=2048, seed=k) for k in range(RUNS // 2)])
    p, limit, pixels = smallest_p(slow, photographs(recording, RUNS // 2, 1 << 19))
    assert pixels > 60
    assert p > limit
    other = replace(recording, effects=own | {"beam-direction": {"sel": 0.1}})
    p, limit, _ = smallest_p(slow, photographs(other, RUNS // 2, 1 << 19))
    assert p < limit


def test_effects_that_are_no_scene_are_refused():
    recording = replace(close_up(), effects={"window": {"win": 2.0}})
    with pytest.raises(BenchsimError, match="window is not drawn as a Mitsuba scene"):
        reference.scene_xml(recording, recording.exposures[0])


@pytest.mark.parametrize("name", ["fig7a", "fig7b"])
def test_scene_files_say_what_the_bench_files_say(name):
    """scenes/*.xml is what `scene_xml` writes for scenes/*.toml, number by number."""
    recording = read(SCENES / f"{name}.toml", images=False)
    written = (SCENES / f"{name}.xml").read_text(encoding="utf-8")
    expected = reference.scene_xml(recording, recording.exposures[0])
    number = r"(?<![\w.])-?\d+\.?\d*(?:e-?\d+)?(?![\w.])"
    assert re.sub(number, "#", written) == re.sub(number, "#", expected), "write it anew with scene_xml"
    ours, theirs = ([float(x) for x in re.findall(number, text)] for text in (written, expected))
    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9)


def test_plain_mitsuba_renders_the_files_under_any_variant():
    """`mi.load_file` and `mi.render`, also after the variant was changed, which makes Mitsuba forget plugins."""
    first = backend.use()
    try:
        for variant in ("llvm_ad_rgb", first):
            mi.set_variant(variant)
            scene = mi.load_file(str(SCENES / "fig7a.xml"))
            picture = np.array(mi.render(scene, spp=1))
            assert picture.shape == (1500, 2000, 1)
            assert picture.sum() > 0
    finally:
        mi.set_variant(first)


def test_a_rotor_without_shapes_is_said():
    backend.use()
    with pytest.raises(RuntimeError, match="nest the rotor's shapes"):
        mi.load_string('<scene version="3.0.0"><integrator type="benchsim_spinning_mirror"/></scene>')
