"""The picture of a calibration: residuals over the picture, how well each place is fixed, every view's own say."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchsim.reports.pictures import EXPLAINED, GREY, MEASURED, STATED, _plain, save

Array = NDArray[np.float64]


def calibration(
    path: Path,
    resolution: tuple[int, int],
    names: Sequence[str],
    corners: Sequence[Array],
    residuals: Sequence[Array],
    sight: tuple[Array, Array, Array],
    distance: Array,
    focal: Array,
    focal_sigma: Array,
    rms: Array,
    title: str,
    focal_caption: str,
) -> None:
    """Draw a calibration.

    Parameters
    ----------
    path : Path
    resolution : (width, height) px
    names : sequence of str
        Of the v views.
    corners, residuals : sequences of (n, 2) px
        Of every view: where the marks' corners stand, and measured less projected.
    sight : (columns, rows, sigma)
        Map of the lines of sight's 1 σ [px].
    distance : (v,) mm
    focal, focal_sigma : (v,)
        Each view's own focal length less the common one, as a fraction.
    rms : (v,) px
    title, focal_caption : str
    """
    figure = Figure(figsize=(13.0, 9.6), layout="constrained")
    grid = figure.add_gridspec(2, 2, height_ratios=[1.35, 1.0])
    _residuals(figure.add_subplot(grid[0, 0]), resolution, names, corners, residuals)
    _sight(figure, figure.add_subplot(grid[0, 1]), resolution, corners, sight)
    axes = figure.add_subplot(grid[1, 0])
    axes.errorbar(
        distance, 100 * focal, 100 * focal_sigma, fmt="o", color=MEASURED, ecolor=GREY, markersize=4, capsize=2
    )
    axes.axhline(0, color=EXPLAINED, linewidth=1.2)
    axes.set(xlabel="distance to the board (mm)", ylabel="own focal length less the common one (%)")
    axes.set_title(focal_caption, fontsize=9)
    _plain(axes)
    axes = figure.add_subplot(grid[1, 1])
    axes.bar(np.arange(len(names)), rms, color=STATED, width=0.7)
    axes.set_xticks(np.arange(len(names)), names, rotation=60, ha="right", fontsize=7)
    axes.set_ylabel("residuals of a view, rms (px)")
    _plain(axes)
    figure.suptitle(title, fontsize=11)
    save(figure, path)


def _residuals(axes, resolution, names, corners, residuals) -> None:
    everything = np.concatenate(residuals)
    typical = float(np.median(np.linalg.norm(everything, axis=1)))
    scale = 0.012 * resolution[0] / max(typical, 1e-9)
    for k, (at, off) in enumerate(zip(corners, residuals, strict=True)):
        axes.quiver(
            *at.T, *(off * scale).T, angles="xy", scale_units="xy", scale=1, width=0.0012, headwidth=3,
            color=colormaps["tab20"](k % 20),
        )  # fmt: skip
    width, height = resolution
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal", xlabel="u (px)", ylabel="v (px)")
    axes.set_title(
        f"residuals of the marks' corners, {scale:.0f} × enlarged, one colour a view; median {typical:.3f} px",
        fontsize=9,
    )


def _sight(figure, axes, resolution, corners, sight) -> None:
    u, v, sigma = sight
    filled = axes.contourf(u, v, sigma, levels=12, cmap="viridis")
    for at in corners:
        axes.plot(*at.T, ".", color="white", markersize=0.9, alpha=0.7)
    width, height = resolution
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal", xlabel="u (px)", ylabel="v (px)")
    axes.set_title("how well the lens is fixed: 1σ of a line of sight (px); dots: corners of marks", fontsize=9)
    figure.colorbar(filled, ax=axes, shrink=0.85)
