"""Arrays of detectors and prisms in a plant's file, and mirrors that stand before others."""

import numpy as np
import pytest

from benchsim.bench.errors import BenchsimError
from benchsim.jobs.detectors_result import tables_of
from benchsim.plant import files
from benchsim.plant.hiding import hidden

ROW = '[[detector]]\nname = "{}"\nalong = "{}"\noffset_m = 3\nfrom_m = -4\nto_m = 4.05\npitch_m = 0.1\n'
TWO = ROW.format("over", "horizontal") + ROW.format("beside", "vertical")


def added(written, text):
    folder = written()
    with (folder / "plant.toml").open("a") as file:
        file.write(text)
    return folder


def test_arrays_are_as_stated_or_as_suits_the_field(written):
    plant = files.read(added(written, TWO))
    over, beside = plant.station.arrays
    assert (over.name, over.upright, over.offset, over.count) == ("over", False, 3000.0, 81)
    assert beside.upright and plant.station.remarks == ()
    suited = files.read(written()).station
    assert len(suited.arrays) == 2 and "No [[detector]]" in suited.remarks[0]
    assert np.allclose(suited.frame @ suited.frame.T, np.eye(3)) and np.linalg.det(suited.frame) > 0


@pytest.mark.parametrize("far", [60.0, 71.3, 83.7, 97.1])
@pytest.mark.parametrize(
    "kind", ["width_m = 3.0\n", 'kind = "cylinder"\ndiameter_m = 3.0\n'], ids=["plane", "cylinder"]
)
def test_arrays_that_suit_a_field_are_the_same_when_written_and_read(written, far, kind):
    """Beside the second receiver, whose arrays a file has to name; pitches by the nearest heliostat."""
    other = '[[receiver]]\nname = "other"\ncentre_m = [0.0, 0.0, 32.0]\nheight_m = 3.0\n' + kind
    table = f"id,east_m,north_m,up_m,receiver\nA,0,{far},0,other\nB,15,90,0,other\nC,30,90,0,target\n"
    own = [("width_m = 3.0\nheight_m = 3.0\n[sun]", f"width_m = 3.0\nheight_m = 3.0\n{other}[sun]")]
    folder = written(*own, table=table)
    suited = files.read(folder)
    with (folder / "plant.toml").open("a") as file:
        file.write(tables_of(suited))
    again = files.read(folder).station
    assert again.remarks == () and again.receiver == suited.station.receiver == 1
    np.testing.assert_allclose(again.frame, suited.station.frame, atol=1e-12)
    for a, b in zip(again.arrays, suited.station.arrays, strict=True):
        assert a.count == b.count and a.upright == b.upright
        np.testing.assert_allclose((a.offset, a.low, a.pitch), (b.offset, b.low, b.pitch), rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (ROW.format("a", "horizontal") * 2, "two have one name"),
        (TWO + 'receiver = "elsewhere"\n', r"detector\[2\].receiver: 'elsewhere' is none of"),
        (TWO + "azimuth_deg = 5\n", r"detector\[2\].azimuth_deg: all arrays stand on one plane"),
        (TWO.replace("to_m = 4.05", "to_m = -4"), "is not beyond from_m"),
        (TWO.replace("pitch_m = 0.1", "pitch_m = 0.005"), "detectors are more than"),
        ("[prisms]\nrate_high_hz = 260\n", "within an octave"),
        ("[prisms]\nsample_rate_hz = 400\n", "passes rates below 160 Hz"),
        ("[prisms]\nlongest_s = 5\n", "is shorter than record_s"),
    ],
)
def test_what_is_wrong_with_them_is_told_in_a_sentence(written, text, says):
    with pytest.raises(BenchsimError, match=says):
        files.read(added(written, text))


def test_a_mirror_before_another_hides_it():
    """Looking north: the second stands in the way of the first, the third beside it."""
    position = np.array([[0.0, 0, 0], [0.5e3, 8e3, 0], [6e3, 8e3, 0]])
    normals = np.tile([0.0, 1.0, 0.0], (3, 1))
    size = np.full(3, 2e3)
    assert hidden(position, normals, size, size, np.array([0.0, 1.0, 0.0])).tolist() == [True, False, False]
    assert not hidden(position, normals, size, size, np.array([0.0, -1.0, 0.0]))[0]
    assert not hidden(position, normals, size, size, np.array([0.0, 1.0, 1.0])).any()


@pytest.mark.parametrize("scale", [1.0, 100e3], ids=["unit", "whole"])
def test_a_mirror_before_a_point_hides_it_and_one_beyond_does_not(scale):
    """Toward a point 100 m off: the second mirror stands 8 m before the first, the third 8 m beyond the point."""
    position = np.array([[0.0, 0, 0], [0.5e3, 8e3, 0], [0.0, 108e3, 0]])
    normals, size = np.tile([0.0, 1.0, 0.0], (3, 1)), np.full(3, 2e3)
    ways = np.tile([0.0, scale, 0.0], (3, 1))
    far = np.full(3, 100e3)
    assert hidden(position, normals, size, size, ways, far).tolist() == [True, False, False]
    assert not hidden(position[[0, 2]], normals[:2], size[:2], size[:2], ways[:2], far[:2]).any()
    assert hidden(position[[0, 2]], normals[:2], size[:2], size[:2], ways[:2]).tolist() == [True, False]


def test_rays_meet_the_mirrors_that_a_look_at_every_pair_finds():
    """A field of 300 in random places, rays at 10 deg to 80: against each pair computed alone."""
    rng = np.random.default_rng(61)
    position = np.column_stack([rng.uniform(-60e3, 60e3, (300, 2)), rng.uniform(2e3, 4e3, 300)])
    normals = rng.normal(size=(300, 3)) * [0.3, 0.3, 0.0] + [0.0, 0.6, 0.8]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    width, height = rng.uniform(3e3, 9e3, (2, 300))
    target = np.array([0.0, 0.0, 30e3])
    for ways, reach in ((np.array([0.0, 0.98, 0.17]), np.inf), (target - position, 20e3)):
        rays = np.broadcast_to(ways, (300, 3)) / np.linalg.norm(np.broadcast_to(ways, (300, 3)), axis=1)[:, None]
        expected = []
        for i, ray in enumerate(rays):
            way = ((position - position[i]) * normals).sum(axis=1) / (normals @ ray)
            met = position[i] + way[:, None] * ray - position
            across = np.cross([0.0, 0.0, 1.0], normals)
            across /= np.linalg.norm(across, axis=1, keepdims=True)
            up = np.cross(normals, across)
            on = (np.abs((met * across).sum(axis=1)) < width / 2) & (np.abs((met * up).sum(axis=1)) < height / 2)
            expected.append((on & (way > 1.0) & (way < reach)).any())
        assert 0.02 < np.mean(expected) < 0.98
        assert hidden(position, normals, width, height, ways, reach).tolist() == expected
