"""Pictures whose own words contradict each other."""

from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import pytest

from benchsim.bench.model import Camera
from benchsim.intake import metadata
from benchsim.intake.photo import Photo

PHOTO = Photo(
    Path("a.jpg"), (4000, 3000), 8, True, 1, datetime(2026, 5, 4, 9), 0.5, 50.0, 1.8, 5.6, 26.0, 1.0, "Acme P1"
)


def other(**changes):
    return replace(PHOTO, path=Path("b.jpg"), **changes)


def test_alike_pictures_raise_nothing():
    later = other(time=PHOTO.time + timedelta(minutes=1))
    assert metadata.same_lens([PHOTO, later], ["A", "A"]) == []
    assert metadata.dark_alike(PHOTO, later) == []
    assert metadata.in_order([PHOTO, later], [0.0, 60.0]) == []
    assert metadata.merged([PHOTO, later]) == []
    assert metadata.focal_agrees([PHOTO], Camera("A", (4000, 3000), 3100.0, (2000.0, 1500.0)), 0.001) == []


@pytest.mark.parametrize(
    "changes, word",
    [({"zoom": 2.0}, "zoom 2"), ({"focal": 6.9}, "focal length 6.9"), ({"model": "Acme P2"}, "Acme P2")],
)
def test_another_lens_is_named(changes, word):
    (found,) = metadata.same_lens([PHOTO, other(**changes)], ["A", "A"])
    assert found.kind == "inconsistent" and found.where == "b.jpg" and word in found.says
    assert metadata.same_lens([PHOTO, other(**changes)], ["A", "B"]) == []


@pytest.mark.parametrize(
    "changes, word", [({"exposure": 1 / 30}, "exposure time"), ({"iso": 400.0}, "ISO 400"), ({"zoom": 2.0}, "zoom")]
)
def test_a_dark_picture_exposed_otherwise_is_named(changes, word):
    (found,) = metadata.dark_alike(PHOTO, other(**changes))
    assert found.where == "b.jpg" and word in found.says


def test_clocks_against_the_file():
    earlier = other(time=PHOTO.time - timedelta(minutes=1))
    (found,) = metadata.in_order([PHOTO, earlier], [0.0, 60.0])
    assert "time_s" in found.where


def test_a_calibration_of_another_lens():
    (found,) = metadata.focal_agrees([PHOTO], Camera("A", (4000, 3000), 6000.0, (2000.0, 1500.0)), 0.001)
    assert found.where == "cameras.A.focal_px" and "3004" in found.says


def test_hdr():
    (found,) = metadata.merged([PHOTO, other(hdr=True)])
    assert found.where == "b.jpg" and "HDR" in found.says
