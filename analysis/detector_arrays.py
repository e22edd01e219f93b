"""Misalignments of 100 heliostats at once from two detector arrays (Carretero 2019, sections 2 and 4.3), against the
bars.

The field: the six heliostats of ``fig4.py`` and 94 more, June 21, solar hours 8, 12 and 16. Every heliostat is off by a
draw within ±10 mrad in elevation and azimuth. Per hour, several records of 20 s with fresh noise give

- pulls: errors over their stated sigma (bar: std 0.9 to 1.15);
- errors² over the Cramér–Rao bound, computed from the raw samples of each heliostat's own light (bar: at most 1.25),
  for the fit of all lines and for the crossings alone;
- the loop: measured, corrected by drives that err by 2 %, measured again, three times (bar: 0.1 mrad wherever both
  traces cross an array at the beginning, by the vector model's own traces).

Pictures: ``detector_pulls.png``, ``detector_loop.png``. What the paper does not print is
``benchsim.arrays.Assumptions``. About 8 min of CPU; --quick: one hour, one record, fewer bounds.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from fig4 import LOCATIONS, location
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import stats
from threadpoolctl import threadpool_limits

from benchsim import arrays
from benchsim.arrays import Assumptions, Plant, Step, Truth
from benchsim.vector import deviation, solar_vector, sun_angles

Array = NDArray[np.float64]

LATITUDE, DAY = 40.4, 172
HOURS = (8.0, 12.0, 16.0)
LARGEST = 10e-3
NAMES = "abcdef"
COLOURS = ("#d7301f", "#1f78b4")


def plant_at(hour: float, count: int, assumptions: Assumptions) -> Plant:
    """The field of ``count`` heliostats, the six of Fig. 4 first, under the sun of June 21."""
    azimuth, elevation = sun_angles(np.radians(LATITUDE), DAY, hour)
    named = [location(text) for text in LOCATIONS][:count]
    return arrays.build(arrays.sector(named, count), solar_vector(azimuth, elevation), assumptions)


def crosses(plant: Plant, assumptions: Assumptions, heliostat: int, kind: int, misalignment: Array) -> bool:
    """Whether the vector model's trace goes through one of the arrays."""
    body = arrays.prism(plant, heliostat, kind, misalignment)
    points, real = deviation(body, plant.source, np.linspace(-0.13, 0.13, 5201))
    off, half = assumptions.array_offset, assumptions.array_half_length
    for across, along in ((1, 0), (0, 1)):
        side = points[:, across] - off
        through = (side[:-1] * side[1:] <= 0) & real[:-1] & real[1:]
        if np.any(through & (np.abs(points[:-1, along]) <= half)):
            return True
    return False


@dataclass(frozen=True)
class Hour:
    """Records of one hour: arrays (records, n, 2), bound (n, 2) [rad], outcomes (records, n)."""

    hour: float
    error: Array
    sigma: Array
    crossing_error: Array
    crossing_sigma: Array
    bound: Array
    outcome: NDArray[np.str_]
    distance: Array


def study(hour: float, count: int, records: int, bounds: int, seed: int, a: Assumptions) -> Hour:
    """Pulls and bounds of one hour."""
    rng = np.random.default_rng([seed, round(hour * 100), 1])
    plant = plant_at(hour, count, a)
    truth = arrays.draw_truth(plant, a, rng.uniform(-LARGEST, LARGEST, (count, 2)), rng)
    steady = arrays.background(plant, a, rng)
    light = arrays.clean(plant, a, truth)
    shape = (records, count, 2)
    error, sigma, c_error, c_sigma = (np.full(shape, np.nan) for _ in range(4))
    outcome = np.empty(shape[:2], dtype="U16")
    for r in range(records):
        found, _, _ = arrays.measure(arrays.record(plant, a, truth, steady, rng, light), plant)
        for m in found:
            k = m.heliostat
            outcome[r, k] = m.outcome
            error[r, k] = m.misalignment - truth.misalignment[k]
            sigma[r, k] = np.sqrt(np.diag(m.covariance))
            if m.by_crossings is not None:
                c_error[r, k] = m.by_crossings[0] - truth.misalignment[k]
                c_sigma[r, k] = np.sqrt(np.diag(m.by_crossings[1]))
    # information grows with the record's length: a fifth of it is enough, and five times faster
    short = replace(plant, samples=plant.samples // 5)
    bound = np.full((count, 2), np.nan)
    for k in range(min(bounds, count)):
        bound[k] = np.sqrt(np.diag(arrays.bound(short, a, truth, steady, k)) * short.samples / plant.samples)
    distance = np.linalg.norm(plant.heliostats, axis=1)
    return Hour(hour, error, sigma, c_error, c_sigma, bound, outcome, distance)


def run_loop(hour: float, count: int, seed: int, a: Assumptions) -> tuple[list[Step], NDArray[np.bool_]]:
    """Three steps of the loop, and whether both traces of each heliostat cross an array at the beginning."""
    rng = np.random.default_rng([seed, round(hour * 100), 2])
    plant = plant_at(hour, count, a)
    truth: Truth = arrays.draw_truth(plant, a, rng.uniform(-LARGEST, LARGEST, (count, 2)), rng)
    both = np.array([all(crosses(plant, a, k, kind, truth.misalignment[k]) for kind in range(2)) for k in range(count)])
    return arrays.close_loop(plant, a, truth, arrays.background(plant, a, rng), rng), both


def summary(name: str, values: Array) -> str:
    """Mean and standard deviation of pulls, with their own errors."""
    n = values.size
    s = values.std(ddof=1)
    return f"{name}: n {n}, std {s:.3f} ± {s / np.sqrt(2 * n):.3f}, mean {values.mean():+.3f} ± {s / np.sqrt(n):.3f}"


def tables(hours: list[Hour]) -> list[str]:
    """Lines of what the records say."""
    lines = []
    good = [h.outcome == "measured" for h in hours]
    counts = Counter(o for h in hours for o in h.outcome.ravel())
    lines.append("outcomes: " + ", ".join(f"{k} {v}" for k, v in counts.most_common()))
    pulls = np.concatenate([(h.error / h.sigma)[g] for h, g in zip(hours, good, strict=True)])
    lines.append(summary("pulls, elevation", pulls[:, 0]))
    lines.append(summary("pulls, azimuth", pulls[:, 1]))
    spread = pulls.std(axis=0)
    lines.append(f"  bar 0.9 to 1.15: {'met' if ((spread >= 0.9) & (spread <= 1.15)).all() else 'NOT met'}")
    beyond = [np.mean(np.abs(pulls) < s) for s in (1.0, 2.0)]
    lines.append(f"  within 1 and 2 sigma: {beyond[0]:.3f}, {beyond[1]:.3f} (0.683, 0.954)")
    other = np.concatenate([(h.error / h.sigma)[h.outcome == "steered"] for h in hours])
    if len(other):
        lines.append(summary("pulls of steered heliostats", other.ravel()))
    for name, error in (("all lines", "error"), ("crossings alone", "crossing_error")):
        ratio = np.concatenate(
            [((getattr(h, error) / h.bound) ** 2)[g] for h, g in zip(hours, good, strict=True)]
        ).ravel()
        ratio = ratio[np.isfinite(ratio)]
        mean, err = ratio.mean(), ratio.std() / np.sqrt(ratio.size)
        lines.append(f"error² over the bound, {name}: {mean:.3f} ± {err:.3f} (n {ratio.size})")
        if name == "all lines":
            lines.append(f"  bar 1.25: {'met' if mean <= 1.25 else 'NOT met'}")
    claimed = np.concatenate([((h.sigma / h.bound) ** 2)[g] for h, g in zip(hours, good, strict=True)]).ravel()
    claimed = claimed[np.isfinite(claimed)]
    lines.append(
        f"stated variance over the bound: median {np.median(claimed):.3f}, 5 to 95 % "
        f"{np.percentile(claimed, 5):.3f} to {np.percentile(claimed, 95):.3f}, largest {claimed.max():.3f}"
    )
    six = np.concatenate(
        [(h.error[:, :6] / h.bound[:6])[g[:, :6]] ** 2 for h, g in zip(hours, good, strict=True)]
    ).ravel()
    six = six[np.isfinite(six)]
    lines.append(
        f"error² over the bound, the six of Fig. 4: {six.mean():.3f} ± {np.sqrt(2 / six.size):.3f} (n {six.size})"
    )
    lines.append("heliostat  hour_h  sigma_elevation_mrad  sigma_azimuth_mrad  rms_error/sigma  error²/bound")
    for h in hours:
        for k, name in enumerate(NAMES[: h.error.shape[1]]):
            ok = h.outcome[:, k] == "measured"
            if not ok.any():
                lines.append(f"({name})        {h.hour:6g}  {h.outcome[0, k]}")
                continue
            s = 1e3 * h.sigma[ok, k].mean(axis=0)
            pull = np.sqrt(np.mean((h.error[ok, k] / h.sigma[ok, k]) ** 2))
            ratio = np.mean((h.error[ok, k] / h.bound[k]) ** 2)
            lines.append(f"({name})        {h.hour:6g}  {s[0]:20.4f}  {s[1]:18.4f}  {pull:15.2f}  {ratio:12.2f}")
    return lines


def loop_tables(loops: dict[float, tuple[list[Step], NDArray[np.bool_]]]) -> list[str]:
    """Lines of the loop."""
    lines = ["hour_h  both_cross  largest_mrad: before, after 1, 2, 3   over 0.1 mrad after 1, 2, 3"]
    worst = []
    for hour, (steps, both) in loops.items():
        largest = [np.abs(steps[0].before[both]).max()] + [np.abs(s.after[both]).max() for s in steps]
        over = [int((np.abs(s.after[both]).max(axis=1) > 1e-4).sum()) for s in steps]
        worst.append(largest[-1])
        lines.append(f"{hour:6g}  {both.sum():10d}  " + ", ".join(f"{1e3 * x:.3f}" for x in largest) + f"   {over}")
        for k in np.flatnonzero(~both):
            path = [np.abs(steps[0].before[k]).max()] + [np.abs(s.after[k]).max() for s in steps]
            outcomes = " → ".join(s.measurements[k].outcome for s in steps)
            lines.append(
                f"        heliostat {k}: a trace misses both arrays; {outcomes}; mrad "
                + ", ".join(f"{1e3 * x:.3f}" for x in path)
            )
    lines.append(f"  bar 0.1 mrad in three steps: {'met' if max(worst) <= 1e-4 else 'NOT met'}")
    return lines


def draw_pulls(hours: list[Hour]) -> Figure:
    """Pulls and errors against distance."""
    figure = Figure(figsize=(12.5, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1, 1.45])
    pulls = np.concatenate([(h.error / h.sigma)[h.outcome == "measured"] for h in hours])
    bins = np.linspace(-4.5, 4.5, 46)
    for k, kind in enumerate(arrays.KINDS):
        left.hist(pulls[:, k], bins, histtype="step", color=COLOURS[k], linewidth=1.6, label=f"{kind}")
    x = np.linspace(-4.5, 4.5, 300)
    left.plot(x, len(pulls) * (bins[1] - bins[0]) * stats.norm.pdf(x), color="#444444", linewidth=1.0, label="normal")
    left.set(xlabel="error / stated sigma", ylabel="heliostats × records")
    left.set_title(f"Pulls: std {pulls[:, 0].std():.3f} and {pulls[:, 1].std():.3f}", loc="left", fontsize=11)
    left.legend(frameon=False)
    for h in hours:
        far = np.broadcast_to(h.distance[:, None], h.bound.shape)
        rms = np.sqrt(np.ma.masked_invalid(h.error**2).mean(axis=0))
        for k in range(2):
            right.plot(far[:, k] / 1e6, 1e3 * rms[:, k], ".", color=COLOURS[k], markersize=4, alpha=0.8)
            right.plot(far[:, k] / 1e6, 1e3 * h.bound[:, k], "_", color="#222222", markersize=6, alpha=0.7)
    right.plot([], [], ".", color=COLOURS[0], label="rms error, elevation")
    right.plot([], [], ".", color=COLOURS[1], label="rms error, azimuth")
    right.plot([], [], "_", color="#222222", label="Cramér–Rao bound")
    right.set(xlabel="distance of the heliostat [km]", ylabel="misalignment [mrad]", yscale="log")
    records = hours[0].error.shape[0]
    right.set_title(f"Errors over {records} records of 20 s, three hours", loc="left", fontsize=11)
    right.legend(frameon=False)
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    return figure


def draw_loop(loops: dict[float, tuple[list[Step], NDArray[np.bool_]]]) -> Figure:
    """Misalignments step by step."""
    figure = Figure(figsize=(4.3 * len(loops), 4.3), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(loops), sharey=True))
    for axes, (hour, (steps, both)) in zip(panels, loops.items(), strict=True):
        path = np.abs(np.array([steps[0].before, *(s.after for s in steps)])) * 1e3
        at = np.arange(len(path))
        for k in range(2):
            axes.plot(at, path[:, both, k], color=COLOURS[k], linewidth=0.5, alpha=0.35)
        if (~both).any():
            axes.plot(at, path[:, ~both].reshape(len(path), -1), color="#222222", linewidth=1.0, linestyle=(0, (4, 2)))
        axes.axhline(0.1, color="#e6a100", linewidth=1.2)
        axes.set(yscale="log", ylim=(1e-4, 20), xticks=at, xlabel="corrections")
        axes.set_title(f"{hour:g} h: both traces cross for {both.sum()} of {len(both)}", loc="left", fontsize=10)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("|true misalignment| [mrad]")
    panels[-1].plot([], [], color=COLOURS[0], label="elevation")
    panels[-1].plot([], [], color=COLOURS[1], label="azimuth")
    panels[-1].plot([], [], color="#222222", linestyle=(0, (4, 2)), label="a trace misses at first")
    panels[-1].plot([], [], color="#e6a100", label="0.1 mrad")
    panels[-1].legend(frameon=False, fontsize=9)
    return figure


def main(argv: Sequence[str] | None = None) -> None:
    """Run, print, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--hours", type=float, nargs="+", default=list(HOURS), help="solar [h]")
    parser.add_argument("--count", type=int, default=100, help="heliostats (default %(default)s)")
    parser.add_argument("--records", type=int, default=5, help="per hour (default %(default)s)")
    parser.add_argument("--bounds", type=int, default=100, help="heliostats whose bound is computed")
    parser.add_argument("--no-loop", action="store_true")
    parser.add_argument("--quick", action="store_true", help="noon, one record, bounds of the six named heliostats")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the pictures (default ./out)")
    args = parser.parse_args(argv)
    if args.quick:
        args.hours, args.records, args.bounds = [12.0], 1, 6
    a, begun = Assumptions(), time.process_time()
    args.out.mkdir(parents=True, exist_ok=True)
    print(f"{args.count} heliostats at once, seed {args.seed}, {args.records} records of {a.duration:g} s per hour")
    hours = [study(h, args.count, args.records, args.bounds, args.seed, a) for h in args.hours]
    print("\n".join(tables(hours)), flush=True)
    draw_pulls(hours).savefig(args.out / "detector_pulls.png", dpi=130)
    if not args.no_loop:
        loops = {h: run_loop(h, args.count, args.seed, a) for h in args.hours}
        print("\n".join(loop_tables(loops)))
        draw_loop(loops).savefig(args.out / "detector_loop.png", dpi=130)
    print(f"pictures: {args.out}/detector_*.png; {time.process_time() - begun:.0f} s of CPU")


if __name__ == "__main__":
    with threadpool_limits(1):  # the matrices are small: threads would only wait for each other
        main()
