"""The pictures of a fit and a validation: overlay, residuals along the curve, Fig. 8.

Every function takes finished arrays, draws one figure and writes it under a temporary name before it is moved. Figures
are made without pyplot's global state.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from operator import mul
from pathlib import Path
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.text import Text
from numpy.typing import NDArray

from benchsim.bench.writing import write_bytes

Array = NDArray[np.float64]

MEASURED, STATED, EXPLAINED, MARKS, GREY = "#d7301f", "#1f78b4", "#238b45", "#e6a100", "#5f6368"
"""One colour for one thing in every picture: measured trace, model at the stated setting, model after the settings."""


@dataclass(frozen=True)
class Trace2D:
    """One exposure's trace as the pictures need it; arrays over the profiles, ``s`` and distances in mm.

    ``before`` and ``after`` are signed distances from the model at the stated setting and after the setting errors,
    ``bin_*`` the same in bins with their 1 sigma; ``mrad_per_mm`` converts a distance to a lean of the mirror's normal.
    """

    name: str
    points: Array
    s: Array
    before: Array
    after: Array
    bin_s: Array
    bin_before: Array
    bin_after: Array
    bin_sigma: Array
    mrad_per_mm: float
    stated: Array
    explained: Array
    caption: str


def save(figure: Figure, path: Path, dpi: int = 130) -> bytes:
    """Write a figure as PNG, and return what was written."""
    for text in figure.findobj(Text):
        # A dollar in a name begins no formula; powers on logarithmic axes are Matplotlib's own.
        if "$" in text.get_text() and "\\mathdefault" not in text.get_text():
            text.set_parse_math(False)
    picture = io.BytesIO()
    figure.savefig(picture, dpi=dpi, format="png", facecolor="white")
    write_bytes(path, picture.getvalue())
    return picture.getvalue()


def _plain(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="#e6e6e6", linewidth=0.6)
    axes.set_axisbelow(True)


def _tone(light: Array) -> Array:
    """Brightness for the eye: the board's grey at a third, the line at white, by the picture's own percentiles."""
    low, high = np.percentile(light, [1.0, 99.97])
    scaled = np.clip((light - low) / max(high - low, 1e-12), 0.0, 1.0)
    return scaled**0.45


def overlay(
    path: Path,
    light: Array,
    outlines: Array,
    ridge: Array,
    stated: Array | None,
    explained: Array | None,
    title: str,
) -> None:
    """The photograph with marks, ridge and predicted curves over it, and two details of the line.

    Parameters
    ----------
    path : Path
    light : (h, w) array
        The photograph, any scale.
    outlines : (n, 4, 2) array [px]
        Corners of the board's marks, where the solved pose puts them.
    ridge : (m, 2) array [px]
        The extracted trace.
    stated, explained : (k, 2) arrays [px], optional
        The model at the stated setting and after the setting errors.
    title : str
    """
    height, width = light.shape
    figure = Figure(figsize=(13.0, 13.0 * 0.70 * height / width + 0.9), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=[2.45, 1.0])
    main = figure.add_subplot(grid[:, 0])
    shown = _tone(light)
    details = [figure.add_subplot(grid[0, 1]), figure.add_subplot(grid[1, 1])]
    for axes in [main, *details]:
        axes.imshow(shown, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        axes.set(xticks=[], yticks=[])
    for quad in outlines:
        main.plot(*np.vstack([quad, quad[:1]]).T, color=MARKS, linewidth=0.9)
    lines = [
        (stated, STATED, "model, stated setting", (4, 2)),
        (explained, EXPLAINED, "model, settings fitted", ()),
    ]
    for points, colour, label, dashes in lines:
        if points is None:
            continue
        for axes in [main, *details]:
            axes.plot(*points.T, color=colour, linewidth=1.3, label=label, dashes=dashes)
    main.plot(*ridge.T, color=MEASURED, linewidth=0.7, label="extracted ridge")
    main.plot([], [], color=MARKS, linewidth=0.9, label="marks, by the solved pose")
    main.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    # Below the photograph: the board may fill all of it.
    main.legend(loc="upper left", bbox_to_anchor=(0.0, -0.01), fontsize=8, ncol=4, frameon=False, borderaxespad=0.0)
    half = max(10.0, 0.012 * width)
    for axes, at, letter in zip(details, (0.3, 0.7), "ab", strict=True):
        u, v = ridge[int(at * (len(ridge) - 1))]
        axes.plot(*ridge.T, ".", color=MEASURED, markersize=4)
        axes.set(xlim=(u - half, u + half), ylim=(v + half, v - half))
        axes.set_title(f"detail {letter}: {2 * half:.0f} px wide at u = {u:.0f}, v = {v:.0f} px", fontsize=9)
        main.add_patch(_square(u, v, half))
        main.annotate(letter, (u + 1.4 * half, v), color="white", fontsize=9, va="center")
    figure.suptitle(title, fontsize=11)
    save(figure, path)


def _square(u: float, v: float, half: float) -> Rectangle:
    return Rectangle((u - half, v - half), 2 * half, 2 * half, fill=False, edgecolor="white", linewidth=0.8)


def residuals(traces: Sequence[Trace2D], title: str) -> Figure:
    """Distance of each trace from the vector model along the curve: at the stated setting, and after the settings."""
    figure = Figure(figsize=(6.2 * min(len(traces), 2) + 0.6, 4.6 * -(-len(traces) // 2) + 0.5), layout="constrained")
    columns = min(len(traces), 2)
    grid = figure.add_gridspec(-(-len(traces) // 2) * 2, columns)
    # Traces are compared: one scale for all.
    far = 1.05 * max(float(np.max(np.abs(t.bin_before))) for t in traces)
    near = max(max(5 * np.median(t.bin_sigma), 1.3 * np.max(np.abs(t.bin_after)), 3 * np.std(t.after)) for t in traces)
    for i, t in enumerate(traces):
        row, column = 2 * (i // columns), i % columns
        top = figure.add_subplot(grid[row, column])
        bottom = figure.add_subplot(grid[row + 1, column], sharex=top)
        top.plot(t.bin_s, t.bin_before, color=STATED, linewidth=1.5)
        top.axhline(0, color=GREY, linewidth=0.6)
        top.set_ylabel("stated setting\ndistance (mm)")
        top.set_title(f"{t.name}: {t.caption}", fontsize=9)
        top.tick_params(labelbottom=False)
        bottom.fill_between(
            t.bin_s, -t.bin_sigma, t.bin_sigma, color="#cfe8d5", label="±1σ of a mean, pose included", linewidth=0
        )
        bottom.plot(t.s, t.after, ".", color="#b9b9b9", markersize=1.2, label="profiles", zorder=1)
        mean = f"means of {len(t.s) / len(t.bin_s):.0f} profiles"
        bottom.plot(t.bin_s, t.bin_after, "o-", color=EXPLAINED, markersize=2.5, linewidth=0.8, label=mean)
        bottom.axhline(0, color=GREY, linewidth=0.6)
        top.set_ylim(-far, far)
        bottom.set_ylim(-near, near)
        bottom.set(xlabel="along the curve (mm)", ylabel="settings fitted\ndistance (mm)")
        if i == 0:
            bottom.legend(fontsize=7, ncol=3, loc="upper right", framealpha=0.9)
        for axes in (top, bottom):
            _plain(axes)
            k = t.mrad_per_mm
            side = axes.secondary_yaxis("right", functions=(partial(mul, k), partial(mul, 1 / k)))
            side.set_ylabel("of the normal (mrad)", fontsize=8)
            side.tick_params(labelsize=8)
    figure.suptitle(title, fontsize=11)
    return figure


def figure8(traces: Sequence[Trace2D], size: tuple[float, float], notes: Sequence[str], footer: str) -> Figure:
    """Measured and simulated projections of every exposure on the screen, as in the paper's Fig. 8.

    Parameters
    ----------
    traces : sequence of Trace2D
    size : (2,) mm
        The board along y and z.
    notes : sequence of str
        One line under each panel: what the conic is and where its focus lies.
    footer : str
        The conventions: which cylinder, seen from which side.
    """
    columns = min(len(traces), 4)
    rows = -(-len(traces) // columns)
    figure = Figure(figsize=(4.3 * columns + 0.4, 4.9 * rows + 1.2), layout="constrained")
    for i, (t, note) in enumerate(zip(traces, notes, strict=True)):
        axes = figure.add_subplot(rows, columns, i + 1)
        axes.plot(*t.stated.T, color=STATED, linewidth=1.4, dashes=(4, 2), label="model, stated setting")
        axes.plot(*t.explained.T, color=EXPLAINED, linewidth=1.4, label="model, settings fitted")
        step = max(1, len(t.points) // 40)
        axes.plot(*t.points[::step].T, "o", color=MEASURED, markersize=3.2, markerfacecolor="none", label="measured")
        axes.plot(0, 0, "+", color="black", markersize=8)
        axes.set_aspect("equal")
        axes.set(xlim=(-size[0] / 2, size[0] / 2), ylim=(-size[1] / 2, size[1] / 2), xlabel="y (mm)", ylabel="z (mm)")
        axes.set_title(f"{t.name}\n{note}", fontsize=9)
        _plain(axes)
    # Outside the panels: a trace may run through any of their corners.
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, fontsize=8, loc="outside lower center", ncol=3 if columns > 1 else 1)
    figure.suptitle(fill(footer, 62 * columns), fontsize=9)
    return figure
