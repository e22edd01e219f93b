"""The refractive beam expander: Mitsuba's lenses against a float64 sequential trace, and the beam that they make.

Bars: slopes within 1 µrad of Snell's law in float64; the table within 1 µrad of the rays it was made of.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

import benchsim  # noqa: F401  (before mitsuba)
from benchsim.bench.model import Expander, Laser, Surface
from benchsim.renderer import backend
from benchsim.renderer.beam_table import polynomial
from benchsim.renderer.expander import elements, expand, refract, trace
from benchsim.renderer.glass import index

BAR = 1e-6
WAVELENGTH = 632.8e-6


def galilean(**changes: float) -> Expander:
    """f = −12 mm and f = +150 mm in BK7, moved together until 0.8 mm become about 10 mm and 4 mrad at the mirror."""
    flat = float("inf")
    surfaces = (
        Surface(-6.1811, 1.5, "BK7", 3.0),
        Surface(flat, 124.5, "air", 3.0),
        Surface(flat, 5.0, "BK7", 15.0),
        Surface(-77.263, 140.0, "air", 15.0),
    )
    return Expander(surfaces, **changes)


def snell(expander: Expander, wavelength: float, source: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions and slopes (n, 2) in the mirror's plane by Snell's law, float64, in one frame."""
    p = np.column_stack([source, np.zeros(len(source))])
    d = np.tile([0.0, 0.0, 1.0], (len(p), 1))
    last = elements(expander.surfaces)[-1]
    ct, st = np.cos(expander.tilt), np.sin(expander.tilt)
    about_x = np.array([[1, 0, 0], [0, ct, -st], [0, st, ct]])
    before, z = 1.0, 0.0
    hinge = np.zeros(3)
    for i, s in enumerate(expander.surfaces):
        if i == last.start:
            z += expander.defocus
            hinge = np.array([0.0, expander.decentre, z])
        frame = about_x if i >= last.start else np.eye(3)
        vertex = hinge + frame @ [0, 0, z - hinge[2]] if i >= last.start else np.array([0, 0, z])
        q, e = (p - vertex) @ frame, d @ frame
        if np.isinf(s.radius):
            q = q - e * (q[:, 2:] / e[:, 2:])
            n = np.tile([0.0, 0.0, -1.0], (len(q), 1))
        else:
            c = np.array([0, 0, s.radius])
            b = ((q - c) * e).sum(axis=1)
            t = -b - np.sign(s.radius) * np.sqrt(b * b - ((q - c) ** 2).sum(axis=1) + s.radius**2)
            q = q + t[:, None] * e
            n = (q - c) / s.radius
        after = index(s.glass, wavelength)
        mu, cosine = before / after, -(n * e).sum(axis=1)
        e = mu * e + (mu * cosine - np.sqrt(1 - mu**2 * (1 - cosine**2)))[:, None] * n
        p, d, before = q @ frame.T + vertex, e @ frame.T, after
        z += s.thickness
    slope = d[:, :2] / d[:, 2:]
    return p[:, :2] + (z - p[:, 2:]) * slope, slope


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--grid", type=int, default=401, help="rays across the input")
    parser.add_argument("--seed", type=int, default=0, help="of the rays whose rate is measured")
    parser.add_argument("--quick", action="store_true", help="a tenth of the rays")
    options = parser.parse_args()
    backend.use()
    grid = 101 if options.quick else options.grid
    laser = Laser()
    met = True
    print(
        "expander               diameter  divergence  aberration  lost     worst slope  worst position  worst of table"
    )
    print(
        "                             mm        mrad        µrad                 µrad              nm            µrad"
    )
    for name, changes in {
        "centred": {},
        "defocus -1 mm": {"defocus": -1.0},
        "decentre 0.5 mm": {"decentre": 0.5},
        "tilt 10 mrad": {"tilt": 10e-3},
    }.items():
        lens = galilean(**changes)
        rays = trace(lens, WAVELENGTH, grid)
        position, slope = snell(lens, WAVELENGTH, rays.source)
        beam = expand(lens, WAVELENGTH)
        weight = rays.power / rays.power.sum()
        centred, turned = rays.position - weight @ rays.position, rays.slope - weight @ rays.slope
        waist = beam.diameter / 2
        a, b = (centred / (beam.table.reach * waist)).T
        inside = np.hypot(a, b) < 1
        table = np.column_stack([polynomial(c, a, b) for c in (beam.table.slope_x, beam.table.slope_y)])
        off = turned - beam.divergence / beam.diameter * centred - table
        worst = np.abs(rays.slope - slope).max(), np.abs(off[inside]).max()
        met &= max(worst) < BAR
        print(
            f"{name:22s} {beam.diameter:8.3f} {beam.divergence * 1e3:11.4f} {beam.aberration * 1e6:11.2f}"
            f" {rays.lost:7.1e} {worst[0] * 1e6:12.3f} {np.abs(rays.position - position).max() * 1e6:15.1f}"
            f" {worst[1] * 1e6:15.3f}"
        )
    n = 200_000 if options.quick else 2_000_000
    rng = np.random.default_rng(options.seed)
    origin = np.column_stack([rng.normal(0, 0.2, (n, 2)), np.zeros(n)])
    along = np.tile([0.0, 0.0, 1.0], (n, 1))
    surface, bk7 = galilean().surfaces[0], index("BK7", WAVELENGTH)
    refract(surface, 1.0, bk7, origin, along)
    wall, cpu = time.perf_counter(), time.process_time()
    refract(surface, 1.0, bk7, origin, along)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    print(f"one curved surface, transfers included: {n / wall / 1e6:.1f} Mray/s, {n / cpu / 1e6:.1f} per CPU-s")
    print(f"[laser] for comparison: {laser.beam_diameter:.1f} mm, {laser.divergence * 1e3:.1f} mrad")
    verdict = "met" if met else "MISSED"
    print(f"bar: slopes within {BAR * 1e6:.0f} µrad of float64, table as near to its rays: {verdict}")
    return 0 if met else 1


if __name__ == "__main__":
    raise SystemExit(main())
