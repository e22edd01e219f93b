"""The camera: world to pixel, and pixel back to a ray or to the board; pinhole with OpenCV's distortion.

Poses are OpenCV's: x_camera = R @ x_world + t, with x right, y down, z forward; pixel (0, 0) is the centre of the
top-left pixel. `benchsim.bench.place.camera_pose` gives the nominal pose; a solved pose goes in the same way.

`see` is the true camera before the true board, with every effect that lies between board and pixel; everything else
here is the camera as stated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from benchsim.bench.fields import evaluate
from benchsim.bench.model import Camera, Recording
from benchsim.bench.place import Placement
from benchsim.rays import screen

Array = NDArray[np.float64]

# OpenCV stops after five steps by default, some 1e-4 px short at the corners of the picture.
UNDISTORT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-14)

EFFECTS: Mapping[str, tuple[str, ...]] = {
    "grid-scale": ("gs",),
    "grid-aspect": ("ga",),
    "grid-shear": ("gsh",),
    "radial-distortion": ("k1", "k2"),
    "tangential-distortion": ("p1", "p2"),
    "rolling-shutter": ("rs_s", "rs_c", "rs_period"),
    "saturation": ("sat",),
}
"""Effects that lie between board and pixel, with their parameters."""

ROLLING_PERIOD = 1400.0
"""Rows in one swing of a shaking camera where the file does not say."""


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
    ideal = _undistorted(flat, matrix(camera), np.array(camera.distortion))
    rays = np.concatenate([ideal.reshape(-1, 2), np.ones((flat.shape[0], 1))], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return -np.asarray(rotation).T @ translation, (rays @ rotation).reshape(*pixels.shape[:-1], 3)


def _undistorted(pixels: Array, pinhole: Array, distortion: Array) -> Array:
    """Ideal image coordinates (n, 1, 2) of pixels (n, 1, 2) [px], steps of the inversion to `UNDISTORT`."""
    if hasattr(cv2, "undistortPointsIter"):  # OpenCV 4, whose undistortPoints takes no criteria
        return np.asarray(cv2.undistortPointsIter(pixels, pinhole, distortion, None, None, UNDISTORT))
    return np.asarray(cv2.undistortPoints(pixels, pinhole, distortion, None, None, None, UNDISTORT))


def board_points(camera: Camera, rotation: Array, translation: Array, placement: Placement, pixels: Array) -> Array:
    """Board coordinates (..., 2) [mm] seen at pixels (..., 2) [px] where the placement has it."""
    origin, direction = pixel_rays(camera, rotation, translation, pixels)
    return screen.meet(placement, np.broadcast_to(origin, direction.shape), direction)[0]


def see(
    recording: Recording,
    camera: Camera,
    rotation: Array,
    translation: Array,
    board: Array,
    *,
    printed: bool = False,
    level: Array | None = None,
) -> Array:
    """Pixels at which the true camera shows points of the true board.

    In the order of the light: errors of the print, the height of the board's surface, the lens (the stated distortion
    plus ``radial-`` and ``tangential-distortion``), the rows' shaking, the field ``pixel``, and, for light whose
    brightness is given, blooming and the field ``brightness``.

    Parameters
    ----------
    recording : Recording
        Its ``effects`` and ``fields`` are honoured.
    camera : Camera
        As stated.
    rotation, translation : (3, 3) array, (3,) array [mm]
        Of the board as its marks define it: x_camera = R (height, y, z) + t. However the board as a whole is moved or
        turned (``screen-distance``, ``screen-rotation``, ``screen-tilt``), it is part of the pose.
    board : (n, 2) array [mm]
        y, z: true places on the board (light), or with ``printed`` the nominal ones of what is printed there.
    printed : bool
        Move nominal places to where the print's errors and the field ``shift`` have them.
    level : (n,) array, optional
        Brightness relative to the exposure's peak, 0 … 1; only light that has one blooms.

    Returns
    -------
    (n, 2) ndarray [px]
        u, v; NaN for points behind the camera.
    """
    e, fields = recording.effects, recording.fields
    points = np.asarray(board, float)
    if printed:
        points = print_places(recording, points)
    height = board_height(recording, points)
    lens = camera
    radial, tangential = e.get("radial-distortion", {}), e.get("tangential-distortion", {})
    if radial or tangential:
        more = (*(radial.get(k, 0.0) for k in ("k1", "k2")), *(tangential.get(p, 0.0) for p in ("p1", "p2")), 0.0)
        k1, k2, p1, p2, k3 = np.add(camera.distortion, more).tolist()
        lens = replace(camera, distortion=(k1, k2, p1, p2, k3))
    pixels = project(lens, rotation, translation, np.column_stack([height, points]))
    if shutter := e.get("rolling-shutter"):
        phase = 2 * np.pi * (pixels[:, 1] - camera.principal_point[1]) / shutter.get("rs_period", ROLLING_PERIOD)
        shift = shutter.get("rs_s", 0.0) * np.sin(phase) + shutter.get("rs_c", 0.0) * np.cos(phase)
        pixels = pixels + np.stack([shift, np.zeros_like(shift)], axis=1)
    if "pixel" in fields:
        pixels = pixels + evaluate(fields["pixel"], pixels[:, 0], pixels[:, 1]).T
    if level is not None:
        if bloom := e.get("saturation", {}).get("sat", 0.0):
            pixels = pixels + np.stack([np.zeros(len(pixels)), bloom * np.asarray(level, float) ** 2], axis=1)
        if "brightness" in fields:
            pixels = pixels + evaluate(fields["brightness"], level).T
    return pixels


def print_places(recording: Recording, nominal: Array) -> Array:
    """Where a mark printed at nominal (n, 2) [mm] lies on the board: grid errors, then the field ``shift``."""
    e = recording.effects
    scale, aspect, shear = (
        1e-3 * e.get(name, {}).get(key, 0.0)
        for name, key in (("grid-scale", "gs"), ("grid-aspect", "ga"), ("grid-shear", "gsh"))
    )
    points = np.asarray(nominal, float)
    if scale or aspect or shear:
        points = points @ np.array([[1 + scale + aspect, shear], [shear, 1 + scale - aspect]])
    if "shift" in recording.fields:
        y, z = np.asarray(nominal, float).T
        points = points + evaluate(recording.fields["shift"], y, z).T
    return points


def board_height(recording: Recording, board: Array) -> Array:
    """Height (n,) [mm] of the surface over the board's plane at true places (n, 2): bow and field ``height``."""
    bow = recording.effects.get("screen-bow", {})
    y, z = np.asarray(board, float).T
    x: Array = 0.5e-3 * (bow.get("bow_y", 0.0) * y**2 + bow.get("bow_z", 0.0) * z**2)
    if "height" in recording.fields:
        x = x + evaluate(recording.fields["height"], y, z)[0]
    return x
