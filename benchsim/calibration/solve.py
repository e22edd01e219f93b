"""Lens, board and poses by least squares over the corners of the marks in all views together.

OpenCV gives the start. What is added are the weights, the covariance of every mark's eight coordinates, scaled view by
view to what the residuals say, and with them the covariance of the result.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Camera
from benchsim.calibration.model import BOARD, LENS, OWN, SHARED, State, predict
from benchsim.trace.edge_pixels import OUTLIER_SIGMA
from benchsim.trace.marks import FEWEST_MARKS, MarkObservations

Array = NDArray[np.float64]

LENS_REACH = (1.0, 0.1, 0.1, 1.0, 3.0, 0.1, 0.1, 10.0)
"""1 σ of a lens of which nothing is known; focal length and principal point in units of the picture's longer side. It
weighs nothing beside data that fix a parameter at all, and keeps the covariance finite beside data that do not."""

BOARD_REACH = (0.01, 0.01, 0.02, 0.02, 0.02)
"""1 σ of a board of which nothing is known; bow and twist in units of R."""

PLACE = 0.05
"""First guess of how well the marks lie where the table says, 1 σ along y and z each [mm]; the views then say it."""

LEAST_PLACE = 1e-3
"""Prints are no better than this [mm]: paper is not."""

SMOOTH = 1e-4
"""1 σ of a common motion of all marks' places, which other parameters have [mm]."""

FEWEST_VIEWS = 4
"""Two views of a plane, tilted differently, fix a lens without distortion; of four, one that contradicts is seen."""

ROUNDS = 25
SETTLED = 0.05
"""Relative change of noise and print at which they are taken for settled: of thirty marks they are known to a tenth."""

_MEDIAN_CHI2 = 7.344  # median of χ² with the 8 degrees of freedom of a mark


@dataclass(frozen=True)
class Bundle:
    """The solution.

    Attributes
    ----------
    camera : Camera
        With the lens that was found.
    lens, board : (8,), (5,)
        In the order of `LENS` and `BOARD`.
    poses : (v, 6)
        Rotation vector and translation [mm] of every view: of the points (y, −z, −x) into the camera's frame.
    spread : (v, 3) px
        By how much the edges of the marks have moved outward: in their middle, and how much more they have over the
        marks' extent to the right and downward.
    ids : (m,) int
        Marks seen in any view.
    places, places_sigma : (m, 2) mm
        How far each lies from where the table, stretched and sheared, says, and 1 σ.
    print_sigma : float
        1 σ of that over all marks [mm], as the views say.
    covariance : (13, 13)
        Of lens and board, all else marginalised.
    used : tuple of (n,) bool
        Marks of every view that the solution rests on; the others lie too far off.
    residuals : tuple of (n, 4, 2) px
        Measured corners less predicted ones.
    scale : (v,)
        χ² per degree of freedom of every view: by how much its corners' covariance was too small.
    misfit, slope : (r,), (r, 13 + 2 m + 9 v)
        Whitened residuals (predicted less measured) of all views and priors, and their derivatives in the order of
        `State.flat`: for what is tested or added later.
    rows : tuple of slice
        Of every view in ``misfit``.
    """

    camera: Camera
    lens: Array
    board: Array
    poses: Array
    spread: Array
    ids: NDArray[np.intp]
    places: Array
    places_sigma: Array
    print_sigma: float
    covariance: Array
    used: tuple[NDArray[np.bool_], ...]
    residuals: tuple[Array, ...]
    scale: Array
    misfit: Array
    slope: Array
    rows: tuple[slice, ...]

    @property
    def sigma(self) -> Array:
        """1 σ of lens and board, (13,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def distance(self) -> Array:
        """From camera to the board's centre along the optical axis, (v,) mm."""
        return self.poses[:, 5]

    @property
    def rms(self) -> Array:
        """Of the residuals of the marks used, (v,) px."""
        return np.array([float(np.sqrt((r[u] ** 2).mean())) for r, u in zip(self.residuals, self.used, strict=True)])


def reach(views: Sequence[MarkObservations]) -> float:
    """R: farthest corner of a mark from the board's centre along an axis [mm]."""
    return max(float(np.abs(v.board).max()) for v in views)


def solve(camera: Camera, views: Sequence[MarkObservations]) -> Bundle:
    """Lens, board and poses by weighted least squares, robust against single wrong marks.

    Parameters
    ----------
    camera : Camera
        Only its resolution is used, and what is not the lens.
    views : sequence of MarkObservations
        At least `FEWEST_VIEWS`.

    Returns
    -------
    Bundle

    Raises
    ------
    BenchsimError
        If no lens and board explain the views (half a cell off in the median).

    Notes
    -----
    Start: Zhang's closed form (IEEE TPAMI 22, 1330, 2000) and OpenCV's refinement of focal length, k1 and poses. The
    covariance of each view's corners is scaled by its own χ² per degree of freedom (JPEG adds errors that the edges'
    fits do not see). How well the marks lie is found as MacKay finds it (Neural Computation 4, 415, 1992): places are
    as large as their own prior lets them, which gives the prior; by the median, so that one wrong mark does not. A mark
    is set aside as in `trace.pose.solve_pose`. What the views share and the model does not have (a rolling shutter, a
    board that changes its shape) is not in the covariance.
    """
    problem = _Problem(camera, views)
    state, used = problem.start()
    scale, place = np.ones(len(views)), PLACE
    state = problem.minimise(state, used, scale, place)
    for _ in range(ROUNDS):
        misfit, slope, rows = problem.linear(state, used, scale, place)
        q, r = np.linalg.qr(slope)
        step = np.linalg.solve(r, q.T @ misfit)
        state = state.moved(state.flat() - step)
        left, lever = misfit - q @ (q.T @ misfit), (q**2).sum(axis=1)
        before = scale, place, used
        scale = scale * [_per_freedom(left[k], lever[k]) for k in rows]
        free = np.sqrt(np.maximum(1 - lever[problem.place_rows(rows)], 1e-6))
        place = max(1.4826 * float(np.median(np.abs(state.places.ravel()) / free)), LEAST_PLACE)
        used = problem.plausible(state)
        if (
            np.allclose(scale, before[0], rtol=SETTLED)
            and np.isclose(place, before[1], rtol=SETTLED)
            and all(np.array_equal(a, b) for a, b in zip(used, before[2], strict=True))
            and np.abs(r @ step).max() < 0.1
        ):
            break
    state = problem.minimise(state, used, scale, place)
    misfit, slope, rows = problem.linear(state, used, scale, place)
    residuals = tuple(v.corners - problem.predict(state, k)[0] for k, v in enumerate(views))
    _check(views, residuals, used, state.poses)
    size = np.linalg.norm(slope, axis=0)
    inverse = np.linalg.inv((slope / size).T @ (slope / size)) / np.outer(size, size)
    unit = np.concatenate([np.ones(len(LENS)), _board_units(problem.size)])
    f, u, v = (float(x) for x in state.lens[:3])
    k1, k2, p1, p2, k3 = (float(x) for x in state.lens[3:])
    marks = slice(SHARED, SHARED + state.places.size)
    return Bundle(
        camera=replace(camera, focal=f, principal_point=(u, v), distortion=(k1, k2, p1, p2, k3)),
        lens=state.lens,
        board=state.board * _board_units(problem.size),
        poses=state.poses,
        spread=state.spread,
        ids=problem.ids,
        places=state.places,
        places_sigma=np.sqrt(np.diag(inverse)[marks]).reshape(-1, 2),
        print_sigma=place,
        covariance=inverse[:SHARED, :SHARED] * np.outer(unit, unit),
        used=tuple(used),
        residuals=residuals,
        scale=scale,
        misfit=misfit,
        slope=slope,
        rows=rows,
    )


def _board_units(size: float) -> Array:
    """Inside, bow and twist are in units of R."""
    return np.array([1.0, 1.0, size, size, size])


def _per_freedom(left: Array, lever: Array) -> float:
    """χ² per degree of freedom of some rows: each parameter takes away what the rows' leverage says."""
    return max(float((left**2).sum()) / max(float((1 - lever).sum()), 1.0), 1e-12)


class _Problem:
    """The views, and what is the same in every step of the solution."""

    def __init__(self, camera: Camera, views: Sequence[MarkObservations]) -> None:
        self.camera, self.views, self.size = camera, views, reach(views)
        self.ids = np.unique(np.concatenate([v.ids for v in views]))
        self.index = [np.searchsorted(self.ids, v.ids) for v in views]
        self.whitener = [np.linalg.inv(np.linalg.cholesky(v.joint)) for v in views]
        side, middle = float(max(camera.resolution)), (np.array(camera.resolution) - 1) / 2
        self.expected = np.array([side, *middle, *np.zeros(SHARED - 3)])
        self.smooth = _smooth(self.ids, views)
        self.reach = np.array([*(side * x for x in LENS_REACH[:3]), *LENS_REACH[3:], *BOARD_REACH])

    def predict(self, state: State, k: int) -> tuple[Array, Array]:
        return predict(state, self.views[k], self.index[k], k, self.size)

    def place_rows(self, rows: tuple[slice, ...]) -> slice:
        first = rows[-1].stop + SHARED
        return slice(first, first + 2 * len(self.ids))

    def linear(
        self, state: State, used: list[NDArray[np.bool_]], scale: Array, place: float
    ) -> tuple[Array, Array, tuple[slice, ...]]:
        """Whitened misfit of views and priors, its derivatives, and the views' rows."""
        ends = np.cumsum([0, *(8 * int(u.sum()) for u in used)])
        rows = tuple(slice(int(a), int(b)) for a, b in pairwise(ends))
        count, marks = int(ends[-1]), 2 * len(self.ids)
        misfit = np.zeros(count + SHARED + marks + len(self.smooth))
        slope = np.zeros((len(misfit), SHARED + marks + OWN * len(self.views)))
        for k, view in enumerate(self.views):
            pixels, by = self.predict(state, k)
            keep = np.flatnonzero(used[k])
            w = self.whitener[k][keep] / np.sqrt(scale[k])
            off = (pixels - view.corners)[keep].reshape(-1, 8, 1)
            misfit[rows[k]] = np.nan_to_num(w @ off, nan=1e6).ravel()
            by = w @ by[keep].reshape(-1, 8, by.shape[-1])
            at = rows[k].start + np.arange(8 * len(keep)).reshape(-1, 8)
            slope[rows[k], :SHARED] = by[..., :SHARED].reshape(-1, SHARED)
            for axis in (0, 1):
                column = SHARED + 2 * self.index[k][keep] + axis
                slope[at, column[:, None]] = by[..., SHARED + axis]
            own = SHARED + marks + OWN * k
            slope[rows[k], own : own + OWN] = by[..., SHARED + 2 :].reshape(-1, OWN)
        x = np.concatenate([state.lens, state.board])
        misfit[count : count + SHARED] = (x - self.expected) / self.reach
        slope[count : count + SHARED, :SHARED] = np.diag(1 / self.reach)
        wander = np.concatenate([np.eye(marks) / place, self.smooth / SMOOTH])
        misfit[count + SHARED :] = wander @ state.places.ravel()
        slope[count + SHARED :, SHARED : SHARED + marks] = wander
        return misfit, slope, rows

    def minimise(self, state: State, used: list[NDArray[np.bool_]], scale: Array, place: float) -> State:
        """Minimum from a start, weights fixed."""
        done: dict[bytes, tuple[Array, Array]] = {}

        def both(x: Array) -> tuple[Array, Array]:
            key = x.tobytes()
            if key not in done:
                done.clear()
                done[key] = self.linear(state.moved(x), used, scale, place)[:2]
            return done[key]

        solution = least_squares(
            lambda x: both(x)[0], state.flat(), lambda x: both(x)[1], x_scale="jac", xtol=1e-10, ftol=1e-10
        )
        return state.moved(solution.x)

    def start(self) -> tuple[State, list[NDArray[np.bool_]]]:
        """Zhang's focal length if it is one, then OpenCV's refinement with k1 alone; marks wholly elsewhere are out."""
        shape = self.camera.resolution
        on_board = [_flat(v.board) for v in self.views]
        in_picture = [np.ascontiguousarray(v.corners.reshape(-1, 2), np.float32) for v in self.views]
        keep = [_homography_inliers(b, p) for b, p in zip(on_board, in_picture, strict=True)]
        on_board = [b[k] for b, k in zip(on_board, keep, strict=True)]
        in_picture = [p[k] for p, k in zip(in_picture, keep, strict=True)]
        focal = float(cv2.initCameraMatrix2D(on_board, in_picture, shape, 1.0)[0, 0])
        if not 0.2 * max(shape) < focal < 20 * max(shape):
            focal = float(max(shape))
        matrix = np.array([[focal, 0, (shape[0] - 1) / 2], [0, focal, (shape[1] - 1) / 2], [0, 0, 1.0]])
        flags = (
            cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_FIX_PRINCIPAL_POINT
            | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
        )  # fmt: skip
        _, matrix, distortion, turns, shifts = cv2.calibrateCamera(
            on_board, in_picture, shape, matrix, np.zeros(5), flags=flags
        )
        poses = np.array([np.concatenate([np.ravel(r), np.ravel(t)]) for r, t in zip(turns, shifts, strict=True)])
        lens = np.concatenate([[matrix[0, 0], matrix[0, 2], matrix[1, 2]], np.ravel(distortion)[:5]])
        state = State(lens, np.zeros(len(BOARD)), np.zeros((len(self.ids), 2)), poses, np.zeros((len(self.views), 3)))
        used = []
        for k, view in enumerate(self.views):
            # This first lens leaves the picture's corners some pixels off.
            off = np.linalg.norm(view.corners - self.predict(state, k)[0], axis=-1).max(axis=1)
            used.append(off <= max(10 * float(np.median(off)), 1.0))
        return state, used

    def plausible(self, state: State) -> list[NDArray[np.bool_]]:
        """Marks within five times what the marks of their view are off in the median."""
        out = []
        for k, view in enumerate(self.views):
            white = np.einsum("nij,nj->ni", self.whitener[k], (view.corners - self.predict(state, k)[0]).reshape(-1, 8))
            chi2 = np.nan_to_num((white**2).sum(axis=1), nan=np.inf)
            out.append(chi2 <= 8 * OUTLIER_SIGMA**2 * max(float(np.median(chi2)) / _MEDIAN_CHI2, 1e-12))
        return out


def _smooth(ids: NDArray[np.intp], views: Sequence[MarkObservations]) -> Array:
    """Directions (6, 2 m), of unit length, in which the marks' places do not move together.

    Shift and turn are the poses', stretch and shear the board's; a larger board, its marks with it, is a nearer one.
    """
    centre = {int(i): c for v in views for i, c in zip(v.ids, v.board.mean(axis=1), strict=True)}
    y, z = np.array([centre[int(i)] for i in ids]).T
    one, none = np.ones_like(y), np.zeros_like(y)
    ways = [(one, none), (none, one), (-z, y), (y, z), (y, -z), (z, y)]
    return np.linalg.qr(np.array([np.column_stack(w).ravel() for w in ways]).T)[0].T


def _flat(board: Array) -> NDArray[np.float32]:
    y, z = board.reshape(-1, 2).T
    return np.stack([y, -z, np.zeros_like(y)], axis=-1).astype(np.float32)


def _homography_inliers(on_board: NDArray[np.float32], in_picture: NDArray[np.float32]) -> NDArray[np.bool_]:
    _, inlier = cv2.findHomography(on_board[:, :2], in_picture, cv2.LMEDS)
    keep = np.ones(len(on_board), bool) if inlier is None else inlier.ravel() > 0
    return keep if keep.sum() >= 4 * FEWEST_MARKS else np.ones(len(on_board), bool)


def _check(
    views: Sequence[MarkObservations], residuals: Sequence[Array], used: Sequence[NDArray[np.bool_]], poses: Array
) -> None:
    off = np.concatenate([np.linalg.norm(r, axis=-1).max(axis=1) for r in residuals])
    side = np.concatenate([np.linalg.norm(np.diff(v.corners, axis=1), axis=-1).mean(axis=1) for v in views])
    few = [v.name for v, u in zip(views, used, strict=True) if u.sum() < FEWEST_MARKS]
    if np.median(off) > np.median(side) / 16 or few:
        raise BenchsimError(
            f"{few[0] if few else views[0].name}: the marks of the pictures fit no lens and no board together "
            f"({np.median(off):.1f} px off in the median); check that all show the board of --board, in one piece and "
            "not mirrored, and are by one camera that was not zoomed"
        )
    for view, pose in zip(views, poses, strict=True):
        # The camera's place is -Rᵀt in the frame (y, -z, -x): before the board its third coordinate is negative.
        if (cv2.Rodrigues(pose[:3])[0].T @ pose[3:])[2] <= 0:
            raise BenchsimError(
                f"{view.name}: the marks are seen from behind the board; check that the picture is not mirrored and "
                "that --board gives y to the right, z up, as seen from the mirror's side"
            )
