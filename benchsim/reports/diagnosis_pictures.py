"""The pictures of a diagnosis: residuals before and after, probabilities, the located stretch over the photograph.

Every function takes finished results, draws one figure and writes it whole.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchsim.diagnosis.problem import Effect, Problem
from benchsim.diagnosis.result import Diagnosis, Stretch
from benchsim.reports.pictures import EXPLAINED, GREY, MEASURED, STATED, _plain, _tone, save
from benchsim.reports.vocabulary import BENCH

Array = NDArray[np.float64]

ELEMENT_COLOURS: Mapping[str, str] = {
    "source": "#e66101",
    "mirror": "#5e3c99",
    "air": "#35978f",
    "screen": "#1f78b4",
    "camera": "#b2182b",
    "time": "#7f6000",
    "mount": "#5e3c99",
    "target": "#1f78b4",
    "sky": "#35978f",
}
BEFORE, AFTER = STATED, EXPLAINED
PER_PAGE = 12
"""Exposures in one picture; more go to further ones."""


FILES: Mapping[str, str] = {"c": "residuals", "w": "residuals-width", "f": "residuals-flux", "g": "residuals-parting"}
"""Kind of datum along a trace → name of its picture."""


def residuals(folder: Path, problem: Problem, d: Diagnosis, title: str, kind: str = "c") -> list[Path]:
    """Residuals of every trace before and after: fitted, and predicted from the other settings.

    Parameters
    ----------
    folder : Path
        ``residuals.png`` is written into it, and ``residuals-2.png`` … for every further twelve exposures; of other
        kinds than the centre line see `FILES`.
    problem : Problem
    d : Diagnosis
    title : str
    kind : str
        One of `FILES`.

    Returns
    -------
    list of Path
    """
    out = []
    pages = range(0, len(problem.names), PER_PAGE)
    for page, first in enumerate(pages, 1):
        path = folder / (FILES[kind] + (".png" if page == 1 else f"-{page}.png"))
        blocks = range(first, min(first + PER_PAGE, len(problem.names)))
        named = title if len(pages) == 1 else f"{title} ({page} of {len(pages)})"
        save(residual_figure(problem, d, blocks, named, kind), path)
        out.append(path)
    return out


def residual_figure(problem: Problem, d: Diagnosis, blocks: range, title: str, kind: str = "c") -> Figure:
    """The residuals of one kind of datum of some exposures, each above its own left-out ones."""
    r = d.residuals
    name, unit = BENCH.kinds[kind]
    held = np.isfinite(r.held_out_after).any()
    columns = min(len(blocks), 3)
    rows = -(-len(blocks) // columns)
    panels = 2 if held else 1
    drawn = [r.before, r.after, r.held_out_before, r.held_out_after]
    # Traces are compared, on further pages too: one scale for all.
    shown = np.abs(np.stack(drawn))[:, problem.kind == kind]
    reach = 1.15 * max(float(np.max(shown, where=np.isfinite(shown), initial=0.0)), 1e-12)
    figure = Figure(figsize=(5.2 * columns + 0.5, (1.55 * panels + 0.55) * rows + 1.1), layout="constrained")
    grid = figure.add_gridspec(rows * panels, columns)
    for i, b in enumerate(blocks):
        row, column = divmod(i, columns)
        pairs = [(r.before, r.after, "fitted"), (r.held_out_before, r.held_out_after, "left out")][:panels]
        top: Axes | None = None
        for j, (before, after, word) in enumerate(pairs):
            axes = figure.add_subplot(grid[row * panels + j, column], sharex=top)
            _residual_panel(axes, problem, b, before, after, r.sigma, kind)
            axes.set_ylim(-reach, reach)
            if j == 0:
                top = axes
                axes.set_title(f"{problem.names[b]}, setting {problem.groups[b]}", fontsize=9)
            if column == 0:
                axes.set_ylabel(f"{word}\n({unit})" if unit else word, fontsize=8)
            if j < panels - 1:
                axes.tick_params(labelbottom=False)
            elif row == rows - 1 or i + columns >= len(blocks):
                axes.set_xlabel("along the trace (mm)", fontsize=8)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, fontsize=8, loc="outside lower center", ncol=4)
    explained = f"{BENCH.distance if kind == 'c' else f'{name} less its prediction'}, settings fitted"
    if held:
        explained += "; left out: predicted from the other settings"
    figure.suptitle(fill(f"{title}: {explained}", 52 * columns), fontsize=10)
    return figure


def _alone(problem: Problem, block: int, sigma: Array) -> Array:
    """1 sigma of every datum of a block given its neighbours (n_b,): without the errors that they have in common."""
    c = problem.covariance[block]
    return sigma[problem.rows(block)] / np.sqrt(np.diag(c) * np.diag(np.linalg.inv(c)))


def _bands(axes: Axes, s: Array, sigma: Array, alone: Array) -> None:
    axes.fill_between(s, -sigma, sigma, color="#e8f3ea", linewidth=0, label="±1σ, errors common to the trace included")
    axes.fill_between(s, -alone, alone, color="#bfdcc7", linewidth=0, label="±1σ of a point alone")


def _residual_panel(
    axes: Axes, problem: Problem, block: int, before: Array, after: Array, sigma: Array, kind: str
) -> None:
    rows = problem.rows(block)
    main = np.flatnonzero((problem.kind[rows] == kind) & np.isfinite(before[rows])) + rows.start
    _plain(axes)
    axes.tick_params(labelsize=8)
    axes.axhline(0, color=GREY, linewidth=0.6)
    if not len(main):
        axes.text(
            0.5, 0.5, f"no {BENCH.kinds[kind][0]}", transform=axes.transAxes, ha="center", va="center", fontsize=8
        )
        return
    order = main[np.argsort(problem.position[main], kind="stable")]
    s = problem.position[order]
    _bands(axes, s, sigma[order], _alone(problem, block, sigma)[order - rows.start])
    axes.plot(s, before[order], "o", color=BEFORE, markersize=2.6, markerfacecolor="none", label="before")
    axes.plot(s, after[order], "o", color=AFTER, markersize=2.6, label="after: what was found put in")


def observables(path: Path, problem: Problem, d: Diagnosis, title: str) -> None:
    """Rms of the whitened residuals of every observable in every exposure, before and after.

    Parameters
    ----------
    path : Path
    problem : Problem
    d : Diagnosis
    title : str
    """
    r = d.residuals
    kinds = [
        k for k in (*BENCH.kinds, *sorted(set(problem.kind.tolist()) - set(BENCH.kinds))) if (problem.kind == k).any()
    ]
    count = len(problem.names)
    held = np.isfinite(r.held_out_after).any()
    figure = Figure(figsize=(2.9 * len(kinds) + 1.6, 0.24 * count + 1.9), layout="constrained")
    every = figure.subplots(1, len(kinds), sharex=True, sharey=True, squeeze=False)[0]
    marks = [(r.before, BEFORE, "none", "before", -0.12), (r.after, AFTER, AFTER, "after", -0.12)]
    if held:
        marks += [
            (r.held_out_before, BEFORE, "none", "left out, before", 0.16),
            (r.held_out_after, AFTER, AFTER, "left out, after", 0.16),
        ]
    for axes, kind in zip(every, kinds, strict=True):
        _plain(axes)
        for values, colour, face, label, dy in marks:
            shape = "o" if dy < 0 else "s"
            at, norm = [], []
            for b in range(count):
                rows = problem.rows(b)
                here = (problem.kind[rows] == kind) & np.isfinite(values[rows])
                if here.any():
                    at.append(b + dy)
                    norm.append(_norm(problem, b, here, values[rows], r.sigma[rows]))
            axes.plot(norm, at, shape, color=colour, markerfacecolor=face, markersize=4.5, label=label)
        axes.axvline(1.0, color=GREY, linewidth=0.8)
        axes.set_xscale("log")
        low, high = axes.get_xlim()
        axes.set_xlim(min(low, 0.5), max(high, 2.0))
        axes.xaxis.set_major_formatter(lambda x, _: f"{x:g}")
        axes.xaxis.set_minor_formatter(_ones_twos_fives if high < 12 * low else "")
        axes.tick_params(which="both", labelsize=8)
        axes.set_title(BENCH.kinds.get(kind, (kind, ""))[0], fontsize=9)
        axes.set_xlabel("rms (sigma)", fontsize=8)
    every[0].set_yticks(range(count), [f"{n} ({g})" for n, g in zip(problem.names, problem.groups, strict=True)])
    every[0].set_ylim(count - 0.5, -0.5)
    handles, labels = every[0].get_legend_handles_labels()
    figure.legend(handles, labels, fontsize=8, loc="outside lower center", ncol=4)
    figure.suptitle(
        fill(f"{title}: whitened residuals of every observable; noise alone gives about 1", 34 * len(kinds)),
        fontsize=10,
    )
    save(figure, path)


def _norm(problem: Problem, block: int, here: NDArray[np.bool_], values: Array, sigma: Array) -> float:
    """Rms of the whitened residuals of some data of a block."""
    own = problem.covariance[block][np.ix_(here, here)]
    scaled = values[here] * np.sqrt(np.diag(own)) / sigma[here]
    return float(np.sqrt(np.mean(np.linalg.solve(np.linalg.cholesky(own), scaled) ** 2)))


def _ones_twos_fives(x: float, _: int | None) -> str:
    return f"{x:g}" if f"{x:.0e}"[0] in "25" else ""


def probability(d: Diagnosis, catalogue: Sequence[Effect], title: str, prior: float = 0.02) -> Figure:
    """Probability of every effect to be present, on a scale of log odds.

    Parameters
    ----------
    d : Diagnosis
    catalogue : sequence of Effect
        Gives order and elements.
    title : str
    prior : float
        Probability of every effect before the data.
    """
    order = {name: i for i, name in enumerate(ELEMENT_COLOURS)}
    effects = sorted(catalogue, key=lambda e: order.get(e.element, len(order)))
    low, high = 1e-4, 1 - 1e-4

    def scale(p: float) -> float:
        clipped = min(max(p, low), high)
        return float(np.log10(clipped / (1 - clipped)))

    figure = Figure(figsize=(8.4, 0.235 * len(effects) + 1.5), layout="constrained")
    axes = figure.add_subplot()
    _plain(axes)
    named = {f.name: f.confidence for f in d.effects}
    rivals = {name for c in d.classes for member in c.members for name in member}
    for i, e in enumerate(effects):
        p = d.probability.get(e.name, 0.0)
        colour = ELEMENT_COLOURS.get(e.element, GREY)
        axes.plot([scale(low), scale(p)], [i, i], color=colour, linewidth=8, alpha=0.85, solid_capstyle="butt")
        word = named.get(e.name, "in a class" if e.name in rivals else "")
        # The longest bars carry their word inside, where the frame would cut it off.
        inside = p > 0.997
        axes.annotate(
            word,
            (scale(p), i),
            xytext=(-5 if inside else 5, 0),
            textcoords="offset points",
            ha="right" if inside else "left",
            va="center_baseline",
            fontsize=7.5,
            color="white" if inside else "black",
            bbox=None if inside or not word else {"facecolor": "white", "edgecolor": "none", "pad": 0.8},
        )
    ticks = [1e-4, 1e-3, 0.01, 0.1, 0.5, 0.9, 0.99, 0.999, 0.9999]
    axes.set_xticks([scale(t) for t in ticks], ["≤ 0.0001", *(f"{t:g}" for t in ticks[1:-1]), "≥ 0.9999"], fontsize=8)
    axes.axvline(scale(prior), color=GREY, linewidth=0.9, linestyle=(0, (2, 2)))
    axes.text(scale(prior), -0.9, " before the data", fontsize=7.5, color=GREY, ha="left", va="bottom")
    for threshold, word in ((0.9, "probable"), (0.99, "named")):
        axes.axvline(scale(threshold), color="black", linewidth=0.7)
        axes.text(scale(threshold), -0.9, f" {word}", fontsize=7.5, ha="left", va="bottom")
    axes.set_yticks(range(len(effects)), [e.name for e in effects], fontsize=8)
    for label, e in zip(axes.get_yticklabels(), effects, strict=True):
        label.set_color(ELEMENT_COLOURS.get(e.element, "black"))
    axes.set(ylim=(len(effects) - 0.4, -1.0), xlim=(scale(low), scale(high) + 0.05))
    axes.grid(axis="y", visible=False)
    axes.set_xlabel("probability of being present (log odds)", fontsize=9)
    for i, (name, colour) in enumerate(ELEMENT_COLOURS.items()):
        first = [k for k, e in enumerate(effects) if e.element == name]
        if first:
            axes.text(1.01, float(np.mean(first)), name, color=colour, fontsize=9, va="center", transform=_beside(axes))
        if first and i and first[0]:
            axes.axhline(first[0] - 0.5, color="#d0d0d0", linewidth=0.7)
    figure.suptitle(f"{title}: what the recordings say of every effect", fontsize=10)
    return figure


def _beside(axes: Axes):  # type: ignore[no-untyped-def]  # matplotlib's own transforms have no public type
    return axes.get_yaxis_transform()


@dataclass(frozen=True)
class Ridge:
    """The trace of one exposure in its photograph: arc length [mm] and pixel of every profile."""

    name: str
    light: Array
    s: Array
    pixels: Array


def _window(ridge: Ridge) -> tuple[Array, Array]:
    """Part of the photograph to show: the trace and a fifth of its length around it, at least 3 : 2; corners (u, v)."""
    size = np.array(ridge.light.shape[::-1], float)
    low, high = ridge.pixels.min(axis=0), ridge.pixels.max(axis=0)
    margin = 0.2 * float((high - low).max()) + 10.0
    low, high = low - margin, high + margin
    wide, tall = high - low
    more = np.array([max(0.0, 1.5 * tall - wide), max(0.0, 0.45 * wide - tall)]) / 2
    return np.clip(low - more, -0.5, size - 0.5), np.clip(high + more, -0.5, size - 0.5)


def located(path: Path, ridge: Ridge, stretches: Sequence[Stretch], problem: Problem, d: Diagnosis, title: str) -> None:
    """The stretches of a trace where the misfit lies, over the photograph and over the residuals.

    Parameters
    ----------
    path : Path
    ridge : Ridge
    stretches : sequence of Stretch
        Of this exposure, the strongest first; the residuals are those of the first's kind.
    problem : Problem
    d : Diagnosis
    title : str
    """
    low, high = _window(ridge)
    width, height = high - low
    shape = min(height / width, 1.0)
    figure = Figure(figsize=(10.0, 10.0 * 0.94 * shape + 2.7), layout="constrained")
    picture, below = figure.subplots(2, 1, height_ratios=[10.0 * 0.94 * shape, 2.0])
    picture.imshow(_tone(ridge.light), cmap="gray", vmin=0, vmax=1, interpolation="nearest")
    picture.set(xticks=[], yticks=[], xlim=(low[0], high[0]), ylim=(high[1], low[1]))
    picture.plot(*ridge.pixels.T, color=MEASURED, linewidth=0.6)
    r, first = d.residuals, stretches[0].kind if stretches else "c"
    _residual_panel(below, problem, problem.names.index(ridge.name), r.before, r.after, r.sigma, first)
    apart = len({(s.from_mm, s.to_mm) for s in stretches}) < len(stretches)
    for number, stretch in enumerate(stretches):
        if stretch.kind == first:
            below.axvspan(stretch.from_mm, stretch.to_mm, color="#ffd92f", alpha=0.45, linewidth=0)
        here = (ridge.s >= stretch.from_mm) & (ridge.s <= stretch.to_mm)
        if not here.any():
            continue
        part = ridge.pixels[here]
        order = np.argsort(ridge.s[here])
        path_px = part[order]
        pieces = np.stack([path_px[:-1], path_px[1:]], axis=1)
        picture.add_collection(LineCollection(list(pieces), colors="#ffd92f", linewidths=7, alpha=0.5))
        # Stretches of two kinds may be the same one: their labels would lie on each other.
        u, v = path_px[len(path_px) * (number + 1) // (len(stretches) + 1) if apart else len(path_px) // 2]
        along = path_px[-1] - path_px[0]
        across = np.array([-along[1], along[0]]) / max(float(np.hypot(*along)), 1e-9)
        across *= np.sign(across @ ((low + high) / 2 - (u, v))) or 1.0
        picture.annotate(
            f"{stretch.from_mm:.0f} … {stretch.to_mm:.0f} mm\n{BENCH.kinds[stretch.kind][0]}: {stretch.z:.1f} sigma",
            (u, v),
            xytext=(62 * across[0], -62 * across[1]),
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=9,
            color="white",
            bbox={"facecolor": "black", "alpha": 0.65, "edgecolor": "none", "pad": 2.5},
            arrowprops={"arrowstyle": "-", "color": "#ffd92f"},
        )
    # The trace's own run along the trace, so that the reader finds the ends in the picture.
    for at, word in ((np.argmin(ridge.s), f"{ridge.s.min():.0f} mm"), (np.argmax(ridge.s), f"{ridge.s.max():.0f} mm")):
        u, v = ridge.pixels[int(at)]
        picture.annotate(
            word, (u, v), xytext=(0, -12), textcoords="offset points", ha="center", color="white", fontsize=8
        )
    below.set_xlabel("along the trace (mm)", fontsize=9)
    name, unit = BENCH.kinds[first]
    below.set_ylabel(
        "distance from the\nprediction (mm)"
        if first == "c"
        else f"{name}\nless predicted{f' ({unit})' if unit else ''}",
        fontsize=9,
    )
    below.legend(fontsize=7, ncol=2, loc="best")
    figure.suptitle(fill(title, 110), fontsize=10)
    save(figure, path)
