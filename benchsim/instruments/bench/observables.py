"""From photographs to data: centre line, width, flux and marks of every exposure, each with the noise it shows.

``c``: mean displacement of the trace across itself, in bins; ``w``: width; ``f``: logarithm of the light per mm; ``m``:
what the marks' centres leave after the pose. Where facets draw lines of their own, ``c`` is the mean of all their light
and ``g``, its mean square offset, stands in the place of ``w`` and ``f`` (`facet_lines`). The camera's pose is solved
with the stated intrinsics held, so that whatever is wrong with them stays in the marks' residuals and is modelled
(`board_coordinates`).

Noise is taken from the data alone. Centre line: scatter and correlation of neighbouring profiles, the common errors of
line shape and pose (`trace.covariance`). Width and flux: scatter and correlation of neighbouring profiles about a
smooth curve, and a smooth floor. Marks: scatter of their centres about polynomials that a bent board or a wrong lens
can follow; scatter about the pose alone would call a bow noise. On photographs of other code the polynomials' scatter
predicts the true errors of the centres within 20 %, and bins of the centre line lie from the truth by what their
covariance says (χ² per datum 0.8 to 1.1); what whole traces share needs a small floor (`observed.CENTRE_FLOOR`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.polynomial import Legendre
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from benchsim import rays, trace
from benchsim.bench.curve import Curve, signed_distance
from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Recording
from benchsim.instruments.bench.board_coordinates import View, view
from benchsim.instruments.bench.explain import bin_trace
from benchsim.instruments.bench.facet_lines import Parted, follow_facets, parted
from benchsim.instruments.bench.observed import (
    CENTRE_BINS,
    CENTRE_FLOOR,
    CENTRE_SLOPE,
    FLUX_FLOOR,
    JPEG_FLOOR,
    SHAPE_BINS,
    WIDTH_FLOOR,
    WIDTH_SLOPE,
    Aside,
    Observed,
    beside,
    mm_per_px,
    no_shape,
    nominal,
    smooth_floor,
)
from benchsim.instruments.bench.simulation import simulate
from benchsim.trace.extract import measure, picture_on, read_photographs
from benchsim.trace.marks import MarkObservations, find_marks
from benchsim.trace.noise import centre_noise, spline_basis
from benchsim.trace.pose import Pose, join, solve_pose
from benchsim.trace.side_lines import light_across

__all__ = ["Observed", "observe", "observe_one", "simulate"]

Array = NDArray[np.float64]

SMOOTH_DEGREE = 4
"""Of the polynomials in y and z by which the marks' scatter is judged: lens and bow are of third order at most."""

ALONG = 4
"""Degree of the polynomial along the trace by which the sigma of its width goes."""

LONE = 3.0
"""A mark whose centre lies this many robust sigma off the polynomials (root mean square of both coordinates), alone
among its neighbours, is mismeasured (a scratch, the trace across it); noise does that once in 8000: exp(−3²)."""

STRAY, ALIKE, SLOPE = 6.0, 31, 0.1
"""Robust sigma of log flux from the median of so many neighbours beyond which width and flux of a profile are not used:
one whose crest is left out for the sensor's ceiling can have any, and says it knows them well. Noise does that once in
5e8. What is within the last is never left out: without noise the line's own change among neighbours would be."""

GROSS = 0.15
"""Residual of a corner, in sides of its mark, beyond which the mark is wrong (no dent of a board shows so)."""

MOST_LONE = 0.15
"""Largest share of marks left out so."""

FEWEST_ALIKE = 3
"""Photographs in all of which a mark lies off its neighbours where the board is to blame, not its measurement."""


@dataclass(frozen=True)
class _Task:
    recording: Recording

    def __call__(self, index: int) -> Observed | str:
        try:
            return observe_one(self.recording, index)
        except BenchsimError as error:
            return str(error)


def observe(
    recording: Recording, spread: Callable[..., Iterable[Any]] = map
) -> tuple[tuple[Observed, ...], tuple[str, ...]]:
    """Data of all exposures of a recording.

    Parameters
    ----------
    recording : Recording
        With images.
    spread : callable
        ``map``, or a pool's.

    Returns
    -------
    observed : tuple of Observed
    lost : tuple of str
        A sentence for every exposure that gave none.

    Raises
    ------
    BenchsimError
        If no exposure gave any.
    """
    found = list(spread(_Task(recording), range(len(recording.exposures))))
    observed = tuple(o for o in found if isinstance(o, Observed))
    lost = tuple(o for o in found if isinstance(o, str))
    if not observed:
        raise BenchsimError(f"{recording.path.name}: no exposure can be used: {lost[0]}")
    return _borne_out(recording, _of_the_board(observed)), lost


def _of_the_board(observed: tuple[Observed, ...]) -> tuple[Observed, ...]:
    """Marks that lie off their neighbours in every photograph are the board's, so data; others are mismeasured."""
    off = Counter(a.mark for o in observed for a in o.aside)
    board = {mark for mark, n in off.items() if n == len(observed) >= FEWEST_ALIKE}

    def settled(o: Observed) -> Observed:
        marks, notes = o.marks.copy(), []
        for a in o.aside:
            if a.mark in board:
                marks[a.row] = a.residual
            else:
                notes.append(f"{a.picture}: mark {a.mark} lies off its neighbours and is left out")
        ridge = None if o.ridge is None else settled(o.ridge)
        return replace(o, marks=marks, aside=(), ridge=ridge, notes=(*notes, *o.notes))

    return tuple(settled(o) for o in observed)


def _borne_out(recording: Recording, observed: tuple[Observed, ...]) -> tuple[Observed, ...]:
    """Lines apart are data where all exposures show the same facets; else the main ridge is."""
    parted = [o for o in observed if o.ridge is not None]
    single = [o for o in observed if o.ridge is None and recording.exposures[o.index].facet is None]
    if not parted or follow_facets(recording, parted, single):
        return observed
    note = "its light lies beside its main line too, but not as facets that lean would lay it; the main line is used"
    return tuple(
        o if o.ridge is None else replace(o.ridge, notes=(*o.ridge.notes, f"{o.name}: {note}")) for o in observed
    )


def observe_one(recording: Recording, index: int) -> Observed:
    """Data of one exposure.

    Raises
    ------
    BenchsimError
        As `trace.extract`; names the image and the mend.
    """
    exposure = recording.exposures[index]
    camera = recording.cameras[exposure.camera]
    photograph, dark = read_photographs(recording, exposure)
    marks = find_marks(photograph, recording.screen.marks, camera)
    if dark is not None:
        marks = join(marks, find_marks(dark, recording.screen.marks, camera))
    pose = solve_pose(camera, marks)
    blur = float(np.median(marks.blur))
    picture = picture_on(photograph, dark, pose, recording.screen, blur)
    measured = measure(photograph, dark, pose, recording.screen, blur, picture=picture)
    centres = _centres(marks, pose)
    line = _main_ridge(measured, centres, pose)
    seen = _reduced(recording, index, centres, line, blur)
    if not measured.linear:
        return seen
    across = light_across(picture, pose, line)
    found = parted(recording, exposure, across, pose, blur, line)
    return seen if found is None else _of_all_facets(seen, found)


def _of_all_facets(seen: Observed, found: Parted) -> Observed:
    """Data of an exposure whose lines part: the mean of all light and its parting for one ridge's shape."""
    note = (
        f"{seen.name}: the facets draw lines of their own, {np.sqrt(np.median(found.parting)):.1f} mm rms apart; their "
        "mean and their parting are used, width and flux are not"
    )
    return replace(
        seen,
        points=found.points,
        s=found.s,
        covariance=found.covariance,
        parting=found.parting,
        parting_covariance=found.parting_covariance,
        ridge=seen,
        notes=(*seen.notes, note),
        **no_shape(),
    )


def _main_ridge(measured: trace.Trace, centres: _Centres, pose: Pose) -> trace.Trace:
    """The trace's main ridge; the pose's own covariance counts a bow as noise of the marks, which is mended here."""
    line = trace.only_ridge(measured)
    return replace(line, pose_mm=line.pose_mm * np.sqrt(centres.scale / pose.chi2_per_dof))


def _reduced(recording: Recording, index: int, centres: _Centres, line: trace.Trace, blur: float) -> Observed:
    """Data of the marks' centres and of the main ridge."""
    stated = rays.predict(nominal(recording), recording.exposures[index], width=False)
    ends, line = line.points[[0, -1]], trace.unsaturated(line)
    binned = bin_trace(line.s_mm, trace.covariance(line), bins=CENTRE_BINS)
    distance, feet = signed_distance(stated, line.points)
    points = beside(stated, binned.weights @ feet, binned.weights @ distance)
    shape = _shape(line, stated, distance, feet) if line.linear else no_shape()
    return Observed(
        index=index,
        name=recording.exposures[index].name,
        points=points,
        s=binned.s,
        covariance=binned.covariance + smooth_floor(binned.s, np.full(len(binned.s), CENTRE_FLOOR), CENTRE_SLOPE),
        view=centres.view,
        marks=centres.residual,
        marks_covariance=centres.covariance,
        blur=blur,
        ends=ends,
        aside=centres.aside,
        **shape,
    )


@dataclass(frozen=True)
class _Centres:
    view: View
    residual: Array
    covariance: Array
    scale: float
    aside: tuple[Aside, ...]


def _centres(marks: MarkObservations, pose: Pose) -> _Centres:
    """Residuals of the marks' centres, one per mark, with covariance; and the view of the pose."""
    # Marks that the pose set aside may stand on a dent: they are data all the same, unless they are off by so much that
    # they are another mark or were moved.
    side = np.linalg.norm(np.diff(marks.corners, axis=1), axis=-1).mean(axis=1)
    use = pose.used | (np.linalg.norm(pose.residuals, axis=-1).max(axis=1) < GROSS * side)
    ids = marks.ids[use]
    weight = np.linalg.inv(marks.joint[use])
    each, which = np.unique(ids, return_inverse=True)
    total, held = np.zeros((len(each), 8, 8)), np.zeros((len(each), 8, 8))
    np.add.at(total, which, weight)
    np.add.at(held, which, weight * pose.used[use][:, None, None])
    corners = np.zeros((len(each), 4, 2))
    corners[which] = marks.board[use]
    seen = view(pose, corners, held)
    # A photograph and its dark show a mark twice: the weighted mean of what they show.
    pulled = np.zeros((len(each), 8))
    np.add.at(pulled, which, np.einsum("nij,nj->ni", weight, pose.residuals[use].reshape(-1, 8)))
    joint = np.linalg.inv(total)
    mean = np.tile(np.eye(2), (1, 4)) / 4
    residual = np.einsum("ai,nij,nj->na", mean, joint, pulled)
    covariance = np.einsum("ai,nij,bj->nab", mean, joint, mean)
    whole = np.ones(len(each), bool)
    np.logical_and.at(whole, which, marks.measured[use].all(axis=1))
    scale, lone = _marks_scatter(corners.mean(axis=1), residual, covariance, whole)
    aside = tuple(Aside(int(each[i]), int(i), residual[i], marks.name) for i in np.flatnonzero(lone))
    residual = np.where((whole & ~lone)[:, None], residual, np.nan)
    return _Centres(seen, residual, covariance * scale, scale, aside)


def _marks_scatter(
    board: Array, residual: Array, covariance: Array, whole: NDArray[np.bool_]
) -> tuple[float, NDArray[np.bool_]]:
    """Variance of the centres over what is stated, and marks that are mismeasured.

    Polynomials in y and z take what board and lens can do; their degree falls where the marks are few.
    """
    y, z = (board / max(np.abs(board).max(), 1e-9)).T
    near = np.argsort(np.linalg.norm(board[:, None] - board[None], axis=-1), axis=1)[:, 1:5]
    lone, settled = np.zeros(len(board), bool), ~whole
    scale = 1.0
    while True:
        keep = whole & ~lone
        degree = SMOOTH_DEGREE
        while degree > 1 and (degree + 1) * (degree + 2) // 2 > 0.5 * keep.sum():
            degree -= 1
        basis = np.stack([y**a * z**b for a in range(degree + 1) for b in range(degree + 1 - a)], axis=1)
        if keep.sum() <= basis.shape[1] + 2:
            return max(scale, 1.0), lone
        scale, size = _off(basis, residual, covariance, keep)
        worst = int(np.argmax(np.where(keep & ~settled, size, 0.0)))
        if settled[worst] or lone.sum() + 1 > MOST_LONE * whole.sum():
            return scale, lone
        # Judged by the others alone: a mark that is far off pulls the polynomials to itself and its neighbours away.
        others = keep & (np.arange(len(board)) != worst)
        _, size = _off(basis, residual, covariance, others)
        # The mean square of two Gaussians is exponential: its median is ln 2.
        robust = float(np.median(size[others])) / np.sqrt(np.log(2))
        if size[worst] <= 2.0 * robust:
            return scale, lone
        # Two bad marks may be neighbours; a fault of the board is seen by more.
        alone = np.sort(size[near[worst]])[-2] < LONE * robust
        lone[worst] = size[worst] > LONE * robust and alone
        settled[worst] = True


def _off(basis: Array, residual: Array, covariance: Array, keep: NDArray[np.bool_]) -> tuple[float, Array]:
    """Variance over the stated one, and every mark's distance from the polynomials of those kept, in stated sigma.

    Distances are over what is expected of a mark that the fit followed, or, if it was not kept, did not.
    """
    left = np.zeros_like(residual)
    total = 0.0
    for k in range(2):
        w = 1 / np.sqrt(covariance[:, k, k])
        white, a = residual[:, k] * w, basis * w[:, None]
        q, r = np.linalg.qr(a[keep])
        off = white - a @ np.linalg.solve(r, q.T @ white[keep])
        leverage = np.linalg.norm(np.linalg.solve(r.T, a.T), axis=0) ** 2
        total += float(off[keep] @ off[keep])
        left[:, k] = off / np.sqrt(np.where(keep, np.maximum(1 - leverage, 0.1), 1 + leverage))
    return total / (2 * (keep.sum() - basis.shape[1])), np.sqrt((left**2).mean(axis=1))


def _shape(line: trace.Trace, stated: Curve, distance: Array, feet: Array) -> dict[str, Any]:
    """Width and flux in bins, with covariance from the scatter of neighbouring profiles and a smooth floor."""
    good = (line.width_mm > 0) & (line.flux > 0) & np.isfinite(line.width_mm) & (line.saturated == 0)
    if good.sum() < 8 * SHAPE_BINS // 2:
        return no_shape()
    light = np.log(line.flux[good])
    away = np.abs(light - median_filter(light, ALIKE, mode="nearest"))
    good[good] = away <= max(STRAY * 1.4826 * float(np.median(away)), SLOPE)
    s, profile = line.s_mm[good], line.profile[good].astype(float)
    width, flux, sigma = line.width_mm[good], line.flux[good], line.sigma_mm[good]
    basis = spline_basis(profile, (profile.min(), profile.max()), (profile.max() - profile.min()) / 12)
    common = JPEG_FLOOR if Path(line.exposure).suffix.lower() in (".jpg", ".jpeg") else WIDTH_FLOOR
    out: dict[str, Any] = {}
    binned = None
    for key, value, spread, floor, slope in (
        ("log_width", np.log(width), sigma / width, common, WIDTH_SLOPE),
        ("log_flux", np.log(flux), sigma / width, FLUX_FLOOR, 0.0),
    ):
        # Wrong by a common factor, which the scatter finds.
        noise = centre_noise(profile, value, spread, basis)
        lag = np.abs(profile[:, None] - profile[None, :]).astype(int)
        rho = np.append(noise.correlation, 0.0)[np.minimum(lag, len(noise.correlation))]
        covariance = noise.scale**2 * rho * np.outer(spread, spread)
        if binned is None:
            binned = bin_trace(s, covariance, bins=SHAPE_BINS)
        w = binned.weights
        out[key] = w @ value
        out[f"{key}_covariance"] = w @ (covariance + smooth_floor(s, np.full(len(s), floor), slope)) @ w.T
    assert binned is not None
    assert line.pose is not None
    # Of the logarithm the mean is free of what the profiles' scatter adds to a mean of squares.
    width2 = np.exp(2 * out.pop("log_width"))
    relative = out.pop("log_width_covariance")
    # A sigma in proportion to the datum itself would give more weight to what noise made narrower.
    w = binned.weights
    along = w @ s
    smooth = np.exp(2 * Legendre.fit(along, 0.5 * np.log(width2), ALONG)(along))
    px = mm_per_px(line.pose, line.points[good], line.normal[good])
    return {
        **out,
        "width2": width2,
        "width2_covariance": 4 * relative * np.outer(smooth, smooth),
        "profile_points": beside(stated, w @ feet[good], w @ distance[good]),
        "profile_s": along,
        "mm_per_px": w @ px,
    }
