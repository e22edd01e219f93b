"""Which picture is the dark one of which."""

import numpy as np
from phone_pictures import picture, save

from benchsim.intake.pairing import gain, laser_light, pair
from benchsim.intake.photo import read_photo


def pairs(paths):
    read = [read_photo(p) for p in paths]
    return pair([p for p, _ in read], [laser_light(c) for _, c in read])


def test_light_gained_and_lost():
    on, off, other = (laser_light(picture(c, seed=i)[..., ::-1]) for i, c in enumerate((100, None, 160)))
    assert gain(on, off) == 1 and gain(off, on) == -1
    assert gain(on, other) == 0 and gain(off, laser_light(picture(None, seed=7)[..., ::-1])) == 0
    assert gain(on, off[:-1]) == 0


def test_a_red_thing_in_the_room_is_no_laser():
    """Rationale: what stands still in both pictures says nothing, however red."""
    with_laser, without = picture(100, seed=1), picture(None, seed=2)
    for counts in (with_laser, without):
        counts[150:200, 200:300, 0] = 250
    assert gain(*(laser_light(c[..., ::-1]) for c in (with_laser, without))) == 1


def test_pairs_are_told_by_the_light(phone):
    paths = sorted(phone.iterdir(), key=lambda p: int(p.stem[4:]))
    assert pairs(paths) == [(0, 1), (2, 3), (4, 5)]
    # Dark first, and one without: nothing is paired that shows two lines.
    assert pairs([paths[1], paths[0], paths[2], paths[4], paths[5]]) == [(1, 0), (2, None), (3, 4)]


def test_pairs_are_told_by_name(tmp_path):
    names = ["a.jpg", "b.jpg", "a-dark.jpg"]
    paths = [save(tmp_path / n, picture(100, seed=i)) for i, n in enumerate(names)]
    assert pairs(paths) == [(0, 2), (1, None)]


def test_mono_of_sixteen_bits():
    on = picture(100)[..., 0].astype(np.uint16) * 257
    off = picture(None, seed=3)[..., 0].astype(np.uint16) * 257
    assert gain(laser_light(on), laser_light(off)) == 1
