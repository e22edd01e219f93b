"""Pictures of a mount's diagnosis: residuals over the sky and by the number of the record; and of its predictions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator
from numpy.typing import NDArray

from benchsim.diagnosis.result import Residuals
from benchsim.reports.pictures import EXPLAINED, GREY, STATED, _plain, save

Array = NDArray[np.float64]


def residuals(path: Path, source: Array, r: Residuals, unit: str, title: str) -> None:
    """Residuals as arrows over the sky, before and after, and both components by the number of the record.

    Parameters
    ----------
    path : Path
    source : (n, 3) array
        Unit vectors toward the sun or the stars, east-north-up.
    r : Residuals
        Across and up of every record in turn.
    unit : str
        Of the residuals.
    title : str
    """
    before, after = r.before.reshape(-1, 2), r.after.reshape(-1, 2)
    left = r.held_out_after.reshape(-1, 2)
    azimuth = np.arctan2(source[:, 0], source[:, 1])
    zenith = 90.0 - np.degrees(np.arcsin(np.clip(source[:, 2], -1, 1)))
    figure = Figure(figsize=(10.5, 8.2), layout="constrained")
    grid = figure.add_gridspec(2, 2, height_ratios=[1.35, 1.0])
    for k, (values, word, colour) in enumerate(((before, "before", STATED), (after, "after", EXPLAINED))):
        axes = figure.add_subplot(grid[0, k], projection="polar")
        axes.set_theta_zero_location("N")  # type: ignore[attr-defined]  # polar axes only
        axes.set_theta_direction(-1)  # type: ignore[attr-defined]
        size = float(np.sqrt(np.mean((values**2).sum(axis=1)))) or 1.0
        # Across is toward growing azimuth, up toward the zenith, which is inward.
        u = values[:, 0] * np.cos(azimuth) - values[:, 1] * np.sin(azimuth)
        v = -values[:, 0] * np.sin(azimuth) - values[:, 1] * np.cos(azimuth)
        arrows = axes.quiver(
            azimuth, zenith, u, v, angles="uv", color=colour, scale=size * 14, scale_units="width", width=0.0045
        )
        axes.quiverkey(arrows, 0.02, 1.02, size, f"{size:.3g} {unit}", labelpos="E", fontproperties={"size": 8})
        axes.plot(azimuth, zenith, ".", color=GREY, markersize=3)
        axes.set_rlim(0, 90)  # type: ignore[attr-defined]
        axes.set_yticks([30, 60], ["60°", "30°"], fontsize=7)
        axes.set_xticks(np.radians([0, 90, 180, 270]), ["N", "E", "S", "W"], fontsize=8)
        axes.set_title(f"{word}: rms {size:.3g} {unit}", fontsize=9)
    number = np.arange(1, len(before) + 1)
    sigmas = r.sigma.reshape(-1, 2)
    linear = max(3 * float(sigmas.max()), 1e-9)
    wide = float(np.nanmax(np.abs(before))) > 5 * linear
    for k, word in enumerate(("across", "up")):
        axes = figure.add_subplot(grid[1, k])
        _plain(axes)
        sigma = sigmas[:, k]
        axes.fill_between(number, -sigma, sigma, step="mid", color="#e8f3ea", linewidth=0, label="±1σ of a record")
        axes.axhline(0, color=GREY, linewidth=0.6)
        axes.plot(number, before[:, k], "o", color=STATED, markersize=3, markerfacecolor="none", label="before")
        axes.plot(number, after[:, k], "o", color=EXPLAINED, markersize=3, label="after, fitted")
        if np.isfinite(left[:, k]).any():
            axes.plot(number, left[:, k], "x", color="black", markersize=3.5, label="after, left out")
        if wide:
            axes.set_yscale("symlog", linthresh=linear)
            axes.yaxis.set_major_formatter("{x:g}")
        axes.set(xlabel="number of the record", ylabel=f"{word} ({unit})")
    figure.legend(*axes.get_legend_handles_labels(), fontsize=8, loc="outside lower center", ncol=4, frameon=False)
    figure.suptitle(f"{title}: recorded less predicted direction, over the sky and by record", fontsize=10)
    save(figure, path)


def prediction(
    path: Path, miss: Array, sigma: Array, stated: Array, learnt: NDArray[np.bool_], unit: str, title: str
) -> None:
    """Misses by the number of the record, amended and as stated, with their predicted sigma.

    Parameters
    ----------
    path : Path
    miss, sigma, stated : (n,) array
        Of the mount as amended, predicted, and of the mount as stated; nan where there is none.
    learnt : (n,) bool array
        Records that the mount was amended by.
    unit : str
    title : str
    """
    number = np.arange(1, len(miss) + 1)
    figure = Figure(figsize=(9.0, 4.6), layout="constrained")
    axes = figure.add_subplot()
    _plain(axes)
    values = np.concatenate([miss, sigma, stated])
    values = values[np.isfinite(values) & (values > 0)]
    least, most = (values.min() / 1.5, values.max() * 1.5) if len(values) else (0.1, 1.0)
    known = np.isfinite(sigma)
    if known.any():
        band = np.where(known, sigma, least)
        axes.fill_between(number, least, band, step="mid", color="#cfe6d4", linewidth=0, label="predicted, 68 %")
    axes.plot(number, stated, "o", color=STATED, markersize=3.5, markerfacecolor="none", label="as stated")
    axes.plot(number[~learnt], miss[~learnt], "o", color=EXPLAINED, markersize=3.5, label="as amended")
    if learnt.any():
        axes.plot(number[learnt], miss[learnt], "x", color=GREY, markersize=4, label="as amended, learnt from")
    # As stated they may be a hundred times those that are amended.
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set_ylim(least, most)
    axes.set(xlabel="number of the record", ylabel=f"miss ({unit})")
    axes.legend(fontsize=8, frameon=False, ncol=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    figure.suptitle(title, fontsize=10)
    save(figure, path)
