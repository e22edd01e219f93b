"""Where the camera stands relative to the board, from the marks; and the way from pixels to the board and back.

The pose is that of the board as its marks define it, x_camera = R (0, y, z) + t in mm, OpenCV's camera axes (x right,
y down, z forward). Nothing else of the recording enters: neither the camera's nominal position nor the screen's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2 as chi2_distribution

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Camera
from benchsim.trace.edge_pixels import OUTLIER_SIGMA
from benchsim.trace.lens import distort, distortion_jacobian, undistort
from benchsim.trace.marks import FEWEST_MARKS, MarkObservations
from benchsim.trace.motion import motion

Array = NDArray[np.float64]

_MEDIAN_CHI2 = float(chi2_distribution.median(8))


@dataclass(frozen=True)
class Pose:
    """Pose of the camera relative to the board, and how well the marks determine it.

    Attributes
    ----------
    rotation : (3, 3)
        R.
    translation : (3,) mm
        t.
    camera : Camera
        Intrinsics that belong to the pose: as given, or fitted within their priors. Use this camera with `to_board`.
    covariance : (p, p)
        Of δ, where R → exp([δ]×) R [rad]; of t [mm]; and, where intrinsics were fitted, of ln(focal), the principal
        point's u and v [px] and k1. p = 6 or 10. Scaled by ``chi2_per_dof``.
    residuals : (n, 4, 2) px
        Measured minus predicted corners, marks set aside included.
    chi2_per_dof : float
        Of the marks used, against the covariance that their pixels' noise predicts; > 1 where the board is not plane,
        its print or the lens is not as stated, or the sensor's pixels leave gaps.
    used : (n,) bool
        Marks that the pose rests on.
    set_aside : tuple of int
        Ids of the others: they contradict the rest.
    rms : float
        Of the measured corners of the marks used [px].
    motion : (3, 3), or None
        As in the observations: of the dark picture, against the photograph whose pose this is.
    """

    rotation: Array
    translation: Array
    camera: Camera
    covariance: Array
    residuals: Array
    chi2_per_dof: float
    used: NDArray[np.bool_]
    set_aside: tuple[int, ...]
    rms: float
    motion: Array | None = None

    @property
    def position(self) -> Array:
        """The camera's centre in the board's frame, (x, y, z) mm."""
        return -self.rotation.T @ self.translation


def solve_pose(
    camera: Camera, observations: MarkObservations, intrinsics_sigma: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Pose:
    """Pose from the corners of the marks by weighted least squares, robust against single wrong marks.

    Parameters
    ----------
    camera : Camera
    observations : MarkObservations
        May join those of several pictures of one pose (a photograph and its dark): see `join`.
    intrinsics_sigma : (focal as a fraction, principal point in px, k1)
        1 σ of the stated intrinsics; those with σ > 0 are fitted with that prior. Zero: exact.

    Returns
    -------
    Pose

    Raises
    ------
    BenchsimError
        The marks fit no pose (by a quarter of their size), or fewer than three agree; names the image and the mend.

    Notes
    -----
    Start: homography by least median of squares, then Collins & Bartoli's plane-based solutions (IPPE, IJCV 109,
    252, 2014), both refined. A mark is set aside if it lies five times farther off than the marks do in the median
    (root of χ² of its eight coordinates): wrong marks are, while small errors that many marks share, such as a bow
    of the board, must not choose the marks. The scale of the covariance is that of the residuals: it covers errors
    that are independent from mark to mark, not a bow of the board or a wrong lens, which many marks share.
    """
    n = len(observations.ids)
    if n < FEWEST_MARKS:
        raise BenchsimError(f"{observations.name}: {n} marks, but a pose needs {FEWEST_MARKS}; show more of the board")
    whitener = np.linalg.inv(np.linalg.cholesky(observations.joint))
    used, scale = np.ones(n, bool), 1.0
    starts = _starts(camera, observations)
    limit = 8 * OUTLIER_SIGMA**2
    for attempt in range(20):
        fits = [_refine(camera, observations, whitener, used, scale, s, intrinsics_sigma) for s in starts]
        fit = min(fits, key=lambda f: f.cost)
        starts = [fit.parameters]
        chi2 = _mark_chi2(camera, observations, whitener, fit.parameters)
        # Robust at first, while wrong marks may be among those used; then the mean of those that are left.
        robust = max(float(np.median(chi2)) / _MEDIAN_CHI2, 1e-12)
        previous, used = used, chi2 <= limit * robust
        if used.sum() < FEWEST_MARKS:
            break
        scale = float(chi2[used].sum()) / (8 * int(used.sum()) - 6)
        if attempt > 0 and np.array_equal(previous, used):
            break
    residuals = observations.corners - _project_at(camera, fit.parameters, observations.board)[0]
    side = float(np.median(np.linalg.norm(np.diff(observations.corners, axis=1), axis=-1)))
    off = float(np.median(np.nan_to_num(np.linalg.norm(residuals, axis=-1), nan=np.inf)))
    if off > side / 4 or used.sum() < FEWEST_MARKS or 2 * used.sum() < n:
        raise BenchsimError(
            f"{observations.name}: the marks fit no pose of the board ({off:.1f} px off in the median, {used.sum()} of "
            f"{n} agree); check that screen.marks and the intrinsics of camera {camera.name} belong to this picture"
        )
    fit = _refine(camera, observations, whitener, used, scale, fit.parameters, intrinsics_sigma)
    counted = observations.measured & used[:, None]
    return Pose(
        rotation=fit.parameters.rotation,
        translation=fit.parameters.translation,
        camera=fit.parameters.camera(camera),
        covariance=fit.covariance,
        residuals=residuals,
        chi2_per_dof=scale,
        used=used,
        set_aside=tuple(int(i) for i in observations.ids[~used]),
        rms=float(np.sqrt((residuals[counted] ** 2).mean())),
        motion=observations.motion,
    )


def join(first: MarkObservations, second: MarkObservations) -> MarkObservations:
    """Marks of a photograph and of its dark picture: of one pose, their noise is independent.

    Where the camera moved in between, the marks are the first's alone, and say how it moved. Where it did not, the part
    of their errors that both have counts once.
    """
    moved = motion(first, second)
    if moved is not None:
        return replace(first, motion=moved)
    joint, both = np.concatenate([first.joint, second.joint]), None
    if first.shared is not None and second.shared is not None:
        both = np.concatenate([first.shared, second.shared])
        twice = np.concatenate([np.isin(first.ids, second.ids), np.isin(second.ids, first.ids)])
        # Half of twice that, together, is that.
        joint = joint + both * twice[:, None, None]
    return MarkObservations(
        name=first.name,
        ids=np.concatenate([first.ids, second.ids]),
        corners=np.concatenate([first.corners, second.corners]),
        covariance=np.concatenate([first.covariance, second.covariance]),
        joint=joint,
        board=np.concatenate([first.board, second.board]),
        measured=np.concatenate([first.measured, second.measured]),
        blur=np.concatenate([first.blur, second.blur]),
        unknown=tuple(sorted({*first.unknown, *second.unknown})),
        dropped=first.dropped + second.dropped,
        gamma=first.gamma,
        shared=both,
    )


def to_pixels(pose: Pose, points: Array) -> Array:
    """Pixels of points (..., 2) on the board, y and z in mm; nan for points behind the camera."""
    return _project(pose.camera, pose.rotation, pose.translation, np.asarray(points, float))[0]


def pose_derivatives(pose: Pose, points: Array) -> tuple[Array, Array]:
    """Pixels (..., 2) of points (..., 2) on the board, and their derivatives (..., 2, 6) by turn [rad] and t [mm]."""
    pixels, _, by_all = _project(pose.camera, pose.rotation, pose.translation, np.asarray(points, float))
    return pixels, by_all[..., :6]


def to_board(pose: Pose, pixels: Array) -> tuple[Array, Array, Array]:
    """Points of the board that pixels show, and how they move with pixel and pose.

    Parameters
    ----------
    pose : Pose
    pixels : (m, 2) array [px]

    Returns
    -------
    board : (m, 2) mm
        y, z; nan where the line of sight misses the board's plane or the lens' model cannot be inverted.
    by_pixel : (m, 2, 2) mm/px
    by_pose : (m, 2, p)
        With respect to the parameters of ``pose.covariance``. The covariance of points that share the pose is
        ``by_pixel[i] C_i by_pixel[i].T`` for i = j, plus ``by_pose[i] pose.covariance by_pose[j].T`` for all i, j.
    """
    camera = pose.camera
    ideal = undistort(camera, np.asarray(pixels, float))
    ray = np.concatenate(
        [(ideal - np.asarray(camera.principal_point)) / camera.focal, np.ones((len(ideal), 1))], axis=1
    )
    # In the board's frame the line of sight is position + λ direction; x = 0 there.
    direction, position = ray @ pose.rotation, pose.position
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = -position[0] / direction[:, 0]
    distance = np.where(distance > 0, distance, np.nan)
    board = position[1:] + distance[:, None] * direction[:, 1:]
    _, by_point, by_parameters = _project(camera, pose.rotation, pose.translation, board)
    by_pixel = np.full_like(by_point, np.nan)
    good = np.isfinite(by_point).all(axis=(1, 2))
    by_pixel[good] = np.linalg.inv(by_point[good])
    return board, by_pixel, -by_pixel @ by_parameters[..., : len(pose.covariance)]


@dataclass(frozen=True)
class _Parameters:
    """Pose, and changes of ln(focal), principal point [px] and k1."""

    rotation: Array
    translation: Array
    intrinsics: Array

    def moved(self, x: Array) -> _Parameters:
        turn = Rotation.from_rotvec(x[:3]).as_matrix()
        return _Parameters(turn @ self.rotation, self.translation + x[3:6], self.intrinsics + x[6:])

    def camera(self, camera: Camera) -> Camera:
        if not self.intrinsics.any():
            return camera
        focal, cu, cv, k1 = self.intrinsics
        u, v = camera.principal_point
        return replace(
            camera,
            focal=float(camera.focal * np.exp(focal)),
            principal_point=(float(u + cu), float(v + cv)),
            distortion=(float(camera.distortion[0] + k1), *camera.distortion[1:]),
        )


@dataclass(frozen=True)
class _Fit:
    parameters: _Parameters
    covariance: Array
    cost: float


def _project_at(camera: Camera, p: _Parameters, board: Array) -> tuple[Array, Array, Array]:
    return _project(p.camera(camera), p.rotation, p.translation, board)


def _project(camera: Camera, rotation: Array, translation: Array, board: Array) -> tuple[Array, Array, Array]:
    """Pixels (..., 2) of points (..., 2) of the board, their derivatives by the points (..., 2, 2) and by the ten
    parameters (..., 2, 10)."""
    arm = board @ rotation[:, 1:].T
    x = arm + translation
    depth = np.where(x[..., 2] > 0, x[..., 2], np.nan)[..., None]
    normal = x[..., :2] / depth
    ideal = normal * camera.focal + np.asarray(camera.principal_point)
    pixels = distort(camera, ideal)
    by_x = np.zeros((*board.shape[:-1], 2, 3))
    by_x[..., 0, 0] = by_x[..., 1, 1] = camera.focal / depth[..., 0]
    by_x[..., :, 2] = -camera.focal * normal / depth
    by_x = distortion_jacobian(camera, ideal) @ by_x
    by_all = np.empty((*board.shape[:-1], 2, 10))
    by_all[..., :3] = np.cross(arm[..., None, :], by_x)
    by_all[..., 3:6] = by_x
    by_all[..., 6] = pixels - np.asarray(camera.principal_point)
    by_all[..., 7:9] = np.eye(2)
    by_all[..., 9] = camera.focal * normal * (normal**2).sum(axis=-1, keepdims=True)
    return pixels, by_x @ rotation[:, 1:], by_all


def _starts(camera: Camera, observations: MarkObservations) -> list[_Parameters]:
    """Poses to start from: the plane-based solutions with the camera in front of the board."""
    ideal = undistort(camera, observations.corners).reshape(-1, 2)
    board = observations.board.reshape(-1, 2)
    _, inlier = cv2.findHomography(board, ideal, cv2.LMEDS)
    keep = np.ones(len(board), bool) if inlier is None else inlier.ravel() > 0
    if keep.sum() < 4:
        keep[:] = True
    (cu, cv), f = camera.principal_point, camera.focal
    matrix = np.array([[f, 0.0, cu], [0.0, f, cv], [0.0, 0.0, 1.0]])
    plane = np.column_stack([board[keep], np.zeros(keep.sum())])
    _, turns, shifts, _ = cv2.solvePnPGeneric(plane, ideal[keep], matrix, None, flags=cv2.SOLVEPNP_IPPE)
    out = []
    for turn, shift in zip(turns, shifts, strict=True):
        # OpenCV's plane is (y, z, 0), its normal the board's x.
        rotation = np.roll(Rotation.from_rotvec(np.ravel(turn)).as_matrix(), 1, axis=1)
        if np.isfinite(rotation).all() and (rotation.T @ np.ravel(shift))[0] < 0:
            out.append(_Parameters(rotation, np.ravel(shift), np.zeros(4)))
    if not out:
        raise BenchsimError(
            f"{observations.name}: the marks are seen from behind the board; check that the picture is not mirrored "
            "and that screen.marks gives y to the right, z up, as seen from the mirror's side"
        )
    return out


def _mark_chi2(camera: Camera, observations: MarkObservations, whitener: Array, p: _Parameters) -> Array:
    pixels, _, _ = _project_at(camera, p, observations.board)
    white = np.einsum("nij,nj->ni", whitener, (observations.corners - pixels).reshape(-1, 8))
    return np.nan_to_num((white**2).sum(axis=1), nan=np.inf)


def _refine(
    camera: Camera,
    observations: MarkObservations,
    whitener: Array,
    used: NDArray[np.bool_],
    scale: float,
    start: _Parameters,
    intrinsics_sigma: tuple[float, float, float],
) -> _Fit:
    """Levenberg–Marquardt from a start; the covariance is that of data of variance ``scale`` and of the priors."""
    sigma = np.array([intrinsics_sigma[0], intrinsics_sigma[1], intrinsics_sigma[1], intrinsics_sigma[2]])
    free = np.flatnonzero(np.concatenate([np.ones(6), sigma]) > 0)
    fitted = sigma > 0
    board, corners, white = observations.board[used], observations.corners[used], whitener[used] / np.sqrt(scale)

    def unpack(x: Array) -> Array:
        full = np.zeros(10)
        full[free] = x
        return full

    def misfit(x: Array) -> Array:
        p = start.moved(unpack(x))
        pixels, _, _ = _project_at(camera, p, board)
        data = np.einsum("nij,nj->ni", white, np.nan_to_num(pixels - corners, nan=1e6).reshape(-1, 8)).ravel()
        return np.concatenate([data, (p.intrinsics / np.where(fitted, sigma, 1.0))[fitted]])

    def slope(x: Array) -> Array:
        p = start.moved(unpack(x))
        _, _, by_all = _project_at(camera, p, board)
        by_all = np.nan_to_num(by_all.reshape(-1, 8, 10))
        by_all[..., :3] = by_all[..., :3] @ _left_jacobian(x[:3])
        data = (white @ by_all).reshape(-1, 10)[:, free]
        prior = (np.eye(10)[6:] / np.where(fitted, sigma, 1.0)[:, None])[fitted][:, free]
        return np.concatenate([data, prior])

    solution = least_squares(misfit, np.zeros(len(free)), slope, x_scale="jac", method="lm", xtol=1e-12, ftol=1e-12)
    end = start.moved(unpack(solution.x))
    # Derivatives at the end itself, where the perturbation is δ of the final R.
    start = end
    j = slope(np.zeros(len(free)))
    size = np.maximum(np.linalg.norm(j, axis=0), 1e-150)
    small = np.linalg.pinv((j / size).T @ (j / size)) / np.outer(size, size)
    covariance = np.zeros((10, 10))
    covariance[np.ix_(free, free)] = small
    return _Fit(end, covariance if fitted.any() else covariance[:6, :6], float(solution.cost))


def _left_jacobian(delta: Array) -> Array:
    """d(rotation vector of a left perturbation)/dδ of exp([δ]×), to second order in δ: exact where it matters."""
    cross = np.cross(np.eye(3), delta)
    return np.eye(3) + cross / 2 + cross @ cross / 6
