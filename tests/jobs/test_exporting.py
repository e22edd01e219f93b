"""What was found, written as a heliostat's file: read back it misses by the same, and ARTIST's rigid body, written down
here from its published source, points where the heliostat made by hand (`hand_made`) does."""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchsim.bench.errors import BenchsimError
from benchsim.cli import app
from benchsim.instruments.mount import paint
from benchsim.jobs import export, predict

sys.path.insert(0, str(Path(__file__).parents[1] / "instruments" / "mount"))
import hand_made as hand

TRUE = {
    **{"IA": 12.0, "IE": -9.0, "tilt_n": -25.0, "tilt_u": 18.0, "NPAE": 6.0, "CA": -7.0, "dn": 60.0},
    **{"length_1": 2.0, "length_2": -3.0, "offset_1": 1.5, "offset_2": 0.7, "radius_1": -1.1, "radius_2": 2.1},
    **{"mirror_e": 120.0, "mirror_n": -340.0, "mirror_u": 90.0, "step_1": 0.8, "step_2": -0.5},
    **{"increment_1": 0.002, "increment_2": -0.003},
}
"""Sizes at which first order would be wrong by tenths of a mrad."""

STATED = {
    "encoder-offset": ("IA", "IE"),
    "axis-tilt": ("tilt_n", "tilt_u"),
    "non-perpendicular-axes": ("NPAE",),
    "canting": ("CA",),
    "pivot-offset": ("dn",),
    "actuator-length": ("length_1", "length_2"),
    "actuator-offset": ("offset_1", "offset_2"),
    "actuator-radius": ("radius_1", "radius_2"),
    "mirror-position": ("mirror_e", "mirror_n", "mirror_u"),
    "change-point": ("step_1", "step_2"),
    "encoder-increment": ("increment_1", "increment_2"),
}


def effects(**more):
    out = {name: {k: TRUE[k] for k in terms} for name, terms in STATED.items()}
    out["change-point"]["change"] = 1500.5
    return {**out, **more}


@pytest.fixture
def heliostat(tmp_path):
    """Later records than the change, in a folder with the heliostat's file as stated."""
    hand.write_heliostat(tmp_path / "early", hand.recorded(4, {}, 1))
    hand.write_heliostat(tmp_path / "late", hand.recorded(12, TRUE, 2), first=2000)
    hand.write_amended(tmp_path / "amended.toml", "early", effects())
    return tmp_path


def test_read_back_it_misses_by_the_same(heliostat):
    """Every effect that the file can hold, at once; the records miss by mrad for another reason."""
    hand.write_records(heliostat / "late", hand.recorded(12, {**TRUE, "tilt_n": -21.0}, 2), first=2000)
    before = predict(heliostat / "amended.toml", heliostat / "late", heliostat / "a", draw=False)
    assert np.median([r.miss_mrad for r in before.records]) > 0.5
    done = export(heliostat / "amended.toml", heliostat / "exported.json")
    after = predict(heliostat / "exported.json", heliostat / "late", heliostat / "b", draw=False)
    for x, y in zip(before.records, after.records, strict=True):
        assert x.miss_mrad == pytest.approx(y.miss_mrad, abs=1e-6)
        assert x.miss_mm == pytest.approx(y.miss_mm, abs=1e-3)
    assert set(done.put_in) == set(STATED)
    # In the recordings' own place it is the heliostat's file.
    shutil.copy(heliostat / "exported.json", heliostat / "late" / "heliostat-properties.json")
    own = predict(heliostat / "late", heliostat / "late", heliostat / "c", draw=False)
    assert [r.miss_mrad for r in own.records] == pytest.approx([r.miss_mrad for r in before.records], abs=1e-6)


def artist(data, steps):
    """Normal of ARTIST 2.0's `RigidBody` from a file's constants, the first angle counted from the flat mirror.

    R_n(τ1n) R_u(τ1u) R_e(θ1) R_e(τ2e) R_n(τ2n) R_u(θ2) applied to the normal at angles 0; its `rotate_n` turns east
    toward up, against the right hand. Angles: `LinearActuators.motor_positions_to_angles`.
    """
    k = data["kinematics_properties"]
    theta = []
    for a, step, first in zip(k["actuators"], steps, (-np.pi / 2, 0.0), strict=True):
        o, r = a["offset"], a["pivot_radius"]

        def absolute(length, o=o, r=r):
            return np.arccos((o**2 + r**2 - length**2) / (2 * o * r))

        start = absolute(a["initial_stroke_length"])
        delta = start - absolute(step / a["increment"] + a["initial_stroke_length"])
        theta.append(a["initial_angle"] + first + (delta if a["clockwise_axis_movement"] == 1 else -delta))
    whole = hand.turn(1, -k["first_joint_tilt_n"]) @ hand.turn(2, k["first_joint_tilt_u"]) @ hand.turn(0, theta[0])
    whole = whole @ hand.turn(0, k["second_joint_tilt_e"]) @ hand.turn(1, -k["second_joint_tilt_n"])
    return whole @ hand.turn(2, theta[1]) @ data["initial_orientation"]


def test_artist_s_kinematics_point_where_the_heliostat_does(heliostat):
    export(heliostat / "amended.toml", heliostat / "exported.json")
    data = json.loads((heliostat / "exported.json").read_text(encoding="utf-8"))
    for steps, *_ in hand.recorded(12, TRUE, 2):
        np.testing.assert_allclose(artist(data, steps), hand.pose(steps, TRUE)[0], atol=1e-12)
    for k, actuator in enumerate(data["kinematics_properties"]["actuators"]):
        assert actuator["max_increment"] == hand.REACH[k]
        assert actuator["increment"] == pytest.approx(
            hand.ACTUATORS[k]["increment"] * (1 + TRUE[f"increment_{k + 1}"]), rel=1e-12
        )


def test_what_the_file_cannot_hold_is_said_twice(heliostat):
    law = '[fields."mount.elevation"]\nknots = [[0.3], [0.9]]\nIA_mrad = [0.1, 0.4]\nIE_mrad = [0.0, 1.1]\n'
    more = {
        "clock": {"dt": 120.0},
        "refraction": {"refr": 0.5},
        "tube-flexure": {"TF": 2.0},
        "target-position": {"target_e_1": 40.0, "target_u_1": -30.0},
        "backlash": {"backlash_1": 0.4, "backlash_2": 0.3},
        "thermal-growth": {"thermal_1": 0.6},
    }
    hand.write_amended(heliostat / "amended.toml", "early", effects(**more), law)
    done = export(heliostat / "amended.toml", heliostat / "exported.json")
    said = (heliostat / "exported.txt").read_text(encoding="utf-8")
    assert said.splitlines() == list(done.left)
    for word in (
        *more,
        "mount.elevation",
        "target_u_1 = -30 mm",
        "backlash_2 = 0.3 mm",
        "thermal_1 = 0.6 mm",
        "after its change at record 1500.5",
        "step_2 = -0.5 mm",
    ):
        assert word in said and word in done.summary()
    assert not set(more) & set(done.put_in)


def test_nothing_left_is_no_text(heliostat):
    hand.write_amended(heliostat / "amended.toml", "early", {"axis-tilt": {"tilt_n": 3.0}})
    done = export(heliostat / "amended.toml", heliostat / "exported.json")
    assert done.note is None and not done.left
    assert not (heliostat / "exported.txt").exists()


def test_a_file_with_tilts_is_diagnosed_and_amended_on_top(heliostat):
    """Half of the tilt in the heliostat's file, the rest stated: together they do not miss."""
    half = {"tilt_n": -10.0}
    hand.write_amended(heliostat / "half.toml", "early", {"axis-tilt": half})
    export(heliostat / "half.toml", heliostat / "early" / "heliostat-properties.json.new")
    (heliostat / "early" / "heliostat-properties.json.new").rename(heliostat / "early" / "heliostat-properties.json")
    hand.write_records(heliostat / "late", hand.recorded(5, {"tilt_n": -16.0}, 2), first=2000)
    hand.write_amended(heliostat / "amended.toml", "early", {"axis-tilt": {"tilt_n": -6.0}})
    done = predict(heliostat / "amended.toml", heliostat / "late", heliostat / "out", draw=False)
    assert max(r.miss_mrad for r in done.records[:5]) < 1e-6
    assert max(r.stated_mrad for r in done.records[:5]) > 2.0


@pytest.mark.parametrize(
    ("key", "value", "wanted"),
    [
        ("first_joint_tilt_n", 3.0, "write radians"),
        ("second_joint_tilt_n", "much", "second_joint_tilt_n"),
        ("initial_orientation", [0.0, 0.0, 1.0], "points south"),
        ("initial_orientation", [0.0, -1.0], "initial_orientation"),
        ("initial_orientation", [0.0, 0.0, 0.0], "points south"),
    ],
)
def test_tilts_that_cannot_be(heliostat, key, value, wanted):
    data = hand.properties()
    (data if key in data else data["kinematics_properties"])[key] = value
    (heliostat / "early" / "heliostat-properties.json").write_text(json.dumps(data), encoding="utf-8")
    with pytest.raises(BenchsimError, match=wanted) as error:
        paint.read(heliostat / "early")
    assert "heliostat-properties.json" in str(error.value) and "\n" not in str(error.value)


def test_the_command(heliostat, monkeypatch):
    monkeypatch.chdir(heliostat)
    assert CliRunner().invoke(app, ["export", "amended.toml"]).exit_code == 2
    done = CliRunner().invoke(app, ["export", "amended.toml", "--paint", "--json"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["file"] == "amended-heliostat-properties.json"
    assert (heliostat / "amended-heliostat-properties.json").is_file()


def test_exports_that_cannot_be_are_one_sentence(heliostat):
    with pytest.raises(BenchsimError, match="is an input"):
        export(heliostat / "amended.toml", heliostat / "early" / "heliostat-properties.json")
    with pytest.raises(BenchsimError, match="cannot be written"):
        export(heliostat / "amended.toml", heliostat / "amended.toml" / "x.json")
    (heliostat / "night.dat").write_text("120 45 119.7 44.9\n200 30 199.7 29.9\n300 60 299.7 59.9\n", encoding="utf-8")
    hand.write_amended(heliostat / "t.toml", "night.dat", {})
    with pytest.raises(BenchsimError, match="is of a telescope"):
        export(heliostat / "t.toml", heliostat / "x.json")


def test_artist_itself_reads_it(heliostat, monkeypatch):
    """artist-csp 2.0: its reader takes the file, and its rigid body, given the tilts that its reader leaves out and the
    first angle from the flat mirror, has the normal of the heliostat made by hand to what single precision leaves.
    Canting is left out: the rigid body does not use ``initial_orientation``."""
    # It opens a log where it is imported.
    monkeypatch.chdir(heliostat)
    pytest.importorskip("artist", reason="artist-csp is not installed (extra: peers)")
    import torch
    from artist.field import RigidBody
    from artist.io import paint_scenario_parser
    from artist.util import constants

    true = {k: v for k, v in TRUE.items() if k != "CA"}
    hand.write_amended(heliostat / "amended.toml", "early", {k: v for k, v in effects().items() if k != "canting"})
    facet = {"translation_vector": [0.0, 0.0, 0.0], "canting_e": [0.8, 0.0, 0.0], "canting_n": [0.0, 0.6, 0.0]}
    data = {**hand.properties(), "facet_properties": {"number_of_facets": 1, "facets": [facet]}}
    (heliostat / "early" / "heliostat-properties.json").write_text(json.dumps(data), encoding="utf-8")
    export(heliostat / "amended.toml", heliostat / "exported.json")
    kinematics = json.loads((heliostat / "exported.json").read_text(encoding="utf-8"))["kinematics_properties"]
    cpu = torch.device("cpu")
    plant = torch.tensor([hand.LATITUDE, hand.LONGITUDE, hand.HEIGHT], dtype=torch.float64)
    position, _, _, moved, orientation, actuators = paint_scenario_parser.extract_paint_heliostat_properties(
        heliostat / "exported.json", plant, cpu
    )
    # Its plane is flat: a linear approximation about the plant.
    wanted = hand.PLACE + np.array([true[f"mirror_{k}"] for k in "enu"]) / 1e3
    np.testing.assert_allclose(position[:3].numpy(), wanted, atol=1e-2)
    names = [f"{part}_translation_{k}" for part in ("first_joint", "second_joint", "concentrator") for k in "enu"]
    joints = [
        f"{joint}_joint_tilt_{k}" for joint, k in (("first", "n"), ("first", "u"), ("second", "e"), ("second", "n"))
    ]
    fixed, free = torch.zeros(1, 7, 2), torch.zeros(1, 2, 2)
    for k, (_, clockwise, reach, a) in enumerate(actuators):
        lengths = [float(v) for v in (a.increment, a.offset, a.pivot_radius)]
        fixed[0, :, k] = torch.tensor([constants.linear_actuator_int, float(clockwise), *map(float, reach), *lengths])
        first = float(a.initial_angle) - (np.pi / 2 if k == 0 else 0.0)
        free[0, :, k] = torch.tensor([first, float(a.initial_stroke_length)])
    body = RigidBody(
        number_of_heliostats=1,
        heliostat_positions=position[None],
        initial_orientations=orientation[None],
        translation_deviation_parameters=torch.tensor([[float(getattr(moved, n)) for n in names]]),
        rotation_deviation_parameters=torch.tensor([[kinematics[n] for n in joints]]),
        actuator_parameters_non_optimizable=fixed,
        actuator_parameters_optimizable=free,
        device=cpu,
    )
    # As its groups activate heliostats.
    body.number_of_active_heliostats = 1
    body.active_heliostat_positions = body.heliostat_positions
    body.active_initial_orientations = body.initial_orientations
    body.active_translation_deviation_parameters = body.translation_deviation_parameters
    body.active_rotation_deviation_parameters = body.rotation_deviation_parameters
    body.actuators.active_non_optimizable_parameters = body.actuators.non_optimizable_parameters
    body.actuators.active_optimizable_parameters = body.actuators.optimizable_parameters
    flat = torch.tensor([0.0, 0.0, 1.0, 0.0])
    for steps, *_ in hand.recorded(12, true, 2):
        whole = body.motor_positions_to_orientations(torch.tensor(steps[None], dtype=torch.float32), cpu)
        # Its lengths are softened (softplus), the strokes by some 5 µm.
        np.testing.assert_allclose((whole[0] @ flat)[:3].numpy(), hand.pose(steps, true)[0], atol=1e-4)
