"""HelioPoint (seed paper 004) flown virtually: its budget, its Table 1, and its images.

    python analysis/drone.py [--seed 70401] [--flights 20] [--image-heliostats 2] [--out out]

images   a second realisation in Mitsuba: whole flights over single heliostats rendered frame by frame, mirrors and
         glints found in the pictures, against the float64 predictor; and the estimator on the pictures alone
budget   clusters drawn afresh, glints by the float64 predictor: angular differences, σ_mean, σ_sys, σ_tot, and how
         often the stated uncertainty covers the true optical axis (Wilson intervals), with and without the surface map
sources  every error source of Table 1 alone: what it does to the width of the differences and to the axis
pictures drone-frame.png, drone-convergence.png, drone-sources.png

Tables are in mrad unless they say mm.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import drone_pictures as draw
import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.spatial.distance import cdist

import benchsim  # noqa: F401  (before mitsuba)
from benchsim.bench.errors import BenchsimError
from benchsim.drones import picture
from benchsim.drones.estimate import axis_error, estimate
from benchsim.drones.finding import find_glints, find_mirror, to_mirror
from benchsim.drones.flight import (
    Errors,
    Flight,
    Heliostat,
    Sightings,
    camera_point,
    fly,
    half_of,
    pattern,
    read,
    rows,
    seen,
    stand,
)
from benchsim.drones.glints import glints
from benchsim.drones.heliostat import axes, design_map, four_facets
from benchsim.drones.survey import ACROSS, ALONG, DISTANCE, HALF, PITCH, Outcomes, survey

Array = NDArray[np.float64]

LEVELS = (0.6826894921, 0.95)
EDGE = 40.0
"""A glint nearer to its facet's edge is cut by it, or is only part of the lamp's image [mm]."""
APART = 80.0
"""Glints nearer to one another than that may run together [mm]."""
MATCH = 60.0
STRETCHED = 2.0
"""Of a glint's area against a flat mirror's: beyond, the image of the lamp's disc is long and bent, and so is what its
centroid means."""
OFFSETS = {
    "surface by design": (-0.14, 0.00, 0.01, -0.05, 0.18, 0.54, 0.19, 0.15, 0.34, -0.07),
    "measured surface": (-0.10, 0.01, 0.05, 0.07, 0.04, 0.55, 0.00, 0.20, 0.31, 0.04),
}
"""Table 3: offsets of five heliostats to the reference about x and y [mrad]."""
PAPER_DIRECTION = (214.0, 14.0)
"""Azimuth and elevation of the five heliostats of the paper's Tables 4 and 5 [deg]."""


def cluster(errors: Errors, count: int, seed: int, half=HALF) -> tuple[Flight, list[Heliostat], np.random.Generator]:
    """One flight at the paper's calibration point."""
    rng = np.random.default_rng(seed)
    azimuth, elevation = (math.radians(a) for a in PAPER_DIRECTION)
    target = camera_point(DISTANCE, azimuth, elevation)
    flight = fly(target, pattern(target, half, PITCH), errors, rng)
    return flight, stand(rows(count, ACROSS, ALONG, azimuth), four_facets(), target, errors, rng), rng


# images


@dataclass
class Tally:
    """What was found in pictures, beside what the predictor says."""

    clean: list[Array] = field(default_factory=list)
    stretched: list[Array] = field(default_factory=list)
    near_edge: list[Array] = field(default_factory=list)
    close: list[Array] = field(default_factory=list)
    missed: list[float] = field(default_factory=list)
    missed_special: int = 0
    extra: int = 0
    extra_of_disc: int = 0
    frames: int = 0
    refused: int = 0

    def add(self, found: Array, true: Array, strength: Array, disc: Array, design) -> None:
        """One frame's glints (n, 2) and (m, 2) [mm]; ``disc`` (k, 2): those of the rim of the lamp's disc."""

        def edge(points: Array) -> Array:
            away = np.abs(points[:, None] - design.centres) - np.array(design.size) / 2
            return np.abs(away.max(axis=-1).min(axis=1)) < EDGE

        near = cdist(true, true) + 1e9 * np.eye(len(true)) < APART
        special, close = edge(true), near.any(axis=1)
        distance = cdist(found, true)
        for i, p in enumerate(found):
            j = int(distance[i].argmin()) if len(true) else -1
            if j < 0 or distance[i, j] > MATCH:
                self.extra += 1
                self.extra_of_disc += int(len(disc) > 0 and cdist(p[None], disc).min() < MATCH)
            else:
                kind = self.stretched if strength[j] > STRETCHED else self.clean
                (self.close if close[j] else self.near_edge if special[j] else kind).append(p - true[j])
        for j in range(len(true)):
            if not len(found) or distance[:, j].min() > MATCH:
                self.missed_special += int(special[j] or close[j])
                if not (special[j] or close[j]):
                    self.missed.append(float(strength[j]))


def rms(rows_: Sequence[Array]) -> str:
    if not len(rows_):
        return "      none"
    x = np.array(rows_)
    mean, error = x.mean(axis=0), x.std(axis=0) / math.sqrt(len(x))
    return (
        f"n {len(x):4d}, rms {math.sqrt((x**2).mean()):5.2f} mm per component, median |.| {np.median(np.abs(x)):5.2f}, "
        f"mean ({mean[0]:+.2f} ± {error[0]:.2f}, {mean[1]:+.2f} ± {error[1]:.2f})"
    )


def images(count: int, seed: int, samples: int) -> None:
    """Flights rendered and read."""
    errors = Errors()
    flight, heliostats, rng = cluster(errors, count, seed, half=(2800.0, 2400.0))
    design, camera = four_facets(), picture.Camera()
    print(
        f"images (Mitsuba, {samples} samples per pixel, seed {seed}): {count} heliostats × {len(flight.cameras)} "
        "frames, "
        f"{DISTANCE / camera.focal:.1f} mm per pixel at {DISTANCE / 1e3:.0f} m"
    )
    tally, start, lines = Tally(), time.process_time(), []
    for h in heliostats:
        shots, near = picture.photographs(h, flight, camera, rng, samples)
        true = seen(h, flight)
        frames, points = [], []
        for f, (image, expected) in enumerate(zip(shots, near, strict=True)):
            tally.frames += 1
            try:
                corners = find_mirror(image, expected)
            except BenchsimError as error:
                tally.refused += 1
                print("   ", error)
                continue
            found = to_mirror(find_glints(image, corners), corners, design)
            own = true.frame == f
            turn = np.linspace(0, 2 * math.pi, 12, endpoint=False)
            rim = picture.LAMP_RADIUS * np.column_stack([np.cos(turn), np.sin(turn), 0 * turn]) @ axes(h.mount)[0].T
            eyes = np.tile(flight.cameras[f], (len(turn), 1))
            disc = glints(h.surface, h.mount, eyes, flight.lamps[f] + rim).points
            tally.add(found, true.points[own], true.strength[own], disc, design)
            frames.append(np.full(len(found), f))
            points.append(found)
        rendered = Sightings(np.concatenate(frames), np.concatenate(points))
        predicted = Sightings(true.frame, true.points)
        for name, reference in (("by design", design_map(design)), ("measured", h.measured)):
            row = []
            for sightings in (rendered, predicted):
                p = estimate(sightings, flight.said_cameras, flight.said_lamps, h.said, reference)
                row.append((p, axis_error(p, h.mount, h.axis)))
            (a, ea), (_, eb) = row
            lines.append(
                f"  {name:9s} {len(rendered.frame):6d} {(~a.kept).sum():4d}   "
                f"{1e3 * a.sigma_ad[0]:6.3f} {1e3 * a.sigma_ad[1]:6.3f}   {1e3 * a.sigma_mean[0]:6.3f} "
                f"{1e3 * a.sigma_mean[1]:6.3f}   {1e3 * ea[0]:+7.3f} {1e3 * ea[1]:+7.3f}   "
                f"{1e3 * (ea - eb)[0]:+7.3f} {1e3 * (ea - eb)[1]:+7.3f}   {a.p_normal[0]:.2f} {a.p_normal[1]:.2f}"
            )
    spent = time.process_time() - start
    print(
        f"  {tally.frames} frames, mirror found in {tally.frames - tally.refused}; "
        f"{spent / tally.frames:.2f} s CPU each"
    )
    print("  found − predicted (float64), in the mirror:")
    print(f"    clear of edges and of one another: {rms(tally.clean)}")
    print(f"    clear, but stretched more than {STRETCHED:.0f}:  {rms(tally.stretched)}")
    print(f"    within {EDGE:.0f} mm of a facet's edge:     {rms(tally.near_edge)}")
    print(f"    within {APART:.0f} mm of another:           {rms(tally.close)}")
    everything = tally.clean + tally.stretched + tally.near_edge + tally.close
    print(f"    all of them:                       {rms(everything)}")
    print(
        f"  predicted but not found: {len(tally.missed)} clear ones "
        f"(strengths {', '.join(f'{s:.2f}' for s in sorted(tally.missed)) or '-'}), {tally.missed_special} at edges or "
        f"close; found but not predicted: {tally.extra}, {tally.extra_of_disc} of them of the disc's rim alone"
    )
    print("  estimator on the rendered pictures alone:")
    print("  surface   glints  out   sigma_ad x  y   sigma_mean x  y   error of axis x  y   less predictor's x  y   p")
    print("\n".join(lines))


def monte_carlo(seed: int, samples: int) -> None:
    """The same frame twice with other random numbers: what of the centroids is Monte Carlo noise."""
    flight, (h, *_), rng = cluster(Errors(), 1, seed)
    camera, true = picture.Camera(), seen(h, flight)
    centre = axes(h.mount)[1]
    shapes = picture.mirrors([h], centre)
    apart: dict[int, list[Array]] = {samples: [], 4 * samples: []}
    for f in np.unique(true.frame)[::3]:
        view = picture.looking(flight.cameras[f], np.zeros(3))
        corners = picture.project(camera, view, picture.outline(axes(h.mount), four_facets().outline))
        window = picture.window_of(corners, 15)
        local = corners - [window[1].start, window[0].start]
        for spp, kept in apart.items():
            a, b = (
                find_glints(
                    picture.SKY
                    * picture.radiance(
                        shapes, centre, camera, view, flight.lamps[f], window, spp, int(rng.integers(2**31))
                    ),
                    local,
                )
                for _ in range(2)
            )
            if len(a) and len(b):
                d = cdist(a, b)
                kept += [a[i] - b[d[i].argmin()] for i in range(len(a)) if d[i].min() < 2]
    for spp, kept in apart.items():
        x = np.array(kept) / math.sqrt(2) * DISTANCE / camera.focal
        print(
            f"  Monte Carlo alone, {spp} samples: centroids {x.std():.2f} mm rms per component, "
            f"median |.| {np.median(np.abs(x)):.2f} (n = {len(x)})"
        )


# budget


def wilson(hits: int, n: int) -> str:
    ci = stats.binomtest(hits, n).proportion_ci(0.95, method="wilson")
    return f"{hits / n:.3f} [{ci.low:.3f}, {ci.high:.3f}]"


def budget_lines(name: str, o: Outcomes) -> list[str]:
    """Of one survey and reference surface."""
    mrad = 1e3
    total = np.hypot(o.sigma_mean, o.sigma_sys[:, None])
    n = o.error.size
    out = [
        f"  {name}: {len(o.error)} heliostats, {o.glints.mean():.0f} glints each in {o.frames.mean():.0f} frames "
        f"(fewest {o.glints.min()}), {o.outliers.mean():.1f} outliers removed",
        f"    sigma_ad median {mrad * np.median(o.sigma_ad):.3f} (5–95 %: {mrad * np.quantile(o.sigma_ad, 0.05):.2f}–"
        f"{mrad * np.quantile(o.sigma_ad, 0.95):.2f}), sigma_mean median {mrad * np.median(o.sigma_mean):.3f}, largest "
        f"{mrad * o.sigma_mean.max():.3f}; sigma_sys {mrad * o.sigma_sys.mean():.3f}, sigma_tot median "
        f"{mrad * np.median(total):.3f}, largest {mrad * total.max():.3f}",
        f"    true error rms {mrad * math.sqrt((o.error**2).mean()):.3f}; pull mean {o.pull.mean():+.3f} ± "
        f"{1 / math.sqrt(n):.3f}, std {o.pull.std():.3f} ± {1 / math.sqrt(2 * n):.3f}",
    ]
    for level in LEVELS:
        inside = np.abs(o.pull) < stats.norm.ppf((1 + level) / 2)
        out.append(
            f"    covers at {100 * level:.0f} %: x {wilson(int(inside[:, 0].sum()), len(inside))}, "
            f"y {wilson(int(inside[:, 1].sum()), len(inside))}, both together {wilson(int(inside.sum()), n)}"
        )
    if not o.sigma_sys.any():
        pull = o.error / o.sigma_mean_frames
        inside = [int((np.abs(pull) < stats.norm.ppf((1 + level) / 2)).sum()) for level in LEVELS]
        out.append(
            f"    with the glints of one frame as one draw: pull std {pull.std():.3f}, covers at 68 % "
            f"{wilson(inside[0], n)}, at 95 % {wilson(inside[1], n)}"
        )
    odd = o.p_normal < 0.05
    out.append(
        f"    Shapiro–Wilk below 0.05: {wilson(int(odd.sum()), n)}; pull std {o.pull[odd].std():.2f} there, "
        f"{o.pull[~odd].std():.2f} else; turns of the angles before outliers go: {np.bincount(o.turns).argmax()}"
    )
    return out


def budget(flights: int, seed: int) -> None:
    """The paper's budget, then what bends it."""
    base = Errors()
    cases: list[tuple[str, Errors, float]] = [
        ("as the paper states its errors", base, PITCH),
        ("glints read as well as in our rendered pictures (5 mm)", replace(base, detection=5.0), PITCH),
        ("with an absolute RTK error of 10 mm per flight, stated", replace(base, rtk_absolute=10.0), PITCH),
        ("no shifts at all: sigma_mean alone", replace(base, position=0.0, offset=0.0, tilt=0.0), PITCH),
        ("the same, slope errors 100 mm long", replace(base, position=0, offset=0, tilt=0, slope_scale=100.0), PITCH),
        ("the same, slope errors 500 mm long", replace(base, position=0, offset=0, tilt=0, slope_scale=500.0), PITCH),
        ("the same, 250 mm, pattern twice as fine", replace(base, position=0, offset=0, tilt=0), PITCH / 2),
    ]
    print(f"\nbudget (float64 predictor, seeds {seed}–{seed + len(cases) - 1})")
    for k, (title, errors, pitch) in enumerate(cases):
        n = flights if k < 4 else max(2, flights // 2)
        both = survey(errors, seed + k, n, pitch=pitch)
        print(f" {title} (seed {seed + k}, {n} flights)")
        for name, o in zip(("surface by design", "measured surface"), both, strict=True):
            print("\n".join(budget_lines(name, o)))
            if k == 0:
                total = 1e3 * np.median(np.hypot(o.sigma_mean, o.sigma_sys[:, None]))
                offsets = np.array(OFFSETS[name])
                chi2 = float((offsets**2).sum() / total**2)
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
    errors: Errors
    half: bool = False


SOURCES = (
    Source("RTK relative, 10 mm", "x", "–", Errors.none(rtk_relative=10.0)),
    Source("RTK absolute, 10 mm", "–", "(x)", Errors.none(rtk_absolute=10.0)),
    Source("glint detection, 20 mm", "x", "–", Errors.none(detection=20.0)),
    Source("heliostat position, 10 mm", "–", "x", Errors.none(position=10.0)),
    Source("kinematics: 30 mm and 2 mrad", "x", "x", Errors.none(offset=30.0, tilt=2e-3)),
    Source("  30 mm alone", "", "", Errors.none(offset=30.0)),
    Source("  tilt of 2 mrad alone", "", "", Errors.none(tilt=2e-3)),
    Source("surface, zero mean, 0.7 mrad", "x", "–", Errors.none(slope=0.7e-3)),
    Source("canting 0.4 mrad, whole mirror", "–", "–", Errors.none(canting=0.4e-3)),
    Source("canting 0.4 mrad, right half", "–", "x", Errors.none(canting=0.4e-3), half=True),
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
    """Table 1, one survey per row."""
    print(f"\nsources (float64 predictor, seeds {seed}–{seed + len(SOURCES) - 1}, {12 * flights} heliostats each)")
    print(f"  {'':32s} {'':8s}  {'':9s}   {'':16s}  error / sigma_mean  Shapiro  broadens       shifts")
    print(f"  {'':32s} sigma_ad sigma_mean   error of axis        plain by frames  p<.05  found printed  found printed")
    out = []
    for k, s in enumerate(SOURCES):
        o = survey(s.errors, seed + k, flights, **({"only": half_of} if s.half else {}))[0]
        # a flight's absolute error is one draw for all its heliostats
        by_flight = (o.error**2).reshape(flights, -1).mean(axis=1)
        mean = by_flight.mean()
        e = Effect(
            s,
            math.sqrt((o.sigma_ad**2).mean()),
            math.sqrt((o.sigma_mean**2).mean()),
            math.sqrt((o.sigma_mean_frames**2).mean()),
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


def frame_picture(seed: int, out: Path, samples: int) -> None:
    """One frame over the whole cluster, with what was found in it."""
    flight, heliostats, rng = cluster(Errors(), 12, seed)
    camera, design = picture.Camera(), four_facets()
    counts = np.sum([np.bincount(seen(h, flight).frame, minlength=len(flight.cameras)) for h in heliostats], axis=0)
    f = int(counts.argmax())
    view = picture.looking(flight.cameras[f], np.zeros(3), picture.GIMBAL * rng.standard_normal(2))
    said = picture.looking(flight.said_cameras[f], np.zeros(3))
    window = picture.window_of(
        np.concatenate(
            [picture.project(camera, view, picture.outline(axes(h.mount), design.outline)) for h in heliostats]
        ),
        60,
    )
    shapes = picture.mirrors(heliostats, np.zeros(3))
    light = picture.radiance(shapes, np.zeros(3), camera, view, flight.lamps[f], window, samples, seed)
    image = picture.photograph(light, rng)
    start = np.array([window[1].start, window[0].start])
    mirrors, spots = [], []
    for h in heliostats:
        near = picture.project(camera, said, picture.outline(axes(h.said), design.outline)) - start
        # cut out by what drone and plant say: that is how a mirror gets its heliostat's name
        cut = picture.window_of(near, 45)
        low = np.array([max(cut[1].start, 0), max(cut[0].start, 0)])
        part = image[low[1] : cut[0].stop, low[0] : cut[1].stop]
        corners = find_mirror(part, near - low)
        mirrors.append(corners + low)
        spots.append(find_glints(part, corners) + low)
    off = [
        np.linalg.norm(
            m + start - picture.project(camera, view, picture.outline(axes(h.mount), design.outline)), axis=1
        )
        for h, m in zip(heliostats, mirrors, strict=True)
    ]
    print(
        f"\nframe {f} of seed {seed}: {len(mirrors)} mirrors identified, corners {np.median(off):.2f} px off "
        f"(median; worst {np.max(off):.2f}), "
        f"{sum(map(len, spots))} glints found, {counts[f]} predicted"
    )
    title = f"Frame {f}: {len(mirrors)} heliostats, {sum(map(len, spots))} glints found"
    draw.save(draw.frame(image, mirrors, spots, title), out / "drone-frame.png")


def convergence_picture(seed: int, out: Path) -> None:
    """How the tracking angles come to rest, and what is left of the differences."""
    errors = Errors()
    flight, heliostats, rng = cluster(errors, 12, seed)
    ideal = design_map(four_facets())
    found = []
    for h in heliostats:
        sightings = read(seen(h, flight), len(flight.cameras), four_facets(), errors, rng)
        found.append(
            tuple(
                estimate(sightings, flight.said_cameras, flight.said_lamps, h.said, reference)
                for reference in (ideal, h.measured)
            )
        )
    steps = [1e3 * np.abs(p.steps[: p.second]).max(axis=1) for p, _ in found]
    print("mean difference before each turn, largest of 12 heliostats [mrad]:", end=" ")
    print(", ".join(f"{max(s[i] for s in steps if len(s) > i):.2g}" for i in range(max(map(len, steps)))))
    draw.save(draw.convergence(found), out / "drone-convergence.png")


def main(argv: Sequence[str] | None = None) -> None:
    """All parts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=70401)
    parser.add_argument("--flights", type=int, default=20, help="of 12 heliostats (default %(default)s)")
    parser.add_argument("--image-heliostats", type=int, default=2, help="whole flights to render; 0: no pictures")
    parser.add_argument("--samples", type=int, default=16, help="per rendered pixel (default %(default)s)")
    parser.add_argument("--parts", nargs="+", default=["images", "budget", "sources", "pictures"])
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the pictures (default ./out)")
    args = parser.parse_args(argv)
    args.out.mkdir(parents=True, exist_ok=True)
    if "images" in args.parts and args.image_heliostats:
        images(args.image_heliostats, args.seed, args.samples)
        monte_carlo(args.seed + 1, args.samples)
    if "budget" in args.parts:
        budget(args.flights, args.seed + 10)
    if "sources" in args.parts:
        effects = sources(max(4, args.flights // 2), args.seed + 30)
        draw.save(draw.sources(effects), args.out / "drone-sources.png")
    if "pictures" in args.parts:
        convergence_picture(args.seed + 50, args.out)
        if args.image_heliostats:
            frame_picture(args.seed + 50, args.out, args.samples)


if __name__ == "__main__":
    main()
