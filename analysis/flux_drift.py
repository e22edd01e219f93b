"""Flux under drift: Table 1 and Figs 5 to 9 of Lara-Cerecedo et al. 2016.

What Table 1 determines, its own consistency, the analytic flux against a Monte Carlo in Mitsuba on its ten heliostats
(with errors, and with the share of slope errors that its Monte Carlo columns ask for), daily drift curves, and five
heliostats at 120 m through a solstice day with and without drift, aligned at 7:00. Fluxes are those of the command
``benchsim flux`` on the shipped plant ``five``, or on it with one of the table's heliostats.

    python analysis/flux_drift.py --seed 1 [--edge-m 6] [--quick] [-o DIR]
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from scipy.optimize import least_squares

import benchsim as bs
from benchsim.fluxes.day import Errors, Moment, aligned, clear_sky, deviated_normals, flux_at, image_centres
from benchsim.fluxes.heliostat import Heliostat, Target, ideal_normal
from benchsim.fluxes.table import TABLE, TOWER, Fit, Row, analytic, contradictions, fit_table, sun_at
from benchsim.jobs.flux_result import FluxResult
from benchsim.plant import days as plant_days
from benchsim.plant import files, sunshape
from benchsim.plant.model import Field, Optics, Plant

FIVE = files.read(Path(__file__).resolve().parents[1] / "scenes" / "plants" / "five")
"""The shipped plant: target, site and sky of all that follows."""
MRAD = 1e-3
LOCAL = -(4 * (110.96 - 105.0) + 1.6) / 60
"""True solar less local time in Hermosillo [h]: 110.96° W, time of 105° W, equation of time −1.6 min on June 21."""
SHARES = (0.0, 0.15, 0.3, 0.45)


def table(fit: Fit) -> None:
    print("Table 1 against itself: printed differences that do not follow from their own fluxes")
    for row, what, gap in contradictions():
        print(f"  ({row.x:g}, {row.y:g}) {what}: {gap:.2f} percentage points beyond rounding")
    f, s = fit.field, fit.sigma
    print(
        "\nTable 1 fitted (summer solstice, square mirror and target); lengths only as multiples of the total error σ"
    )
    print(f"  mirror   L/σ  {f.mirror / 1e3:.0f} m/rad ± {s[0]:.1%}")
    print(f"  target   T/σ  {f.target / 1e3:.0f} m/rad ± {s[1]:.1%}")
    print(
        f"  irradiance × reflectance  {f.irradiance:.0f} W/m² ± {s[2]:.0%}, "
        f"correlation with L/σ {fit.correlation[0, 2]:+.4f}"
    )
    print(f"  hour  {f.hour:.2f} ± {s[3]:.2f} if x counts east, {24 - f.hour:.2f} if west")
    product = math.sqrt(max(4 * s[0] ** 2 + s[2] ** 2 + 4 * fit.correlation[0, 2] * s[0] * s[2], 0.0))
    print(f"  irradiance × (L/σ)²  {f.irradiance * (f.mirror / 1e3) ** 2 / 1e6:.1f} MW/sr ± {product:.1%}")
    print(f"  {'x, y [m]':>16} {'peak':>6} {'model':>7} {'%':>6}   {'avg':>6} {'model':>7} {'%':>6}")
    for row, dp, da in zip(TABLE, fit.peak, fit.average, strict=True):
        peak, average = analytic(f, row)
        print(
            f"  {f'({row.x:g}, {row.y:g})':>16} {row.peak:6.0f} {peak:7.1f} {100 * dp:+6.2f}   "
            f"{row.average:6.1f} {average:7.2f} {100 * da:+6.2f}"
        )


def one(fit: Fit, row: Row, sigma: float, share: float, facets=(1, 1)) -> Plant:
    """The shipped plant with a row's heliostat in the place of its five, of the size that the total error asks for."""
    h, target = fit.field.heliostat(row, sigma, share), fit.field.receiver(sigma)
    receiver = replace(FIVE.receivers[0], width=target.width, height=target.height)
    nan = np.full(1, np.nan)
    field = Field(
        ("1",), np.array([h.position]), np.array([h.width]), np.array([h.height]), np.array([facets]), nan, nan,
        np.zeros(1, int), np.array([receiver.centre]),
    )  # fmt: skip
    return replace(FIVE, receivers=(receiver,), field=field, sun=sunshape.gaussian(h.sun), optics=Optics(h.slope))


def clock(solar: float) -> str:
    """The solstice's time in Hermosillo at a true solar one [h]."""
    seconds = round(3600 * (solar - LOCAL))
    return f"2016-06-21T{seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}"


def both(fit: Fit, row: Row, sigma: float, share: float, accuracy: float, seed: int, facets=(1, 1)) -> FluxResult:
    """``benchsim flux --engine both`` of a row's heliostat."""
    return bs.flux(
        one(fit, row, sigma, share, facets), at=clock(fit.field.hour), irradiance=fit.field.irradiance, errors="none",
        cells=60, engine="both", accuracy=accuracy, seed=seed,
    )  # fmt: skip


def ratios(fit: Fit, sigma: float, share: float, seed: int, accuracy: float, facets=(1, 1)) -> np.ndarray:
    """Monte Carlo over analytic less 1, (10, 4): peak, its error, average, its error."""
    out = []
    for k, row in enumerate(TABLE):
        (parting,) = both(fit, row, sigma, share, accuracy, 1000 * seed + k, facets).partings
        (p, pc, ps), (a, ac, es) = parting.peak, parting.power
        out.append([pc / p - 1, ps / p, ac / a - 1, es / a])
    return np.array(out)


def slope_share(fit: Fit, sigma: float, seed: int, accuracy: float) -> tuple[float, float, np.ndarray]:
    """The share of slope errors in σ² that the printed Monte Carlo over analytic asks for, its 1 σ, and all ratios."""
    made = np.array([ratios(fit, sigma, s, seed, accuracy) for s in SHARES])
    printed = np.array([[r.peak_mc / r.peak - 1, r.average_mc / r.average - 1] for r in TABLE])
    scale = np.array([0.01, 0.002])  # noise of peaks in a histogram; of averages

    def at(share: float) -> np.ndarray:
        return np.array([[np.polyval(np.polyfit(SHARES, made[:, k, j], 2), share) for j in (0, 2)] for k in range(10)])

    found = least_squares(lambda p: ((at(p[0]) - printed) / scale).ravel(), [0.2])
    s2 = found.fun @ found.fun / (found.fun.size - 1)
    return float(found.x[0]), float(np.sqrt(s2 / (found.jac[:, 0] @ found.jac[:, 0]))), made


def compare(fit: Fit, sigma: float, seed: int, accuracy: float, out: Path) -> None:
    share, error, made = slope_share(fit, sigma, seed, 2 * accuracy)
    slope = sigma * math.sqrt(max(share, 0.0)) / 2
    print(f"\nShare of the slopes in σ² that the Monte Carlo columns ask for: {share:.2f} ± {error:.2f}")
    print(
        f"  (with σ {1e3 * sigma:.1f} mrad: sun {1e3 * sigma * math.sqrt(1 - share):.1f}, slope {1e3 * slope:.1f} mrad)"
    )
    final = ratios(fit, sigma, share, seed + 1, accuracy)
    facets = ratios(fit, sigma, share, seed + 2, 2 * accuracy, (4, 4))
    distance = np.array([math.hypot(r.x, r.y, TOWER / 1e3) for r in TABLE])
    sun = fit.field.sun()
    incidence = [
        math.degrees(math.acos(float(ideal_normal((1e3 * r.x, 1e3 * r.y, 0), (0, 0, TOWER), sun) @ sun))) for r in TABLE
    ]
    print(
        f"  {'x, y [m]':>16} {'d [m]':>6} {'i [°]':>6}  {'peak: MC/analytic − 1 [%]':>27} {'printed':>8}"
        f"  {'average [%]':>17} {'printed':>8}"
    )
    for row, d, i, (p, ps, a, sa) in zip(TABLE, distance, incidence, final, strict=True):
        print(
            f"  {f'({row.x:g}, {row.y:g})':>16} {d:6.1f} {i:6.1f}  {100 * p:+20.2f} ± {100 * ps:.2f} "
            f"{100 * (row.peak_mc / row.peak - 1):+9.2f}  {100 * a:+10.3f} ± {100 * sa:.3f} "
            f"{100 * (row.average_mc / row.average - 1):+8.2f}"
        )
    print(
        f"  without slope errors: peak {100 * np.abs(made[0, :, 0]).max():.2f} % at most (± "
        f"{100 * made[0, :, 1].max():.2f}), average {100 * np.abs(made[0, :, 2]).max():.3f} %"
    )
    k = [r.x for r in TABLE].index(14.2)
    own = TABLE[k].peak * (1 + final[k, 0])
    print(
        f"  faulty row: analytic {TABLE[k].peak} times own ratio is {own:.0f} by Monte Carlo; "
        "printed are 2701 and 0.77 %, which would be 2636"
    )
    print(
        f"  4 × 4 canted facets against one mirror: peak {100 * np.abs(facets[:, 0] - final[:, 0]).max():.2f} %, "
        f"average {100 * np.abs(facets[:, 2] - final[:, 2]).max():.2f} % at most"
    )
    fig, axes = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    for ax, j, name in ((axes[0], 0, "peak"), (axes[1], 2, "average")):
        printed = [100 * (getattr(r, f"{name}_mc") / getattr(r, name) - 1) for r in TABLE]
        ax.plot(distance, printed, "kx", label="printed (SolTrace)")
        ax.errorbar(
            distance, 100 * final[:, j], 100 * final[:, j + 1], fmt="o", ms=4, label=f"slopes {share:.2f} of σ²"
        )
        ax.errorbar(
            distance, 100 * made[0, :, j], 100 * made[0, :, j + 1], fmt="s", ms=4, mfc="none", label="sun alone"
        )
        ax.axhline(0, color="gray", lw=0.7)
        ax.set(xlabel="distance to the target [m]", ylabel="Monte Carlo over analytic − 1 [%]", title=name)
    axes[0].legend()
    fig.savefig(out / "monte-carlo.png", dpi=110)
    plt.close(fig)
    maps(fit, sigma, share, seed, accuracy, out)


def maps(fit: Fit, sigma: float, share: float, seed: int, accuracy: float, out: Path) -> None:
    """As the paper's Figs 5 and 6: a near and a far heliostat, analytic and Monte Carlo."""
    fig, axes = plt.subplots(2, 3, figsize=(12, 7.4), layout="constrained")
    half = fit.field.receiver(sigma).width / 2e3
    for line, row in zip(axes, (TABLE[2], TABLE[7]), strict=True):
        result = both(fit, row, sigma, share, accuracy, seed)
        a, m = (1e3 * x[0] for x in (result.maps(), result.maps(result.carlo)))
        for ax, image, title in ((line[0], a, "analytic"), (line[1], m, "Monte Carlo"), (line[2], m - a, "difference")):
            big = np.abs(image).max()
            style = (
                {"cmap": "RdBu_r", "vmin": -big, "vmax": big}
                if title == "difference"
                else {"cmap": "inferno", "vmin": 0}
            )
            shown = ax.imshow(image.T, origin="lower", extent=(-half, half, -half, half), **style)
            fig.colorbar(shown, ax=ax, label="W/m²", shrink=0.8)
            ax.set(title=f"({row.x:g}, {row.y:g}) m: {title}", xlabel="east [m]", ylabel="up [m]", xlim=(half, -half))
    fig.savefig(out / "near-and-far.png", dpi=110)
    plt.close(fig)


def random_errors(rng: np.random.Generator) -> Errors:
    """The paper's range: between −3 and 3 mrad each, the tilt toward anywhere."""
    a, e, c = rng.uniform(-3, 3, 3) * MRAD
    return Errors(a, e, c, rng.uniform(0, 3) * MRAD, rng.uniform(0, 2 * math.pi))


def says(e: Errors) -> str:
    return (
        f"Δγ {e.azimuth / MRAD:+.1f}, Δβ {-e.elevation / MRAD:+.1f}, ξ {e.canting / MRAD:+.1f}, "
        f"ε {e.tilt / MRAD:.1f} mrad toward κ {math.degrees(e.toward):.0f}°"
    )


def curves(rng: np.random.Generator, out: Path) -> None:
    """As Fig. 7: the image's centre through the solstice for four heliostats and four sets of errors."""
    target = Target((0.0, 0.0, TOWER), 6000.0, 6000.0)
    local = np.arange(6.5, 18.51, 0.25)
    suns = np.array([sun_at(t + LOCAL) for t in local])
    places = [(0.0, 34.13), (-30.0, 60.0), (40.0, 100.0), (-67.5, 167.99)]
    sets = [random_errors(rng) for _ in range(4)]
    fig, axes = plt.subplots(2, 2, figsize=(11, 10), layout="constrained")
    for ax, e in zip(axes.ravel(), sets, strict=True):
        for x, y in places:
            c = image_centres((1e3 * x, 1e3 * y, 0.0), target, suns, e) / 1e3
            ax.plot(*c.T, label=f"({x:g}, {y:g}) m")
            for hour in (7, 12, 17):
                at = c[int(np.argmin(np.abs(local - hour)))]
                ax.plot(*at, ".", color=ax.lines[-1].get_color())
                ax.annotate(f"{hour}", at, fontsize=7, xytext=(3, 3), textcoords="offset points")
        ax.plot(0, 0, "k+")
        ax.invert_xaxis()
        ax.set(title=says(e), xlabel="east [m]", ylabel="up [m]", aspect="equal")
        ax.title.set_fontsize(9)
    axes[0, 0].legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.02, 1))
    fig.savefig(out / "drift-curves.png", dpi=110)
    plt.close(fig)


WAYS = {"drift, aim point shifted": "aim", "drift, angles shifted": "offset"}


def day_of(sets, times, by: str | None, cells: int = 81) -> list[Moment]:
    """Moments of a day of the five; ``by``: how spots are aligned at the first, None for heliostats without errors.

    The command shifts aims. Constants added to the angles are the room's: `benchsim.fluxes.day`.
    """
    if by == "offset":
        return by_angles(sets, times, cells)
    columns = [e.inside() for e in sets]
    errors = {n: np.concatenate([c[n] for c in columns]) for n in columns[0]} if by else {}
    plant = replace(FIVE, field=replace(FIVE.field, errors=errors))
    aligned = times[0] if by else None
    results = [bs.flux(plant, at=t, errors="stated", aligned=aligned, cells=cells) for t in times]
    return [Moment(1e3 * r.maps()[0], FIVE.receivers[0].target) for r in results]


def by_angles(sets, times, cells: int) -> list[Moment]:
    target, f = FIVE.receivers[0].target, FIVE.field
    suns = plant_days.suns([plant_days.at(t, FIVE.site) for t in times], FIVE.site)
    helios = [
        Heliostat(tuple(p), w, h, FIVE.sun.sigma, FIVE.optics.slope, FIVE.optics.reflectance)
        for p, w, h in zip(f.position, f.width, f.height, strict=True)
    ]
    normals = [
        deviated_normals(h.position, target, suns, e, aligned(h.position, target, suns[0], e, "offset"))
        for h, e in zip(helios, sets, strict=True)
    ]
    sky = clear_sky(suns)
    return [
        flux_at(helios, target, s, n, d, cells) for s, n, d in zip(suns, np.stack(normals, axis=1), sky, strict=True)
    ]


def five(rng: np.random.Generator, draws: int, out: Path) -> None:
    """As Figs 8 and 9: five heliostats at 120 m, ψ −60° to 60°, aligned at 7:00."""
    sets = [random_errors(rng) for _ in FIVE.field.ids]
    psi = np.degrees(np.arctan2(FIVE.field.position[:, 0], FIVE.field.position[:, 1]))
    print(f"\nFive heliostats at 120 m, 6 m × 6 m, σ {1e3 * FIVE.spread[0]:.1f} mrad, aligned at 7:00")
    for a, e in zip(psi, sets, strict=True):
        print(f"  ψ {a:+.0f}°: {says(e)}")
    local = np.arange(7.0, 17.01, 0.25)
    times = [f"2016-06-21T{int(h):02d}:{round(60 * (h % 1)):02d}" for h in local]
    days = {"ideal": day_of(sets, times, None)}
    days |= {name: day_of(sets, times, by) for name, by in WAYS.items()}
    five_maps({k: days[k] for k in list(days)[:2]}, local, out)

    fig, axes = plt.subplots(2, 3, figsize=(14, 7.5), layout="constrained")
    for name, day in days.items():
        parted = np.array([np.linalg.norm(m.centroid - m.brightest) / 1e3 for m in day])
        lines = (
            [m.peak / 1e3 for m in day],
            [m.average / 1e3 for m in day],
            [m.unevenness for m in day],
            [m.centroid[0] / 1e3 for m in day],
            [m.centroid[1] / 1e3 for m in day],
            parted,
        )
        for ax, values in zip(axes.ravel(), lines, strict=True):
            ax.plot(local, values, label=name)
        worst = int(np.argmax(parted))
        print(
            f"  {name}: peak {day[0].peak / 1e3:.1f} kW/m² at 7:00, {max(m.peak for m in day) / 1e3:.1f} at most, "
            f"{day[-1].peak / 1e3:.1f} at 17:00;\n    centroid and peak part by {parted[worst]:.2f} m at "
            f"{local[worst]:.2f} h, by more than 0.3 m in {np.mean(parted > 0.3):.0%} of the day"
        )
    names = (
        "peak [kW/m²]",
        "average [kW/m²]",
        "standard deviation over average",
        "centroid east [m]",
        "centroid up [m]",
        "centroid to peak [m]",
    )
    for ax, name in zip(axes.ravel(), names, strict=True):
        ax.set(xlabel="local time [h]", ylabel=name)

    # One set of errors is a draw: how it lies among many.
    hours = np.arange(7.0, 17.01, 1.0)
    ideal = np.array([m.peak for m in day_of(sets, times[::4], None, 41)])
    for k, (name, by) in enumerate(WAYS.items()):
        many = [day_of([random_errors(rng) for _ in sets], times[::4], by, 41) for _ in range(draws)]
        share = np.array([[m.peak for m in day] for day in many]) / ideal
        parted = np.array([[np.linalg.norm(m.centroid - m.brightest) for m in day] for day in many]) / 1e3
        low, middle, high = np.quantile(share, [0.05, 0.5, 0.95], axis=0)
        axes[0, 0].fill_between(hours, low * ideal / 1e3, high * ideal / 1e3, color=f"C{k + 1}", alpha=0.15)
        axes[1, 2].fill_between(hours, *np.quantile(parted, [0.05, 0.95], axis=0), color=f"C{k + 1}", alpha=0.15)
        print(
            f"  {draws} sets of errors, {name}: peak over ideal at 12:00 {middle[5]:.2f} (5 to 95 %: {low[5]:.2f} to "
            f"{high[5]:.2f}), at 17:00 {middle[10]:.2f} ({low[10]:.2f} to {high[10]:.2f}); centroid to peak at 17:00 "
            f"{np.median(parted[:, 10]):.2f} m, 95 % below {np.quantile(parted[:, 10], 0.95):.2f} m"
        )
    axes[0, 0].legend(title="shaded: 5 to 95 % of sets of errors", fontsize=8, title_fontsize=8)
    fig.savefig(out / "five-day.png", dpi=110)
    plt.close(fig)


def five_maps(days: dict, local: np.ndarray, out: Path) -> None:
    """The flux maps of two days at six hours."""
    top = max(m.peak for day in days.values() for m in day) / 1e3
    fig, axes = plt.subplots(4, 3, figsize=(11, 14.5), layout="constrained")
    for block, (name, day) in enumerate(days.items()):
        for k, hour in enumerate((7, 8, 10, 12, 15, 17)):
            ax = axes[2 * block + k // 3, k % 3]
            m = day[int(np.argmin(np.abs(local - hour)))]
            shown = ax.imshow(m.values.T / 1e3, origin="lower", extent=(-3, 3, -3, 3), cmap="inferno", vmin=0, vmax=top)
            ax.plot(*m.centroid / 1e3, "c+", ms=10)
            ax.plot(*m.brightest / 1e3, "wx", ms=7)
            ax.set(title=f"{name.split(',')[0]}, {hour}:00", xlim=(3, -3), xlabel="east [m]", ylabel="up [m]")
    fig.colorbar(shown, ax=axes, label="kW/m²", shrink=0.4)
    fig.suptitle("+ centroid, × peak")
    fig.savefig(out / "five-maps.png", dpi=90)
    plt.close(fig)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--edge-m", type=float, default=6.0, help="edge of the mirror, which the table does not determine"
    )
    parser.add_argument("--quick", action="store_true", help="a ninth of the rays")
    parser.add_argument("-o", "--out", type=Path, default=Path("flux-drift"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    fit = fit_table()
    table(fit)
    sigma = 1e3 * options.edge_m / fit.field.mirror
    compare(fit, sigma, options.seed, 3.0 if options.quick else 1.0, options.out)
    rng = np.random.default_rng(options.seed)
    curves(rng, options.out)
    five(rng, 10 if options.quick else 60, options.out)


if __name__ == "__main__":
    main()
