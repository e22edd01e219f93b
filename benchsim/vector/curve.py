"""The model's trace on the bench's board."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import bisect

from benchsim.bench.curve import Curve
from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Exposure, Mirror, Screen
from benchsim.bench.place import Placement, place
from benchsim.vector.cylinder import bench_cylinder, positions
from benchsim.vector.reflect import project, reflect

Array = NDArray[np.float64]

_SCAN = 8192
"""Phases of the scan for the stretch on the board: 0.8 mrad apart, 3 mm on a board 2 m away."""


def on_board(placement: Placement, radius: float, phases: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
    """Where the rays of the cylinder meet the plane of the board (Carretero 2019, Eqs (9)–(12)).

    Every P(ε) receives a ray of the laser's direction (a parallel pencil).

    Parameters
    ----------
    placement : Placement
    radius : float
        r [mm].
    phases : (...) array
        ε [rad].

    Returns
    -------
    board_points : (..., 2) ndarray
        y, z on the board [mm].
    real : (...) ndarray of bool
        True where light meets the mirror's front and its reflection arrives on the face of the board.
    """
    points, normals = positions(bench_cylinder(placement, radius), phases)
    directions = reflect(placement.laser_direction, normals)
    board_points, reaches = project(points, directions, placement.screen_rotation, placement.screen_origin)
    face = placement.screen_rotation[:, 0]
    return board_points, reaches & (normals @ placement.laser_direction < 0) & (directions @ face < 0)


def trace(
    mirror: Mirror,
    exposure: Exposure,
    phases: ArrayLike | None = None,
    radius: float | None = None,
    placement: Placement | None = None,
    *,
    count: int = 1001,
    screen: Screen | None = None,
) -> Curve:
    """Trace of the vector model on the board, of real rays only (Carretero 2019, Eqs (9)–(12), (17)).

    A cylinder of radius r that turns about the placement's axis, each P(ε) lit by a ray of the laser's direction.
    Two questions about r, both answered here:

    - ``trace(mirror, exposure, radius=0)`` neglects r from the aim on: mirror and laser are aimed by Eq. (17) with that
      r (at most 0.12/0.09 mm across the curve in Figs 7a/7b, within ±325 mm);
    - ``trace(mirror, exposure, radius=0, placement=place(mirror, exposure))`` keeps n and axis from the true r and
      neglects r only where light is reflected (at most 8.1/7.3 mm; rms 8.0/7.2 mm).

    Parameters
    ----------
    mirror, exposure
        The stated setting. Facets are not modelled: what a polygon adds is left to the ray model.
    phases : (n,) array, optional
        ε [rad]. Points that are not real, or beyond the screen, are left out. Default: ``count`` phases, evenly over
        the longest unbroken stretch on the screen or, without a screen, within the mirror's distance of the board's
        centre.
    radius : float, optional
        r [mm]; default the mirror's own.
    placement : Placement, optional
        Where everything stands, setting errors included; default ``place(mirror, exposure, radius=radius)``.
    count : int
        Points where no phases are given.
    screen : Screen, optional
        Clip to its size.

    Returns
    -------
    Curve
        Points in the order of ε, with ``phase``; no width, no flux.

    Raises
    ------
    BenchsimError
        If no real ray reaches the board, or the radius is negative or not finite.
    """
    r = mirror.radius if radius is None else radius
    if not (np.isfinite(r) and r >= 0):
        raise BenchsimError(f"{exposure.name}: a mirror radius of {r!r} mm is no length; give one that is not negative")
    where = place(mirror, exposure, radius=r) if placement is None else placement

    if screen is not None:
        half = np.asarray(screen.size, float) / 2
    reach = float(np.linalg.norm(where.centre - where.screen_origin))

    def margin(e: ArrayLike) -> Array:
        """Distance inside the window [mm], −inf where there is no real ray."""
        points, real = on_board(where, r, e)
        with np.errstate(invalid="ignore"):
            inside = reach - np.linalg.norm(points, axis=-1) if screen is None else (half - np.abs(points)).min(axis=-1)
        return np.where(real, inside, -np.inf)

    if phases is None:
        chosen = _stretch(margin, lambda e: on_board(where, r, e)[0], count)
    else:
        chosen = np.asarray(phases, float)
        keep = margin(chosen) >= 0 if screen is not None else margin(chosen) > -np.inf
        chosen = chosen[keep]
    if chosen.size == 0:
        what = "the board" if screen is not None else "the board's plane"
        raise BenchsimError(
            f"{exposure.name}: no reflected ray reaches {what}; mend mirror_position_mm or the laser's angles"
        )
    return Curve(on_board(where, r, chosen)[0], phase=chosen)


def _stretch(margin: Callable[[ArrayLike], Array], points: Callable[[ArrayLike], Array], count: int) -> Array:
    """Phases evenly over the longest run with margin ≥ 0; empty if there is none."""
    # the seam at ±π is where n points away from the light for every setting that can be aimed
    scan = np.linspace(-np.pi, np.pi, _SCAN)
    inside = margin(scan) >= 0
    edges = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(int)))
    runs = [(a, b) for a, b in zip(edges[::2], edges[1::2] - 1, strict=True) if a < b]
    if not runs:
        return np.empty(0)
    lengths = [np.linalg.norm(np.diff(points(scan[a : b + 1]), axis=0), axis=-1).sum() for a, b in runs]
    a, b = runs[int(np.argmax(lengths))]

    def sign(e: float) -> float:
        return 1.0 if margin(e) >= 0 else -1.0

    # a run's end is an edge of the window or of what is real, where the margin jumps: bisection takes both
    first = scan[a] if a == 0 else bisect(sign, scan[a - 1], scan[a], xtol=1e-15)
    last = scan[b] if b == len(scan) - 1 else bisect(sign, scan[b], scan[b + 1], xtol=1e-15)
    # inside by more than bisection and rounding leave open: 1e-10 mm on the board
    return np.linspace(first + 1e-13, last - 1e-13, count)
