"""The files, read back by other code: marks and rules at true scale."""

import re
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from benchsim import jobs
from benchsim.bench.errors import BenchsimError
from benchsim.bench.marks import read_marks
from benchsim.bench.model import Camera
from benchsim.boards import lay_out
from benchsim.boards.drawing import mark, outlines
from benchsim.boards.tiles import MARGIN
from benchsim.trace import Photograph, find_marks

pdfium = pytest.importorskip("pypdfium2", reason="rasterises PDF")

SIZE, SIDE = (180.0, 270.0), 20.0


@pytest.fixture(scope="module")
def board(tmp_path_factory):
    return jobs.board(tmp_path_factory.mktemp("board") / "b", size=SIZE, side=SIDE, paper="a4")


@pytest.fixture(scope="module")
def raster(board):
    page = pdfium.PdfDocument(board.folder / "board.pdf")[0]
    size = np.array(page.get_size()) * 25.4 / 72
    # The oldest pypdfium2 has a third axis of length one.
    grey = page.render(scale=300 / 72, grayscale=True).to_numpy()
    return grey.reshape(grey.shape[:2]), size


def test_the_page_is_a4_and_marks_lie_where_the_table_says(board, raster):
    grey, size = raster
    assert size == pytest.approx([210, 297], abs=0.01)
    light = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 1.0)
    light += np.random.default_rng(3).normal(0, 1, grey.shape).astype(np.float32)
    full = np.zeros(grey.shape, bool)
    picture = Photograph("page", light, full, np.ones((), np.float32), True, False, "mono", "mono", light, full)
    marks = read_marks(board.folder / "marks.csv")
    seen = find_marks(picture, marks, Camera("A", grey.shape[::-1], 1e5, (1000.0, 1500.0)))
    assert set(seen.ids) == set(marks.ids)
    at = (seen.corners + 0.5) * size / grey.shape[::-1]
    at[..., 1] = size[1] - at[..., 1]
    at -= MARGIN + np.array(SIZE) / 2
    assert np.abs(at - seen.board).max() < 0.01


def test_the_rules_measure_100_mm_on_the_page(board, raster):
    grey, size = raster
    layout = lay_out(SIZE, SIDE)
    scale = np.array(grey.shape[::-1]) / size
    for axis in (0, 1):
        y0, z0, y1, z1 = layout.rules[axis]
        centre = np.array([(y0 + y1) / 2, (z0 + z1) / 2]) + np.array(SIZE) / 2 + MARGIN
        # Half a millimetre beside the rule itself: the line that is read crosses the end marks only.
        centre[1 - axis] += 1.5
        u, v = centre[0] * scale[0], grey.shape[0] - centre[1] * scale[1]
        line = 255.0 - (grey[int(v)] if axis == 0 else grey[::-1, int(u)])
        middle = (centre[axis] * scale[axis],)
        ends = []
        for sign in (-1, 1):
            at = int(middle[0] + sign * 50 * scale[axis])
            window = np.arange(at - 8, at + 9)
            ends.append(np.average(window, weights=line[window]))
        assert (ends[1] - ends[0]) / scale[axis] == pytest.approx(100, abs=0.03)


def test_the_svg_holds_the_same_marks_in_millimetres(board):
    root = ElementTree.parse(board.folder / "board.svg").getroot()
    assert (root.get("width"), root.get("height")) == ("180mm", "270mm")
    assert root.get("viewBox") == "-90 -135 180 270"
    paths = root.findall(".//{*}g[@id='marks']/{*}path")
    for path, centre in zip(paths, board.layout.marks.centres, strict=True):
        points = np.array(re.findall(r"(-?[\d.]+),(-?[\d.]+)", path.get("d")), float) * [1, -1]
        assert points.min(axis=0) == pytest.approx(np.subtract(centre, SIDE / 2))
        assert points.max(axis=0) == pytest.approx(np.add(centre, SIDE / 2))


def test_outlines_fill_exactly_the_black_cells():
    rng = np.random.default_rng(5)
    for _ in range(20):
        black = rng.random((6, 7)) < 0.5
        area = sum(
            0.5 * sum(a[0] * b[1] - a[1] * b[0] for a, b in zip(ring, ring[1:] + ring[:1], strict=True))
            for ring in outlines(black)
        )
        assert area == black.sum()
        rings = [np.array(ring) for ring in outlines(black)]
        for j, i in np.ndindex(black.shape):
            inside = sum(_winding(ring, i + 0.5, j + 0.5) for ring in rings)
            assert inside == black[j, i]


def _winding(ring, x, y):
    a, b = ring - [x, y], np.roll(ring, -1, axis=0) - [x, y]
    turn = np.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], (a * b).sum(axis=1))
    return round(turn.sum() / (2 * np.pi))


def test_a_mark_is_upright():
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    upright = cv2.aruco.generateImageMarker(dictionary, 7, 8, borderBits=1)
    rings = [np.array(r) for r in mark(7, (0.0, 0.0), 8.0).rings]
    for row, column in np.ndindex(8, 8):
        inside = sum(_winding(ring, column - 3.5, 3.5 - row) for ring in rings)
        assert inside == (upright[row, column] == 0)


def test_the_same_board_gives_the_same_bytes_and_the_ruler_changes_the_table_only(board):
    before = (board.folder / "board.pdf").read_bytes()
    again = jobs.board(board.folder, measured=(99.0, 101.0))
    assert (board.folder / "board.pdf").read_bytes() == before
    assert again.layout == board.layout and again.paper == "a4"
    assert again.size == pytest.approx((178.2, 272.7))
    marks = read_marks(board.folder / "marks.csv")
    assert np.array(marks.centres) == pytest.approx(np.array(board.layout.marks.centres) * [0.99, 1.01])
    with pytest.raises(BenchsimError, match="leave --side-mm out"):
        jobs.board(board.folder, measured=(99.0, 101.0), side=30.0)
    jobs.board(board.folder, size=SIZE, side=SIDE, paper="a4")
