"""What was found goes into the file: on top of what it had, held to what is physical, standing where it lies."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchsim.bench.fields import FORMS, evaluate, field
from benchsim.bench.files import read
from benchsim.diagnosis.result import Class, Diagnosis, Found, Law, Residuals, Size
from benchsim.instruments.bench import amended_file, effects

SCENE = Path(__file__).resolve().parents[2] / "scenes" / "fig7a.toml"
NONE = np.zeros(0)


def diagnosis(found=(), classes=(), law=None, values=None):
    """A diagnosis that holds these effects: name → parameter → value."""
    entries = tuple(
        Found(name, "x", 1.0, "named", {k: Size(v, 0.1, "1") for k, v in own.items()}, "", "") for name, own in found
    )
    return Diagnosis(
        "named", entries, classes, None, law, {}, None, {}, {}, (), 1.0, 0.0, 1.0, {}, values or {},
        Residuals(NONE, NONE, NONE, NONE, NONE),
    )  # fmt: skip


@pytest.fixture(scope="module")
def recording():
    return read(SCENE, images=False)


def test_amplitudes_are_added_and_shapes_replace(recording):
    plume = {"plume": 0.5, "plume_y": 10.0, "plume_z": -300.0, "plume_width": 60.0}
    stated = replace(recording, effects={"canting": {"pyr": 1.5}, "plume": plume})
    again = {"plume": 0.25, "plume_y": 40.0, "plume_z": -250.0, "plume_width": 80.0}
    got = amended_file.amended(
        stated, diagnosis([("canting", {"pyr": -0.5}), ("plume", again), ("drift", {"dry": 0.1})])
    )
    assert got.effects == {"canting": {"pyr": 1.0}, "plume": {**again, "plume": 0.75}, "drift": {"dry": 0.1}}
    assert stated.effects["canting"] == {"pyr": 1.5}
    assert amended_file.put_in(stated, got) == ("canting", "plume", "drift")
    effects.check(got)


def test_what_was_found_is_held_to_what_is_physical(recording):
    found = [("facets", {"facets": 1.03}), ("window", {"win": -0.01}), ("vibration", {"amp": 0.02})]
    got = amended_file.amended(recording, diagnosis(found), against="vector")
    assert got.effects == {"facets": {"facets": 1.0}, "window": {"win": 0.0}, "vibration": {"amp": 0.02}}
    assert (got.physics.facets, got.physics.beam, got.physics.diffraction) == (False, False, False)
    effects.check(got)


def test_of_a_class_the_most_probable_member_is_put_in(recording):
    rivals = Class((("screen-tilt",), ("grid-aspect",)), 0.99, None, stated=True)
    values = {"st_y": 2.0, "st_z": -1.0, "s1.mirror_axis_1": 0.3}
    got = amended_file.amended(recording, diagnosis(classes=(rivals,), values=values))
    assert got.effects == {"screen-tilt": {"st_y": 2.0, "st_z": -1.0}}
    hands = diagnosis(classes=(replace(rivals, members=((), ("setting-errors",))),), values=values)
    assert amended_file.amended(recording, hands) == recording


def test_nothing_found_leaves_the_recording_as_it_is(recording):
    assert amended_file.amended(recording, diagnosis()) == recording


def law(name, knots, component, coefficients):
    return Law(name, "", {}, 0.9, 0.1, np.array(knots, float), np.array(component), np.array(coefficients, float))


def test_a_law_becomes_the_field_of_its_element_in_the_file_s_units(recording):
    y, z = np.meshgrid([-100.0, 0.0, 100.0], [-50.0, 50.0], indexing="ij")
    knots = np.column_stack([y.ravel(), z.ravel()])
    values = knots[:, 0] + 2 * knots[:, 1]
    got = amended_file.amended(
        recording, diagnosis(law=law("air.kick", np.tile(knots, (2, 1)), [0] * 6 + [1] * 6, [*values, *-values]))
    )
    assert tuple(got.fields) == ("kick",) and amended_file.put_in(recording, got) == ("field kick",)
    at = evaluate(got.fields["kick"], 100.0, -50.0)
    assert at == pytest.approx([0.0, 0.0], abs=1e-12)
    # mrad in the file, rad inside.
    assert evaluate(got.fields["kick"], 100.0, 50.0) == pytest.approx([0.2, -0.2])


def test_a_law_over_one_value_of_a_coordinate_is_constant_in_it(recording):
    knots = [[phase, 3.0] for phase in (-5.0, 0.0, 5.0)]
    got = amended_file.amended(recording, diagnosis(law=law("mirror.lean", knots, [0] * 3, [1.0, 2.0, 4.0])))
    assert FORMS["lean"].coordinates[1][0] == "facet"
    for facet in (0.0, 3.0, 9.0):
        assert evaluate(got.fields["lean"], np.radians(5.0), facet) == pytest.approx([4e-3])


def test_fields_of_one_name_add_up(recording):
    old = field([[0.0, 2.0]], [[0.0, 2.0], [1.0, 1.0]])
    new = field([[0.0, 1.0, 2.0]], [[0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    both = amended_file.summed(old, new)
    for t in (0.0, 0.5, 1.0, 2.0):
        assert evaluate(both, t) == pytest.approx(evaluate(old, t) + evaluate(new, t))


def test_the_file_stands_where_it_will_lie(recording, tmp_path):
    """Images are named from the folder that the file will lie in; read back, it is the amended recording."""
    source = tmp_path / "night" / "recording"
    (source / "more").mkdir(parents=True)
    for name in ("001.png", "more/dark.png"):
        (source / name).write_bytes(b"x")
    exposure = replace(recording.exposures[0], image="001.png", dark="more/dark.png")
    stated = replace(recording, exposures=(exposure,), path=source / "recording.toml")
    got = amended_file.amended(stated, diagnosis([("screen-bow", {"bow_y": 0.0312, "bow_z": -0.0121})]))
    target = tmp_path / "out"
    target.mkdir()
    amended_file.write_amended(got, target / "amended.toml", target)
    again = read(target / "amended.toml", images=True, allow_outside=True)
    assert again.effects == got.effects and again.laser == stated.laser and again.uncertainty == stated.uncertainty
    assert again.screen.marks == stated.screen.marks
    assert again.exposures[0].image == "../night/recording/001.png"
    assert (again.folder / again.exposures[0].dark).resolve() == source / "more" / "dark.png"
    assert "render" not in (target / "amended.toml").read_text()
