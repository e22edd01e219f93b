"""Where the marks lie: the default board is the one of the scenes, and every board keeps its promises."""

import itertools
from pathlib import Path

import numpy as np
import pytest

from benchsim.bench.errors import BenchsimError
from benchsim.bench.marks import read_marks
from benchsim.boards import corrected, lay_out, tiles, whole
from benchsim.boards.layout import QUIET, RULE
from benchsim.boards.tiles import MARGIN, OVERLAP

SCENES = Path(__file__).resolve().parents[2] / "scenes"
BOARDS = [((700.0, 700.0), 36.0), ((180.0, 270.0), 20.0), ((1200.0, 600.0), 50.0), ((431.7, 333.3), 17.3)]


def test_the_default_board_is_the_scenes():
    assert lay_out().marks == read_marks(SCENES / "marks.csv")


@pytest.mark.parametrize(("size", "side"), BOARDS)
def test_marks_keep_their_margins_and_stay_on_the_board(size, side):
    layout = lay_out(size, side)
    centres = np.array(layout.marks.centres)
    apart = np.abs(centres[:, None] - centres[None]).max(axis=-1) + 1e9 * np.eye(len(centres))
    assert apart.min() >= 2 * QUIET * side
    assert (np.abs(centres) + QUIET * side <= np.array(size) / 2).all()
    for y0, z0, y1, z1 in layout.rules:
        assert np.hypot(y1 - y0, z1 - z0) == pytest.approx(RULE)
        along = np.linspace([y0, z0], [y1, z1], 200)
        assert np.abs(along[:, None] - centres[None]).max(axis=-1).min() > QUIET * side


@pytest.mark.parametrize("paper", ["a4", "a3", "letter"])
@pytest.mark.parametrize(("size", "side"), BOARDS)
def test_every_mark_is_whole_on_exactly_one_tile_and_the_tiles_cover_the_board(size, side, paper):
    layout = lay_out(size, side)
    pages = tiles(layout, paper)
    half = QUIET * side
    for y, z in layout.marks.centres:
        whole_on = [t for t in pages if t.low[0] <= y - half and y + half <= t.high[0]
                    and t.low[1] <= z - half and z + half <= t.high[1]]  # fmt: skip
        touched = [t for t in pages if t.low[0] < y + half and y - half < t.high[0]
                   and t.low[1] < z + half and z - half < t.high[1]]  # fmt: skip
        assert len(whole_on) == len(touched) == 1
    for tile in pages:
        assert all(tile.high[a] - tile.low[a] + 2 * MARGIN <= tile.paper[a] + 1e-9 for a in (0, 1))
    for axis in (0, 1):
        spans = sorted({(t.low[axis], t.high[axis]) for t in pages})
        assert spans[0][0] == -size[axis] / 2 and spans[-1][1] == size[axis] / 2
        for (_, end), (start, _) in itertools.pairwise(spans):
            assert end - start == pytest.approx(OVERLAP)


def test_neighbouring_tiles_show_the_same_crosses():
    pages = tiles(lay_out(), "a4")
    left, right = pages[0], pages[1]
    seam = (left.high[0] + right.low[0]) / 2

    def crosses(tile):
        return {round(line.start[1], 6) for line in tile.lines
                if line.start[1] == line.end[1] and line.start[0] == pytest.approx(seam - 4)}  # fmt: skip

    assert len(crosses(left)) >= 3
    assert crosses(left) == crosses(right)


def test_the_ruler_corrects_y_and_z_apart():
    marks = corrected(lay_out().marks, (598.2, 600.6), over=600.0)
    assert marks.centres[0] == pytest.approx((-320 * 0.997, 320 * 1.001))
    assert marks.sides[0] == pytest.approx(36 * 0.999)


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: lay_out((50, 50)), "larger --size-mm"),
        (lambda: lay_out((700, 700), 4), "--side-mm of 8 or more"),
        (lambda: lay_out((4000, 4000), 20), "larger --side-mm"),
        (lambda: lay_out((100, 100), 12), "check rule"),
        (lambda: lay_out((9000, 700)), "5000"),
        (lambda: corrected(lay_out().marks, (60, 60)), "--over-mm"),
        (lambda: tiles(lay_out((1600, 1600), 180), "a4"), "--paper sheet"),
    ],
)
def test_what_cannot_be_drawn_is_refused_with_the_mend(call, says):
    with pytest.raises(BenchsimError, match=says):
        call()


def test_one_sheet_shows_all():
    page = whole(lay_out())
    assert page.paper == (720.0, 720.0)
    assert (page.low, page.high) == ((-350.0, -350.0), (350.0, 350.0))
