"""From the true board to the coordinates in which a trace was measured, by way of a pose that the marks fix.

A trace's board coordinates are read with the stated camera from a pose that the marks were solved for. A board that is
moved, tilted or rolled as a whole takes the pose with it, and nothing of that is seen. If lens, print or the board's
surface are not as stated, that pose P̂ is not the true one T, and the marks leave residuals. With `rays.see` as the
true camera before the true board, T is the pose for which the marks as they are seen would be solved to P̂:

    Jᵀ W (see(T, marks) − stated(P̂, marks)) = 0,    J = ∂ stated/∂ pose at P̂,  W the weights of the solution,

so T = P̂ ⊕ δ, and δ = −G (see(P̂ ⊕ δ) − stated(P̂)) with G = (Jᵀ W J)⁻¹ Jᵀ W, iterated. Light at a true place of the
board is then seen by T through the true camera and read back by P̂ through the stated one. What of the marks'
displacement no pose explains is the residual that the marks must show.

With T as six nuisances of every exposure, integrated beside all others, the same would be found: the pose is fitted to
the marks alone, whose residuals are independent of it, and its covariance is in that of the trace. What is kept of an
effect's visibility is 97 % and more of what free nuisances keep (a mark's centre stands for its corners).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchsim import rays
from benchsim.bench.model import Camera, Recording
from benchsim.rays.camera import EFFECTS
from benchsim.trace.lens import undistort
from benchsim.trace.marks import board_corners
from benchsim.trace.pose import Pose, pose_derivatives, to_pixels

Array = NDArray[np.float64]

BOARD_EFFECTS = ("screen-bow",)
BOARD_FIELDS = ("pixel", "brightness", "height", "shift")

STEPS = 4
SMALL = 0.02
"""Largest change of any mark [px] that is taken as the last: what it leaves is of second order, some percent of it."""


@dataclass(frozen=True)
class View:
    """A solved camera pose, and how it hangs on the marks.

    Attributes
    ----------
    camera : Camera
        As stated.
    rotation, translation : (3, 3), (3,) mm
        P̂: x_camera = R (0, y, z) + t.
    corners : (4 m, 2) mm
        Nominal corners of the marks, mark after mark; those that the pose does not rest on have no share in ``gain``.
    flat : (4 m, 2) px
        Where the stated camera sees them from P̂.
    gain : (6, 8 m)
        G: change of turn [rad] and translation [mm] by displacements of the corners [px].
    by_pose : (4 m, 2, 6)
        J.
    """

    camera: Camera
    rotation: Array
    translation: Array
    corners: Array
    flat: Array
    gain: Array
    by_pose: Array


def view(pose: Pose, corners: Array, weight: Array) -> View:
    """View of a solved pose.

    Parameters
    ----------
    pose : Pose
        Solved without freeing the intrinsics.
    corners : (m, 4, 2) array [mm]
        Nominal corners of the marks.
    weight : (m, 8, 8) array [1/px²]
        Inverse covariance of each mark's eight coordinates; 0 where the pose does not rest on the mark.
    """
    board = np.asarray(corners, float).reshape(-1, 2)
    flat, j = pose_derivatives(pose, board)
    by_mark = j.reshape(len(weight), 8, 6)
    weighted = np.einsum("nij,njk->nik", weight, by_mark)
    normal = np.einsum("nia,nib->ab", by_mark, weighted)
    size = np.sqrt(np.diag(normal))
    gain = np.linalg.solve(normal / np.outer(size, size), weighted.reshape(-1, 6).T / size[:, None]) / size[:, None]
    return View(pose.camera, pose.rotation, pose.translation, board, flat, gain, j)


def pose_of(seen: View) -> Pose:
    """The pose of a view, as if it were exact."""
    none = np.zeros((0, 4, 2))
    return Pose(seen.rotation, seen.translation, seen.camera, np.zeros((6, 6)), none, 1.0, np.zeros(0, bool), (), 0.0)


def view_of_all(recording: Recording, pose: Pose) -> View | None:
    """View of a pose that all of the board's marks inside the picture bear alike; None where the board has none there.

    For where the marks themselves are no data: which of them were found, and how well, moves the pose by little.
    """
    marks = recording.screen.marks
    if marks is None or not marks.ids:
        return None
    corners = board_corners(marks)
    pixels = to_pixels(pose, corners)
    inside = ((pixels > 0) & (pixels < np.asarray(pose.camera.resolution) - 1)).all(axis=(1, 2))
    if inside.sum() < 2:
        return None
    return view(pose, corners[inside], np.tile(np.eye(8), (int(inside.sum()), 1, 1)))


def active(recording: Recording) -> bool:
    """Whether anything lies between the true board and the stated camera's picture of it."""
    return any(n in recording.effects for n in (*EFFECTS, *BOARD_EFFECTS)) or any(
        n in recording.fields for n in BOARD_FIELDS
    )


def true_pose(recording: Recording, seen: View, camera: Camera | None = None) -> tuple[Array, Array, Array]:
    """Pose of the true camera that the marks would have led to the solved one, and their residuals.

    Parameters
    ----------
    recording : Recording
        The true bench: effects and fields.
    seen : View
    camera : Camera, optional
        The true intrinsics where they are not the stated ones.

    Returns
    -------
    rotation, translation : (3, 3), (3,) mm
        T.
    residual : (m, 2) px
        Seen minus stated centres of the marks, after the pose.
    """
    truth = camera or seen.camera
    rotation, translation = seen.rotation, seen.translation
    shift = np.zeros_like(seen.flat)
    for _ in range(STEPS):
        shift = rays.see(recording, truth, rotation, translation, seen.corners, printed=True) - seen.flat
        delta = -seen.gain @ shift.ravel()
        moved = seen.by_pose @ delta
        rotation, translation = turned(rotation, translation, delta)
        if np.abs(moved).max() < SMALL:
            shift = shift + moved
            break
    return rotation, translation, shift.reshape(-1, 4, 2).mean(axis=1)


def turned(rotation: Array, translation: Array, delta: Array) -> tuple[Array, Array]:
    """Pose moved by δ (6,): R → exp([δ₀₋₂]×) R, t → t + δ₃₋₅ [rad, mm]."""
    return Rotation.from_rotvec(delta[:3]).as_matrix() @ rotation, translation + delta[3:]


def read_back(seen: View, pixels: Array) -> Array:
    """Board coordinates (n, 2) [mm] that the stated camera reads from pixels (n, 2) at the solved pose.

    NaN where the line of sight misses the board's plane.
    """
    camera = seen.camera
    ideal = (undistort(camera, pixels) - np.asarray(camera.principal_point)) / camera.focal
    direction = np.column_stack([ideal, np.ones(len(ideal))]) @ seen.rotation
    position = -seen.rotation.T @ seen.translation
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = -position[0] / direction[:, 0]
    distance = np.where(distance > 0, distance, np.nan)
    return position[1:] + distance[:, None] * direction[:, 1:]


def measured(
    recording: Recording,
    seen: View,
    board: Array,
    level: Array | None = None,
    camera: Camera | None = None,
) -> tuple[Array, Array]:
    """Coordinates in which light at true places of the board is measured, and what the marks show of it.

    Parameters
    ----------
    recording, seen, camera
        As `true_pose`.
    board : (n, 2) array [mm]
        True places.
    level : (n,) array, optional
        Brightness relative to the exposure's peak.

    Returns
    -------
    (n, 2) mm, (m, 2) px
        Measured coordinates; residuals of the marks' centres.
    """
    rotation, translation, residual = true_pose(recording, seen, camera)
    pixels = rays.see(recording, camera or seen.camera, rotation, translation, board, level=level)
    return read_back(seen, pixels), residual
