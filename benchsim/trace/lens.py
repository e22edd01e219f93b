"""The camera's lens: OpenCV's distortion (Brown's model), applied and undone in pixels."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from benchsim.bench.model import Camera

Array = NDArray[np.float64]


def undistort(camera: Camera, pixels: Array) -> Array:
    """Pixels as a camera of the same focal length without distortion would see them, (..., 2) px."""
    if not any(camera.distortion):
        return np.asarray(pixels, float)
    k = camera_matrix(camera)
    flat = np.ascontiguousarray(pixels, float).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 1e-8)
    out = cv2.undistortPoints(flat, k, np.asarray(camera.distortion), None, None, k, criteria)
    return out.reshape(np.shape(pixels)).astype(float)


def distort(camera: Camera, ideal: Array) -> Array:
    """Inverse of `undistort`: Brown's model, exact."""
    k1, k2, p1, p2, k3 = camera.distortion
    c = np.asarray(camera.principal_point)
    x, y = np.moveaxis((np.asarray(ideal, float) - c) / camera.focal, -1, 0)
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([xd, yd], axis=-1) * camera.focal + c


def camera_matrix(camera: Camera) -> Array:
    """OpenCV's 3 × 3 matrix of the camera."""
    (cx, cy), f = camera.principal_point, camera.focal
    return np.array([[f, 0.0, cx], [0.0, f, cy], [0.0, 0.0, 1.0]])


def distortion_jacobian(camera: Camera, ideal: Array) -> Array:
    """d(pixel)/d(undistorted pixel) at undistorted places, (..., 2, 2); invert it for the other direction."""
    k1, k2, p1, p2, k3 = camera.distortion
    x, y = np.moveaxis((np.asarray(ideal, float) - np.asarray(camera.principal_point)) / camera.focal, -1, 0)
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))
    mixed = slope * x * y + 2 * p1 * x + 2 * p2 * y
    return np.stack(
        [
            np.stack([radial + slope * x * x + 2 * p1 * y + 6 * p2 * x, mixed], axis=-1),
            np.stack([mixed, radial + slope * y * y + 6 * p1 * y + 2 * p2 * x], axis=-1),
        ],
        axis=-2,
    )
