"""Motor positions that hit, of a heliostat made by hand (`hand_made`): its own vectors say where the beam goes."""

import json
import sys
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchsim.bench.errors import BenchsimError
from benchsim.cli import app
from benchsim.instruments.mount import solar
from benchsim.jobs import aim, predict

sys.path.insert(0, str(Path(__file__).parents[1] / "instruments" / "mount"))
import hand_made as hand

NOON = "2024-06-21T11:40:00Z"
TRUE = {"tilt_n": -12.0, "tilt_u": 7.0, "IA": 3.0, "IE": -4.0, "CA": 4.0}
STATED = {
    "axis-tilt": {"tilt_n": -12.0, "tilt_u": 7.0},
    "encoder-offset": {"IA": 3.0, "IE": -4.0},
    "canting": {"CA": 4.0},
}


@pytest.fixture
def heliostat(tmp_path):
    hand.write_heliostat(tmp_path / "early", hand.recorded(6, TRUE, 1))
    hand.write_amended(tmp_path / "amended.toml", "early", STATED)
    return tmp_path


def sun(time, place):
    return solar.almanac(np.array([datetime.fromisoformat(time).timestamp()]), np.array(place))[0]


def test_the_beam_hits_to_a_micrometre(heliostat):
    for target, place in (("upper", hand.TARGET), ("0.4,-2,41.5", np.array([0.4, -2.0, 41.5]))):
        found = aim(heliostat / "amended.toml", target, NOON)
        source = hand.direction(*found.sun)
        assert np.linalg.norm(hand.hit(found.motor, source, TRUE) - place) < 1e-6
        # The faultless mount would miss by far with them.
        assert np.linalg.norm(hand.hit(found.motor, source) - place) > 0.5


def test_a_faultless_mount_s_positions_are_its_inverse_s(heliostat):
    """Its mirror 175 mm in front of the axes moves the normal by less than 5 mrad; a second step takes that in."""
    bare = heliostat / "early" / "heliostat-properties.json"
    found = aim(bare, "upper", NOON, tower=heliostat / "tower-measurements.json")
    source, centre = hand.direction(*found.sun), hand.PLACE
    for _ in range(6):
        way = (hand.TARGET - centre) / np.linalg.norm(hand.TARGET - centre)
        normal = (source + way) / np.linalg.norm(source + way)
        centre = hand.PLACE + hand.IN_FRONT * normal
    np.testing.assert_allclose(found.motor, hand.steps_for(normal), atol=1e-3)
    assert found.sigma is None


def test_play_is_said_beside_the_aim(heliostat):
    """Actuators with 1.6 and 1.2 mm of play: the beam lands to either side by what half of them does."""
    hand.write_amended(heliostat / "a.toml", "early", {"backlash": {"backlash_1": 1.6, "backlash_2": 1.2}})
    found = aim(heliostat / "a.toml", "upper", NOON)
    source = hand.direction(*found.sun)
    middle = hand.hit(found.motor, source)
    beam = (middle - hand.PLACE) / np.linalg.norm(middle - hand.PLACE)
    each = [hand.hit(found.motor, source, e) - middle for e in ({"step_1": 0.8}, {"step_2": 0.6})]
    seen = [np.linalg.norm(d - d @ beam * beam) for d in each]
    assert found.play == pytest.approx(1e3 * sum(seen), rel=0.05)
    assert f"up to {found.play:.0f} mm" in found.text() and found.as_dict()["play_mm"] == found.play
    assert aim(heliostat / "amended.toml", "upper", NOON).play == 0


def test_aimed_at_where_a_record_s_spot_was_it_finds_the_record_s_positions(heliostat, tmp_path):
    """A spot that the true mount made with 41234 and 50321 steps, by the sun of that time."""
    at = sun(NOON, [hand.LATITUDE, hand.LONGITUDE, hand.HEIGHT])
    steps = aim(heliostat / "amended.toml", "upper", NOON).motor.round() + np.array([120.0, -340.0])
    spot = hand.hit(steps, hand.direction(*at), TRUE)
    found = aim(heliostat / "amended.toml", ",".join(f"{v:.9f}" for v in spot), NOON)
    np.testing.assert_allclose(found.motor, steps, atol=1e-2)


def test_sigma_of_the_spot_is_what_a_step_of_the_parameter_does(heliostat):
    prediction = '[prediction]\nsigma_mrad = [9.0, 9.0]\nparameters = ["tilt_u"]\ncovariance = [[0.16]]\n'
    hand.write_amended(heliostat / "amended.toml", "early", STATED, prediction)
    found = aim(heliostat / "amended.toml", "upper", NOON)
    source = hand.direction(*found.sun)
    way, start = hand.beam(found.motor, source, TRUE)
    other = hand.beam(found.motor, source, {**TRUE, "tilt_u": TRUE["tilt_u"] + 0.01})[0]
    far = np.linalg.norm(hand.TARGET - start)
    right = np.array([way[1], -way[0], 0.0]) / np.hypot(way[0], way[1])
    wanted = [abs((other - way) @ v) * far * 1e3 * 0.4 / 0.01 for v in (right, np.cross(right, way))]
    np.testing.assert_allclose(found.sigma, wanted, rtol=1e-2)


def test_the_command_prints_it_alone_or_beside_a_prediction(heliostat):
    options = ["--aim", "upper", "--time", NOON, "--json"]
    alone = CliRunner().invoke(app, ["predict", str(heliostat / "amended.toml"), *options])
    assert alone.exit_code == 0, alone.output
    plain = json.loads(alone.stdout)
    assert len(plain["motor_positions"]) == 2
    hand.write_heliostat(heliostat / "late", hand.recorded(4, TRUE, 2), first=2000)
    both = predict(
        heliostat / "amended.toml", heliostat / "late", heliostat / "out", aim="upper", time=NOON, draw=False
    )
    assert both.as_dict()["aim"] == plain
    assert both.as_dict()["rms_mrad"] < 1e-6


@pytest.mark.parametrize(
    ("target", "time", "wanted"),
    [
        ("lower", NOON, "no target of .*upper"),
        ("1,2", NOON, "EAST,NORTH,UP"),
        ("1,2,nan", NOON, "EAST,NORTH,UP"),
        ("1000,2000,43000", NOON, "write metres"),
        ("upper", "noon", "no time with a zone"),
        ("upper", "", "no time with a zone"),
        ("upper", None, "no time with a zone"),
        ("upper", "2024-06-21T11:40:00", "no time with a zone"),
        ("upper", "2024-06-21T23:00:00Z", "below the horizon"),
        ("0,400,2", NOON, "choose another target or time"),
    ],
)
def test_aims_that_cannot_be_are_one_sentence(heliostat, target, time, wanted):
    with pytest.raises(BenchsimError, match=wanted) as error:
        aim(heliostat / "amended.toml", target, time)
    assert "\n" not in str(error.value)


def test_an_actuator_at_its_end_is_not_driven_further(heliostat):
    """The second one needs 48000 steps then; its file allows 40000."""
    assert aim(heliostat / "amended.toml", "upper", NOON).motor[1] > 45000
    short = hand.properties()
    short["kinematics_properties"]["actuators"][1]["max_increment"] = 40000
    (heliostat / "early" / "heliostat-properties.json").write_text(json.dumps(short), encoding="utf-8")
    with pytest.raises(BenchsimError, match="0 to 70000, 0 to 40000 steps"):
        aim(heliostat / "amended.toml", "upper", NOON)


def test_a_telescope_has_no_beam_to_aim(tmp_path):
    (tmp_path / "night.dat").write_text("120 45 119.7 44.9\n200 30 199.7 29.9\n300 60 299.7 59.9\n", encoding="utf-8")
    hand.write_amended(tmp_path / "a.toml", "night.dat", {})
    with pytest.raises(BenchsimError, match="--aim is for a heliostat"):
        aim(tmp_path / "a.toml", "upper", NOON)
