"""What peers learn from a heliostat made by hand: its four tilts, by least squares and by ARTIST's reconstruction."""

import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "analysis"), str(ROOT / "tests" / "instruments" / "mount")]

import field_peers as peers  # noqa: E402
import hand_made as hand  # noqa: E402

from benchsim.instruments.mount import paint  # noqa: E402

TRUE = {"tilt_n": -8.0, "tilt_u": 6.0, "IE": 4.0, "NPAE": -5.0}


@pytest.fixture
def sessions(tmp_path, monkeypatch):
    """Early and later records [mrad of the beam: some 20 as stated]."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(hand, "IN_FRONT", 0.0)
    hand.write_heliostat(tmp_path / "early", hand.recorded(20, TRUE, 1))
    hand.write_heliostat(tmp_path / "late", hand.recorded(8, TRUE, 2), first=2000)
    return tuple(peers.in_artist(paint.read(tmp_path / name)) for name in ("early", "late"))


def worst(rest):
    return np.linalg.norm(rest, axis=1).max()


def test_least_squares_find_them(sessions):
    early, late = sessions
    assert worst(peers.miss(late)) > 10.0
    assert worst(peers.miss(late, peers.peer(early, peers.OF_ARTIST))) < 0.01


def test_artist_s_reconstruction_goes_there(sessions, tmp_path):
    """To what single precision leaves of the arc cosine in its loss, 0.35 mrad of the normal."""
    pytest.importorskip("artist.optim", reason="artist-csp is not installed (extra: peers)")
    early, late = sessions
    assert peers.version_of_artist(tmp_path)
    assert worst(peers.miss(peers.in_artist(late, peers.reconstructed(early, 600)))) < 1.0


def test_records_that_all_fits_miss_are_aside():
    row = {"stated": [9.0, 50.0, 1.0], "amended": [1.0, 7.0, 3.0], "plain": [6.0, 6.0, 1.0]}
    found = peers.pooled([row])
    assert found["aside"] == 1
    assert found["median"] == {"stated": 5.0, "amended": 2.0, "plain": 3.5}
    assert found["rms"]["amended"] == pytest.approx(5**0.5)
