"""Pictures of a plant's flux: on a receiver, with contours, and what each heliostat brings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

Array = NDArray[np.float64]


def flux(name: str, kind: str, u: Array, v: Array, values: Array, levels: Sequence[float], day: bool) -> Figure:
    """Flux on a receiver as who looks at it sees it; a cylinder unrolled from north.

    Parameters
    ----------
    name, kind : str
        Of the receiver.
    u, v : arrays
        Centres of the cells along and up [mm].
    values : (along, up) array
        [kW/m²], or kWh/m² of a day.
    levels : sequence of float
        Of contours, in the same unit.
    day : bool
    """
    unit = "kW/m²"
    if day:
        # A year's energy on a square metre is millions of kWh.
        factor, unit = (1e-3, "MWh/m²") if values.max() >= 1e4 else (1.0, "kWh/m²")
        values, levels = factor * values, [factor * level for level in levels]
    figure, axes, x, z = _on(kind, u, v, values, {"cmap": "inferno", "vmin": 0}, unit)
    there = sorted({level for level in levels if 0 < level < values.max()})
    if there:
        lines = axes.contour(x, z, values.T, levels=there, colors="white", linewidths=0.8)
        axes.clabel(lines, fmt="%.4g", fontsize=8)
    axes.set_title(f"{name}: {'energy' if day else 'flux'}, peak {values.max():.4g} {unit}", fontsize=10)
    return figure


def difference(name: str, kind: str, u: Array, v: Array, values: Array, day: bool) -> Figure:
    """Where two engines part on a receiver, as `flux`: what one has more than the other."""
    big = float(np.abs(values).max()) or 1.0
    unit = "kWh/m²" if day else "kW/m²"
    figure, axes, _, _ = _on(kind, u, v, values, {"cmap": "RdBu_r", "vmin": -big, "vmax": big}, unit)
    axes.set_title(f"{name}: Monte Carlo less product", fontsize=10)
    return figure


def _on(
    kind: str, u: Array, v: Array, values: Array, style: Mapping[str, Any], unit: str
) -> tuple[Figure, Axes, Array, Array]:
    x, z = u / 1e3, v / 1e3
    figure = Figure(figsize=(7.2, 5.4), layout="constrained")
    axes = figure.add_subplot()
    edges = [np.r_[g - (g[1] - g[0]) / 2, g[-1] + (g[1] - g[0]) / 2] for g in (x, z)]
    shown = axes.pcolormesh(*edges, values.T, rasterized=True, **style)
    figure.colorbar(shown, ax=axes, label=unit)
    axes.set_aspect("equal")
    if kind == "cylinder":
        axes.set_xlabel("along the surface from north, through east (m)")
    else:
        # The width runs to the left of who looks at the plane.
        axes.set_xlim(edges[0][-1], edges[0][0])
        axes.set_xlabel("along the width, to the left (m)")
    axes.set_ylabel("up from the centre (m)")
    return figure, axes, x, z


def field(position: Array, values: Array, day: bool) -> Figure:
    """Plan of a field: what each square metre of mirror brings to the receiver [kW/m², kWh/m²]."""
    figure = Figure(figsize=(7.2, 6.0), layout="constrained")
    axes = figure.add_subplot()
    size = float(np.clip(4000 / len(position), 2, 60))
    east, north = position[:, 0] / 1e3, position[:, 1] / 1e3
    shown = axes.scatter(east, north, c=values, s=size, cmap="viridis", rasterized=True)
    figure.colorbar(shown, ax=axes, label=f"on the receiver, per area of mirror ({'kWh/m²' if day else 'kW/m²'})")
    axes.plot(0, 0, "k^", markersize=6)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("east (m)")
    axes.set_ylabel("north (m)")
    return figure
