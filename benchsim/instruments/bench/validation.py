"""A trace against the vector model at the stated setting: how far apart, and what the settings explain of it.

The vector model has a cylinder and a parallel pencil where the bench has a polygon and a beam. That difference, some
tens of µm, is known and reported apart; on a good photograph it is several sigma and would reject the paper's model on
every clean recording. The judgement therefore rests on the model *with* what the file's ``[physics]`` adds to it, and
the model as printed is judged beside it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchsim import rays, vector
from benchsim.bench.curve import Curve, signed_distance
from benchsim.bench.model import Exposure, Physics, Recording, Screen
from benchsim.bench.place import Placement, SettingErrors, place
from benchsim.bench.settings import prior_sigma, uncertainty_of
from benchsim.instruments.bench.explain import Binned, Explained, bin_trace, explain

Array = NDArray[np.float64]

MIN_BINS = 8
"""Fewer bins than setting errors (7) test nothing; below this the answer is "cannot tell"."""

LEVEL = 0.01
"""Probability with which a model that is right is said to disagree."""


@dataclass(frozen=True)
class ExposureValidation:
    """One exposure against the vector model, and against the ray model with the file's ``[physics]``.

    Attributes
    ----------
    name : str
        The exposure's image.
    vector, bench : Explained
        Against the vector model of the same r as printed, and with what the file's ``[physics]`` adds to it (``rays``).
    binned : Binned
    mm_per_mrad : (n,) array
        How far a lean of the mirror's normal toward its axis by 1 mrad moves the trace across itself, at every point.
    polygon_mm : float
        rms distance of a turning polygon's central ray from the cylinder of the same r, at the trace's points.
    radius_mm : float
        rms distance that neglecting r makes when normal and axis are kept.
    radius_own_aim_mm : float
        The same when each model is aimed by Eq. (17) at its own r.
    agrees : bool or None
        Whether the vector model, with what ``[physics]`` adds to it, agrees within noise and setting uncertainties at
        the 1 % level; None: cannot tell.
    stated : Curve
        The vector model at the stated setting.
    """

    name: str
    vector: Explained
    bench: Explained
    binned: Binned
    mm_per_mrad: Array
    polygon_mm: float
    radius_mm: float
    radius_own_aim_mm: float
    agrees: bool | None
    stated: Curve

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``validation.json``."""
        before, after = _sides(self.bench, self.mm_per_mrad)
        alone_before, alone_after = _sides(self.vector, self.mm_per_mrad)
        return {
            "exposure": self.name,
            "before": before,
            "after": after,
            "polygon_mm": self.polygon_mm,
            "radius_mm": self.radius_mm,
            "radius_own_aim_mm": self.radius_own_aim_mm,
            "agrees": self.agrees,
            "converged": self.bench.converged,
            "bin_sigma_um": float(1e3 * np.sqrt(np.median(np.diag(self.binned.covariance)))),
            "pulls": self.bench.pulls,
            "vector_alone": {
                "before": alone_before,
                "after": alone_after,
                "agrees": _agrees(self.vector),
                "converged": self.vector.converged,
            },
        }


def _sides(e: Explained, mm_per_mrad: Array) -> tuple[dict[str, Any], dict[str, Any]]:
    def side(distance: Array, chi2: float, p: float) -> dict[str, Any]:
        return {
            "rms_mm": _rms(distance),
            "rms_mrad": _rms(distance / mm_per_mrad),
            "chi2": chi2,
            "dof": e.dof,
            "p_value": p,
        }

    return side(e.before, e.chi2_before, e.p_before), side(e.after, e.chi2_after, e.p_after)


def _rms(x: Array) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


def normal_sensitivity(placement: Placement, radius: float, points: Array, curve: Curve) -> Array:
    """Shift of the trace across itself per lean of the mirror's normal toward its axis, at points [mm/rad].

    The lean is the one error of the normal that a trace can show everywhere: a turn about the axis runs along it.
    """
    assert curve.phase is not None
    step = 1e-5
    surface, normals = vector.positions(vector.bench_cylinder(placement, radius), curve.phase)
    shifted = []
    for sign in (1.0, -1.0):
        leaned = normals + sign * step * placement.axis
        leaned /= np.linalg.norm(leaned, axis=-1, keepdims=True)
        travel = vector.reflect(placement.laser_direction, leaned)
        shifted.append(vector.project(surface, travel, placement.screen_rotation, placement.screen_origin)[0])
    across = (signed_distance(curve, shifted[0])[0] - signed_distance(curve, shifted[1])[0]) / (2 * step)
    s = signed_distance(curve, points)[1]
    return np.interp(s, curve.arc_length(), np.abs(across))


def validate_trace(
    recording: Recording,
    exposure: Exposure,
    *,
    reseated: bool,
    points: Array,
    s: Array,
    covariance: Array,
    measured: Callable[[Array], Array] | None = None,
    blur: float = 0.0,
) -> ExposureValidation:
    """Compare one trace with the vector model and with the ray model.

    Parameters
    ----------
    recording : Recording
    exposure : Exposure
    reseated : bool
        Whether the screen was moved before this exposure, so that its seat carries errors.
    points : (n, 2) array
        The trace on the board [mm].
    s : (n,) array
        Arc length [mm].
    covariance : (n, n) array
        Of the points' shifts across the curve, camera pose and correlated noise included [mm²].
    measured : callable, optional
        Coordinates in which light at true places of the board, (k, 2) mm, is measured, where the file's effects lie
        between board and pixel (`board_coordinates.measured`); default the true places. The vector model as printed
        knows none.
    blur : float
        rms of the camera's across the trace [mm].

    Returns
    -------
    ExposureValidation

    Raises
    ------
    BenchsimError
        If the model's trace misses the board at the stated setting.
    """
    mirror = recording.mirror
    wide = _widened(recording)

    def paper(errors: SettingErrors) -> Curve:
        return vector.trace(mirror, exposure, placement=place(mirror, exposure, errors), screen=wide, count=201)

    def bench(errors: SettingErrors) -> Curve:
        curve = rays.predict(recording, exposure, errors, samples=64, blur=blur).at_centre()
        return curve if measured is None else replace(curve, points=measured(curve.points))

    binned = bin_trace(s, covariance)
    prior = prior_sigma(uncertainty_of(recording), reseated=reseated)
    against_paper = explain(points, binned, paper, prior)
    against_bench = explain(points, binned, bench, prior)
    stated = paper(SettingErrors())
    at = place(mirror, exposure)

    def apart(other: Curve, base: Curve) -> float:
        feet = signed_distance(base, points)[0]
        return _rms(signed_distance(other, points)[0] - feet)

    single_ray = Physics(facets=recording.mirror.shape == "polygon", beam=False, diffraction=False)
    polygon = rays.trace_curve(recording.laser, mirror, single_ray, wide, at, samples=96)
    return ExposureValidation(
        name=exposure.name,
        vector=against_paper,
        bench=against_bench,
        binned=binned,
        mm_per_mrad=1e-3 * normal_sensitivity(at, mirror.radius, points, stated),
        polygon_mm=apart(polygon, stated),
        radius_mm=apart(vector.trace(mirror, exposure, radius=0.0, placement=at, screen=wide), stated),
        radius_own_aim_mm=apart(vector.trace(mirror, exposure, radius=0.0, screen=wide), stated),
        agrees=_agrees(against_bench),
        stated=stated,
    )


def _widened(recording: Recording) -> Screen:
    """The board with a margin, so that models that are off by millimetres still cover the measured trace."""
    y, z = recording.screen.size
    return replace(recording.screen, size=(1.1 * y, 1.1 * z))


def _agrees(e: Explained) -> bool | None:
    if e.dof < MIN_BINS or not e.converged:
        return None
    return e.p_after >= LEVEL
