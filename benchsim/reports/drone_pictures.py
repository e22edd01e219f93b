"""Pictures of a drone's flight over a plant: the plan, errors of a virtual flight, and axes that were found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import stats

Array = NDArray[np.float64]

BLUE, GREY = "#1f78b4", "#5f6368"


def plan(position: Array, cluster: Array, sigma: Array, points: Sequence[Array]) -> Figure:
    """Plan of a field by expected sigma, its clusters with the patterns that are flown for them.

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
    figure, axes = _patterns(position, cluster, sigma, points, (0, 1))
    for k, p in enumerate(points, 1):
        x, y = p.mean(axis=0)[:2] / 1e3
        axes.annotate(str(k), (x, y), (0, 8), textcoords="offset points", fontsize=9, ha="center", va="center")
    axes.plot(0, 0, "k^", markersize=6)
    return figure


def side(position: Array, cluster: Array, sigma: Array, points: Sequence[Array]) -> Figure:
    """As `plan`, seen from the east."""
    return _patterns(position, cluster, sigma, points, (1, 2))[0]


def _patterns(
    position: Array, cluster: Array, sigma: Array, points: Sequence[Array], on: tuple[int, int]
) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(7.2, 6.0), layout="constrained")
    axes = figure.add_subplot()
    a, b = on
    for k, p in enumerate(points, 1):
        ends = np.stack([position[cluster == k].mean(axis=0), p.mean(axis=0)]) / 1e3
        axes.plot(ends[:, a], ends[:, b], color=f"C{(k - 1) % 10}", linewidth=0.8, alpha=0.6)
        axes.plot(p[:, a] / 1e3, p[:, b] / 1e3, color=f"C{(k - 1) % 10}", linewidth=0.9)
    size = float(np.clip(4000 / len(position), 2, 60))
    x, y = position[:, a] / 1e3, position[:, b] / 1e3
    shown = axes.scatter(x, y, c=sigma, s=size, cmap="viridis", rasterized=True)
    figure.colorbar(shown, ax=axes, label="expected σ of the axis (mrad)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.spines[["top", "right"]].set_visible(False)
    names = ("east (m)", "north (m)", "up (m)")
    axes.set(xlabel=names[a], ylabel=names[b])
    return figure, axes


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
