"""The loop closed in pixels, drawn: photograph, the same rendered again, and what is left, along the trace."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchsim.reports.pictures import save

Array = NDArray[np.float64]

PER_PAGE = 6
"""Exposures in one picture; more go to further ones."""

REACH = 5.0
"""z at the ends of the colour scale."""


@dataclass(frozen=True)
class Strip:
    """One exposure; arrays (k, m) along and across the trace, nan where nothing was compared.

    ``along`` (k,) and ``across`` (m,) in px; ``photograph`` and ``render`` in counts; ``before`` and ``after`` in
    sigmas of a pixel's noise. ``caption``: what the numbers are.
    """

    name: str
    along: Array
    across: Array
    photograph: Array
    render: Array
    before: Array
    after: Array
    caption: str


def strips(path: Path, exposures: Sequence[Strip], title: str) -> list[Path]:
    """Four strips for each exposure: photograph, render with what was found, residual before and after as z.

    Parameters
    ----------
    path : Path
        PNG to write; ``NAME-2.png`` … beside it for every further six exposures.
    exposures : sequence of Strip
        At least one.
    title : str

    Returns
    -------
    list of Path
        Written.
    """
    pages = [exposures[i : i + PER_PAGE] for i in range(0, len(exposures), PER_PAGE)]
    out = []
    for number, page in enumerate(pages, 1):
        out.append(path if number == 1 else path.with_name(f"{path.stem}-{number}{path.suffix}"))
        _page(out[-1], page, title if len(pages) == 1 else f"{title} ({number} of {len(pages)})")
    return out


def _page(path: Path, exposures: Sequence[Strip], title: str) -> None:
    figure = Figure(figsize=(11.0, 2.5 * len(exposures) + 0.9), layout="constrained")
    grid = figure.subplots(4 * len(exposures), 1, squeeze=False)[:, 0]
    colour = None
    for i, s in enumerate(exposures):
        extent = (float(s.along[0]), float(s.along[-1]), float(s.across[0]) - 0.5, float(s.across[-1]) + 0.5)
        top = max(float(np.nanmax(s.render)), 1e-12)
        rows = (
            ("photograph", s.photograph / top, "gray", (0.0, 1.0)),
            ("rendered", s.render / top, "gray", (0.0, 1.0)),
            ("z before", s.before, "RdBu_r", (-REACH, REACH)),
            ("z after", s.after, "RdBu_r", (-REACH, REACH)),
        )
        for axes, (label, values, colours, (low, high)) in zip(grid[4 * i : 4 * i + 4], rows, strict=True):
            shown = axes.imshow(
                values.T, cmap=colours, vmin=low, vmax=high, extent=extent, origin="lower", aspect="auto",
                interpolation="nearest",
            )  # fmt: skip
            axes.set_facecolor("#d9d9d9")
            axes.set_ylabel(label, rotation=0, ha="right", va="center", fontsize=8)
            axes.tick_params(labelsize=7, labelbottom=False)
            colour = shown if colours != "gray" else colour
        grid[4 * i].set_title(f"{s.name}: {s.caption}", fontsize=9, loc="left")
        grid[4 * i + 3].tick_params(labelbottom=True)
    grid[-1].set_xlabel("along the trace (px); across it ± 3 widths; grey: not compared", fontsize=8)
    if colour is not None:
        figure.colorbar(colour, ax=list(grid), shrink=0.4, label="z: residual in sigmas of a pixel's noise")
    figure.suptitle(title, fontsize=11)
    save(figure, path)
