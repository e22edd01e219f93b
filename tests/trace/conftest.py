"""Photographs of a board by a few lines of sampling, independent of the renderer, for the tests of this room."""

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from benchsim.bench.model import Camera, Marks

PATTERN = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)


def reflectance(points, marks):
    """0.8 where white, 0.04 where black, of points (m, 2) on an endless board."""
    out = np.full(len(points), 0.8)
    for tag, (y, z), side in zip(marks.ids, marks.centres, marks.sides, strict=True):
        cells = cv2.aruco.generateImageMarker(PATTERN, tag, 8, borderBits=1) > 0
        column = np.floor((points[:, 0] - y) / side * 8 + 4).astype(int)
        row = np.floor(4 - (points[:, 1] - z) / side * 8).astype(int)
        inside = (column >= 0) & (column < 8) & (row >= 0) & (row < 8)
        out[np.flatnonzero(inside)[~cells[row[inside], column[inside]]]] = 0.04
    return out


def board_points(camera, rotation, translation, pixels):
    """Points (y, z) that pixels (m, 2) show, by OpenCV's inversion of the lens."""
    (cu, cv), f = camera.principal_point, camera.focal
    k = np.array([[f, 0, cu], [0, f, cv], [0, 0, 1.0]])
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-10)
    flat = np.ascontiguousarray(pixels[:, None], float)
    if hasattr(cv2, "undistortPointsIter"):  # OpenCV 4
        ray = cv2.undistortPointsIter(flat, k, np.array(camera.distortion), None, None, criteria)
    else:
        ray = cv2.undistortPoints(flat, k, np.array(camera.distortion), None, None, None, criteria)
    homography = np.linalg.inv(np.column_stack([rotation[:, 1], rotation[:, 2], translation]))
    q = np.column_stack([ray[:, 0], np.ones(len(ray))]) @ homography.T
    return q[:, :2] / q[:, 2:]


@pytest.fixture(scope="session")
def photograph_board():
    """Function (camera, rotation, translation, marks, blur, samples=16) → reflectance of every pixel, (h, w).

    Pixels near an edge hold the mean of 16 × 16 samples of their area, jittered, so that no grid of samples moves an
    edge. Between its corners a pixel is taken for a bilinear patch of the board, which is off by 2e-4 px at most.
    """

    def take(camera: Camera, rotation, translation, marks: Marks, blur: float = 0.6, samples: int = 16, seed: int = 1):
        rng = np.random.default_rng(seed)
        w, h = camera.resolution
        corner = np.stack(np.meshgrid(np.arange(w + 1), np.arange(h + 1)), axis=-1).reshape(-1, 2) - 0.5
        on = board_points(camera, rotation, translation, corner)
        at, on = reflectance(on, marks).reshape(h + 1, w + 1), on.reshape(h + 1, w + 1, 2)
        picture = at[:-1, :-1].copy()
        differs = (
            cv2.dilate(
                (np.ptp(np.stack([at[:-1, :-1], at[1:, :-1], at[:-1, 1:], at[1:, 1:]]), axis=0) > 0).astype(np.uint8),
                np.ones((3, 3), np.uint8),
            )
            > 0
        )
        i, j = np.nonzero(differs)
        base, along, down = on[i, j], on[i, j + 1] - on[i, j], on[i + 1, j] - on[i, j]
        twist = on[i + 1, j + 1] - on[i + 1, j] - along
        total = np.zeros(len(i))
        for k in range(samples):
            row = np.stack([np.arange(samples), np.full(samples, k)], axis=-1) + rng.random((len(i), samples, 2))
            x, y = row[..., :1] / samples, row[..., 1:] / samples
            points = base[:, None] + x * along[:, None] + y * (down[:, None] + x * twist[:, None])
            total += reflectance(points.reshape(-1, 2), marks).reshape(-1, samples).sum(1)
        picture[i, j] = total / samples**2
        return gaussian_filter(picture, blur, mode="nearest", truncate=5.0)

    return take
