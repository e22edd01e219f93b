"""The phases at which light falls on the board: of one bench, or of several that differ in numbers alone.

Of several the axes are (bench, phase), of one (phase,).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.errors import BenchsimError
from benchsim.rays import plane
from benchsim.rays import screen as board_plane
from benchsim.rays.bench import Bench
from benchsim.rays.laser import dot
from benchsim.rays.sweep import Light, axis_ray

Array = NDArray[np.float64]

SEARCH = (501, 4001)
"""Phases of the half turn at which the board is looked for: the finer only where the coarser finds nothing."""

DENSE = 160
"""Phases between the edges by which points are spaced evenly."""


def check(bench: Bench) -> None:
    """Raise BenchsimError if the laser stands below the horizon or behind the mirror."""
    d = bench.placement.laser_direction
    if d[2] > 0:
        raise BenchsimError("the laser is below the horizon; give an elevation above 0")
    if d @ bench.placement.normal >= 0:
        raise BenchsimError("the laser stands behind the mirror; mend the laser's angles or the mirror's position")


def stands(bench: Bench) -> bool:
    """Whether the laser stands above the horizon and before the mirror."""
    try:
        check(bench)
    except BenchsimError:
        return False
    return True


def sample_phases(bench: Bench, samples: int) -> Array:
    """Phases at which the laser's axis ray travels evenly over the board, (samples,) [rad], growing.

    Raises
    ------
    BenchsimError
        If the ray misses the mirror at all phases, or never meets the board.
    """
    for count in SEARCH:
        grid = np.linspace(-np.pi / 2, np.pi / 2, count)
        beyond, board = _beyond(bench, grid)
        if np.any(beyond <= 0):
            break
    else:
        if not np.isfinite(beyond).any():
            raise BenchsimError(
                "the mirror misses the beam or sends none of it toward the board; "
                "mend the mirror's position or the laser's angles"
            )
        nearest = board[np.argmin(beyond)]
        raise BenchsimError(
            f"the trace passes beside the board (nearest point y = {nearest[0]:.0f}, z = {nearest[1]:.0f} mm); "
            "mend the mirror's position, the laser's angles or the screen's size"
        )
    dense = np.linspace(*_span(bench, grid, beyond), DENSE)
    return _even(dense, *_way(bench, dense), samples)


def many_phases(bench: Bench, members: Sequence[Bench], samples: int) -> Array:
    """`sample_phases` of several benches at once, (bench, samples); NaN for those whose light misses the board.

    ``bench`` is the stack of the members (`batch.stacked`).
    """
    grid = np.linspace(-np.pi / 2, np.pi / 2, SEARCH[0])
    each = np.broadcast_to(grid, (len(members), len(grid)))
    # The closed form takes one row of phases for all benches.
    beyond = np.broadcast_to(_beyond(bench, each if bench.frame is None else grid[None])[0], each.shape)
    out = np.full((len(members), samples), np.nan)
    spans = np.zeros((len(members), 2))
    for i, member in enumerate(members):
        if beyond[i].min() <= 0:
            spans[i] = _span(member, grid, beyond[i])
            continue
        # Nothing where one looks first: rare enough to be looked for alone.
        try:
            out[i] = sample_phases(member, samples)
        except BenchsimError:
            pass
    dense = np.linspace(spans[:, 0], spans[:, 1], DENSE, axis=1)
    s, off = _way(bench, dense)
    for i in np.flatnonzero(np.isnan(out[:, 0]) & (spans[:, 0] < spans[:, 1])).tolist():
        out[i] = _even(dense[i], s[i], off[i], samples)
    return out


def axis_light(bench: Bench, phase: Array) -> Light:
    """`sweep.axis_ray` at phases (n,) or (bench, n), with axes (..., n, 1, 1) as of profiles' nodes."""
    return axis_ray(bench, phase[..., None, None])


def axis_points(bench: Bench, phase: Array) -> Array:
    """Where the axis ray meets the board, (..., n, 2) [mm]."""
    if bench.frame is not None and bench.facets:
        return _closed(bench, bench.frame, phase)[0]
    return axis_light(bench, phase).board[..., 0, 0, :]


def _closed(bench: Bench, frame: plane.Frame, phase: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Where the axis ray meets the board, and whether it does, from the closed form."""
    at = phase[..., None, None]
    board, lit = plane.axis_hits(frame, at, bench.parts.polygon.lean(bench.facet, at))
    return board[..., 0, 0, :], lit[..., 0, 0]


def _span(bench: Bench, grid: Array, beyond: Array) -> tuple[float, float]:
    """First and last phase of the branch nearest to phase 0, about at the board's edges or just beyond them."""
    on = np.flatnonzero(beyond <= 0)
    first, last = int(on[0]), int(on[-1])
    if last - first >= len(on):
        runs = np.split(on, np.flatnonzero(np.diff(on) > 1) + 1)
        run = min(runs, key=lambda r: np.min(np.abs(grid[r])))
        first, last = int(run[0]), int(run[-1])
    before, after = max(first - 1, 0), min(last + 1, len(grid) - 1)
    if np.isfinite(beyond[before]) and np.isfinite(beyond[after]):
        return float(grid[before]), float(grid[after])
    return _edges(bench, grid, first, last)


def _way(bench: Bench, dense: Array) -> tuple[Array, Array]:
    """Way of the axis ray over the board since the first of growing phases [mm], and how far it is off the board."""
    board = axis_points(bench, dense)
    steps = np.diff(board, axis=-2)
    s = np.zeros(board.shape[:-1])
    np.cumsum(np.hypot(steps[..., 0], steps[..., 1]), axis=-1, out=s[..., 1:])
    return s, board_plane.margin(bench.screen.size, board)


def _even(dense: Array, s: Array, off: Array, samples: int) -> Array:
    """Phases of points evenly along the way between the edges."""
    # Where it crosses the edge, by a straight line between two of the points: to some 1e-3 mm.
    on = np.flatnonzero(off <= 0)
    i, j = (int(on[0]), int(on[-1])) if len(on) else (0, len(dense) - 1)
    start = s[i] if i == 0 else s[i] + (s[i - 1] - s[i]) * off[i] / (off[i] - off[i - 1])
    end = s[j] if j == len(dense) - 1 else s[j] + (s[j + 1] - s[j]) * off[j] / (off[j] - off[j + 1])
    return np.interp(np.linspace(start, end, samples), s, dense)


def _beyond(bench: Bench, phase: Array) -> tuple[Array, Array]:
    """How far beyond the board's edge the axis ray lands [mm], infinite where it does not, and where."""
    if bench.frame is not None and bench.facets:
        board, on = _closed(bench, bench.frame, phase)
        return np.where(on, board_plane.margin(bench.screen.size, board), np.inf), board
    p = bench.placement
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        light = axis_light(bench, phase)
        lit = light.reaches(p)
        if bench.facets and not bench.physics.beam:
            rest = light.x - p.centre
            off = dot(rest, rest) - dot(rest, p.axis) ** 2 - bench.radius**2
            lit &= np.sqrt(np.maximum(off, 0.0)) <= bench.mirror.facet_width / 2
        beyond = np.where(lit, board_plane.margin(bench.screen.size, light.board), np.inf)
    return beyond[..., 0, 0], light.board[..., 0, 0, :]


def _edges(bench: Bench, grid: Array, first: int, last: int) -> tuple[float, float]:
    """Phases at which the axis ray comes onto the board and leaves it, to 1e-3 of the grid's step, from inside."""
    inside, ways = (first, last), (-1, 1)
    out = [float(grid[i]) for i in inside]
    beside = [
        float(grid[i + w]) if 0 <= i + w < len(grid) else float(grid[i]) for i, w in zip(inside, ways, strict=True)
    ]
    for _ in range(2):
        part = np.linspace(out, beside, 33)
        off = _beyond(bench, part.ravel())[0].reshape(part.shape) > 0
        for side in (0, 1):
            k = int(np.argmax(off[:, side])) if off[:, side].any() else len(part)
            out[side] = float(part[max(k - 1, 0), side])
            beside[side] = float(part[min(k, len(part) - 1), side])
    return out[0], out[1]
