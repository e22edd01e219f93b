"""The board's texture: areas, sub-texel edges, and marks that a reader of the picture finds upright."""

import cv2
import numpy as np
import pytest

from benchsim.bench.model import Marks, Screen
from benchsim.renderer.board import CELLS, INK, reflectance, tag_cells


def test_area_of_board_and_mark_is_exact():
    """Sides and positions that fit no texel: the sum over texels is still the area, the first moment the centre."""
    marks = Marks((7,), ((3.137, -5.019),), (13.37,))
    white, wall = 0.8, 0.01
    texture = reflectance(Screen((70.3, 50.1), white, marks), pitch=0.25, outside=wall)
    plain = reflectance(Screen((70.3, 50.1), white), pitch=0.25, outside=wall)
    cell = (13.37 / CELLS) ** 2
    black = tag_cells(7).sum() * cell
    texel = texture.pitch**2
    assert (plain.values - wall).sum() * texel == pytest.approx((white - wall) * 70.3 * 50.1, rel=1e-12)
    lost = plain.values - texture.values
    assert lost.sum() * texel == pytest.approx((white - INK) * black, rel=1e-12)
    y = texture.y0 + texture.pitch * np.arange(texture.values.shape[1])
    j = np.nonzero(tag_cells(7))[1]
    middle = 3.137 + 13.37 * ((j + 0.5).mean() / CELLS - 0.5)
    # Moments of texels are those of the area only to within the shape of a cut texel: exact at texel borders.
    assert (lost * y).sum() / lost.sum() == pytest.approx(middle, abs=1e-3)


@pytest.mark.parametrize("shift", [0.0, 0.06, 0.125, 0.2])
def test_edge_lies_at_its_sub_texel_place(shift):
    """Rationale: an edge seen through a symmetric filter lies where the texels' sum puts it.

    Set-up: the black border at the left of a mark, whose edge lies ``shift`` beyond a texel border. Expectation: the
    missing light left of a fixed place grows with the shift exactly.
    """
    side = 16.0
    marks = Marks((0,), ((shift, 0.0),), (side,))
    texture = reflectance(Screen((40.0, 40.0), 1.0, marks), pitch=0.25)
    y = texture.y0 + texture.pitch * np.arange(texture.values.shape[1])
    row = texture.values[len(texture.values) // 2]
    border = (y > -12) & (y < -side / 2 + 1.0)
    white = (row[border] - INK).sum() / (1 - INK) * texture.pitch
    first = y[border][0] - texture.pitch / 2
    assert first + white == pytest.approx(shift - side / 2, abs=1e-12)


def test_marks_are_read_upright_and_not_mirrored():
    """Seen with +y to the right and z up, cv2.aruco finds each id in its place, its first corner at the top left."""
    places = {3: (-50.0, 40.0), 100: (45.0, 35.0), 586: (10.0, -45.0)}
    marks = Marks(tuple(places), tuple(places.values()), (32.0,) * 3)
    texture = reflectance(Screen((200.0, 200.0), 0.8, marks), pitch=0.25, outside=0.0)
    seen = np.round(texture.values[::-1] * 255).astype(np.uint8)
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11))
    corners, ids, _ = detector.detectMarkers(seen)
    assert sorted(ids.ravel()) == sorted(places)
    top = texture.z0 + texture.pitch * (seen.shape[0] - 1)
    for quad, tag in zip(corners, ids.ravel(), strict=True):
        y = texture.y0 + texture.pitch * quad[0, :, 0]
        z = top - texture.pitch * quad[0, :, 1]
        want = np.array([[-16, 16], [16, 16], [16, -16], [-16, -16]]) + places[int(tag)]
        np.testing.assert_allclose(np.column_stack([y, z]), want, atol=0.5)


def test_a_mark_over_the_edge_is_cut_there():
    marks = Marks((1,), ((20.0, 0.0),), (16.0,))
    texture = reflectance(Screen((40.0, 40.0), 0.8, marks), outside=0.3, border=3)
    assert np.all(texture.values[:, -3:] == 0.3)
    assert texture.values.min() == pytest.approx(INK)
