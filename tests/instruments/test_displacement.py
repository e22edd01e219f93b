"""What a switch of the physics moves on the trace, beside its share: against the ray model's own curves."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchsim import rays
from benchsim.bench.curve import signed_distance
from benchsim.bench.files import read
from benchsim.diagnosis.result import Diagnosis, Found, Residuals, Size
from benchsim.instruments.bench import amended_file, displacement, effects, observables
from benchsim.instruments.bench.candidates import simulated
from benchsim.instruments.bench.prediction import SAMPLES
from benchsim.instruments.bench.problem import build

SCENE = Path(__file__).resolve().parents[2] / "scenes" / "campaign12.toml"
NONE = np.zeros(0)


def diagnosis(values, sigma=0.02):
    """A diagnosis that found each effect of name → (parameter, value), and nothing about the settings."""
    found = tuple(
        Found(name, "x", 1.0, "named", {key: Size(value, sigma, "1")}, "", "") for name, (key, value) in values.items()
    )
    return Diagnosis(
        "named", found, (), None, None, {}, None, {}, {}, (), 1.0, 0.0, 1.0, {}, dict(values.values()),
        Residuals(NONE, NONE, NONE, NONE, NONE),
    )  # fmt: skip


@pytest.fixture(scope="module")
def made():
    whole = read(SCENE, images=False)
    recording = replace(whole, exposures=whole.exposures[:2])
    return recording, build(recording, observables.simulate(recording, seed=3), against="vector", attached=False)


def test_the_size_is_the_rms_by_which_the_trace_moves(made):
    """Rationale: a share of 0.9 says nothing in millimetres. Expectation: where the two curves of the ray model, with
    and without facets, lie apart at the data's points."""
    recording, problem = made
    (got,) = displacement.sized(problem, diagnosis({"facets": ("facets", 0.9)})).effects
    apart = []
    bare = replace(recording, physics=simulated(recording, "vector"))
    for block in problem.predict.blocks:
        exposure = recording.exposures[block.observed.index]
        there, without = (
            signed_distance(
                rays.predict(replace(bare, effects=given), exposure, samples=SAMPLES, width=False),
                block.observed.points,
            )[0]
            for given in ({"facets": {"facets": 0.9}}, {})
        )
        apart.append(there - without)
    size = got.parameters["size_mm"]
    assert got.parameters["facets"] == Size(0.9, 0.02, "1") and size.unit == "mm"
    assert size.value == pytest.approx(np.sqrt(np.mean(np.concatenate(apart) ** 2)), rel=1e-6)
    assert 0.001 < size.value < 1 and size.sigma / size.value == pytest.approx(0.02 / 0.9)


def test_it_is_of_the_fitted_point_and_of_each_switch_alone(made):
    """All three together; diffraction changes the width and moves little. A share of 0 is still as uncertain."""
    _, problem = made
    d = diagnosis({"facets": ("facets", 0.9), "finite-beam": ("beam", 0.95), "diffraction": ("fresnel", 0.8)})
    got = {f.name: f.parameters["size_mm"] for f in displacement.sized(problem, d).effects}
    alone = displacement.sized(problem, diagnosis({"facets": ("facets", 0.9)})).effects[0].parameters["size_mm"]
    assert got["facets"].value != pytest.approx(alone.value, rel=0.05)
    assert got["finite-beam"].value > 0.001 and got["diffraction"].value < 0.1 * got["finite-beam"].value
    nothing = displacement.sized(problem, diagnosis({"facets": ("facets", 0.0)})).effects[0].parameters["size_mm"]
    assert nothing.value == 0 and nothing.sigma == pytest.approx(0.02 * alone.value / 0.9, rel=1e-2)


def test_other_effects_stay_as_they_are(made):
    _, problem = made
    d = diagnosis({"canting": ("pyr", 1.5)})
    assert displacement.sized(problem, d) == d


def test_the_amended_file_states_the_share_and_a_file_may_state_both(made):
    recording, problem = made
    d = displacement.sized(problem, diagnosis({"facets": ("facets", 0.9)}))
    stated = replace(recording, effects={"facets": {"facets": 0.05, "size_mm": 2.0}})
    effects.check(stated)
    assert amended_file.amended(recording, d, against="vector").effects == {"facets": {"facets": 0.9}}
    assert amended_file.amended(stated, d, against="vector").effects == {"facets": {"facets": pytest.approx(0.95)}}
