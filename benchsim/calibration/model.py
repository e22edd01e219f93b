"""What a calibration solves for, and the pixels that it predicts.

Unknown are the focal length, the principal point and the five coefficients of Brown's distortion; six numbers of a pose
for every view; and of the board what a printer and a wall never make as the table says: how much longer it is along y
than along z, how much its axes lean, its height over its plane, quadratic in y and z, and the place of every single
mark. Three numbers more for every view are by how much black has spread over white: a tone curve that is not known, a
slight overexposure and ink all move the edges of a mark outward alike, but more where there is less light, and a lamp
beside the board lights it unevenly.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from benchsim.trace.edge_pixels import intersections
from benchsim.trace.marks import MarkObservations

Array = NDArray[np.float64]

LENS = ("focal_px", "principal_point_u_px", "principal_point_v_px", "k1", "k2", "p1", "p2", "k3")
"""Parameters of the lens, in this order everywhere."""

BOARD = ("stretch", "shear", "bow_y_mm", "bow_z_mm", "twist_mm")
"""Parameters of the board, in this order everywhere. A point meant for (y, z) lies at ((1 + stretch) y + shear z, (1 −
stretch) z + shear y), and bow_y (y/R)² + bow_z (z/R)² + twist y z/R² before the board's plane, R being the farthest
mark's distance from the centre along an axis."""

SHARED = len(LENS) + len(BOARD)
"""Parameters that all views share, besides the marks' places."""

OWN = 9
"""Parameters of a view: rotation vector, translation [mm], and of the spread [px] the three of `spreading`."""


@dataclass(frozen=True)
class State:
    """Values of all parameters.

    Attributes
    ----------
    lens, board : (8,), (5,)
        In the order of `LENS` and `BOARD`; bows in units of R.
    places : (m, 2) mm
        How far the marks lie from where they were meant, along y and z.
    poses : (v, 6)
        Rotation vector and translation [mm] of the points (y, −z, −x) into the frame of every view's camera.
    spread : (v, 3) px
    """

    lens: Array
    board: Array
    places: Array
    poses: Array
    spread: Array

    def flat(self) -> Array:
        """All in one row: lens, board, places, then pose and spread of every view."""
        views = np.column_stack([self.poses, self.spread])
        return np.concatenate([self.lens, self.board, self.places.ravel(), views.ravel()])

    def moved(self, x: Array) -> State:
        """With values from such a row."""
        m = SHARED + self.places.size
        views = x[m:].reshape(-1, OWN)
        return State(x[:8], x[8:SHARED], x[SHARED:m].reshape(-1, 2), views[:, :6], views[:, 6:])


def points(board: Array, at: Array, size: float) -> tuple[Array, Array]:
    """Points (y, −z, −x) of places (..., 2) meant for y, z [mm].

    Their derivatives (..., 3, 7) are by the board's five parameters and by y and z.
    """
    y, z = at[..., 0], at[..., 1]
    stretch, shear, bow_y, bow_z, twist = board
    height = (bow_y * y * y + bow_z * z * z + twist * y * z) / size
    out = np.stack([(1 + stretch) * y + shear * z, -((1 - stretch) * z + shear * y), -height], axis=-1)
    by = np.zeros((*at.shape[:-1], 3, 7))
    by[..., 0, 0], by[..., 0, 1] = y, z
    by[..., 1, 0], by[..., 1, 1] = z, -y
    by[..., 2, 2], by[..., 2, 3], by[..., 2, 4] = -y * y / size, -z * z / size, -y * z / size
    by[..., 0, 5], by[..., 1, 5], by[..., 2, 5] = 1 + stretch, -shear, -(2 * bow_y * y + twist * z) / size
    by[..., 0, 6], by[..., 1, 6], by[..., 2, 6] = shear, -(1 - stretch), -(2 * bow_z * z + twist * y) / size
    return out, by


def project(lens: Array, board: Array, pose: Array, at: Array, size: float) -> tuple[Array, Array]:
    """Pixels (..., 2) of places (..., 2) on the board [mm]; OpenCV's projection and derivatives.

    Parameters
    ----------
    lens, board, pose : (8,), (5,), (6,)
        As in `State`.
    at : (..., 2) mm
    size : float
        R [mm].

    Returns
    -------
    pixels : (..., 2)
    by : (..., 2, 21)
        Derivatives by lens, board, y and z, pose.
    """
    here, by_place = points(board, at, size)
    f, u, v = lens[:3]
    matrix = np.array([[f, 0, u], [0, f, v], [0, 0, 1.0]])
    pixels, jacobian = cv2.projectPoints(here.reshape(-1, 1, 3), pose[:3], pose[3:], matrix, lens[3:])
    by = jacobian.reshape(-1, 2, jacobian.shape[1])
    by_point = by[:, :, 3:6] @ cv2.Rodrigues(pose[:3])[0]
    one_focal_length = by[:, :, 6:7] + by[:, :, 7:8]
    columns = [one_focal_length, by[:, :, 8:15], by_point @ by_place.reshape(-1, 3, 7), by[:, :, :6]]
    return np.asarray(pixels, float).reshape(at.shape), np.concatenate(columns, axis=2).reshape(*at.shape, 21)


def predict(state: State, view: MarkObservations, index: NDArray[np.intp], k: int, size: float) -> tuple[Array, Array]:
    """Pixels (n, 4, 2) at which the corners of view ``k`` should stand.

    Their derivatives (n, 4, 2, 24) are by lens, board, the own mark's place, pose and spread; ``index`` (n,) says which
    row of ``state.places`` is a mark's.
    """
    at = view.board + state.places[index][:, None]
    pixels, by = project(state.lens, state.board, state.poses[k], at, size)
    outward = spreading(view.corners)
    return pixels + outward @ state.spread[k], np.concatenate([by, outward], axis=-1)


def spreading(corners: Array) -> Array:
    """How corners (n, 4, 2) move by the three numbers of a view's spread, (n, 4, 2, 3).

    All edges move outward by one pixel; or by what they lie to the right of the marks' middle, or below it, in units of
    the marks' extent.
    """
    run = np.roll(corners, -1, axis=1) - corners
    _, by_edge = intersections(corners, run / np.linalg.norm(run, axis=-1, keepdims=True))
    reach = np.ptp(corners.reshape(-1, 2), axis=0)
    aside = (corners + run / 2 - corners.mean(axis=(0, 1))) / reach.max()
    how = np.concatenate([np.ones((*corners.shape[:2], 1)), aside], axis=-1)
    # Corner k is where edges k - 1 and k meet.
    return by_edge @ np.stack([np.roll(how, 1, axis=1), how], axis=2)
