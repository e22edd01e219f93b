"""HelioPoint's tables and its budget, from `benchsim drone` on its plant.

    python analysis/drone.py [--seed 70401] [--flights 20] [--out out]

tables   what `benchsim drone plan scenes/plants/heliopoint --fly --seed 70401` tells, with either surface, beside the
         paper's Tables 2 and 3
budget   many flights of the command toward other points: angular differences, σ_mean, σ_sys, σ_tot, and how often the
         stated uncertainty covers the true optical axis (Wilson intervals), with and without the surface map
sources  every error source of Table 1 alone: what it does to the width of the differences and to the axis
pictures drone-convergence.png, drone-sources.png

Tables are in mrad. `drone_images.py` is the same in Mitsuba.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import drone_pictures as draw
import numpy as np
from numpy.typing import NDArray
from scipy import stats

import benchsim as bs
from benchsim.drones.estimate import axis_error, estimate
from benchsim.drones.flight import Sightings
from benchsim.drones.heliostat import design_map
from benchsim.jobs.drone_cluster import clusters
from benchsim.jobs.drone_flown import Flown
from benchsim.plant import files
from benchsim.plant.model import Plant

Array = NDArray[np.float64]

PLANT = files.read(Path(__file__).resolve().parents[1] / "scenes" / "plants" / "heliopoint")
SURFACES = {"design": "surface by design", "measured": "measured surface"}
LEVELS = (0.6826894921, 0.95)
MEANS = {
    "design": (0.14, 0.19, 0.11, 0.13, 0.11, 0.08, 0.10, 0.13, 0.13, 0.15),
    "measured": (0.02, 0.03, 0.03, 0.03, 0.02, 0.03, 0.03, 0.04, 0.02, 0.03),
}
NORMAL = {
    "design": (0.31, 0.21, 0.63, 0.33, 0.12, 0.94, 0.26, 0.78, 0.22, 0.09),
    "measured": (0.38, 0.73, 0.18, 0.88, 0.61, 0.01, 0.93, 0.49, 0.20, 0.05),
}
"""Table 2: σ_mean of five heliostats about x and y [mrad], and p."""
OFFSETS = {
    "design": (-0.14, 0.00, 0.01, -0.05, 0.18, 0.54, 0.19, 0.15, 0.34, -0.07),
    "measured": (-0.10, 0.01, 0.05, 0.07, 0.04, 0.55, 0.00, 0.20, 0.31, 0.04),
}
"""Table 3: offsets to the reference [mrad]."""


# the command


def plant(base: Plant = PLANT, slope: float | None = None, **drone: float) -> Plant:
    """The paper's, with something of it changed: `DroneFlight`, and the slope [rad]."""
    optics = base.optics if slope is None else replace(base.optics, slope=slope)
    return replace(base, optics=optics, drone=replace(base.drone, **drone))


ERRORS = ("relative", "absolute", "detection", "position", "kinematics", "tilt", "canting", "map_slope", "false_glints")
UNSHIFTED = {"position": 0.0, "kinematics": 0.0, "tilt": 0.0}


def only(**sizes: float) -> Plant:
    """The paper's with all errors off but these, and the tracking errors, which are what is looked for."""
    return plant(**({"slope": 0.0} | dict.fromkeys(ERRORS, 0.0) | sizes))


def command(p: Plant, seed: int, surface: str) -> Iterable[Flown]:
    """One flight."""
    flown = bs.drone(p, virtual=True, surface=surface, seed=seed).flown
    assert flown is not None
    return flown.values()


def right_half(p: Plant, seed: int, surface: str) -> Iterable[Flown]:
    """The same, by the glints on the mirrors' right half alone: what a route that is not symmetric leaves."""
    (c,) = clusters(p)
    for k, flight, h, s in c.fly(np.random.default_rng([seed, 48])):
        kept = s.points[:, 0] > 0
        half = Sightings(s.frame[kept], s.points[kept])
        reference = design_map(c.design(k)) if surface == "design" else h.measured
        e = estimate(half, flight.said_cameras, flight.said_lamps, h.said, reference)
        yield Flown(len(half.frame), len(np.unique(half.frame)), c.sigma(k)[2], e, axis_error(e, h.mount, h.axis))


Fly = Callable[[Plant, int, str], Iterable[Flown]]


class Outcomes:
    """Flights over the plant toward points drawn afresh: heliostats (rows) about x and y (columns) [rad]."""

    def __init__(self, p: Plant, seed: int, flights: int, surface: str = "design", fly: Fly = command) -> None:
        rng, self.flown = np.random.default_rng(seed), []
        for _ in range(flights):
            azimuth, elevation = rng.uniform(-math.pi, math.pi), math.radians(rng.uniform(13, 40))
            there = plant(p, azimuth=azimuth, elevation=elevation)
            self.flown += list(fly(there, int(rng.integers(2**31)), surface))
        self.error, self.sigma_sys = self.of("error"), self.of("sigma_sys")
        names = ("sigma_ad", "sigma_mean", "sigma_mean_frames", "p_normal")
        self.sigma_ad, self.sigma_mean, self.by_frames, self.p_normal = (self.said(n) for n in names)
        self.total = np.hypot(self.sigma_mean, self.sigma_sys[:, None])

    def of(self, name: str) -> Array:
        return np.array([getattr(x, name) for x in self.flown])

    def said(self, name: str) -> Array:
        return np.array([getattr(x.pointing, name) for x in self.flown])


def tables(seed: int) -> None:
    """Tables 2 and 3: the plant as it is shipped."""
    print(f"tables (the shipped plant, seed {seed}; the paper's in brackets)")
    for surface, name in SURFACES.items():
        rows = bs.drone(PLANT, virtual=True, surface=surface, seed=seed).rows()
        mean, p, off = (
            np.array([[r[f"{k}{a}{unit}"] for a in "xy"] for r in rows])
            for k, unit in (("flown_sigma_mean_", "_mrad"), ("p_normal_", ""), ("error_", "_mrad"))
        )
        printed = [np.array(x[surface]) for x in (MEANS, NORMAL, OFFSETS)]
        print(
            f"  {name}: sigma_mean {mean.min():.2f} to {mean.max():.2f} ({printed[0].min():.2f} to "
            f"{printed[0].max():.2f}); p below 0.05 of {(p < 0.05).mean():.2f} ({(printed[1] < 0.05).mean():.2f}); "
            f"offsets {math.sqrt((off**2).mean()):.2f} rms, at most {np.abs(off).max():.2f} "
            f"({math.sqrt((printed[2] ** 2).mean()):.2f}, {np.abs(printed[2]).max():.2f})"
        )


# budget


def wilson(hits: int, n: int) -> str:
    ci = stats.binomtest(hits, n).proportion_ci(0.95, method="wilson")
    return f"{hits / n:.3f} [{ci.low:.3f}, {ci.high:.3f}]"


def covered(name: str, pull: Array) -> str:
    """How often the stated uncertainty covers the truth."""
    said = []
    for level in LEVELS:
        inside = np.abs(pull) < stats.norm.ppf((1 + level) / 2)
        each = ", ".join(f"{axis} {wilson(int(x.sum()), len(x))}" for axis, x in zip("xy", inside.T, strict=True))
        said.append(f"at {100 * level:.0f} % {wilson(int(inside.sum()), pull.size)} ({each})")
    n = pull.size
    return (
        f"    {name}pull mean {pull.mean():+.3f} ± {1 / math.sqrt(n):.3f}, std {pull.std():.3f} ± "
        f"{1 / math.sqrt(2 * n):.3f}; covers {', '.join(said)}"
    )


def budget_lines(name: str, o: Outcomes) -> list[str]:
    """Of one case and reference surface."""
    mrad, pull, odd = 1e3, o.error / o.total, o.p_normal < 0.05
    read, turns = o.of("glints"), np.array([x.pointing.second - 1 for x in o.flown])
    out = [
        f"  {name}: {len(o.error)} heliostats, {read.mean():.0f} glints each in {o.of('pictures').mean():.0f} frames "
        f"(fewest {read.min()}), {np.mean([(~x.pointing.kept).sum() for x in o.flown]):.1f} outliers removed",
        f"    sigma_ad median {mrad * np.median(o.sigma_ad):.3f} (5–95 %: {mrad * np.quantile(o.sigma_ad, 0.05):.2f}–"
        f"{mrad * np.quantile(o.sigma_ad, 0.95):.2f}), sigma_mean median {mrad * np.median(o.sigma_mean):.3f}, largest "
        f"{mrad * o.sigma_mean.max():.3f}; sigma_sys {mrad * o.sigma_sys.mean():.3f}, sigma_tot median "
        f"{mrad * np.median(o.total):.3f}, largest {mrad * o.total.max():.3f}",
        covered(f"true error rms {mrad * math.sqrt((o.error**2).mean()):.3f}; ", pull),
    ]
    if not o.sigma_sys.any():
        out.append(covered("with the glints of one frame as one draw: ", o.error / o.by_frames))
    out.append(
        f"    Shapiro–Wilk below 0.05: {wilson(int(odd.sum()), odd.size)}; pull std {pull[odd].std():.2f} there, "
        f"{pull[~odd].std():.2f} else; turns of the angles before outliers go: {np.bincount(turns).argmax()}"
    )
    return out


def budget(flights: int, seed: int) -> None:
    """The paper's budget, then what bends it."""
    cases = (
        ("as the paper states its errors", plant()),
        ("glints read as well as in our rendered pictures (5 mm)", plant(detection=5.0)),
        ("with an absolute RTK error of 10 mm per flight, stated", plant(absolute=10.0)),
        ("no shifts at all: sigma_mean alone", plant(**UNSHIFTED)),
        ("the same, slope errors 100 mm long", plant(**UNSHIFTED, length=100.0)),
        ("the same, slope errors 500 mm long", plant(**UNSHIFTED, length=500.0)),
        ("the same, 250 mm, pattern twice as fine", plant(**UNSHIFTED, pitch=PLANT.drone.pitch / 2)),
    )
    print(f"\nbudget (float64 predictor, seeds {seed}–{seed + len(cases) - 1})")
    for k, (title, p) in enumerate(cases):
        n = flights if k < 4 else max(2, flights // 2)
        print(f" {title} (seed {seed + k}, {n} flights)")
        for surface, name in SURFACES.items():
            o = Outcomes(p, seed + k, n, surface)
            print("\n".join(budget_lines(name, o)), flush=True)
            if k == 0:
                offsets = np.array(OFFSETS[surface])
                chi2 = float((offsets**2).sum() / (1e3 * np.median(o.total)) ** 2)
                print(
                    f"    the paper's ten offsets (Table 3): rms {math.sqrt((offsets**2).mean()):.2f} mrad; with this "
                    f"sigma_tot chi² {chi2:.1f} for 10, p = {stats.chi2.sf(chi2, 10):.2f}"
                )


# sources


@dataclass(frozen=True)
class Source:
    """A row of Table 1: what the paper says of it, and how it is switched on."""

    name: str
    broadens: str
    shifts: str
    plant: Plant
    fly: Fly = command


SOURCES = (
    Source("RTK relative, 10 mm", "x", "–", only(relative=10.0)),
    Source("RTK absolute, 10 mm", "–", "(x)", only(absolute=10.0)),
    Source("glint detection, 20 mm", "x", "–", only(detection=20.0)),
    Source("heliostat position, 10 mm", "–", "x", only(position=10.0)),
    Source("kinematics: 30 mm and 2 mrad", "x", "x", only(kinematics=30.0, tilt=2e-3)),
    Source("  30 mm alone", "", "", only(kinematics=30.0)),
    Source("  tilt of 2 mrad alone", "", "", only(tilt=2e-3)),
    Source("surface, zero mean, 0.7 mrad", "x", "–", only(slope=0.7e-3)),
    Source("canting 0.4 mrad, whole mirror", "–", "–", only(canting=0.4e-3)),
    Source("canting 0.4 mrad, right half", "–", "x", only(canting=0.4e-3), right_half),
)
BROADENS = 2e-6
"""σ_ad above which a source broadens [rad]; a shift alone leaves below 0.001 mrad, for angles differ a little over a
mirror."""
SHIFTS = 2.0
"""A source shifts if the axis' error is that many times what σ_mean says of it: between 1 and 2 it is still a mean's
scatter, with glints that are not independent."""


@dataclass(frozen=True)
class Effect:
    """What a source did alone [rad]: rms width, rms σ_mean (also by frames), rms error with its standard error."""

    source: Source
    width: float
    sigma_mean: float
    by_frames: float
    error: float
    error_se: float
    odd: float

    @property
    def broadens(self) -> bool:
        return self.width > BROADENS

    @property
    def shifts(self) -> bool:
        return self.error > SHIFTS * self.sigma_mean

    @property
    def agrees(self) -> bool:
        s = self.source
        return self.broadens == (s.broadens == "x") and self.shifts == ("x" in s.shifts)


def sources(flights: int, seed: int) -> list[Effect]:
    """Table 1."""
    print(f"\nsources (float64 predictor, seeds {seed}–{seed + len(SOURCES) - 1}, {12 * flights} heliostats each)")
    print(f"  {'':32s} {'':8s}  {'':9s}   {'':16s}  error / sigma_mean  Shapiro  broadens       shifts")
    print(f"  {'':32s} sigma_ad sigma_mean   error of axis        plain by frames  p<.05  found printed  found printed")
    out = []
    for k, s in enumerate(SOURCES):
        o = Outcomes(s.plant, seed + k, flights, fly=s.fly)
        # a flight's absolute error is one draw for all its heliostats
        by_flight = (o.error**2).reshape(flights, -1).mean(axis=1)
        mean = by_flight.mean()
        e = Effect(
            s,
            math.sqrt((o.sigma_ad**2).mean()),
            math.sqrt((o.sigma_mean**2).mean()),
            math.sqrt((o.by_frames**2).mean()),
            math.sqrt(mean),
            by_flight.std(ddof=1) / math.sqrt(flights) / (2 * math.sqrt(mean)),
            float((o.p_normal < 0.05).mean()),
        )
        out.append(e)
        marks = f"{'x' if e.broadens else '–':5s} {s.broadens:7s}  {'x' if e.shifts else '–':5s} {s.shifts:7s}"
        print(
            f"  {s.name:32s} {1e3 * e.width:8.4f}  {1e3 * e.sigma_mean:9.4f}   {1e3 * e.error:7.4f} ± "
            f"{1e3 * e.error_se:.4f}  {e.error / e.sigma_mean:7.2f}  {e.error / e.by_frames:7.2f}  {e.odd:7.2f}  "
            f"{marks}{'' if e.agrees or not s.broadens else '  differs'}"
        )
    return out


# pictures


def convergence_picture(seed: int, out: Path) -> None:
    """How the tracking angles come to rest, and what is left of the differences."""
    found = list(zip(*([x.pointing for x in command(PLANT, seed, s)] for s in SURFACES), strict=True))
    steps = [1e3 * np.abs(p.steps[: p.second]).max(axis=1) for p, _ in found]
    print("mean difference before each turn, largest of 12 heliostats [mrad]:", end=" ")
    print(", ".join(f"{max(s[i] for s in steps if len(s) > i):.2g}" for i in range(max(map(len, steps)))))
    draw.save(draw.convergence(found), out / "drone-convergence.png")


def main(argv: Sequence[str] | None = None) -> None:
    """All parts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=70401)
    parser.add_argument("--flights", type=int, default=20, help="of 12 heliostats (default %(default)s)")
    parser.add_argument("--parts", nargs="+", default=["tables", "budget", "sources", "pictures"])
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the pictures (default ./out)")
    args = parser.parse_args(argv)
    args.out.mkdir(parents=True, exist_ok=True)
    if "tables" in args.parts:
        tables(args.seed)
    if "budget" in args.parts:
        budget(args.flights, args.seed + 10)
    if "sources" in args.parts:
        effects = sources(max(4, args.flights // 2), args.seed + 30)
        draw.save(draw.sources(effects), args.out / "drone-sources.png")
    if "pictures" in args.parts:
        convergence_picture(args.seed + 50, args.out)


if __name__ == "__main__":
    main()
