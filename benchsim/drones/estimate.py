"""From glints to a heliostat's orientation and its uncertainty, as HelioPoint does it.

Every glint gives a measured normal, by the law of reflection at its place in the field; the reference surface and the
tracking angles give the expected one. Their mean difference turns the tracking angles, until they stand still; then
outliers go, and it is done a last time.

The estimator sees glints in the concentrator's frame, where the drone says it is, and the plant's own numbers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from benchsim.bench.errors import BenchsimError
from benchsim.drones.flight import Sightings
from benchsim.drones.glints import bisector
from benchsim.drones.heliostat import Mount, SurfaceMap, axes, mapped_slopes, mean_normal, normals

Array = NDArray[np.float64]

OUTLIERS = 0.1
"""Largest share of a heliostat's glints that is tested for being outliers."""

ALPHA = 0.05
"""Of the outlier test and, as a threshold on p, of the Shapiro–Wilk test: the paper's."""

STILL = 1e-9
"""Mean difference at which the tracking angles stand still [rad]."""

_MOST_STEPS = 50

FEWEST = 8
"""Glints under which nothing is said."""


@dataclass(frozen=True)
class Pointing:
    """A heliostat's orientation.

    Attributes
    ----------
    mount : Mount
        The plant's mount with the tracking angles that were found.
    axis : (3,) ndarray
        Optical axis in the field frame: the mean of all normals of the reference surface.
    differences : (n, 2) ndarray
        Of measured from expected normals at the end, about the concentrator's x and y [rad].
    kept : (n,) ndarray of bool
        False: an outlier.
    steps : (steps, 2) ndarray
        Mean difference before each turn of the tracking angles [rad]; the last is what was left.
    second : int
        Index into ``steps`` of the first after outliers had gone.
    sigma_ad : (2,) ndarray
        Standard deviation of the differences kept [rad].
    sigma_mean : (2,) ndarray
        σ_ad/√n, the paper's [rad].
    sigma_mean_frames : (2,) ndarray
        The same with the glints of one frame taken for one draw, as they share its camera position and, close together,
        the mirror's slope [rad]. No part of the paper's budget.
    p_normal : (2,) ndarray
        Shapiro–Wilk: below 0.05 the differences are not normal, and the paper holds σ_mean for an order of magnitude.
    """

    mount: Mount
    axis: Array
    differences: Array
    kept: NDArray[np.bool_]
    steps: Array
    second: int
    sigma_ad: Array
    sigma_mean: Array
    sigma_mean_frames: Array
    p_normal: Array


def differences(sightings: Sightings, cameras: Array, lamps: Array, mount: Mount, expected: Array) -> Array:
    """(n, 2) angles from expected to measured normals about the concentrator's x and y [rad] (Eqs (1), (2)).

    Parameters
    ----------
    sightings : Sightings
    cameras, lamps : (frames, 3) array
        As the drone says [mm].
    mount : Mount
        Expected orientation and the plant's kinematics.
    expected : (n, 3) array
        Normals of the reference surface at the glints, in the concentrator's frame.
    """
    turned, origin = axes(mount)
    # The mirror's sag, below 10 mm, moves a glint along its own normal and turns nothing: 1e-8 rad.
    places = origin + sightings.points @ turned[:, :2].T
    measured = bisector(places, cameras[sightings.frame], lamps[sightings.frame]) @ turned
    return np.stack([_about_x(measured) - _about_x(expected), _about_y(measured) - _about_y(expected)], axis=1)


def _about_x(n: Array) -> Array:
    return np.arctan2(-n[:, 1], n[:, 2])


def _about_y(n: Array) -> Array:
    return np.arctan2(n[:, 0], n[:, 2])


def turned(mount: Mount, about: ArrayLike) -> Mount:
    """The mount with tracking angles that turn it by small angles about the concentrator's x and y [rad]."""
    x, y = np.asarray(about, float)
    return replace(mount, azimuth=mount.azimuth - y / math.cos(mount.elevation), elevation=mount.elevation - x)


def outliers(values: ArrayLike, most: int, alpha: float = ALPHA) -> NDArray[np.bool_]:
    """The generalised extreme Studentized deviate test (Rosner 1983, Technometrics 25, 165).

    Parameters
    ----------
    values : (n,) array
        Normal but for outliers; n ≥ 25 for the level to hold (Rosner), n ≥ 15 for it to be near.
    most : int
        Outliers that there may be.
    alpha : float
        Chance that any is found where there is none.

    Returns
    -------
    (n,) ndarray of bool
        True for outliers: all those removed up to the last deviate that exceeds its critical value.
    """
    x = np.asarray(values, float)
    n = len(x)
    left = np.ones(n, bool)
    gone: list[int] = []
    count = 0
    for i in range(1, min(most, n - 3) + 1):
        away = np.where(left, np.abs(x - x[left].mean()), -1.0)
        worst = int(away.argmax())
        spread = x[left].std(ddof=1)
        t = stats.t.ppf(1 - alpha / (2 * (n - i + 1)), n - i - 1)
        limit = t * (n - i) / math.sqrt((n - i - 1 + t * t) * (n - i + 1))
        gone.append(worst)
        left[worst] = False
        if away[worst] > limit * spread:
            count = i
    out = np.zeros(n, bool)
    out[gone[:count]] = True
    return out


def estimate(
    sightings: Sightings,
    cameras: Array,
    lamps: Array,
    mount: Mount,
    reference: SurfaceMap,
    most_outliers: float = OUTLIERS,
) -> Pointing:
    """Tracking angles and optical axis of one heliostat.

    Parameters
    ----------
    sightings : Sightings
    cameras, lamps : (frames, 3) array
        As the drone says [mm].
    mount : Mount
        The plant's position, kinematics and best guess of the tracking angles.
    reference : SurfaceMap
        Surface by design, or measured.
    most_outliers : float
        Largest share that is tested for being outliers, about either axis.

    Returns
    -------
    Pointing

    Raises
    ------
    BenchsimError
        If there are too few glints, or the angles do not come to rest.

    Notes
    -----
    σ_mean takes the glints for independent, and the mirror for a sample of many. It says too little where one frame
    shows several glints (``sigma_mean_frames`` mends that), and too much where slope errors reach further than the
    pattern's pitch: then the mean over the glints is nearly that over the mirror. `analysis/drone.py` measures both.
    """
    n = len(sightings.frame)
    if n < FEWEST:
        raise BenchsimError(f"the heliostat shows {n} glints, fewer than {FEWEST}: fly a wider or a finer pattern")
    expected = normals(mapped_slopes(reference, sightings.points)[1])
    kept = np.ones(n, bool)
    steps: list[Array] = []
    mount, d = _rest(sightings, cameras, lamps, mount, expected, kept, steps)
    second = len(steps)
    most = int(most_outliers * n)
    kept = ~(outliers(d[:, 0], most) | outliers(d[:, 1], most))
    mount, d = _rest(sightings, cameras, lamps, mount, expected, kept, steps)
    sigma = d[kept].std(axis=0, ddof=1)
    frames, which = np.unique(sightings.frame[kept], return_inverse=True)
    if len(frames) < 2:
        raise BenchsimError("all glints of the heliostat are in one frame: fly a pattern over it")
    sums = np.stack([np.bincount(which, d[kept, i]) for i in range(2)])
    by_frame = np.sqrt((sums**2).sum(axis=1) * len(frames) / (len(frames) - 1)) / kept.sum()
    p = np.array([stats.shapiro(d[kept, i]).pvalue for i in range(2)])
    axis = axes(mount)[0] @ mean_normal(reference)
    return Pointing(mount, axis, d, kept, np.array(steps), second, sigma, sigma / math.sqrt(kept.sum()), by_frame, p)


def _rest(
    sightings: Sightings,
    cameras: Array,
    lamps: Array,
    mount: Mount,
    expected: Array,
    kept: NDArray[np.bool_],
    steps: list[Array],
) -> tuple[Mount, Array]:
    """The mount at rest and its differences; the mean before each turn goes into ``steps``."""
    for _ in range(_MOST_STEPS):
        d = differences(sightings, cameras, lamps, mount, expected)
        mean = d[kept].mean(axis=0)
        steps.append(mean)
        if np.abs(mean).max() < STILL:
            return mount, d
        mount = turned(mount, mean)
    raise BenchsimError(
        f"the tracking angles have not come to rest in {_MOST_STEPS} steps ({1e3 * np.abs(mean).max():.2g} mrad left): "
        "check the heliostat's position and the drone's"
    )


def sigma_sys(distance: float, sizes: Sequence[float]) -> float:
    """Σ σ_sys,i² with σ_sys,i = σ_x,i/d, its root [rad]: sizes are 1 sigma per component of what shifts [mm]."""
    return math.hypot(*sizes) / distance


def axis_error(pointing: Pointing, mount: Mount, axis: Array) -> Array:
    """(2,) what the found axis is off from the true ``axis``, about x and y of the true ``mount`` [rad]."""
    off = axes(mount)[0].T @ (pointing.axis - axis)
    return np.array([-off[1], off[0]])
