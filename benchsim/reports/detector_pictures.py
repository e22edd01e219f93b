"""Pictures of what arrays of detectors see: a field and its arrays, hours, sigma by distance, and a correction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from benchsim.plant.model import Receiver
from benchsim.plant.station import Station
from benchsim.reports.quantities import counted

Array = NDArray[np.float64]

BLUE, RED, GREY, LINE = "#1f78b4", "#d7301f", "#5f6368", "#e6a100"

MARKS = {"elevation": "o", "azimuth": "^"}


def plan(position: Array, share: Array, station: Station, receiver: Receiver, detectors: Array, limit: float) -> Figure:
    """Plan of a field by how often each heliostat is seen, with the arrays as they hang there and where they look.

    Parameters
    ----------
    position : (n, 3)
        [mm]
    share : (n,)
        Of the times at which it is seen.
    station, receiver
    detectors : (m, 3)
        Their places, as `position` [mm].
    limit : float
        Sigma of either angle up to which a heliostat counts as seen [mrad].
    """
    figure, axes = _one((7.2, 6.0), "east (m)", "north (m)")
    east, north = position[:, 0] / 1e3, position[:, 1] / 1e3
    size = float(np.clip(4000 / len(position), 2, 60))
    shown = axes.scatter(east, north, c=100 * share, s=size, cmap="viridis", vmin=0, vmax=100, rasterized=True)
    figure.colorbar(shown, ax=axes, label=f"of the times, both angles known to {limit:g} mrad (%)")
    x, y = (c / 1e3 for c in receiver.centre[:2])
    axes.plot(*detectors[:, :2].T / 1e3, ".", color=BLUE, markersize=2)
    axes.plot(x, y, "k^", markersize=6)
    # As long as is seen, of a single heliostat too.
    reach = 0.12 * max(float(np.ptp(np.append(v, c))) for v, c in ((east, x), (north, y)))
    end = (x + reach * station.frame[0][0], y + reach * station.frame[0][1])
    axes.annotate("", end, (x, y), arrowprops={"arrowstyle": "->", "color": RED, "linewidth": 1.4})
    axes.set_aspect("equal", adjustable="datalim")
    return figure


def arrays(station: Station, receiver: Receiver) -> Figure:
    """Receiver and arrays as who stands in the field sees them: left is left."""
    figure, axes = _one((7.2, 6.0), "to the left of the receiver's centre (m)", "up from it (m)")
    w, h = receiver.width / 1e3, receiver.height / 1e3
    axes.add_patch(Rectangle((-w / 2, -h / 2), w, h, facecolor="#fdf3d0", edgecolor=LINE))
    for k, a in enumerate(station.arrays):
        along = a.along / 1e3
        off = np.full_like(along, a.offset / 1e3)
        x, z = (off, along) if a.upright else (along, off)
        colour = (RED, BLUE, GREY)[k % 3]
        axes.plot(x, z, "|" if not a.upright else "_", color=colour, markersize=5)
        axes.plot([], [], "s", color=colour, markersize=5, label=f"{a.name}: {counted(a.count, 'detector')}")
    axes.plot([], [], "s", color="#fdf3d0", markeredgecolor=LINE, label=receiver.name)
    axes.set_aspect("equal", adjustable="datalim")
    axes.invert_xaxis()
    axes.legend(frameon=False, fontsize=9, loc="lower right")
    return figure


def hours(times: Sequence[datetime], hourly: Array, zone: str) -> Figure:
    """Shares (T,) of the field that are seen, by the hour, a line for each day."""
    figure, axes = _one((7.2, 4.4), f"hour ({zone})", "of the field seen (%)")
    for k, day in enumerate(dict.fromkeys(f"{t:%Y-%m-%d}" for t in times)):
        on = [i for i, t in enumerate(times) if f"{t:%Y-%m-%d}" == day]
        at = [times[i].hour + times[i].minute / 60 for i in on]
        axes.plot(at, 100 * hourly[on], "o-", markersize=3.5, color=f"C{k}", label=day)
    axes.set_ylim(-3, 103)
    axes.legend(frameon=False, fontsize=9)
    return figure


def sigmas(distance: Array, sigma: Array, limit: float) -> Figure:
    """Median and range of sigma over the times, by distance.

    Parameters
    ----------
    distance : (k,)
        From the receiver [mm].
    sigma : (T, k, 2)
        [rad]; nan where not seen.
    limit : float
        As of `plan`.
    """
    figure, axes = _one((7.2, 4.4), "distance from the receiver (m)", "1 σ by one record (mrad)")
    there = np.isfinite(sigma).any(axis=(0, 2))
    x = distance[there] / 1e3
    for k, (name, colour) in enumerate((("elevation", RED), ("azimuth", BLUE))):
        low, middle, high = (np.nanpercentile(1e3 * sigma[:, there, k], q, axis=0) for q in (0, 50, 100))
        axes.vlines(x, low, high, color=colour, linewidth=0.6, alpha=0.4)
        axes.plot(x, middle, ".", markersize=4, color=colour, label=name)
    axes.axhline(limit, color=LINE, linewidth=1.2, label="limit of what counts as seen")
    middle, half = (x.max() + x.min()) / 2, max(0.55 * np.ptp(x), 1.0)
    axes.set(yscale="log", xlim=(middle - half, middle + half))
    axes.legend(frameon=False, fontsize=9)
    return figure


def loop(before: Array, after: Array, outcomes: Sequence[str], limit: float) -> Figure:
    """Misalignments (k, 2) before and after a correction [rad], by what the arrays said; a line at a limit [mrad]."""
    figure, axes = _one((7.2, 5.4), "true misalignment before (mrad)", "after one correction (mrad)")
    x, y = (np.maximum(1e3 * np.abs(v), 1e-7) for v in (before, after))
    for k, kind in enumerate(dict.fromkeys(outcomes)):
        on = [i for i, o in enumerate(outcomes) if o == kind]
        for c, mark in enumerate(MARKS.values()):
            label = f"{kind} ({len(on)})" if c == 0 else None
            axes.loglog(x[on, c], y[on, c], mark, markersize=4, alpha=0.7, color=f"C{k}", label=label)
    for name, mark in MARKS.items():
        axes.plot([], [], mark, markersize=4, color=GREY, label=name)
    ends = np.array(axes.get_xlim())
    axes.plot(ends, ends, color=GREY, linewidth=0.8, linestyle=(0, (4, 2)), label="not corrected")
    axes.axhline(limit, color=LINE, linewidth=1.2, label=f"{limit:g} mrad")
    axes.legend(frameon=False, fontsize=9)
    return figure


def _one(size: tuple[float, float], x: str, y: str) -> tuple[Figure, Axes]:
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    axes.set(xlabel=x, ylabel=y)
    return figure, axes


def misalignments(place: Mapping[str, Array], rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Plan of a field: the larger of both angles that were measured of each heliostat."""
    figure = Figure(figsize=(7.4, 6.0), layout="constrained")
    axes = figure.add_subplot()
    at = np.array([place[r["id"]][:2] for r in rows]) / 1e3
    size = np.array([max((abs(r[f"{k}_mrad"] or 0.0) for k in ("elevation", "azimuth")), default=0.0) for r in rows])
    known = np.array([r["elevation_mrad"] is not None or r["azimuth_mrad"] is not None for r in rows])
    dot = float(np.clip(4000 / len(rows), 4, 60))
    if known.any():
        shown = axes.scatter(at[known, 0], at[known, 1], c=size[known], s=dot, cmap="magma_r", vmin=0, rasterized=True)
        figure.colorbar(shown, ax=axes, label="larger misalignment of both (mrad)")
    if not known.all():
        axes.plot(at[~known, 0], at[~known, 1], "x", color=GREY, markersize=5, label="nothing known")
        axes.legend(frameon=False, fontsize=9)
    axes.plot(0, 0, "k^", markersize=6)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="east (m)", ylabel="north (m)")
    return figure
