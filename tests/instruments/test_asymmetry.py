"""Where along its axis the mirror stands, read from how unevenly light lies on the two sides of its trace.

Scenario: Fig. 7(a) photographed by the other realisation with a camera of half the resolution, the mirror two of its
prior sigma off along its axis and all else as stated. The beam's density then falls over the facet's height, which
brightens one tail of the line. Centre line, width and flux hardly tell this place from the laser's and the axis'
angles; the tails do. The truth is known: the reading about it must be nothing, about a state beside it the way back,
and a fitted setting must come nearer to it.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchsim.bench.files import read
from benchsim.bench.place import SettingErrors, place
from benchsim.bench.settings import to_vector
from benchsim.instruments.bench import asymmetry, observables, problem
from benchsim.instruments.bench.fitted_simulation import probable
from benchsim.instruments.bench.pixels import pixels_of
from benchsim.instruments.bench.prediction import UNITS, errors
from benchsim.renderer import recording as rendering

ROOT = Path(__file__).parents[2]

OFF = 2.0
"""Of the mirror along its axis [mm], in prior sigma of 1 mm."""

BESIDE = 1.0
"""Of a state from the truth [mm]."""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Recording, its truth, problem, true values of setting and beam with blur and gain as fitted, and pixels."""
    whole = read(ROOT / "scenes" / "fig7a.toml", images=False)
    camera = whole.cameras["A"]
    (w, h), (cx, cy) = camera.resolution, camera.principal_point
    small = replace(
        camera, resolution=(w // 2, h // 2), focal=camera.focal / 2, principal_point=(cx / 2 - 0.25, cy / 2 - 0.25)
    )
    axis = place(whole.mirror, whole.exposures[0]).axis
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rendering, "draw_errors", lambda *_: (SettingErrors(mirror_position=OFF * axis),))
        bench = replace(whole, cameras={"A": small})
        truth = rendering.render_recording(bench, tmp_path_factory.mktemp("uneven"), seed=5)
    recording = truth.recording
    observed, lost = observables.observe(recording)
    assert not lost
    built = problem.build(recording, observed, attached=False)
    fitted = probable(built, built.nuisances, {})
    block = built.predict.blocks[0]
    stands = to_vector(truth.errors[0]) / np.array([1.0 if unit == "mm" else 1e-3 for unit in UNITS])
    true = {name: float(x) for name, x in zip(block.setting, stands, strict=True) if name}
    true |= {name: fitted[name] for name in ("A.blur", f"{observed[0].name}.gain")}
    true["beam_diameter"] = truth.laser.beam_diameter / recording.laser.beam_diameter - 1
    true["divergence"] = truth.laser.divergence / recording.laser.divergence - 1
    pixels = pixels_of(recording, observed[0])
    assert pixels is not None
    return truth, built, fitted, true, pixels


def along_axis(truth, built, values, by=0.0):
    """Error of the mirror's place along its axis [mm], and the values with the mirror moved by so much along it."""
    block, axis = built.predict.blocks[0], truth.placements[0].axis
    off = errors(values, block.setting).mirror_position - truth.errors[0].mirror_position
    moved = {name: values.get(name, 0.0) + by * a for name, a in zip(block.setting[:3], axis, strict=True)}
    return float(off @ axis), {**values, **moved}


def test_the_reading_is_nothing_at_the_truth_and_the_way_back_beside_it(made):
    """Rationale: render and rays agree on the light in a line's tails, not only on its place and width.

    Expectation: 4 sigma of the pixels' own noise (a false alarm in 16000 each), which is below half a millimetre.
    """
    truth, built, _, true, pixels = made
    here = asymmetry.measure(built.predict, 0, true, pixels)
    assert 0 < here.sigma < 0.5 and abs(here.value) < 4 * here.sigma
    for by in (-BESIDE, BESIDE):
        beside = asymmetry.measure(built.predict, 0, along_axis(truth, built, true, by)[1], pixels)
        # The noise is common to both; what is left is of second order in the step.
        assert beside.value - here.value == pytest.approx(-by, abs=0.5 * BESIDE)
        # What is read beside the truth is predicted for the truth.
        block = asymmetry.stands(built.predict, 0, true)
        assert beside.predicted(block) == pytest.approx(beside.value, abs=4 * beside.sigma)


def test_a_setting_comes_nearer_to_where_it_stands(made):
    """Set-up: the setting as centre line, width, flux and the prior have it, which leave most of the error.

    Expectation: with the reading the error is what noise and prior leave (4 of their sigma), and less than half.
    """
    truth, built, fitted, true, pixels = made
    sigma = asymmetry.measure(built.predict, 0, true, pixels).sigma
    (new,) = asymmetry.settled(built, [pixels], [fitted])
    before, after = (along_axis(truth, built, v)[0] for v in (fitted, new))
    assert abs(before) > 0.5
    assert abs(after) < 0.5 * abs(before)
    # Data of sigma s and a prior of 1 mm draw the place s² of its distance toward the stated one.
    assert abs(after) < 4 * sigma + sigma**2 * OFF
    # Centre line, width, flux and marks fit as well as without.
    rows, covariance = built.rows(0), built.covariance[0]
    chi2 = [
        float(r @ np.linalg.solve(covariance, r))
        for r in (built.data[rows] - built.predict(v, 0) for v in (fitted, new))
    ]
    assert chi2[1] < chi2[0] + 9
    # What settings share is held.
    assert {k: new[k] for k in ("beam_diameter", "beam_c4")} == {k: fitted[k] for k in ("beam_diameter", "beam_c4")}


def test_the_joined_problem_has_one_datum_more_for_each_reading(made):
    _, built, fitted, _, pixels = made
    reading = asymmetry.measure(built.predict, 0, fitted, pixels)
    joined = asymmetry.joined(built, {0: reading})
    assert len(joined.data) == len(built.data) + 1 and joined.kind[-1] == "a" and joined.data[-1] == reading.value
    assert joined.covariance[0][-1, -1] == reading.sigma**2 and not joined.covariance[0][-1, :-1].any()
    # Measured about these values, it is 0 there, and one millimetre a millimetre along the axis.
    here, lists = joined.predict(fitted, 0), joined.predict([fitted, fitted], [0, 0])
    assert here[-1] == pytest.approx(0, abs=1e-9) and np.array_equal(here, lists[1])
    axis = made[0].placements[0].axis
    names = built.predict.blocks[0].setting[:3]
    step = {n: fitted.get(n, 0.0) + 0.05 * a for n, a in zip(names, axis, strict=True)}
    assert joined.predict({**fitted, **step}, 0)[-1] == pytest.approx(0.05, rel=0.1)


def test_a_simulation_without_beam_has_no_reading(made):
    """A single ray has no profile: nothing is measured, values stay. With its switches on it is the full simulation."""
    truth, built, _, true, pixels = made
    vector = problem.build(
        truth.recording, tuple(b.observed for b in built.predict.blocks), against="vector", attached=False
    )
    assert asymmetry.measure(vector.predict, 0, {}, pixels) is None
    assert asymmetry.settled(vector, [pixels], [{"7a.mirror_axis_1": 0.3}]) == [{"7a.mirror_axis_1": 0.3}]
    on = {**true, "facets": 1.0, "beam": 1.0, "fresnel": 1.0}
    full = asymmetry.measure(built.predict, 0, true, pixels)
    assert asymmetry.measure(vector.predict, 0, on, pixels).value == pytest.approx(full.value, abs=1e-6)
    glass = replace(
        built.predict, recording=replace(truth.recording, effects={"second-surface": {"glass": 3.0}}), cache={}
    )
    assert asymmetry.measure(glass, 0, true, pixels) is None
