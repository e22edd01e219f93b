"""Pictures of a drone's flight over a plant: the plan, errors of a virtual flight, and axes that were found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import stats

Array = NDArray[np.float64]

BLUE, RED, GREY = "#1f78b4", "#d7301f", "#5f6368"


def plan(position: Array, cluster: Array, sigma: Array, points: Sequence[Array]) -> Figure:
    """Plan of a field by expected sigma, its clusters with the patterns that are flown for them, and their side view.

    Parameters
    ----------
    position : (n, 3)
        [mm]
    cluster : (n,)
        Numbers from 1.
    sigma : (n,)
        [mrad]
    points : sequence of (frames, 3)
        Of the patterns, east, north, up [mm].
    """
    figure = Figure(figsize=(12.6, 6.2), layout="constrained")
    top, side = figure.subplots(1, 2)
    size = float(np.clip(4000 / len(position), 2, 60))
    for axes, (a, b) in ((top, (0, 1)), (side, (1, 2))):
        for k, p in enumerate(points, 1):
            own = position[cluster == k].mean(axis=0)
            ends = np.stack([own, p.mean(axis=0)]) / 1e3
            axes.plot(ends[:, a], ends[:, b], color=f"C{(k - 1) % 10}", linewidth=0.8, alpha=0.6)
            axes.plot(p[:, a] / 1e3, p[:, b] / 1e3, color=f"C{(k - 1) % 10}", linewidth=0.9)
            if axes is top:
                axes.annotate(str(k), p.mean(axis=0)[:2] / 1e3, fontsize=9, ha="center", va="center")
        shown = axes.scatter(
            position[:, a] / 1e3, position[:, b] / 1e3, c=sigma, s=size, cmap="viridis", rasterized=True
        )
        axes.set_aspect("equal", adjustable="datalim")
        axes.spines[["top", "right"]].set_visible(False)
    top.plot(0, 0, "k^", markersize=6)
    top.set(xlabel="east (m)", ylabel="north (m)")
    top.set_title("Heliostats, and the pattern that each cluster looks at", fontsize=10, loc="left")
    side.set(xlabel="north (m)", ylabel="up (m)")
    side.set_title("The same from the east's side", fontsize=10, loc="left")
    figure.colorbar(shown, ax=side, label="expected σ of the axis (mrad)")
    return figure


def pulls(values: Array) -> Figure:
    """Errors of a virtual flight over their stated sigmas."""
    figure = Figure(figsize=(6.4, 4.4), layout="constrained")
    axes = figure.add_subplot()
    bins = np.linspace(-4, 4, 33)
    axes.hist(np.clip(values, -4, 4), bins.tolist(), color=BLUE, alpha=0.8, label=f"{len(values)} angles")
    x = np.linspace(-4, 4, 200)
    axes.plot(x, len(values) * (bins[1] - bins[0]) * stats.norm.pdf(x), color=GREY, label="as stated")
    axes.set(xlabel="error / stated σ", ylabel="angles")
    axes.legend(frameon=False, fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def axes_found(place: Mapping[str, Array], rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Plan of heliostats: by how much each looks beside where it was told to."""
    figure = Figure(figsize=(7.4, 6.0), layout="constrained")
    axes = figure.add_subplot()
    at = np.array([place[r["id"]][:2] for r in rows]) / 1e3
    known = np.array([r["azimuth_off_mrad"] is not None for r in rows])
    across = [
        np.sqrt(1 - r["axis_up"] ** 2) * r["azimuth_off_mrad"] if k else 0.0 for r, k in zip(rows, known, strict=True)
    ]
    size = np.hypot(across, [r["elevation_off_mrad"] or 0.0 for r in rows])
    if known.any():
        shown = axes.scatter(at[known, 0], at[known, 1], c=size[known], s=60, cmap="magma_r", vmin=0)
        figure.colorbar(shown, ax=axes, label="looks beside by (mrad)")
    if not known.all():
        axes.plot(at[~known, 0], at[~known, 1], "x", color=GREY, label="nothing known")
        axes.legend(frameon=False, fontsize=9)
    for where, r in zip(at, rows, strict=True):
        axes.annotate(r["id"], where, fontsize=7, xytext=(4, 4), textcoords="offset points")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="east (m)", ylabel="north (m)")
    return figure
