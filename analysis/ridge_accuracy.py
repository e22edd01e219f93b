"""How true the extracted ridge is: bias, honesty of its sigmas, and variance against the Cramér–Rao bound.

Photographs of a known arc (`line_pictures`: other optics than benchsim's; Gaussian, lopsided box and diffraction
shapes), 16 and 8 bit in turn, with and without a dark picture in turn, read from their files with the pose known. Then
the same with the brightest 20 % of the ridge saturated, and as JPEG of quality 90; with ``--rendered``, recordings
rendered by benchsim against the ray model's prediction, marks and pose included.

    python analysis/ridge_accuracy.py --seed 1 [--geometries 120] [--draws 2] [--rendered] [--quick]
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import line_pictures as pictures
import numpy as np

import benchsim
from benchsim.bench.curve import signed_distance
from benchsim.bench.files import read
from benchsim.bench.model import Screen
from benchsim.trace.extract import extract, measure
from benchsim.trace.image import read_image
from benchsim.trace.table import Trace, covariance, only_ridge


@dataclass(frozen=True)
class Result:
    """Errors of one picture's profiles [mm], their sigmas, χ² per profile with the full covariance, bound (or nan).

    ``mean_sigma``: the stated 1 sigma of the mean error, what the profiles share included.
    """

    error: np.ndarray
    sigma: np.ndarray
    chi2: float
    bound: np.ndarray
    saturated: np.ndarray
    geometry: int
    mean_sigma: float

    @property
    def bias(self) -> float:
        return float(self.error.mean())


def judge(
    trace: Trace, error: np.ndarray, sign: float = 1.0, bound: np.ndarray | None = None, geometry: int = 0
) -> Result:
    """``sign``: of the trace's normal along the direction in which the error counts."""
    c = covariance(trace)
    chi2 = float(error @ np.linalg.solve(c, error)) / len(error)
    nothing = np.full(len(error), np.nan)
    common = np.concatenate([trace.shape_mm, trace.pose_mm], axis=1).mean(axis=0) * sign
    own = float(np.sqrt(common @ common + np.mean(trace.sigma_mm**2) / len(error)))
    return Result(error, trace.sigma_mm, chi2, nothing if bound is None else bound, trace.saturated, geometry, own)


def photograph(scene, light, folder: Path, rng, bits: int, dark: bool, jpeg: int | None) -> Trace:
    """Expose, write, read and measure one picture."""
    image = pictures.encode(folder / "image", pictures.photograph(light.line + light.room, rng, bits), jpeg)
    ground = pictures.encode(folder / "dark", pictures.photograph(light.room, rng, bits), jpeg) if dark else None
    photo = read_image(image, scene.camera)
    black = None if ground is None else read_image(ground, scene.camera, dark=True)
    return only_ridge(measure(photo, black, pictures.true_pose(scene), Screen(), scene.blur))


def study(kind: str, geometries: int, seed: int, folder: Path, draws: int = 1) -> list[Result]:
    results = []
    for g in range(geometries):
        rng = np.random.default_rng([seed, g])
        bits = 8 if kind == "jpeg" or g % 2 else 16
        dark = g // 2 % 2 == 0
        scene = pictures.random_scene(rng, bits)
        light = pictures.expose(scene)
        if kind == "saturated":
            light = brightened(light, 0.2)
        for _ in range(draws):
            trace = photograph(scene, light, folder, rng, bits, dark, 90 if kind == "jpeg" else None)
            s, outward = pictures.to_arc(scene, trace.points)
            outward = outward - pictures.beside_arc(scene, s)
            _, beyond = pictures.to_arc(scene, trace.points + 1e-3 * trace.normal)
            bound = None
            if kind == "plain":
                at, sigma = pictures.centre_bound(scene, light, bits, dark)
                bound = np.interp(s, at, sigma)
            # Outward from the arc's centre, whichever way the trace runs, so that draws of one geometry compare.
            results.append(judge(trace, outward, np.sign(np.median(beyond - outward)), bound, g))
    return results


def brightened(light: pictures.Light, fraction: float) -> pictures.Light:
    """More laser light, so that this fraction of the ridge's length exceeds the full well at its crest."""
    rows, columns = light.line.max(axis=1), light.line.max(axis=0)
    crest = rows if (rows > 0).sum() > (columns > 0).sum() else columns
    room = float(np.median(light.room[light.line > 0.5 * light.line.max()]))
    factor = (pictures.FULL_WELL - room) / np.quantile(crest[crest > 0.2 * crest.max()], 1 - fraction)
    return replace(light, line=light.line * factor, shift=light.shift * factor, stretch=light.stretch * factor)


def rendered(seed: int, folder: Path, quick: bool) -> list[Result]:
    """Recordings of the twelve settings rendered by benchsim, 16 and 8 bit, against the ray model's trace."""
    from benchsim.rays.curve import trace_curve
    from benchsim.renderer import backend, render_recording

    backend.use()
    bench = read(benchsim_scene("campaign12.toml"), images=False)
    results = []
    for bits in (16, 8):
        cameras = {
            k: replace(
                c, bit_depth=bits, saturation_level=2.0**bits - 1, black_level=c.black_level * 2.0 ** (bits - 16)
            )
            for k, c in bench.cameras.items()
        }
        some = replace(bench, cameras=cameras, exposures=bench.exposures[:3] if quick else bench.exposures)
        truth = render_recording(some, folder / f"rendered-{bits}", seed=seed)
        recording = read(folder / f"rendered-{bits}")
        for e, placement in zip(recording.exposures, truth.placements, strict=True):
            curve = trace_curve(
                truth.laser,
                recording.mirror,
                recording.physics,
                recording.screen,
                placement,
                facet=e.facet,
                samples=200,
            )
            trace = only_ridge(extract(recording, e))
            error = signed_distance(curve, trace.points)[0]
            results.append(judge(trace, error, geometry=len(results)))
    return results


def benchsim_scene(name: str) -> Path:
    return Path(benchsim.__file__).parent.parent / "scenes" / name


def show(title: str, results: list[Result], bias_bar: float) -> bool:
    n = len(results)
    single = np.array([r.bias for r in results])
    geometry = np.array([r.geometry for r in results])
    bias = np.array([single[geometry == g].mean() for g in np.unique(geometry)])
    stated = np.array([r.mean_sigma for r in results])
    error, sigma = (np.concatenate([getattr(r, k) for r in results]) for k in ("error", "sigma"))
    pull = error / sigma
    each = np.array([np.std(r.error / r.sigma) for r in results])
    chi2 = np.array([r.chi2 for r in results])
    print(f"{title}: {n} pictures, {len(error)} profiles, median sigma {np.median(sigma):.4f} mm")
    print(
        f"  bias: pooled {error.mean():+.4f} ± {bias.std() / np.sqrt(len(bias)):.4f} mm; of {len(bias)} geometries, "
        f"{n // len(bias)} pictures each, largest {np.abs(bias).max():.4f} mm; bar {bias_bar} mm"
    )
    print(
        f"  mean error of single pictures: rms {np.sqrt((single**2).mean()):.4f}, "
        f"largest {np.abs(single).max():.4f} mm; "
        f"over its stated sigma ({np.median(stated):.4f} mm in the median): rms "
        f"{np.sqrt(np.mean((single / stated) ** 2)):.2f}"
    )
    print(
        f"  pulls: std {pull.std():.3f} pooled, {each.min():.2f} … {each.max():.2f} per picture; bar 0.9 … 1.15; "
        f"χ² per profile with the full covariance {chi2.mean():.3f}"
    )
    good = abs(error.mean()) <= bias_bar and np.abs(bias).max() <= bias_bar and 0.9 <= pull.std() <= 1.15
    bound = np.concatenate([r.bound for r in results])
    if np.isfinite(bound).all():
        ratio = np.array([np.mean((r.error / r.bound) ** 2) for r in results])
        print(
            f"  variance over the bound: {np.mean((error / bound) ** 2):.3f} ± {ratio.std() / np.sqrt(n):.3f} pooled, "
            f"median picture {np.median(ratio):.3f}, largest {ratio.max():.2f}; bar 1.25"
        )
        good &= bool(np.mean((error / bound) ** 2) <= 1.25)
    hit = np.concatenate([r.saturated for r in results]) > 0
    if hit.any():
        print(
            f"  profiles with saturated pixels: {100 * hit.mean():.0f} %, bias {error[hit].mean():+.4f} mm, pull std "
            f"{pull[hit].std():.2f}"
        )
    print(f"  {'met' if good else 'NOT met'}")
    return bool(good)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--geometries", type=int, default=120)
    parser.add_argument("--draws", type=int, default=2, help="pictures of every plain geometry: a bias is a mean")
    parser.add_argument("--rendered", action="store_true")
    parser.add_argument("--quick", action="store_true", help="12 geometries")
    options = parser.parse_args()
    n = 12 if options.quick else options.geometries
    cv2.setNumThreads(1)
    print(f"seed {options.seed}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        met = show("plain, 16 and 8 bit", study("plain", n, options.seed, folder, options.draws), 0.01)
        met &= show("brightest 20 % saturated", study("saturated", max(n // 3, 6), options.seed, folder), 0.05)
        met &= show("JPEG quality 90, 8 bit", study("jpeg", max(n // 3, 6), options.seed, folder), 0.05)
        if options.rendered:
            met &= show("rendered by benchsim, 16 and 8 bit", rendered(options.seed, folder, options.quick), 0.01)
    print("every bar met" if met else "a bar is NOT met")


if __name__ == "__main__":
    main()
