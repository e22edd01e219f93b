"""The camera: world to pixel, and pixel back to a ray or to the board; pinhole with OpenCV's distortion.

Poses are OpenCV's: x_camera = R @ x_world + t, with x right, y down, z forward; pixel (0, 0) is the centre of the
top-left pixel. `benchsim.bench.place.camera_pose` gives the nominal pose; a solved pose goes in the same way.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from benchsim.bench.model import Camera
from benchsim.bench.place import Placement
from benchsim.rays import screen

Array = NDArray[np.float64]

# OpenCV stops after five steps by default, some 1e-4 px short at the corners of the picture.
UNDISTORT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-14)


def matrix(camera: Camera) -> Array:
    """Intrinsic matrix (3, 3) in px."""
    (cx, cy), f = camera.principal_point, camera.focal
    return np.array([[f, 0.0, cx], [0.0, f, cy], [0.0, 0.0, 1.0]])


def project(camera: Camera, rotation: Array, translation: Array, x: Array) -> Array:
    """Pixels of world points.

    Parameters
    ----------
    camera : Camera
    rotation, translation : (3, 3) array, (3,) array [mm]
        Pose.
    x : (..., 3) array [mm]
        World points; those at or behind the camera give NaN.

    Returns
    -------
    (..., 2) ndarray [px]
        u (column), v (row). Points far outside the picture can be folded back into it by the distortion polynomial.
    """
    x = np.asarray(x, float)
    in_camera = x.reshape(-1, 3) @ np.asarray(rotation).T + translation
    ahead = in_camera[:, 2] > 0
    out = np.full((len(in_camera), 2), np.nan)
    if ahead.any():
        zero = np.zeros(3)
        pixels, _ = cv2.projectPoints(in_camera[ahead], zero, zero, matrix(camera), np.array(camera.distortion))
        out[ahead] = pixels.reshape(-1, 2)
    return out.reshape(*x.shape[:-1], 2)


def pixel_rays(camera: Camera, rotation: Array, translation: Array, pixels: Array) -> tuple[Array, Array]:
    """Rays of sight of pixels.

    Parameters
    ----------
    camera, rotation, translation
        As in `project`.
    pixels : (..., 2) array [px]
        Inside or near the picture, where the distortion can be inverted.

    Returns
    -------
    origin : (3,) ndarray [mm]
        The camera's centre, world frame.
    direction : (..., 3) ndarray
        Unit, world frame, away from the camera.
    """
    pixels = np.asarray(pixels, float)
    flat = np.ascontiguousarray(pixels.reshape(-1, 1, 2))
    ideal = cv2.undistortPoints(flat, matrix(camera), np.array(camera.distortion), None, None, None, UNDISTORT)
    rays = np.concatenate([ideal.reshape(-1, 2), np.ones((flat.shape[0], 1))], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return -np.asarray(rotation).T @ translation, (rays @ rotation).reshape(*pixels.shape[:-1], 3)


def project_board(camera: Camera, rotation: Array, translation: Array, placement: Placement, board: Array) -> Array:
    """Pixels (..., 2) [px] of points (..., 2) [mm] of the board where the placement has it."""
    return project(camera, rotation, translation, screen.to_world(placement, board))


def board_points(camera: Camera, rotation: Array, translation: Array, placement: Placement, pixels: Array) -> Array:
    """Board coordinates (..., 2) [mm] seen at pixels (..., 2) [px]; the inverse of `project_board`."""
    origin, direction = pixel_rays(camera, rotation, translation, pixels)
    return screen.meet(placement, np.broadcast_to(origin, direction.shape), direction)[0]
