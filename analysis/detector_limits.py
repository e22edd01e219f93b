"""Where the detector arrays work, and where they cannot: pictures of crossings and spectra, tables of limits.

- ``detector_crossings.png``: the aligned traces of the six heliostats of ``fig4.py`` at 8, 12 and 16 h, the arrays, and
  where the traces of drawn misalignments were measured to cross them;
- ``detector_spectra.png``: one detector's samples and spectrum with 100 heliostats at once, labels in it, and one
  label's amplitude along an array;
- tables: labels against the record's length; how far a heliostat may be off before a trace misses; whether blocked can
  be told from missed; and what a plant that is not as stated does to errors and outcomes.

Seeds are fixed by --seed. About 3 min of CPU.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from detector_arrays import COLOURS, HOURS, LARGEST, NAMES, Array, crosses, plant_at
from fig4 import STYLES
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from threadpoolctl import threadpool_limits

from benchsim import arrays
from benchsim.arrays import KINDS, Assumptions, Plant
from benchsim.arrays.plant import beam
from benchsim.vector import deviation


def draw_crossings(a: Assumptions, seed: int) -> Figure:
    """Traces and crossings of six places and three hours."""
    figure = Figure(figsize=(12.9, 9.4), layout="constrained")
    panels = figure.subplots(2, 3).ravel()
    figure.suptitle(
        "Where the traces cross the arrays, June 21, 40.4° north", fontsize=13, x=0.01, ha="left", weight="bold"
    )
    off, half = a.array_offset / 1e3, a.array_half_length / 1e3
    for h, hour in enumerate(HOURS):
        rng = np.random.default_rng([seed, h, 3])
        plant = plant_at(hour, 6, a)
        truth = arrays.draw_truth(plant, a, rng.uniform(-LARGEST, LARGEST, (6, 2)), rng)
        record = arrays.record(plant, a, truth, arrays.background(plant, a, rng), rng)
        found, _, _ = arrays.measure(record, plant)
        for k, axes in enumerate(panels):
            for kind in range(2):
                for misalignment, width, alpha in ((np.zeros(2), 1.4, 1.0), (truth.misalignment[k], 0.7, 0.55)):
                    body = arrays.prism(plant, k, kind, misalignment)
                    points, real = deviation(body, plant.source, np.linspace(-0.3, 0.3, 2401))
                    points = np.where(real[:, None], points, np.nan) / 1e3
                    axes.plot(*points.T, color=COLOURS[kind], linewidth=width, alpha=alpha, linestyle=STYLES[h])
            for c in found[k].crossings:
                if c.state == "crosses":
                    at = (c.position / 1e3, off) if c.array == 0 else (off, c.position / 1e3)
                    axes.plot(*at, "o", color=COLOURS[c.kind], markersize=6, markeredgecolor="white", zorder=5)
    for k, axes in enumerate(panels):
        axes.add_patch(Rectangle((-7, -7), 14, 14, facecolor="#fdf3d0", edgecolor="#e6a100", linewidth=1.0, zorder=0.5))
        axes.plot([-half, half], [off, off], color="#222222", linewidth=3.0, alpha=0.35, solid_capstyle="butt")
        axes.plot([off, off], [-half, half], color="#222222", linewidth=3.0, alpha=0.35, solid_capstyle="butt")
        axes.set(xlim=(-24, 24), ylim=(-24, 24), aspect="equal", xlabel="y [m]", ylabel="z [m]")
        c = plant.heliostats[k] / 1e3
        label = f"({NAMES[k]})  heliostat at ({c[0]:.0f}, {c[1]:.0f}, {c[2]:.0f}) m".replace("-", "−")
        axes.set_title(label, fontsize=9.5, loc="left")
        axes.spines[["top", "right"]].set_visible(False)
    handles = [Line2D([], [], color=COLOURS[i], label=f"{KINDS[i]} prism") for i in range(2)]
    handles += [Line2D([], [], color="#444444", linestyle=STYLES[h], label=f"{HOURS[h]:g} h") for h in range(3)]
    handles += [
        Line2D([], [], color="#444444", linewidth=1.4, label="aligned"),
        Line2D([], [], color="#444444", linewidth=0.7, alpha=0.55, label="misaligned by up to 10 mrad"),
        Line2D([], [], color="#444444", marker="o", linestyle="none", label="measured crossing"),
        Line2D([], [], color="#222222", linewidth=3, alpha=0.35, label="arrays"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=9, frameon=False, fontsize=9)
    return figure


def draw_spectra(a: Assumptions, seed: int) -> Figure:
    """One record of 100 heliostats at noon, as one detector sees it, and one label along an array."""
    rng = np.random.default_rng([seed, 4])
    plant = plant_at(12.0, 100, a)
    truth = arrays.draw_truth(plant, a, rng.uniform(-LARGEST, LARGEST, (100, 2)), rng)
    light = arrays.clean(plant, a, truth)
    samples = arrays.record(plant, a, truth, arrays.background(plant, a, rng), rng, light)
    found, lines, noise = arrays.measure(samples, plant)
    i = int(np.argmin(np.abs(plant.along) + 1e6 * plant.member))
    figure = Figure(figsize=(12.9, 8.2), layout="constrained")
    top, middle, bottom = figure.subfigures(3, 1, height_ratios=[0.8, 1, 1.1])
    left, right = top.subplots(1, 2)
    t = np.arange(plant.samples) / plant.sample_rate
    left.plot(t, samples[i], color="#222222", linewidth=0.4)
    left.set(xlabel="time [s]", ylabel="irradiance [W/m²]")
    left.set_title("One detector: steady light and its flicker", fontsize=10, loc="left")
    part = slice(0, 100)
    right.plot(t[part], samples[i, part] - samples[i, part].mean(), color="#222222", linewidth=0.9, label="less mean")
    right.plot(t[part], light[i, part] - light[i, part].mean(), color=COLOURS[1], linewidth=0.9, label="prisms alone")
    right.set(xlabel="time [s]")
    right.set_title("A fifth of a second of it", fontsize=10, loc="left")
    right.legend(frameon=False, fontsize=8)
    window = np.hanning(plant.samples)
    f = np.fft.rfftfreq(plant.samples, 1 / plant.sample_rate)
    amplitude = 2 * np.abs(np.fft.rfft((samples[i] - samples[i].mean()) * window)) / window.sum()
    whole, near = middle.subplots(1, 2, width_ratios=[1.3, 1])
    for axes in (whole, near):
        axes.semilogy(f, amplitude, color="#222222", linewidth=0.5)
        axes.set(xlabel="frequency [Hz]", ylabel="amplitude [W/m²]")
    whole.set(xlim=(0, 250), ylim=(1e-6, 2))
    whole.axvspan(a.rate_low, a.rate_high, color="#fdf3d0", zorder=0)
    whole.set_title(
        "Its spectrum: flicker, then 200 labels (yellow), then the converter's end", fontsize=10, loc="left"
    )
    start = 150.0
    near.set(xlim=(start, start + 5), ylim=(1e-5, 0.2))
    for k in range(100):
        for kind in range(2):
            if start < plant.rates[k, kind] < start + 5:
                z = abs(lines.amplitude[k, kind, i])
                near.plot(plant.rates[k, kind], z, "o", color=COLOURS[kind], markersize=4)
                near.text(plant.rates[k, kind], 0.11, f"{k}", fontsize=7, ha="center", color=COLOURS[kind])
    near.set_title("Five hertz of it: heliostats, and their amplitudes here by least squares", fontsize=10, loc="left")
    for axes, (k, kind) in zip(bottom.subplots(1, 2), ((0, 0), (5, 1)), strict=True):
        on = plant.member == (0 if kind == 0 else 1)
        z = lines.amplitude[k, kind]
        model = arrays.response(arrays.prism(plant, k, kind, found[k].misalignment), plant)
        factor = np.vdot(model, z) / np.vdot(model, model).real
        turned = z * np.exp(-1j * np.angle(factor * np.where(model == 0, 1, model)))
        error = np.sqrt(np.diag(noise.density(plant.rates[k, kind]))[on] * lines.gain[k, kind])
        axes.errorbar(
            plant.along[on] / 1e3,
            1e3 * turned.real[on],
            1e3 * error,
            fmt=".",
            color="#222222",
            markersize=4,
            linewidth=0.8,
        )
        axes.plot(plant.along[on] / 1e3, 1e3 * np.abs(factor * model)[on], color=COLOURS[kind], linewidth=1.2)
        for c in found[k].crossings:
            if c.kind == c.array == kind and c.state == "crosses":
                axes.axvline(c.position / 1e3, color=COLOURS[kind], linewidth=0.8, linestyle=(0, (4, 2)))
        axes.set(xlabel=f"{'y' if kind == 0 else 'z'} along the {'horizontal' if kind == 0 else 'vertical'} array [m]")
        axes.set_ylabel("amplitude [mW/m²]")
        axes.set_title(
            f"({NAMES[k]}), {KINDS[kind]} prism, {plant.rates[k, kind]:.2f} Hz: in phase, fit; floor: common flicker",
            fontsize=10,
            loc="left",
        )
    for sub in (top, middle, bottom):
        for axes in sub.axes:
            axes.spines[["top", "right"]].set_visible(False)
    return figure


def close_labels(a: Assumptions, seed: int, records: int = 6) -> list[str]:
    """Two elevation prisms whose labels come closer and closer."""
    lines = ["labels apart [1/T]   variance × T   outcomes of the two   rms error / sigma of what is known"]
    plant = plant_at(12.0, 6, a)
    rng = np.random.default_rng([seed, 5])
    truth = arrays.draw_truth(plant, a, rng.uniform(-5e-3, 5e-3, (6, 2)), rng)
    steady = arrays.background(plant, a, rng)
    for apart in (0.0, 0.3, 0.7, 0.95, 1.0, 1.3, 2.0, 3.0):
        rates = plant.rates.copy()
        rates[5, 0] = rates[4, 0] + apart / plant.duration
        close = replace(plant, rates=rates)
        light = arrays.clean(close, a, truth)
        outcomes: Counter[str] = Counter()
        pulls, gain = [], 0.0
        for _ in range(records):
            found, apart_lines, _ = arrays.measure(arrays.record(close, a, truth, steady, rng, light), close)
            gain = float(apart_lines.gain[4, 0]) * close.duration
            for m in found[4:]:
                outcomes[m.outcome] += 1
                sigma = np.sqrt(np.diag(m.covariance))
                known = np.isfinite(sigma)
                pulls.extend(((m.misalignment - truth.misalignment[m.heliostat]) / sigma)[known])
        said = ", ".join(f"{k} {v}" for k, v in outcomes.items())
        rms = np.sqrt(np.mean(np.square(pulls)))
        lines.append(f"{apart:18.2f}   {gain:12.3g}   {said:20s}   {rms:.2f} (n {len(pulls)})")
    return lines


def reaches(a: Assumptions) -> list[str]:
    """How far off a heliostat may be, one angle at a time, until the trace that it moves crosses no array."""
    lines = ["heliostat  hour_h  misses from [mrad]: elevation −, +   azimuth −, +"]
    sizes = np.arange(1.0, 41.0) * 1e-3
    for hour in HOURS:
        plant = plant_at(hour, 6, a)
        for k in range(6):
            limits = []
            for component in range(2):
                for sign in (-1, 1):
                    way = sign * np.eye(2)[component]
                    gone = [s for s in sizes if not crosses(plant, a, k, 1 - component, s * way)]
                    limits.append(f"{1e3 * gone[0]:4.0f}" if gone else " >40")
            lines.append(f"({NAMES[k]})        {hour:6g}  {limits[0]:>24s}, {limits[1]}   {limits[2]:>9s}, {limits[3]}")
    return lines


def blocked(a: Assumptions, seed: int) -> list[str]:
    """Two heliostats of the six blocked, then two far out of range: what is said of each."""
    lines = ["hour_h  what                            outcomes"]
    for hour in HOURS:
        rng = np.random.default_rng([seed, round(hour), 6])
        plant = plant_at(hour, 6, a)
        truth = arrays.draw_truth(plant, a, rng.uniform(-LARGEST, LARGEST, (6, 2)), rng)
        steady = arrays.background(plant, a, rng)
        shut = truth.transmission.copy()
        shut[[0, 5]] = 0.0
        away = truth.misalignment.copy()
        away[[0, 5]] = 0.08, -0.08
        for what, changed in (
            ("(a) and (f) blocked", replace(truth, transmission=shut)),
            ("(a) and (f) 80 mrad off", replace(truth, misalignment=away)),
        ):
            found, _, _ = arrays.measure(arrays.record(plant, a, changed, steady, rng), plant)
            said = ", ".join(f"({NAMES[m.heliostat]}) {m.outcome}" for m in found)
            lines.append(f"{hour:6g}  {what:28s}    {said}")
        few = replace(a, array_half_length=14e3)
        short = plant_at(hour, 6, few)
        there = replace(truth, transmission=shut, misalignment=0 * truth.misalignment)
        samples = arrays.record(short, few, there, arrays.background(short, few, rng), rng)
        said = ", ".join(f"({NAMES[m.heliostat]}) {m.outcome}" for m in arrays.measure(samples, short)[0])
        lines.append(f"{hour:6g}  (a), (f) blocked, arrays ±14 m  {said}")
    return lines


def not_as_stated(a: Assumptions, seed: int) -> list[str]:
    """What 100 heliostats at noon come to if the plant is not as stated."""
    rng = np.random.default_rng([seed, 7])
    plant = plant_at(12.0, 100, a)
    truth = arrays.draw_truth(plant, a, rng.uniform(-LARGEST, LARGEST, (100, 2)), rng)
    steady = arrays.background(plant, a, rng)

    def spread(size: float) -> Array:
        facets = 1 + size * rng.standard_normal(truth.facet_reflectance.shape)
        return np.asarray(facets / facets.mean(axis=-1, keepdims=True))

    cases: list[tuple[str, Plant, arrays.Truth]] = [
        ("as stated", plant, truth),
        ("facets' reflectances 0.3 % rms", plant, replace(truth, facet_reflectance=spread(0.003))),
        ("facets' reflectances 2 % rms", plant, replace(truth, facet_reflectance=spread(0.02))),
        ("facets' slope errors 0.30 mrad", replace(plant, beam=beam(replace(a, facet_error=0.30e-3))), truth),
        ("detectors 10 mm beside", replace(plant, detectors=plant.detectors + np.array([0.0, 10.0, 10.0])), truth),
        ("rates 10 ppm rms off", plant, replace(truth, rate_error=10 * truth.rate_error)),
    ]
    lines = ["plant                              outcomes                                median|error| mrad  pulls_std"]
    for name, real, there in cases:
        light = arrays.clean(real, a, there)
        found, _, _ = arrays.measure(arrays.record(plant, a, there, steady, rng, light), plant)
        counts = Counter(m.outcome for m in found)
        said = ", ".join(f"{k} {v}" for k, v in counts.most_common())
        both = [m for m in found if np.isfinite(m.covariance).all()]
        error = np.array([m.misalignment - truth.misalignment[m.heliostat] for m in both])
        sigma = np.array([np.sqrt(np.diag(m.covariance)) for m in both])
        lines.append(f"{name:33s}  {said:40s}  {1e3 * np.median(np.abs(error)):16.4f}  {(error / sigma).std():9.2f}")
    return lines


def main(argv: Sequence[str] | None = None) -> None:
    """Draw and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--no-tables", action="store_true", help="pictures only")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the pictures (default ./out)")
    args = parser.parse_args(argv)
    a = Assumptions()
    args.out.mkdir(parents=True, exist_ok=True)
    draw_crossings(a, args.seed).savefig(args.out / "detector_crossings.png", dpi=130)
    draw_spectra(a, args.seed).savefig(args.out / "detector_spectra.png", dpi=130)
    if not args.no_tables:
        print(f"seed {args.seed}, records of {a.duration:g} s")
        for table in (close_labels(a, args.seed), reaches(a), blocked(a, args.seed), not_as_stated(a, args.seed)):
            print("\n".join(table), end="\n\n", flush=True)
    print(f"pictures: {args.out}/detector_crossings.png, {args.out}/detector_spectra.png")


if __name__ == "__main__":
    with threadpool_limits(1):  # the matrices are small: threads would only wait for each other
        main()
