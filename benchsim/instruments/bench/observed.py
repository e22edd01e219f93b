"""What one exposure gives to the diagnosis, wherever it comes from, and what its makers share."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from benchsim.bench.curve import Curve
from benchsim.bench.model import Recording
from benchsim.instruments.bench.board_coordinates import View
from benchsim.trace.pose import Pose, to_board, to_pixels

Array = NDArray[np.float64]

CENTRE_BINS = 64
SHAPE_BINS = 24

CENTRE_FLOOR, CENTRE_SLOPE = 1.5e-3, 1.5e-3
"""Smooth error of the centre line [mm], and of its slope at a trace's ends: by so much two codes' centres of lopsided
light differ behind diffraction (`analysis/noise_pulls.py`: without them pulls of offset, slope and bend are 1.33, 1.24
and 1.18 on 38 pictures by other code). What is larger hides weak tilts and drifts."""

WIDTH_FLOOR = 3.5e-3
"""Smooth error of a width, as a fraction, common to neighbouring bins: what the profile's finite window, its background
and the line's mean shape leave. Pulls of the common offset have a std of 1.01 on 200 pictures, 0.57 on 38 by other code
to 1.35 on those like a phone's (`analysis/noise_pulls.py`). Smaller, and clean pictures show lenses and shaking that
are not there; larger, and facets that lean differently are seen later."""

JPEG_FLOOR = 7e-3
"""`WIDTH_FLOOR` of a JPEG: its blocks of 8 px round a line alike as long as it stays in their rows."""

WIDTH_SLOPE = 5e-3
"""The same of its change from the middle of a trace to its ends: with diffraction, other code's widths change along the
trace by that much more than `rays`' (pulls 1.14), and own renders' do not (0.46 to 0.83)."""

FLUX_FLOOR = 4e-3
"""The same as `WIDTH_FLOOR` of the flux: print and board reflect unevenly, and the background is subtracted to so
much."""

FLOOR_LENGTH = 250.0
"""Length over which the smooth errors change [mm]: of 1 sigma, 0.85 is common to a trace of 560 mm, 0.8 its slope, 0.5
its bend."""


@dataclass(frozen=True)
class Aside:
    """A mark that lies off its neighbours: its name, its row in `Observed.marks`, its residual [px], the picture."""

    mark: int
    row: int
    residual: Array
    picture: str


@dataclass(frozen=True)
class Observed:
    """What one exposure gives to the diagnosis.

    Attributes
    ----------
    index : int
        Number of the exposure in the recording.
    name : str
    points : (n, 2) mm
        Where the trace was measured, in the coordinates that the marks and the stated camera give.
    s : (n,) mm
        Arc length along the trace.
    covariance : (n, n) mm²
        Of the points' displacements across the trace.
    profile_points : (k, 2) mm, profile_s : (k,) mm
        Where width and flux were measured; empty where the camera's gamma is unknown.
    width2 : (k,) mm²
        Square of the adaptive width, blur included.
    width2_covariance : (k, k)
    log_flux : (k,)
        Of the light per mm; its constant is free.
    log_flux_covariance : (k, k)
    mm_per_px : (k,)
        Of a shift across the trace.
    view : View
        The pose and how it hangs on the marks.
    marks : (m, 2) px
        Residuals of the marks' centres, those of `View.corners` in their order; nan where a centre was not measured.
    marks_covariance : (m, 2, 2) px²
    blur : float
        1 sigma of the camera's blur [px], the pixel's width included, as the marks' edges show it.
    parting : (n,) mm²
        Mean square offset of the light of all facets across the trace about ``points``, one line's own not included;
        empty where no lines part. Where they do, there is neither width nor flux.
    parting_covariance : (n, n)
    ridge : Observed or None
        What the main ridge alone gives, where lines part.
    ends : (2, 2) mm
        Where the trace was first and last seen, saturated or not; none where nobody says.
    aside : tuple of Aside
        Marks of which all exposures together have to say whether they are data.
    notes : tuple of str
        What was left out, in sentences.
    """

    index: int
    name: str
    points: Array
    s: Array
    covariance: Array
    profile_points: Array
    profile_s: Array
    width2: Array
    width2_covariance: Array
    log_flux: Array
    log_flux_covariance: Array
    mm_per_px: Array
    view: View
    marks: Array
    marks_covariance: Array
    blur: float
    notes: tuple[str, ...] = ()
    parting: Array = field(default_factory=lambda: np.zeros(0))
    parting_covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    ridge: Observed | None = None
    ends: Array = field(default_factory=lambda: np.zeros((0, 2)))
    aside: tuple[Aside, ...] = ()


def nominal(recording: Recording) -> Recording:
    """The stated bench without effects: where reference points are laid off from, in every simulation alike."""
    return replace(recording, effects={}, fields={})


def beside(curve: Curve, s: Array, distance: Array) -> Array:
    """Points (n, 2) at signed distances from the feet at arc lengths s of a curve; undoes `signed_distance`."""
    spline = CubicSpline(curve.arc_length(), curve.points)
    tangent = spline(s, 1)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return spline(s) + distance[:, None] * np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)


def no_shape() -> dict[str, Any]:
    """Width and flux of an exposure that has none."""
    none, square = np.zeros(0), np.zeros((0, 0))
    return {
        "profile_points": np.zeros((0, 2)),
        "profile_s": none,
        "width2": none,
        "width2_covariance": square,
        "log_flux": none,
        "log_flux_covariance": square,
        "mm_per_px": none,
    }


def mm_per_px(pose: Pose, points: Array, normal: Array) -> Array:
    """mm across a trace per px across it in the picture.

    Parameters
    ----------
    pose : Pose
    points : (n, 2) array [mm]
        On the board.
    normal : (n, 2) array
        Unit, across the trace on the board.

    Returns
    -------
    (n,) ndarray
    """
    _, by_pixel, _ = to_board(pose, to_pixels(pose, points))
    along = np.stack([normal[:, 1], -normal[:, 0]], axis=1)
    run = np.einsum("nij,nj->ni", np.linalg.inv(by_pixel), along)
    across = np.stack([-run[:, 1], run[:, 0]], axis=1) / np.linalg.norm(run, axis=1, keepdims=True)
    return np.asarray(np.abs(np.einsum("ni,nij,nj->n", normal, by_pixel, across)), float)


def smooth_floor(s: Array, size: Array, slope: Array | float = 0.0, length: float = FLOOR_LENGTH) -> Array:
    """Covariance (n, n) of a smooth error at s [mm] of 1 sigma ``size`` (n,) that changes over ``length`` [mm], and of
    one that is straight along s and ``slope``, 1 sigma, at its ends."""
    apart = s[:, None] - s[None, :]
    straight = slope * (2 * (s - s.min()) / max(float(np.ptp(s)), 1e-9) - 1)
    return np.outer(size, size) * np.exp(-0.5 * (apart / length) ** 2) + np.outer(straight, straight)
