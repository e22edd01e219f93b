"""Data of a recording without photographs: the stated bench as its cameras would see it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchsim import rays, trace
from benchsim.bench.curve import Curve
from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Exposure, Recording
from benchsim.bench.place import camera_pose, place
from benchsim.instruments.bench.board_coordinates import View, turned, view
from benchsim.instruments.bench.observed import (
    CENTRE_BINS,
    FLUX_FLOOR,
    SHAPE_BINS,
    WIDTH_FLOOR,
    WIDTH_SLOPE,
    Observed,
    beside,
    mm_per_px,
    no_shape,
    nominal,
    smooth_floor,
)
from benchsim.trace.marks import board_corners
from benchsim.trace.pose import Pose

Array = NDArray[np.float64]


TYPICAL = (0.006, 0.004, 0.004, 0.012, 0.7)
"""Noise of photographs of 3 MP: sigma of one of 64 bins of the centre line [mm]; of one of 24 bins of width, as a
fraction, and of the logarithm of the flux; of a corner of a mark, each coordinate [px]; blur, the pixel in it [px]."""


def simulate(
    recording: Recording,
    *,
    seed: int | None = None,
) -> tuple[Observed, ...]:
    """Data of a recording without photographs: the stated bench as its cameras would see it.

    For studies of naming and for the question what a set of settings could show. The reference points lie on the
    trace of the stated bench without effects, poses are the nominal ones, and the data fit it exactly; hand the problem
    built from them to `problem.draw` for data of another truth.

    Parameters
    ----------
    recording : Recording
    seed : int, optional
        Draw the camera's poses 5 mm and 2 mrad about their nominal ones.

    Returns
    -------
    tuple of Observed

    Raises
    ------
    BenchsimError
        If a trace misses the board, or the recording lists no marks.
    """
    rng = np.random.default_rng(seed)
    return tuple(simulate_one(recording, i, None if seed is None else rng) for i in range(len(recording.exposures)))


def simulate_one(
    recording: Recording,
    index: int,
    rng: np.random.Generator | None = None,
) -> Observed:
    """Data of one exposure; ``rng`` draws the camera's pose."""
    exposure = recording.exposures[index]
    curve = rays.predict(nominal(recording), exposure)
    rotation, translation = _nominal_pose(recording, exposure)
    if rng is not None:
        delta = np.concatenate([2e-3 * rng.standard_normal(3), 5.0 * rng.standard_normal(3)])
        rotation, translation = turned(rotation, translation, delta)
    return _simulated(recording, index, curve, (rotation, translation))


def _nominal_pose(recording: Recording, exposure: Exposure) -> tuple[Array, Array]:
    rotation, translation = camera_pose(recording.cameras[exposure.camera])
    at = place(recording.mirror, exposure)
    return rotation @ at.screen_rotation, rotation @ at.screen_origin + translation


def _simulated(
    recording: Recording,
    index: int,
    curve: Curve,
    pose: tuple[Array, Array],
) -> Observed:
    exposure = recording.exposures[index]
    camera = recording.cameras[exposure.camera]
    centre_sigma, width_fraction, flux_sigma, corner_sigma, blur = TYPICAL
    marks = recording.screen.marks
    if marks is None or not marks.ids:
        raise BenchsimError(f"{recording.path.name}: the recording lists no marks; add screen.marks")
    solved = Pose(*pose, camera, np.zeros((6, 6)), np.zeros((0, 4, 2)), 1.0, np.zeros(0, bool), (), 0.0)
    corners = board_corners(marks)
    inside = _inside(recording, solved, corners.reshape(-1, 2)).reshape(-1, 4).all(axis=1)
    corners = corners[inside]
    if len(corners) < 3:
        raise BenchsimError(
            f"{recording.path.name}: camera {camera.name} sees {len(corners)} of the board's marks; mend its position"
        )
    seen = view(solved, corners, np.tile(np.eye(8) / corner_sigma**2, (len(corners), 1, 1)))
    arc = curve.arc_length()
    here = _inside(recording, solved, curve.points)
    if here.sum() < 2:
        raise BenchsimError(f"{recording.path.name}: camera {camera.name} does not see the trace of {exposure.name}")
    low, high = arc[here][[0, -1]]
    s = np.linspace(low, high, 2 * CENTRE_BINS + 1)[1::2]
    t = np.linspace(low, high, 2 * SHAPE_BINS + 1)[1::2]
    j = _pose_shift(seen, solved, beside(curve, s, np.zeros(len(s))), _normals(curve, s))
    covariance = np.diag(np.full(len(s), centre_sigma**2)) + corner_sigma**2 * j @ j.T
    points = beside(curve, t, np.zeros(len(t)))
    scale = mm_per_px(solved, points, _normals(curve, t))
    behind = rays.predict(nominal(recording), exposure, blur=blur * float(scale.mean()))
    aside = np.zeros(len(s)) if behind.aside is None else np.interp(s, arc, behind.aside)
    shape = no_shape()
    if camera.gamma != "unknown" and curve.width is not None and curve.flux is not None:
        width2 = np.interp(t, arc, curve.width) ** 2 + (blur * scale) ** 2
        shape = {
            "profile_points": points,
            "profile_s": t,
            "width2": width2,
            "width2_covariance": np.diag((2 * width_fraction * width2) ** 2)
            + smooth_floor(t, 2 * WIDTH_FLOOR * width2, 2 * WIDTH_SLOPE * width2),
            "log_flux": np.log(np.interp(t, arc, curve.flux)),
            "log_flux_covariance": np.diag(np.full(len(t), flux_sigma**2))
            + smooth_floor(t, np.full(len(t), FLUX_FLOOR)),
            "mm_per_px": scale,
        }
    return Observed(
        index=index,
        name=exposure.name,
        points=beside(curve, s, aside),
        s=s,
        covariance=covariance,
        view=seen,
        marks=np.zeros((len(corners), 2)),
        marks_covariance=np.tile(np.eye(2) * corner_sigma**2 / 4, (len(corners), 1, 1)),
        blur=blur,
        **shape,
    )


def _inside(recording: Recording, pose: Pose, points: Array) -> NDArray[np.bool_]:
    px = trace.to_pixels(pose, points)
    size = np.asarray(pose.camera.resolution)
    board = np.asarray(recording.screen.size) / 2
    return np.asarray((px > 0).all(axis=1) & (px < size - 1).all(axis=1) & (np.abs(points) <= board).all(axis=1))


def _pose_shift(seen: View, solved: Pose, points: Array, normal: Array) -> Array:
    """Shift across the trace (n, 8 m) by every coordinate of the marks' corners, through the pose [mm/px]."""
    _, _, by_pose = trace.to_board(solved, trace.to_pixels(solved, points))
    return np.einsum("ni,nip->np", normal, by_pose) @ seen.gain


def _normals(curve: Curve, s: Array) -> Array:
    """Unit vectors (n, 2) across a curve at arc lengths s."""
    ends = [beside(curve, s, np.full(len(s), d)) for d in (-0.5, 0.5)]
    return ends[1] - ends[0]
