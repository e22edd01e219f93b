"""Time and memory of a plant's flux at one hour, by its parts, for fields of growing size.

Radial stagger all around a tower, an external cylinder, errors of the mounts; the sun high and low.

    python analysis/plant_time.py [--heliostats 10000] [--dense]
    python analysis/plant_time.py --carlo [--heliostats 1000] [--accuracy 0.01] [--seed 1]

The second is the Monte Carlo: until the standard errors of the receiver's power and of the brightest cell are 1 %.
"""

from __future__ import annotations

import argparse
import math
import resource
import sys
import time
from zoneinfo import ZoneInfo

import numpy as np

from benchsim.instruments.mount.axes import reflected
from benchsim.instruments.mount.records import toward
from benchsim.plant import sunshape
from benchsim.plant.layout import radial_stagger
from benchsim.plant.model import Field, Optics, Plant, Receiver, Site
from benchsim.plant.moment import meshes, moment, normals
from benchsim.plant.shading import lost
from benchsim.plant.traced import moment_traced


def field(count: int, dense: bool) -> Plant:
    """Mirrors of 12 m × 10 m around a tower of 150 m; dense: rings as near as the mirrors' diagonal allows."""
    tower = 150e3
    places = radial_stagger(count, 12e3, 10e3, 75e3, 1e9 if dense else tower)
    position = np.c_[places, np.full(count, 6e3)]
    receiver = Receiver("receiver", "cylinder", (0.0, 0.0, 6e3 + tower), 16e3, 20e3)
    nan, rng = np.full(count, np.nan), np.random.default_rng(1)
    errors = {name: rng.normal(0, 0.7e-3, count) for name in ("IA", "IE", "CA", "AN", "AW")}
    heliostats = Field(
        tuple(str(k) for k in range(count)), position, np.full(count, 12e3), np.full(count, 10e3),
        np.ones((count, 2), int), nan, nan, np.zeros(count, int), receiver.aim(position), errors=errors,
    )  # fmt: skip
    site = Site(math.radians(37), math.radians(-2), 500.0, ZoneInfo("UTC"))
    return Plant("", None, (), site, (receiver,), heliostats, sunshape.buie(0.05), Optics(1.5e-3))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--heliostats", type=int, default=10_000)
    parser.add_argument("--dense", action="store_true", help="rings as near as the mirrors allow")
    parser.add_argument("--carlo", action="store_true", help="by Monte Carlo")
    parser.add_argument("--accuracy", type=float, default=0.01, help="standard error of power and brightest cell")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    if options.carlo:
        carlo(min(options.heliostats, 1000), options)
        return
    for count in sorted({100, 1000, options.heliostats}):
        plant = field(count, options.dense)
        f = plant.field
        for elevation in (60.0, 10.0):
            sun = toward(np.array(2.5), np.array(math.radians(elevation)))
            start = time.process_time()
            n = normals(f, sun, f.errors)
            lost(f.position, n, f.width, f.height, sun, reflected(n, sun), f.distance)
            shading = time.process_time() - start
            start = time.process_time()
            m = moment(plant, sun, 900.0, f.errors)
            whole = time.process_time() - start
            print(
                f"{count:6d} heliostats, sun {elevation:.0f}° high, {m.flux[0].shape} cells: "
                f"{whole:.2f} s of CPU, of which {shading:.2f} for shading and blocking; shaded {m.shaded.mean():.1%}, "
                f"blocked {m.blocked.mean():.1%}, spilled {m.spillage.mean():.1%}, grid {m.grid:.0e}"
            )
    memory()


def carlo(count: int, options: argparse.Namespace) -> None:
    plant = field(count, options.dense)
    for elevation in (60.0, 10.0):
        sun = toward(np.array(2.5), np.array(math.radians(elevation)))
        for cells in (60, None):
            grids = meshes(plant, cells)
            start, cpu = time.perf_counter(), time.process_time()
            m = moment_traced(
                plant, sun, 900.0, plant.field.errors, grids, accuracy=options.accuracy, seed=options.seed
            )
            p = moment(plant, sun, 900.0, plant.field.errors, grids)
            print(
                f"{count} heliostats, sun {elevation:.0f}° high, {m.flux[0].shape} cells: {m.noise.rays / 1e6:.1f} "
                f"million rays, {time.perf_counter() - start:.1f} s by the clock, {time.process_time() - cpu:.1f} s of "
                f"CPU, standard error {m.noise.accuracy:.2%}; power {m.received[0] / 1e3:.0f} kW, product "
                f"{p.received[0] / 1e3:.0f}"
            )
    memory()


def memory() -> None:
    # Kilobytes on Linux, bytes on macOS.
    unit = 1 if sys.platform == "darwin" else 1024
    print(f"largest memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20:.0f} MiB")


if __name__ == "__main__":
    main()
