"""The catalogue is complete, refuses what it does not hold, and offers what a recording could show."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchsim.bench.errors import BenchsimError
from benchsim.bench.files import read
from benchsim.bench.model import Physics, Recording
from benchsim.bench.units import IN_TEXT
from benchsim.diagnosis.problem import Effect
from benchsim.instruments.bench import effects
from benchsim.instruments.bench.candidates import candidates, not_judged
from benchsim.instruments.mount import effects as mount_effects
from benchsim.instruments.mount.records import UNITS

NAMES = """pivot-offset facets canting axis-tilt azimuth-offset second-surface facet-tilts axis-wobble facet-curvature
beam-direction beam-offset wavefront-curvature astigmatism coma finite-beam diffraction window window-tilt air-gradient
plume screen-tilt screen-rotation screen-distance screen-bow grid-scale grid-aspect grid-shear radial-distortion
tangential-distortion rolling-shutter saturation drift vibration setting-errors""".split()


@pytest.fixture(scope="module")
def bench() -> Recording:
    return read(Path(__file__).parents[2] / "scenes/campaign12.toml")


def test_catalogue_holds_every_effect_once_with_sentences():
    assert sorted(e.name for e in effects.CATALOGUE) == sorted(NAMES)
    for e in effects.CATALOGUE:
        assert e.element in effects.ELEMENTS
        assert e.says.endswith(".") and e.remedy.endswith(".") and e.source
        assert e.terms and all(t.cap > 0 for t in e.terms)
        amplitudes = [not t.grid for t in e.terms]
        assert amplitudes == sorted(amplitudes, reverse=True), "amplitudes stand before shapes"


@pytest.mark.parametrize(
    ("given", "parts"),
    [
        ({"canitng": {"pyr": 1.0}}, ("effects.canitng", "nearest name is canting")),
        ({"canting": {"pry": 1.0}}, ("effects.canting.pry", "nearest name is pyr")),
        ({"facet-tilts": {"tilt_12": 1.0}}, ("effects.facet-tilts.tilt_12", "from 0 to 11")),
        ({"second-surface": {"glass": -1.0}}, ("effects.second-surface.glass", "0 or more")),
        ({"facets": {"facets": 1.5}}, ("effects.facets.facets", "0 to 1")),
        ({"facets": {"size_mm": -1.0}}, ("effects.facets.size_mm", "0 or more")),
        ({"canting": {"size_mm": 1.0}}, ("effects.canting.size_mm", "no such parameter")),
        ({"plume": {"plume": 0.1, "plume_width": 0.0}}, ("effects.plume.plume_width", "more than 0")),
    ],
)
def test_unknown_or_impossible_effects_are_refused_in_one_sentence(bench, given, parts):
    with pytest.raises(BenchsimError) as error:
        effects.check(replace(bench, effects=given))
    text = str(error.value)
    assert text.startswith("campaign12.toml: ") and all(part in text for part in parts) and "\n" not in text


def test_every_parameter_of_the_catalogue_is_accepted(bench):
    given = {e.name: {t.name: (t.grid[0] if t.grid else 0.5) for t in e.terms} for e in effects.CATALOGUE}
    given["facet-tilts"] = {"tilt_0": 0.5, "tilt_11": -0.5}
    for name in ("facets", "finite-beam", "diffraction"):
        given[name]["size_mm"] = 2.5
    effects.check(replace(bench, effects=given))


def _names(recording: Recording, against: str = "bench") -> dict[str, Effect]:
    return {e.name: e for e in candidates(recording, against)}


def test_switches_compete_only_where_physics_has_them_false(bench):
    on = replace(bench, physics=Physics(True, True, True))
    assert not {"facets", "finite-beam", "diffraction"} & _names(on).keys()
    assert {"facets", "finite-beam", "diffraction"} <= _names(on, "vector").keys()
    assert "diffraction" in _names(replace(bench, physics=Physics(True, True, False)))
    with pytest.raises(BenchsimError, match="bench or vector"):
        candidates(bench, "paper")


def test_tilts_and_wobble_follow_the_gating(bench):
    ungated = replace(bench, exposures=tuple(replace(e, facet=None) for e in bench.exposures))
    tilts, wobble = _names(ungated)["facet-tilts"], _names(ungated)["axis-wobble"]
    assert [(p.name, p.power) for p in tilts.parameters] == [("tilt_rms", 2)] and not tilts.random_field
    assert [(p.name, p.power) for p in wobble.parameters] == [("wob_c", 2)]
    some = (replace(ungated.exposures[0], facet=3), replace(ungated.exposures[1], facet=7), *ungated.exposures[2:])
    gated = _names(replace(ungated, exposures=some))
    assert [p.name for p in gated["facet-tilts"].parameters] == ["tilt_3", "tilt_7"]
    assert gated["facet-tilts"].random_field
    assert [(p.name, p.power) for p in gated["axis-wobble"].parameters] == [("wob_c", 1), ("wob_s", 1)]


def test_what_cannot_be_observed_is_no_candidate(bench):
    at_once = replace(bench, exposures=tuple(replace(e, time=0.0) for e in bench.exposures))
    assert "drift" not in _names(at_once)
    unknown = replace(bench, cameras={k: replace(c, gamma="unknown") for k, c in bench.cameras.items()})
    assert not {"vibration", "saturation"} & _names(unknown).keys()
    assert all(p.name != "freq" for p in _names(bench)["vibration"].parameters)


def test_every_effect_is_a_candidate_or_comes_with_a_reason_why_not(bench):
    """Whatever the recording, nothing of the catalogue is passed over in silence."""
    at_once = replace(bench, exposures=tuple(replace(e, time=0.0, facet=None) for e in bench.exposures))
    blind = replace(bench, cameras={k: replace(c, gamma="unknown") for k, c in bench.cameras.items()})
    ungated = replace(blind, exposures=at_once.exposures)
    round_ = replace(bench, mirror=replace(bench.mirror, shape="cylinder"), physics=Physics(False, True, True))
    single = replace(bench, physics=Physics(False, False, False))
    for recording in (bench, at_once, blind, ungated, round_, single):
        for against in ("bench", "vector"):
            judged, rest = _names(recording, against), not_judged(recording, against)
            assert sorted([*judged, *rest]) == sorted({*NAMES} - {"setting-errors"}) and all(rest.values())
    assert not_judged(at_once)["drift"] == "all exposures are of one time"
    assert not_judged(bench)["diffraction"] == "already in the simulation" and not not_judged(bench, "vector")
    assert {n for n, why in not_judged(ungated, "vector").items() if "gamma" in why} == {
        "vibration", "saturation", "facet-tilts", "axis-wobble"
    }  # fmt: skip
    assert not_judged(round_, "vector")["facets"] == "the mirror is a cylinder"
    assert not_judged(single)["axis-wobble"] == "the simulation has no facets"


def test_entries_say_where_a_closed_form_stands_in_for_an_optics_library():
    """What `renderer` does not trace: motions and rows as shifts, polynomials of direction and lens, a thin deflector,
    waves, charge, and shares of physics that is there or not."""
    drawn = {e.name: e.drawn for e in effects.CATALOGUE if e.drawn}
    assert drawn.keys() == {
        "facets", "finite-beam", "diffraction", "astigmatism", "coma", "plume", "radial-distortion",
        "tangential-distortion", "rolling-shutter", "saturation", "drift", "vibration",
    }  # fmt: skip
    for sentence in drawn.values():
        assert sentence.startswith("Drawn ") and sentence.endswith(".") and sentence.count(".") == 1


def test_prior_is_half_the_cap_and_shapes_cover_the_light(bench):
    found = _names(bench)
    assert found["canting"].parameters[0].sigma == 5.0
    y, z = (next(p.grid for p in found["plume"].parameters if p.name == n) for n in ("plume_y", "plume_z"))
    for e in bench.exposures:
        # The light to the board's centre crosses midway to the mirror, within a plume's width of a node.
        assert np.abs(np.array(y) - e.mirror_position[1] / 2).min() < 90
        assert np.abs(np.array(z) - e.mirror_position[2] / 2).min() < 90


def test_the_ray_model_has_every_parameter_of_the_catalogue():
    from benchsim.rays.effects import EFFECTS

    assert set(EFFECTS) == set(NAMES)
    for e in effects.CATALOGUE:
        assert {t.name for t in effects.terms(e.name, 12)} <= set(EFFECTS[e.name]) | {f"tilt_{k}" for k in range(12)}


CONTRACT = """pivot-offset mm canting mrad facet-tilts mrad axis-wobble mrad axis-tilt mrad azimuth-offset mrad
second-surface mm facet-curvature 1/m beam-direction mrad beam-offset mm wavefront-curvature 1/m astigmatism 1/m
coma mrad/mm2 facets 1 finite-beam 1 diffraction 1 window mm window-tilt deg air-gradient K/m screen-distance mm
screen-tilt mrad screen-bow 1/m screen-rotation mrad grid-scale 1e-3 grid-aspect 1e-3 grid-shear 1e-3
radial-distortion 1 tangential-distortion 1 saturation px drift mm/h setting-errors 1""".split()
MIXED = {
    "plume": {"plume": "mrad", "plume_y": "mm", "plume_z": "mm", "plume_width": "mm"},
    "rolling-shutter": {"rs_s": "px", "rs_c": "px", "rs_period": "rows"},
    "vibration": {"amp": "mm", "freq": "Hz"},
}


def test_units_are_spelled_as_the_table_of_parameters_spells_them(bench):
    """Effects of one unit by their name, the others number by number; nothing is handed out that the table lacks."""
    of = dict(zip(CONTRACT[::2], CONTRACT[1::2], strict=True))
    assert {*of, *MIXED} == set(NAMES)
    for e in effects.CATALOGUE:
        for t in e.terms:
            assert t.unit == (MIXED[e.name][t.name] if e.name in MIXED else of[e.name]), t.name
        assert {t.unit for t in effects.terms(e.name, 12)} <= set(IN_TEXT)
    for against in ("bench", "vector"):
        assert {p.unit for e in candidates(bench, against) for p in e.parameters} <= set(IN_TEXT)


def test_mounts_hand_out_units_of_the_table():
    terms = [t for e in mount_effects.CATALOGUE for t in e.terms]
    assert {t.unit for t in terms} - {mount_effects.ANGLE} <= set(IN_TEXT)
    assert {"mrad", "arcsec"} <= set(IN_TEXT) and set(UNITS) - {"rad"} <= set(IN_TEXT)


def test_text_shows_no_caret_and_files_hold_plain_letters():
    for unit, text in IN_TEXT.items():
        assert unit.isascii() and "^" not in unit + text
