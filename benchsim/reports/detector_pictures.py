"""Pictures of what arrays of detectors see: the plan of a field with its arrays, hours, and a correction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from benchsim.plant.model import Receiver
from benchsim.plant.station import Station

Array = NDArray[np.float64]

BLUE, RED, GREY = "#1f78b4", "#d7301f", "#5f6368"


def plan(
    position: Array,
    share: Array,
    station: Station,
    receiver: Receiver,
    times: Sequence[datetime],
    hourly: Array,
    distance: Array,
    sigma: Array,
    zone: str,
    limit: float,
) -> Figure:
    """Plan of a field by how often each heliostat is seen, the arrays beside the receiver, hours, sigma by distance.

    Parameters
    ----------
    position : (n, 3)
        [mm]
    share : (n,)
        Of the times at which it is seen.
    station, receiver
    times : sequence of datetime
    hourly : (T,)
        Share of the field that is seen.
    distance : (k,)
        Of the heliostats that may be seen [mm].
    sigma : (T, k, 2)
        [rad]; nan where not seen.
    zone : str
    limit : float
        Sigma of either angle up to which a heliostat counts as seen [mrad].
    """
    figure = Figure(figsize=(12.6, 9.6), layout="constrained")
    (field, front), (hours, errors) = figure.subplots(2, 2, gridspec_kw={"height_ratios": [1.5, 1]})
    size = float(np.clip(4000 / len(position), 2, 60))
    shown = field.scatter(
        position[:, 0] / 1e3,
        position[:, 1] / 1e3,
        c=100 * share,
        s=size,
        cmap="viridis",
        vmin=0,
        vmax=100,
        rasterized=True,
    )
    figure.colorbar(shown, ax=field, label=f"of the times, both angles known to {limit:g} mrad (%)")
    centre = np.array(receiver.centre) / 1e3
    field.plot(*centre[:2], "k^", markersize=7)
    looks = station.frame[0][:2]
    reach = 0.12 * float(np.ptp(position[:, :2], axis=0).max()) / 1e3
    field.annotate(
        "", centre[:2] + reach * looks, centre[:2], arrowprops={"arrowstyle": "->", "color": RED, "linewidth": 1.4}
    )
    field.set_aspect("equal", adjustable="datalim")
    field.set(xlabel="east (m)", ylabel="north (m)")
    field.set_title("Heliostats, and where the arrays look", fontsize=10, loc="left")
    _front(front, station, receiver)
    days = list(dict.fromkeys(f"{t:%Y-%m-%d}" for t in times))
    for k, day in enumerate(days):
        on = [i for i, t in enumerate(times) if f"{t:%Y-%m-%d}" == day]
        at = [times[i].hour + times[i].minute / 60 for i in on]
        hours.plot(at, 100 * hourly[on], "o-", markersize=3.5, color=f"C{k}", label=day)
    hours.set(xlabel=f"hour ({zone})", ylabel="of the field seen (%)", ylim=(-3, 103))
    hours.legend(frameon=False, fontsize=9)
    there = np.isfinite(sigma).any(axis=(0, 2))
    for k, (name, colour) in enumerate((("elevation", RED), ("azimuth", BLUE))):
        low, middle, high = (np.nanpercentile(1e3 * sigma[:, there, k], q, axis=0) for q in (0, 50, 100))
        x = distance[there] / 1e3
        errors.vlines(x, low, high, color=colour, linewidth=0.6, alpha=0.4)
        errors.plot(x, middle, ".", markersize=4, color=colour, label=name)
    errors.axhline(limit, color="#e6a100", linewidth=1.2)
    errors.set(xlabel="distance from the receiver (m)", ylabel="1 σ by one record (mrad)", yscale="log")
    errors.set_title("Median and range over the times at which it is seen", fontsize=10, loc="left")
    errors.legend(frameon=False, fontsize=9)
    for axes in (field, front, hours, errors):
        axes.spines[["top", "right"]].set_visible(False)
    return figure


def _front(axes: Any, station: Station, receiver: Receiver) -> None:
    """Receiver and arrays as who stands in the field sees them: left is left."""
    w, h = receiver.width / 1e3, receiver.height / 1e3
    axes.add_patch(Rectangle((-w / 2, -h / 2), w, h, facecolor="#fdf3d0", edgecolor="#e6a100"))
    axes.text(0, 0, receiver.name, ha="center", va="center", fontsize=8, color=GREY)
    for k, a in enumerate(station.arrays):
        along = a.along / 1e3
        off = np.full_like(along, a.offset / 1e3)
        x, z = (off, along) if a.upright else (along, off)
        axes.plot(x, z, "|" if not a.upright else "_", color=(RED, BLUE, GREY)[k % 3], markersize=5)
        axes.plot([], [], "s", color=(RED, BLUE, GREY)[k % 3], markersize=5, label=f"{a.name}: {a.count} detectors")
    axes.set_aspect("equal", adjustable="datalim")
    axes.invert_xaxis()
    axes.set(xlabel="to the left of the receiver's centre (m)", ylabel="up from it (m)")
    axes.set_title("The arrays, seen from the field", fontsize=10, loc="left")
    axes.legend(frameon=False, fontsize=8, loc="lower right")


def loop(before: Array, after: Array, outcomes: Sequence[str], limit: float) -> Figure:
    """Misalignments (k, 2) before and after a correction [rad], by what the arrays said; a line at a limit [mrad]."""
    figure = Figure(figsize=(10.4, 4.6), layout="constrained")
    figure.suptitle("True misalignments, before and after one correction", fontsize=11, x=0.01, ha="left")
    kinds = list(dict.fromkeys(outcomes))
    floor = 1e-5
    for axes, c, name in zip(figure.subplots(1, 2, sharey=True), range(2), ("elevation", "azimuth"), strict=True):
        for k, kind in enumerate(kinds):
            on = [i for i, o in enumerate(outcomes) if o == kind]
            x, y = (np.maximum(1e3 * np.abs(v[on, c]), 1e3 * floor * 1e-2) for v in (before, after))
            axes.loglog(x, y, "o", markersize=4, alpha=0.7, color=f"C{k}", label=f"{kind} ({len(on)})")
        ends = np.array(axes.get_xlim())
        axes.plot(ends, ends, color=GREY, linewidth=0.8, linestyle=(0, (4, 2)), label="not corrected")
        axes.axhline(limit, color="#e6a100", linewidth=1.2)
        axes.set(xlabel=f"{name}, before (mrad)")
        axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8)
    figure.axes[0].set_ylabel("after (mrad)")
    return figure


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
