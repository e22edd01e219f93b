"""Flux of ten heliostats by both engines of ``benchsim flux``, by a bare ray tracer of this script, and by ARTIST.

    python analysis/plant_peers.py [--seed 1] [--rays 4000000] [--artist PYTHON] [-o out/peers]

Two plants on one vertical target, at one hour. *Smooth*: a Gaussian sun, spheres focused and canted at their own
distance, no slope errors, where all should agree. *Real*: a pillbox sun, slopes of 1.5 mrad, 3 × 3 facets that are all
focused and canted at 90 m, where the product makes a Gaussian of each.

The bare tracer, `bare`, is float64 numpy without any of benchsim's modules, neighbours tried one by one. ARTIST is
artist-csp (run with 2.0.0, extra ``peers``), here or in another Python (``--artist``): its own ray tracer, sun, target
and bitmaps, with the mirrors' points and normals as the bare tracer has them. Its sun is a Gaussian of the light's
whole variance.
What ARTIST leaves to its user is put in: each heliostat's power (its rays all count alike, whatever the incidence on
the mirror). What it has and the others have not is printed and explained below the table.
"""

from __future__ import annotations

import argparse
import importlib.util
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np

TIME, IRRADIANCE, CELLS, TARGET = "2026-03-21T10:00", 900.0, 60, 6.0
PLANT = """\
format = "benchsim-plant/1"
[site]
latitude_deg = 37.0
longitude_deg = 0.0
attenuation = "none"
[[receiver]]
name = "target"
centre_m = [0.0, 0.0, 40.0]
width_m = {target}
height_m = {target}
[sun]
{sun}
[optics]
slope_mrad = {slope}
reflectance = 1.0
[heliostats]
width_m = 4.0
height_m = 3.0
facets = {facets}
{focus}
"""
PLANTS = {
    "smooth": {"sun": 'shape = "gaussian"\nsigma_mrad = 3.0', "slope": 0.0, "facets": [1, 1], "focus": ""},
    "real": {
        "sun": 'shape = "pillbox"', "slope": 1.5, "facets": [3, 3], "focus": "focal_m = 90.0\ncanting_m = 90.0",
    },
}  # fmt: skip


def places() -> np.ndarray:
    """Ten heliostats in two rows to 40° from north, east, north and up [m]."""
    psi = np.radians([-36, -18, 0, 18, 36, -40, -20, 0, 20, 40])
    radius = np.repeat([70.0, 100.0], 5)
    return np.stack([radius * np.sin(psi), radius * np.cos(psi), np.full(10, 2.0)], axis=1)


# The bare tracer: 80 lines at most, and nothing of benchsim.


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def frame(place, sun):
    """Rows across, up, normal of a mirror that is aimed at the target's centre."""
    n = unit(unit(np.array([0, 0, 40.0]) - place) + sun)
    across = unit(np.cross([0, 0, 1.0], n))
    return np.array([across, np.cross(n, across), n])


def mirror(p, u, focal, canting, facets):
    """Points and normals (N, 3) of a mirror, in its frame, at (N, 2) of the unit square."""
    facet = np.minimum(np.floor(u * facets), np.array(facets) - 1)
    centre = ((facet + 0.5) / facets - 0.5) * [4.0, 3.0]
    own = (u - 0.5) * [4.0, 3.0] - centre
    axis = unit(np.c_[-centre / (2 * canting), np.ones(len(u))])
    x = unit(np.array([1.0, 0, 0]) - axis[:, :1] * axis)
    y = np.cross(axis, x)
    n = np.c_[-own / (2 * focal), np.sqrt(1 - (own**2).sum(axis=1) / (2 * focal) ** 2)]
    sag = 2 * focal - np.sqrt((2 * focal) ** 2 - (own**2).sum(axis=1))
    points = np.c_[centre, np.zeros(len(u))] + x * own[:, :1] + y * own[:, 1:] + axis * sag[:, None]
    return points, x * n[:, :1] + y * n[:, 1:2] + axis * n[:, 2:]


def tilted(v, two):
    """Directions (N, 3) moved by (N, 2) radians in the plane across them."""
    a = unit(np.cross(v, [0.3, 0.2, 0.9]))
    return unit(v + two[:, :1] * a + two[:, 1:] * np.cross(v, a))


def behind(start, ray, others, reach):
    """Which rays meet one of the rectangles (place, frame) before ``reach``."""
    hit = np.zeros(len(start), bool)
    for place, f in others:
        way = (place - start) @ f[2] / (ray @ f[2])
        at = (start + way[:, None] * ray - place) @ f[:2].T
        hit |= (way > 1e-6) & (way < reach) & (np.abs(at) < [2.0, 1.5]).all(axis=1)
    return hit


def bare(sun, plant, rays, seed, turned=0.0):
    """Flux [kW/m²] in cells along east and up, and the noise of each.

    ``turned``: instead of sun and slopes a Gaussian of that sigma [rad], by which rays turn about east and about up.
    """
    rng, at = np.random.default_rng(seed), places()
    frames = [frame(p, sun) for p in at]
    total, squares = np.zeros((2, CELLS, CELLS))
    n = rays // len(at)
    for k, (p, f) in enumerate(zip(at, frames, strict=True)):
        reach = float(np.linalg.norm(np.array([0, 0, 40.0]) - p))
        focus = (reach, reach) if plant == "smooth" else (90.0, 90.0)
        points, normals = mirror(p, rng.random((n, 2)), *focus, PLANTS[plant]["facets"])
        if turned or plant == "smooth":
            spot = rng.normal(0, 3e-3, (n, 2))
        else:
            angle = rng.random(n) * 2 * np.pi
            spot = 4.65e-3 * np.sqrt(rng.random(n))[:, None] * np.c_[np.cos(angle), np.sin(angle)]
        toward = tilted(np.broadcast_to(sun, (n, 3)), spot * (turned == 0))
        normals = normals @ f
        weight = (normals * toward).sum(axis=1) * 12.0 / n * IRRADIANCE / 1e3
        bent = tilted(normals, rng.normal(0, 1e-3 * PLANTS[plant]["slope"] * (turned == 0), (n, 2)))
        ray = 2 * (bent * toward).sum(axis=1)[:, None] * bent - toward
        for axis in np.eye(3)[[0, 2]] if turned else []:
            ray = unit(ray + rng.normal(0, turned, (n, 1)) * np.cross(axis, ray))
        start = p + points @ f
        others = [(q, g) for j, (q, g) in enumerate(zip(at, frames, strict=True)) if j != k]
        free = ~behind(start, toward, others, np.inf) & ~behind(start, ray, others, reach)
        land = start - (start[:, 1] / ray[:, 1])[:, None] * ray - [0, 0, 40.0]
        where = [land[free][:, 0], land[free][:, 2]], [np.linspace(-TARGET / 2, TARGET / 2, CELLS + 1)] * 2
        total += np.histogram2d(*where[0], bins=where[1], weights=weight[free])[0]
        squares += np.histogram2d(*where[0], bins=where[1], weights=weight[free] ** 2)[0]
    cell = (TARGET / CELLS) ** 2
    return total / cell, np.sqrt(squares) / cell


# ARTIST: run by whichever Python has it; numpy alone besides.


def artist(folder: Path) -> None:
    """Trace what ``in.npz`` says into ``out.npz``."""
    import torch
    from artist.field.tower_target_areas_planar import TowerTargetAreasPlanar
    from artist.raytracing.heliostat_ray_tracer import HeliostatRayTracer
    from artist.scene.sun import Sun

    given = np.load(folder / "in.npz")
    torch.set_num_threads(1)
    points, normals = (torch.tensor(given[k], dtype=torch.float32) for k in ("points", "normals"))
    n, m = points.shape[:2]

    def four(x: torch.Tensor, last: float) -> torch.Tensor:
        return torch.cat([x, torch.full((*x.shape[:-1], 1), last)], dim=-1)

    # Pixels' centres, not the outermost edges, lie on the target's edge: a target smaller by a pixel has ours.
    side = TARGET * (1 - 1 / CELLS)
    target = TowerTargetAreasPlanar(
        ["target"], torch.tensor([[0, 0, 40.0, 1]]), torch.tensor([[0, 1.0, 0, 0]]), torch.tensor([[side, side]])
    )
    active = torch.ones(n, dtype=torch.int32)
    sun = Sun(
        int(given["rays"]) // (n * m),
        {"distribution_type": "normal", "mean": 0.0, "covariance": float(given["sigma"]) ** 2},
        torch.device("cpu"),
    )
    scenario = SimpleNamespace(
        light_sources=SimpleNamespace(light_source_list=[sun]),
        solar_tower=SimpleNamespace(number_of_target_areas_per_type=torch.tensor([1, 0]), target_areas=[target]),
    )
    group = SimpleNamespace(
        active_surface_points=four(points, 1.0), active_surface_normals=four(normals, 0.0), surface_points=points,
        number_of_active_heliostats=n, active_heliostats_mask=active,
    )  # fmt: skip
    tracer = HeliostatRayTracer(
        scenario, group, blocking_active=False, batch_size=1, random_seed=int(given["seed"]),
        bitmap_resolution=torch.tensor([CELLS, CELLS]),
    )  # fmt: skip
    towards = torch.tensor(given["sun"], dtype=torch.float32)
    incident = four(-towards.expand(n, 3), 0.0)
    index = torch.zeros(n, dtype=torch.int32)
    maps = tracer.trace_rays(incident, active, index, mirror_reflectivity=1.0, device=torch.device("cpu"))[0]
    # [heliostat, down, to the right of who looks south at the target, that is west] → east, up.
    np.savez(folder / "out.npz", maps=np.flip(maps.numpy(), 1).transpose(0, 2, 1)[:, ::-1] / (sun.number_of_rays * m))


def by_artist(python: str, sun: np.ndarray, plant: str, rays: int, seed: int, sigma: float) -> np.ndarray:
    """Flux [kW/m²] of each heliostat, (10, cells, cells) east and up."""
    steps = (np.arange(50) + 0.5) / 50
    u = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    points, normals, powers = [], [], []
    for p in places():
        f = frame(p, sun)
        reach = float(np.linalg.norm(np.array([0, 0, 40.0]) - p))
        focus = (reach, reach) if plant == "smooth" else (90.0, 90.0)
        q, n = mirror(p, u, *focus, PLANTS[plant]["facets"])
        points.append(p + q @ f)
        normals.append(n @ f)
        powers.append(12.0 * IRRADIANCE / 1e3 * float((n @ f @ sun).mean()))
    with tempfile.TemporaryDirectory() as name:
        np.savez(Path(name) / "in.npz", points=points, normals=normals, sun=sun, rays=rays, seed=seed, sigma=sigma)
        # It writes a log where it runs.
        command = [python, Path(__file__).resolve(), "--trace", name]
        subprocess.run(command, check=True, stdout=sys.stderr, cwd=name)
        maps = np.load(Path(name) / "out.npz")["maps"]
    return maps * np.array(powers)[:, None, None] / (TARGET / CELLS) ** 2


def compared(name: str, found: np.ndarray, base: np.ndarray) -> None:
    x = ((np.arange(CELLS) + 0.5) / CELLS - 0.5) * TARGET
    cell = (TARGET / CELLS) ** 2
    centre = [m.sum(axis=1) @ x / m.sum() for m in (found, found.T)]
    wide = [np.sqrt(m.sum(axis=1) @ (x - c) ** 2 / m.sum()) for m, c in zip((found, found.T), centre, strict=True)]
    top = base > 0.9 * base.max()
    away = 100 * (found - base) / base.max()
    peak = float(found[top].mean())
    print(
        f"  {name:<24} {found.sum() * cell:8.2f} {peak:8.3f} {100 * (peak / base[top].mean() - 1):+7.2f} "
        f"{np.sqrt((away**2).mean()):7.3f} {np.abs(away).max():7.2f}   {1e3 * centre[0]:+6.1f} "
        f"{1e3 * centre[1]:+6.1f}  {1e3 * wide[0]:6.1f} {1e3 * wide[1]:6.1f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rays", type=int, default=4_000_000, help="of the bare tracer and of ARTIST")
    parser.add_argument("--artist", metavar="PYTHON", help="a Python that has artist-csp; default this one if it has")
    parser.add_argument("--trace", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.trace:
        artist(options.trace)
        return
    import benchsim as bs
    from benchsim.jobs.flux_engines import over_cells

    python = options.artist or (sys.executable if importlib.util.find_spec("artist") else None)
    for plant, keys in PLANTS.items():
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            (folder / "plant.toml").write_text(PLANT.format(target=TARGET, **keys))
            rows = [f"{k},{e:.9f},{n:.9f},{u}" for k, (e, n, u) in enumerate(places())]
            (folder / "heliostats.csv").write_text("\n".join(["id,east_m,north_m,up_m", *rows]) + "\n")
            result = bs.flux(
                folder, at=TIME, irradiance=IRRADIANCE, cells=CELLS, engine="both", accuracy=0.4, seed=options.seed
            )
        sun = result.moments[0].sun
        by_rays, noise = bare(sun, plant, options.rays, options.seed)
        print(
            f"\n{plant}: {result.plant.sun.name} sun, {TIME}, noise of the brightest cell: bare "
            f"{noise.max() / by_rays.max():.2%}, Monte Carlo {result.carlo[0].noise.accuracy:.2%}"
        )
        print(f"{'kW':>35} {'peak':>8} {'off, %':>7} {'rms, %':>7} {'most, %':>7}    centroid, mm  rms width, mm")
        compared("bare, float64", by_rays, by_rays)
        compared("benchsim, Monte Carlo", result.maps(result.carlo)[0], by_rays)
        compared("benchsim, product", over_cells(result.maps()[0], False), by_rays)
        if python is not None:
            sigma = float(np.sqrt(result.plant.sun.sigma**2 + (2e-3 * keys["slope"]) ** 2))
            maps = by_artist(python, sun, plant, options.rays, options.seed, sigma)
            compared("ARTIST", maps.sum(axis=0), by_rays)
            # It multiplies each ray by the cosine of its incidence on the target.
            ways = np.array([0, 0, 40.0]) - places()
            squint = -(ways / np.linalg.norm(ways, axis=1, keepdims=True))[:, 1]
            print(f"    (cosines of incidence on the target: {', '.join(f'{-c:.3f}' for c in squint)})")
            alike = (maps / np.abs(squint)[:, None, None]).sum(axis=0)
            compared("ARTIST over its cosines", alike, by_rays)
            # It scatters rays by turns about the plant's east and up, whichever way they go.
            own = bare(sun, plant, options.rays, options.seed, sigma)[0]
            compared("the bare one so turned", own, by_rays)
            print("  and against that:")
            compared("ARTIST over its cosines", alike, own)
        for sentence in result.partings[0].sentences():
            print(sentence)


if __name__ == "__main__":
    main()
