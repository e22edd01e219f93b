"""Pictures of `drone.py`: a frame with what was found, the tracking angles coming to rest, Table 1 as bars."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from numpy.typing import NDArray

Array = NDArray[np.float64]

BLUE, RED, GREY = "#1f78b4", "#d7301f", "#5f6368"


def save(figure: Figure, path: Path) -> None:
    figure.savefig(path, dpi=130)
    print(f"picture: {path}")


def _toned(image: Array) -> Array:
    return np.clip(3 * image, 0, 1) ** 0.5


def frame(image: Array, mirrors: Sequence[Array], spots: Sequence[Array], title: str) -> Figure:
    """The frame, and the three mirrors with the most glints enlarged."""
    figure = Figure(figsize=(13, 9), layout="constrained")
    top, bottom = figure.subfigures(2, 1, height_ratios=(1.25, 1))
    figure.suptitle(title, fontsize=13, x=0.01, ha="left", weight="bold")
    axes = top.subplots()
    axes.imshow(_toned(image), cmap="gray", vmin=0, vmax=1, interpolation="nearest")
    for i, (corners, found) in enumerate(zip(mirrors, spots, strict=True)):
        axes.add_patch(Polygon(corners, fill=False, edgecolor=BLUE, linewidth=1.2))
        axes.plot(*found.T, "o", color="none", markeredgecolor=RED, markersize=9, markeredgewidth=1.3)
        axes.text(*(corners[3] - [0, 12]), str(i + 1), color="white", fontsize=9)
    axes.set(xlabel="column of the window [px]", ylabel="row [px]")
    order = sorted(range(len(mirrors)), key=lambda i: -len(spots[i]))[:3]
    for panel, i in zip(bottom.subplots(1, 3), order, strict=True):
        panel.imshow(_toned(image), cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        panel.add_patch(Polygon(mirrors[i], fill=False, edgecolor=BLUE, linewidth=1.2))
        panel.plot(*spots[i].T, "+", color=RED, markersize=12, markeredgewidth=1.5)
        (x0, y0), (x1, y1) = mirrors[i].min(axis=0) - 12, mirrors[i].max(axis=0) + 12
        panel.set(xlim=(x0, x1), ylim=(y1, y0))
        panel.set_title(
            f"heliostat {i + 1}: {len(spots[i])} glints in the dark image of the drone", fontsize=9.5, loc="left"
        )
    return figure


def convergence(found: Sequence[tuple]) -> Figure:
    """``found``: per heliostat, the Pointing by design and with the measured surface."""
    figure = Figure(figsize=(13, 4.9), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    figure.suptitle("The tracking angles come to rest", fontsize=13, x=0.01, ha="left", weight="bold")
    for p, _ in found:
        steps = 1e3 * np.abs(p.steps).max(axis=1)
        left.semilogy(np.arange(p.second), steps[: p.second], "o-", color=BLUE, markersize=3, linewidth=0.9, alpha=0.7)
        after = np.arange(p.second - 1, len(steps) - 1)
        left.semilogy(after, steps[p.second :], "s--", color=RED, markersize=3, linewidth=0.9, alpha=0.7)
    left.plot([], [], "o-", color=BLUE, label="all glints")
    left.plot([], [], "s--", color=RED, label="outliers gone")
    left.legend(frameon=False, fontsize=9)
    left.set(xlabel="turns of the tracking angles", ylabel="largest mean difference [mrad]")
    left.set_title(f"{len(found)} heliostats", fontsize=10, loc="left")
    bins = np.arange(-5, 5.01, 0.25)
    p, q = found[0]
    for panel, axis, name in ((middle, 0, "x"), (right, 1, "y")):
        start = 1e3 * (p.differences[:, axis] + p.steps[: p.second, axis].sum())
        panel.hist(start, bins, color="#cccccc", label="at the plant's angles")
        panel.hist(1e3 * p.differences[p.kept, axis], bins, color=BLUE, alpha=0.75, label="at rest, surface by design")
        panel.hist(
            1e3 * q.differences[q.kept, axis], bins, histtype="step", color=RED, linewidth=1.6, label="measured surface"
        )
        panel.set(xlabel=f"angular difference about {name} [mrad]", ylabel="glints")
        panel.set_title(
            f"heliostat 1: σ_ad {1e3 * p.sigma_ad[axis]:.2f} and {1e3 * q.sigma_ad[axis]:.2f} mrad",
            fontsize=10,
            loc="left",
        )
    figure.legend(*middle.get_legend_handles_labels(), loc="outside lower right", frameon=False, fontsize=9, ncols=3)
    for axes in (left, middle, right):
        axes.spines[["top", "right"]].set_visible(False)
    return figure


def sources(effects: Sequence) -> Figure:
    """Table 1: width and error of the axis of every source alone."""
    figure = Figure(figsize=(12, 5.6), layout="constrained")
    axes, table = figure.subplots(1, 2, width_ratios=(3, 1), sharey=True)
    figure.suptitle("Every error source of Table 1 alone", fontsize=13, x=0.01, ha="left", weight="bold")
    y = np.arange(len(effects))[::-1]
    floor = 1e-4
    width, error, mean = (
        np.maximum(1e3 * np.array([getattr(e, k) for e in effects]), floor) for k in ("width", "error", "sigma_mean")
    )
    axes.barh(y + 0.2, width, 0.36, left=0, color=BLUE, label="width of the differences, σ_ad: broadening")
    axes.barh(y - 0.2, error, 0.36, color=RED, label="error of the axis, rms: a shift where it passes σ_mean")
    axes.errorbar(
        error, y - 0.2, xerr=1e3 * np.array([e.error_se for e in effects]), fmt="none", ecolor="black", capsize=2
    )
    axes.plot(mean, y - 0.2, "|", color="black", markersize=13, markeredgewidth=2, label="σ_mean = σ_ad/√n")
    axes.set_xscale("log")
    axes.set(xlim=(floor, 1.5), yticks=y, yticklabels=[e.source.name for e in effects], xlabel="[mrad]")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower left", frameon=False, fontsize=9, ncols=3)
    for x, text in enumerate(("broadens\nprinted", "found", "shifts\nprinted", "found")):
        table.text(x, len(effects) - 0.35, text, ha="center", va="bottom", fontsize=9, color=GREY)
    for e, at in zip(effects, y, strict=True):
        s = e.source
        marks = (s.broadens, "x" if e.broadens else "–", s.shifts, "x" if e.shifts else "–")
        for x, mark in enumerate(marks):
            odd = bool(s.broadens) and x % 2 == 1 and (mark == "x") != ("x" in marks[x - 1])
            table.text(x, at, mark, ha="center", va="center", fontsize=12, color=RED if odd else "black")
    table.set(xlim=(-0.6, 3.6))
    table.axis("off")
    return figure
