"""Moments of a plant, one after the other or on other processes, by either engine; and why the engines part."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.errors import BenchsimError
from benchsim.jobs.cluster import Each, Scheduler, cluster, here
from benchsim.plant.model import Mesh, Plant
from benchsim.plant.moment import Moment, meshes, moment

Array = NDArray[np.float64]
Errors = Mapping[str, Array]

LONG = 20.0
"""Work that this process would take longer for [s] is spread over others, which take some seconds to start."""

TOP = 0.95
"""Cells in which the product is above this part of its peak are where peaks are compared: many, so that noise of the
Monte Carlo in one of them is of no concern."""


@dataclass(frozen=True)
class Engine:
    """How a moment is computed.

    Attributes
    ----------
    name : {"product", "carlo"}
    cells : int or None
        Of maps, as `benchsim.plant.moment.meshes` takes them.
    accuracy : float
        Relative standard error of the Monte Carlo at one moment.
    seed : int
        Of the Monte Carlo.
    variant : str or None
        Of Mitsuba.
    """

    name: str = "product"
    cells: int | None = None
    accuracy: float = 0.01
    seed: int = 0
    variant: str | None = None

    def moment(
        self, plant: Plant, sun: Array, sky: float, errors: Errors, grids: tuple[Mesh, ...] | None = None, **more: Any
    ) -> Moment:
        """The plant at one moment."""
        grids = grids or meshes(plant, self.cells)
        if self.name == "product":
            return moment(plant, sun, sky, errors, grids)
        # Mitsuba is loaded by who wants rays alone.
        from benchsim.plant.traced import moment_traced

        return moment_traced(
            plant, sun, sky, errors, grids, accuracy=self.accuracy, seed=self.seed, variant=self.variant, **more
        )


@dataclass(frozen=True)
class Pool:
    """Where work is done.

    Attributes
    ----------
    scheduler : Scheduler or None
        Of Dask, one's own.
    workers : int or None
        Processes of this machine; None: as many as there are cores if the work is long, 0: none.
    own : bool
        Whether work uses all cores by itself, so that processes are started only if they are asked for.
    """

    scheduler: Scheduler | None = None
    workers: int | None = None
    own: bool = False


def done(
    function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]], pool: Pool, told: Callable[[float], None]
) -> list[Any]:
    """Results of a function for all tasks, in their order; ``told`` hears which part is done.

    Raises
    ------
    Exception
        The first that ended one of them.
    """
    out: list[Any] = [None] * len(tasks)
    first = 0
    started: Any = None
    if pool.scheduler is None and pool.workers is None:
        begun = time.perf_counter()
        out[0] = function(*tasks[0])
        first = 1
        told(1 / len(tasks))
        left = (len(tasks) - 1) * (time.perf_counter() - begun)
        started = cluster(None, 0 if pool.own or left < LONG else None)
    else:
        started = cluster(pool.scheduler, pool.workers)
    if first == len(tasks):
        return out

    def every(each: Each) -> None:
        for count, (k, result) in enumerate(each(function, tasks[first:]), first + 1):
            if isinstance(result, BaseException):
                raise result
            out[first + k] = result
            told(count / len(tasks))

    if first + 1 == len(tasks) and pool.scheduler is None:
        every(here)
        return out
    with started as each:
        every(each)
    return out


def moments(
    plant: Plant, suns: Array, sky: Array, errors: Errors, engine: Engine, pool: Pool, told: Callable[[float], None]
) -> tuple[Moment, ...]:
    """The plant at several suns."""
    tasks = [
        (plant, s, float(i), errors, replace(engine, seed=engine.seed * 1009 + k))
        for k, (s, i) in enumerate(zip(suns, sky, strict=True))
    ]
    grids = meshes(plant, engine.cells)
    return tuple(replace(m, meshes=grids) for m in done(bare_moment, tasks, pool, told))


def bare_moment(plant: Plant, sun: Array, sky: float, errors: Errors, engine: Engine) -> Moment:
    """A moment without its meshes, which the other side has."""
    return replace(engine.moment(plant, sun, sky, errors), meshes=())


@dataclass(frozen=True)
class Parting:
    """How two engines part at one moment, on one receiver.

    Attributes
    ----------
    receiver : str
    power, peak : (float, float, float)
        By the product, by Monte Carlo, and the latter's standard error [kW], [kW/m²]; peaks are means over the same
        cells, those in which the product is above `TOP` of its own.
    centroid : (float, float)
        Of the light by Monte Carlo, from that by the product, along and up [m].
    causes : tuple of (str, (float, float), (float, float))
        What the product simplifies, and by which part that changes power and peak, each with its standard error.
    """

    receiver: str
    power: tuple[float, float, float]
    peak: tuple[float, float, float]
    centroid: tuple[float, float]
    causes: tuple[tuple[str, tuple[float, float], tuple[float, float]], ...]

    def sentences(self) -> list[str]:
        """For a person."""
        (p, c, s), (pp, cp, sp) = self.power, self.peak
        out = [
            f"  {self.receiver}: product {p:.4g} kW, Monte Carlo {c:.4g} ± {s:.2g} ({100 * (p / c - 1):+.2f} %); at "
            f"the peak {pp:.4g} and {cp:.4g} ± {sp:.2g} kW/m² ({100 * (pp / cp - 1):+.2f} %); centroids "
            f"{1e3 * float(np.hypot(*self.centroid)):.0f} mm apart"
        ]
        for words, power, peak in self.causes:
            both = (f"{what} {100 * by:+.2f} ± {100 * s:.2f} %" for what, (by, s) in (("power", power), ("peak", peak)))
            out.append(f"    {words}: {', '.join(both)}")
        return out


def over_cells(values: Array, around: bool) -> Array:
    """Means over cells of a function given at their centres, to fourth order: its second differences, a 24th."""
    pad = np.pad(values, 1, mode="reflect", reflect_type="odd")
    if around:
        pad[0, 1:-1], pad[-1, 1:-1] = values[-1], values[0]
    bend = pad[:-2, 1:-1] + pad[2:, 1:-1] + pad[1:-1, :-2] + pad[1:-1, 2:] - 4 * values
    return values + bend / 24


SLOPES, FACETS, REST = (
    "slopes taken to spread alike in and across the plane of incidence",
    "facets' images and their canting taken for a Gaussian",
    "the rest (the sun as a sum of Gaussians, a mirror's own aberrations, the receiver's depth, edges of shadows)",
)


def parted(plant: Plant, sun: Array, sky: float, errors: Errors, product: Moment, carlo: Moment, engine: Engine) -> Any:
    """How the engines part, and why: Monte Carlo with one simplification of the product after the other.

    Parameters
    ----------
    plant, sun, sky, errors
        Of the moment.
    product, carlo : Moment
        By both engines.
    engine : Engine
        Of the Monte Carlo.

    Returns
    -------
    tuple of Parting
        Of each receiver that is lit.
    """
    o, f = plant.optics, plant.field
    chain: list[tuple[str, Moment]] = []
    like, more = plant, np.full(len(f), o.specularity)
    if o.slope:
        like = replace(like, optics=replace(o, slope=0.0))
        more = np.hypot(more, 2 * o.slope)
        chain.append((SLOPES, engine.moment(like, sun, sky, errors, product.meshes, specularity=more)))
    if not (np.isnan(f.focal).all() and np.isnan(f.canting).all()):
        none = np.full(len(f), np.nan)
        sphere = replace(f, focal=none, canting=none, facets=np.ones_like(f.facets))
        like = replace(like, field=sphere)
        more = plant.blur
        chain.append((FACETS, engine.moment(like, sun, sky, errors, product.meshes, specularity=more)))
    out = []
    for k, receiver in enumerate(plant.receivers):
        mesh = product.meshes[k]
        flat = over_cells(product.flux[k], receiver.kind == "cylinder")
        top = flat >= TOP * flat.max()
        if not carlo.received[k] or not flat.max():
            continue
        powers, peaks = [], []
        for m in (carlo, *(m for _, m in chain)):
            assert m.noise is not None
            spread = m.noise.flux[k]
            powers.append((float(m.received[k]), float(m.noise.received[k])))
            peaks.append((float(m.flux[k][top].mean()), float(np.sqrt((spread[top] ** 2).sum())) / top.sum()))
        powers.append((float(product.received[k]), 0.0))
        peaks.append((float(flat[top].mean()), 0.0))
        words = [w for w, _ in chain] + [REST]
        steps = zip(words, *(zip(v[1:], v[:-1], strict=True) for v in (powers, peaks)), strict=True)
        causes = tuple((w, _change(*power), _change(*peak)) for w, power, peak in steps)
        centres = [_centroid(m.flux[k], mesh, receiver.kind == "cylinder", receiver.radius) for m in (product, carlo)]
        apart = (centres[1] - centres[0]) / 1e3
        out.append(
            Parting(
                receiver.name,
                (powers[-1][0] / 1e3, powers[0][0] / 1e3, powers[0][1] / 1e3),
                (peaks[-1][0] / 1e3, peaks[0][0] / 1e3, peaks[0][1] / 1e3),
                (float(apart[0]), float(apart[1])),
                causes,
            )
        )
    if not out:
        raise BenchsimError("--engine: no receiver is lit by both engines; mend the plant's errors or aims")
    return tuple(out)


def _change(to: tuple[float, float], of: tuple[float, float]) -> tuple[float, float]:
    """By which part a value differs from another, and its standard error by both of theirs.

    Rays of one seed go together if at all, so that it is too large rather than too small.
    """
    ratio = to[0] / of[0]
    return ratio - 1, float(np.hypot(to[1] / of[0], ratio * of[1] / of[0]))


def _centroid(values: Array, mesh: Mesh, around: bool, radius: float) -> Array:
    along = values.sum(axis=1)
    if around:
        u = radius * float(np.angle(along @ np.exp(1j * mesh.u / radius)))
    else:
        u = float(along @ mesh.u / along.sum())
    return np.array([u, float(values.sum(axis=0) @ mesh.v / values.sum())])
