"""HelioPoint's plant flown over in Mitsuba: what is found in pictures, beside what float64 computes.

    python analysis/drone_images.py [--seed 70401] [--heliostats 2] [--samples 16] [--out out]

Whole flights over single heliostats rendered frame by frame, mirrors and glints found in the pictures, against the
float64 predictor; the estimator on the pictures alone; Monte Carlo noise; drone-frame.png. Tables are in mrad unless
they say mm.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import drone_pictures as draw
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

import benchsim  # noqa: F401  (before mitsuba)
from benchsim.bench.errors import BenchsimError
from benchsim.drones import picture
from benchsim.drones.estimate import axis_error, estimate
from benchsim.drones.finding import find_glints, find_mirror, to_mirror
from benchsim.drones.flight import Sightings, seen
from benchsim.drones.glints import glints
from benchsim.drones.heliostat import axes, design_map
from benchsim.jobs.drone_cluster import clusters
from benchsim.plant import files

Array = NDArray[np.float64]

PLANT = files.read(Path(__file__).resolve().parents[1] / "scenes" / "plants" / "heliopoint")
(CLUSTER,) = clusters(PLANT)
DESIGN = CLUSTER.design(0)
EDGE = 40.0
"""A glint nearer to its facet's edge is cut by it, or is only part of the lamp's image [mm]."""
APART = 80.0
"""Glints nearer to one another than that may run together [mm]."""
MATCH = 60.0
STRETCHED = 2.0
"""Of a glint's area against a flat mirror's: beyond, the image of the lamp's disc is long and bent, and so is what its
centroid means."""


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

    def add(self, found: Array, true: Array, strength: Array, disc: Array) -> None:
        """One frame's glints (n, 2) and (m, 2) [mm]; ``disc`` (k, 2): those of the rim of the lamp's disc."""

        def edge(points: Array) -> Array:
            away = np.abs(points[:, None] - DESIGN.centres) - np.array(DESIGN.size) / 2
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
    rng, camera, far = np.random.default_rng(seed), picture.Camera(), PLANT.drone.distance
    print(
        f"images (Mitsuba, {samples} samples per pixel, seed {seed}): {count} heliostats × {len(CLUSTER.route[0])} "
        f"frames, {far / camera.focal:.1f} mm per pixel at {far / 1e3:.0f} m"
    )
    tally, start, lines = Tally(), time.process_time(), []
    for _, flight, h, _ in islice(CLUSTER.fly(rng), count):
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
            found = to_mirror(find_glints(image, corners), corners, DESIGN)
            own = true.frame == f
            turn = np.linspace(0, 2 * math.pi, 12, endpoint=False)
            rim = picture.LAMP_RADIUS * np.column_stack([np.cos(turn), np.sin(turn), 0 * turn]) @ axes(h.mount)[0].T
            eyes = np.tile(flight.cameras[f], (len(turn), 1))
            disc = glints(h.surface, h.mount, eyes, flight.lamps[f] + rim).points
            tally.add(found, true.points[own], true.strength[own], disc)
            frames.append(np.full(len(found), f))
            points.append(found)
        rendered = Sightings(np.concatenate(frames), np.concatenate(points))
        predicted = Sightings(true.frame, true.points)
        for name, reference in (("by design", design_map(DESIGN)), ("measured", h.measured)):
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
    rng = np.random.default_rng(seed)
    _, flight, h, _ = next(CLUSTER.fly(rng))
    camera, true = picture.Camera(), seen(h, flight)
    centre = axes(h.mount)[1]
    shapes = picture.mirrors([h], centre)
    apart: dict[int, list[Array]] = {samples: [], 4 * samples: []}
    for f in np.unique(true.frame)[::3]:
        view = picture.looking(flight.cameras[f], np.zeros(3))
        corners = picture.project(camera, view, picture.outline(axes(h.mount), DESIGN.outline))
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
        x = np.array(kept) / math.sqrt(2) * PLANT.drone.distance / camera.focal
        print(
            f"  Monte Carlo alone, {spp} samples: centroids {x.std():.2f} mm rms per component, "
            f"median |.| {np.median(np.abs(x)):.2f} (n = {len(x)})"
        )


def frame_picture(seed: int, out: Path, samples: int) -> None:
    """One frame over the whole cluster, with what was found in it."""
    rng, camera, outline = np.random.default_rng(seed), picture.Camera(), DESIGN.outline
    whole = list(CLUSTER.fly(rng))
    flight, heliostats = whole[0][1], [h for _, _, h, _ in whole]
    counts = np.sum([np.bincount(seen(h, flight).frame, minlength=len(flight.cameras)) for h in heliostats], axis=0)
    f = int(counts.argmax())
    view = picture.looking(flight.cameras[f], np.zeros(3), picture.GIMBAL * rng.standard_normal(2))
    said = picture.looking(flight.said_cameras[f], np.zeros(3))
    window = picture.window_of(
        np.concatenate([picture.project(camera, view, picture.outline(axes(h.mount), outline)) for h in heliostats]),
        60,
    )
    shapes = picture.mirrors(heliostats, np.zeros(3))
    light = picture.radiance(shapes, np.zeros(3), camera, view, flight.lamps[f], window, samples, seed)
    image = picture.photograph(light, rng)
    start = np.array([window[1].start, window[0].start])
    mirrors, spots = [], []
    for h in heliostats:
        near = picture.project(camera, said, picture.outline(axes(h.said), outline)) - start
        # cut out by what drone and plant say: that is how a mirror gets its heliostat's name
        cut = picture.window_of(near, 45)
        low = np.array([max(cut[1].start, 0), max(cut[0].start, 0)])
        part = image[low[1] : cut[0].stop, low[0] : cut[1].stop]
        corners = find_mirror(part, near - low)
        mirrors.append(corners + low)
        spots.append(find_glints(part, corners) + low)
    off = [
        np.linalg.norm(m + start - picture.project(camera, view, picture.outline(axes(h.mount), outline)), axis=1)
        for h, m in zip(heliostats, mirrors, strict=True)
    ]
    print(
        f"\nframe {f} of seed {seed}: {len(mirrors)} mirrors identified, corners {np.median(off):.2f} px off "
        f"(median; worst {np.max(off):.2f}), "
        f"{sum(map(len, spots))} glints found, {counts[f]} predicted"
    )
    title = f"Frame {f}: {len(mirrors)} heliostats, {sum(map(len, spots))} glints found"
    draw.save(draw.frame(image, mirrors, spots, title), out / "drone-frame.png")


def main(argv: Sequence[str] | None = None) -> None:
    """All of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=70401)
    parser.add_argument("--heliostats", type=int, default=2, help="whole flights to render (default %(default)s)")
    parser.add_argument("--samples", type=int, default=16, help="per rendered pixel (default %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the picture (default ./out)")
    args = parser.parse_args(argv)
    args.out.mkdir(parents=True, exist_ok=True)
    images(args.heliostats, args.seed, args.samples)
    monte_carlo(args.seed + 1, args.samples)
    frame_picture(args.seed + 50, args.out, args.samples)


if __name__ == "__main__":
    main()
