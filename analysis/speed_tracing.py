"""Cost of tracing: the fast path against Mitsuba's stock particle tracer re-rendered at every angle of the mirror.

Both in one run, in geometric optics, since the stock tracer knows no other; the fast path's rate with diffraction is
printed too. CPU seconds are those of the whole process, all threads.

1. Rays per CPU second. Fast path: the whole of `irradiance` (preparing the exposure, sampling, polygon, a phase per
   ray, binning, noise estimate). Stock `ptracer`: `mi.render` only, at phases that light the board; loading its
   scenes is not counted.
2. Hits: the same samples traced in float64 vectors of the world frame.
3. A 2000 × 1500 picture with 1 % noise per lit pixel (rms over the pixels above 5 % of the brightest). Fast path:
   `irradiance` and `photograph`, the noise measured from pictures of several seeds. Stock: the noise measured from
   repeated renders at one set of phases (the ripple that few phases leave is not held against it), the cost
   *extrapolated* by noise ∝ 1/√rays at the rate of 1.

Bars: 10 × in rays per CPU second; every hit within 1 µm; 30 × in CPU for the picture.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchsim.bench.files import read
from benchsim.bench.model import Recording
from benchsim.bench.place import Placement, place
from benchsim.renderer import backend, irradiance
from benchsim.renderer.laser import perpendicular
from benchsim.renderer.picture import photograph
from benchsim.renderer.reference import facet_shapes, rotor_frame
from benchsim.renderer.sweep import sweep
from benchsim.renderer.tracer import Tracer

SCENES = Path(__file__).resolve().parents[1] / "scenes"
NOISE = 0.01


def cpu(job: Callable[[], Any]) -> float:
    """CPU seconds of a call, all threads."""
    start = time.process_time()
    job()
    return time.process_time() - start


def float64_hits(recording: Recording, placement: Placement, phase: Any, t: Any, h: Any) -> np.ndarray:
    """(n, 2) hits on the board, float64 vectors in the world frame."""
    a, n0 = placement.axis, placement.normal
    n = np.cos(phase)[:, None] * n0 + np.sin(phase)[:, None] * np.cross(a, n0)
    x = placement.centre + recording.mirror.radius * n + t[:, None] * np.cross(a, n) + h[:, None] * a
    g = x - (placement.laser_point - placement.laser_direction / recording.laser.curvature)
    out = g - 2 * (g * n).sum(1)[:, None] * n
    front = placement.screen_rotation[:, 0]
    path = ((placement.screen_origin - x) @ front) / (out @ front)
    return ((x + path[:, None] * out - placement.screen_origin) @ placement.screen_rotation)[:, 1:]


def hit_errors(recording: Recording, placement: Placement, n: int, seed: int) -> np.ndarray:
    """Distance of float32 hits from float64 ones [mm]."""
    s = sweep(recording, recording.exposures[0], placement)
    tracer = Tracer(s)
    y, z, _, arrives, (delta, t, h) = tracer(tracer.points(n, np.random.default_rng(seed)))
    y, z, delta, t, h = (np.array(v, float) for v in (y, z, delta, t, h))
    on = np.array(arrives) & (np.abs(y) < 350) & (np.abs(z) < 350)
    exact = float64_hits(recording, placement, s.middle + delta[on], t[on], h[on])
    return np.hypot(y[on] - exact[:, 0], z[on] - exact[:, 1])


def stock_scene(recording: Recording, placement: Placement, phase: float) -> Any:
    """The bench with the mirror standing at one phase, for the stock particle tracer."""
    import mitsuba as mi

    def at(matrix: np.ndarray) -> Any:
        return mi.ScalarTransform4f(matrix)

    def frame(rotation: np.ndarray, origin: np.ndarray) -> np.ndarray:
        m = np.eye(4)
        m[:3, :3], m[:3, 3] = rotation, origin
        return m

    turned = np.eye(4)
    turned[:2, :2] = [[np.cos(phase), -np.sin(phase)], [np.sin(phase), np.cos(phase)]]
    rotor = frame(*rotor_frame(placement)) @ turned
    camera = recording.cameras["A"]
    width, height = recording.screen.size
    front, ey, ez = placement.screen_rotation.T
    u, v = perpendicular(placement.laser_direction)
    board = frame(np.stack([ey * width / 2, ez * height / 2, front], axis=1), placement.screen_origin)
    beam = frame(np.stack([u, v, placement.laser_direction], axis=1), placement.laser_point)
    facets = {
        f"facet{k}": {
            "type": "rectangle",
            "to_world": at(rotor @ m),
            "bsdf": {"type": "conductor", "material": "none"},
        }
        for k, m in enumerate(facet_shapes(recording.mirror))
    }
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "ptracer", "max_depth": 3, "hide_emitters": True},
            "sensor": {
                "type": "perspective",
                "fov_axis": "x",
                "fov": float(np.degrees(2 * np.arctan(camera.resolution[0] / 2 / camera.focal))),
                "to_world": mi.ScalarTransform4f().look_at(
                    origin=list(camera.position), target=list(camera.look_at), up=[0, 0, 1]
                ),
                "film": {
                    "type": "hdrfilm",
                    "width": camera.resolution[0],
                    "height": camera.resolution[1],
                    "pixel_format": "luminance",
                    "rfilter": {"type": "box"},
                },
                "sampler": {"type": "independent"},
            },
            "laser": {
                "type": "benchsim_laser",
                "to_world": at(beam),
                "beam_diameter": recording.laser.beam_diameter,
                "curvature": recording.laser.curvature,
            },
            "board": {
                "type": "rectangle",
                "to_world": at(board),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "uniform", "value": recording.screen.reflectance}},
            },
            **facets,
        }
    )


def phases(recording: Recording, placement: Placement, count: int) -> np.ndarray:
    """Phases of the mirror whose light reaches the board, evenly spaced."""
    s = sweep(recording, recording.exposures[0], placement)
    reach = s.half_range + abs(s.shear) * recording.mirror.facet_width / 2
    return s.middle + reach * ((np.arange(count) + 0.5) / count * 2 - 1)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--variant", default=None)
    parser.add_argument("--angles", type=int, default=100)
    parser.add_argument("--quick", action="store_true", help="half of the stock tracer's renders")
    args = parser.parse_args()
    print(f"back end {backend.use(args.variant)}, seed {args.seed}")
    import mitsuba as mi

    full = read(SCENES / "fig7a.toml", images=False)
    full = replace(full, screen=replace(full.screen, marks=None))
    recording = replace(full, physics=replace(full.physics, diffraction=False))
    exposure = recording.exposures[0]
    placement = place(recording.mirror, exposure)
    camera = recording.cameras["A"]

    rays = 1 << 27
    rates = {}
    for label, r in (("geometric", recording), ("with diffraction", full)):
        irradiance(r, exposure, seed=args.seed, rays=1 << 20)
        rates[label] = rays / min(
            cpu(lambda r=r, k=k: irradiance(r, exposure, seed=args.seed + k, rays=rays)) for k in range(3)
        )
    spp = 2
    some = [stock_scene(recording, placement, p) for p in phases(recording, placement, 5)]
    mi.render(some[0], spp=spp)
    pictures: list[Any] = []

    def sweep_stock() -> None:
        for k, scene in enumerate(some):
            picture = mi.render(scene, spp=spp, seed=mi.UInt32(args.seed + k))
            pictures.append(np.array(picture).sum())

    stock = len(some) * camera.resolution[0] * camera.resolution[1] * spp / min(cpu(sweep_stock) for _ in range(3))
    assert min(pictures) > 0, "the stock tracer drew nothing"
    speed = rates["geometric"] / stock
    print("1. rays per CPU second")
    for label, rate in rates.items():
        print(f"   fast path, {label:17} {rate / 1e6:7.1f} M")
    print(f"   stock ptracer per angle     {stock / 1e6:7.1f} M")
    print(f"   ratio {speed:.1f}; bar 10: {'met' if speed >= 10 else 'MISSED'}")

    error = hit_errors(recording, placement, 1 << 20, args.seed)
    near = error.max() <= 1e-3
    print(
        f"2. float32 hits against float64, {error.size} rays: rms {1e3 * np.sqrt(np.mean(error**2)):.3f} µm, "
        f"largest {1e3 * error.max():.3f} µm; bar 1 µm: {'met' if near else 'MISSED'}"
    )

    seeds, wanted = 6, 0.05
    drawn, spent = [], []

    def draw(seed: int, wanted: float) -> None:
        light = irradiance(recording, exposure, seed=seed, relative_error=wanted)
        drawn.append(photograph(recording.screen, camera, light, placement=placement).laser)

    while True:
        drawn.clear()
        spent = [cpu(lambda k=k, wanted=wanted: draw(args.seed + k, wanted)) for k in range(seeds)]
        stack = np.array(drawn, float)
        mean = stack.mean(axis=0)
        lit = mean > 0.05 * mean.max()
        ours = float(np.sqrt(np.mean(stack[:, lit].var(axis=0, ddof=1) / mean[lit] ** 2)))
        if ours <= NOISE:
            break
        wanted /= 1.5
    cost = float(np.mean(spent))

    scenes = [stock_scene(recording, placement, p) for p in phases(recording, placement, args.angles)]
    repeats = 2 if args.quick else 4
    batches = []
    for k in range(repeats):
        total = np.zeros(mean.shape)
        for j, scene in enumerate(scenes):
            seed = mi.UInt32(args.seed + 1 + k * len(scenes) + j)
            total += np.array(mi.render(scene, spp=1, seed=seed), float)[..., 0]
        batches.append(total[lit])
    stack = np.array(batches)
    # Relative to the expected picture: dividing by the mean of few photons would bias the noise.
    scale = stack.mean() / mean[lit].mean()
    theirs = float(np.sqrt(np.mean(stack.var(axis=0, ddof=1) / (scale * mean[lit]) ** 2)))
    rays_theirs = args.angles * mean.size
    cost_theirs = rays_theirs * (theirs / NOISE) ** 2 / stock
    ratio = cost_theirs / cost
    sigma = ratio * np.sqrt(2 / (lit.sum() * (repeats - 1)) + np.var(spent, ddof=1) / len(spent) / cost**2)
    print(f"3. a {camera.resolution[0]} × {camera.resolution[1]} picture with {NOISE:.0%} noise per lit pixel")
    print(f"   fast path: {cost:.2f} CPU s, noise {ours:.2%} (measured, {seeds} seeds, {lit.sum()} lit pixels)")
    print(
        f"   stock ptracer: {theirs:.1%} with {rays_theirs / 1e6:.0f} M rays at {args.angles} phases (measured, "
        f"{repeats} renders); extrapolated to {NOISE:.0%}: "
        f"{rays_theirs * (theirs / NOISE) ** 2 / 1e6:.0f} M rays, {cost_theirs:.0f} CPU s"
    )
    print(f"   ratio {ratio:.0f} ± {sigma:.0f}; bar 30: {'met' if ratio >= 30 else 'MISSED'}")
    return 0 if speed >= 10 and near and ratio >= 30 else 1


if __name__ == "__main__":
    sys.exit(main())
