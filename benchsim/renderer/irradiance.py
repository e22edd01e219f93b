"""Irradiance on the board, in the board's millimetres: the light of one exposure, traced and binned.

A sample is a phase of the mirror and a point of the facet, weighted with the beam's density there; facets being alike,
one facet over all phases that reach the board stands for all. Samples are points of a lattice with a random shift;
several shifts give the noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Exposure, Recording
from benchsim.bench.place import Placement, place
from benchsim.renderer import backend
from benchsim.renderer.beam_table import BeamTable
from benchsim.renderer.film import Film
from benchsim.renderer.partial_physics import mixture, without
from benchsim.renderer.sweep import blur_reach, footprint, sweep
from benchsim.renderer.tracer import Tracer, opaque

Array = NDArray[np.float64]

REPLICATES = 8
"""Independent shifts of the lattice; their scatter is the noise."""

LIT = 0.05
"""A bin counts as lit above this fraction of the brightest; the noise is that of lit bins."""

FIRST, MOST = 1 << 18, 1 << 29
"""Rays per replicate that a search for the wanted noise begins with, and ends with at the latest."""


@dataclass(frozen=True)
class ScreenMap:
    """Irradiance on the board.

    Attributes
    ----------
    values : (nz, ny) ndarray [1/mm²]
        Per unit of laser power, averaged over one revolution; bin (i, j) is centred at (y0 + j pitch, z0 + i pitch) and
        holds the irradiance averaged over it with a tent of half width ``pitch`` in y and z.
    y0, z0, pitch : mm
    relative_error : float
        rms of the relative noise (1 sigma) over the lit bins, those above 5 % of the brightest.
    rays : int
        Rays traced for it.
    """

    values: Array
    y0: float
    z0: float
    pitch: float
    relative_error: float
    rays: int = 0

    @property
    def y(self) -> Array:
        """Centres of the columns (ny,) [mm]."""
        return self.y0 + self.pitch * np.arange(self.values.shape[1], dtype=float)

    @property
    def z(self) -> Array:
        """Centres of the rows (nz,) [mm]."""
        return self.z0 + self.pitch * np.arange(self.values.shape[0], dtype=float)


FAINT = 1e-7
"""Share of the laser's light on the board below which the mirror is out of the beam; Fig. 7 has 7e-2."""


def irradiance(
    recording: Recording,
    exposure: Exposure,
    *,
    placement: Placement | None = None,
    seed: int,
    rays: int | None = None,
    relative_error: float | None = None,
    pitch: float = 0.25,
    lenses: BeamTable | None = None,
) -> ScreenMap:
    """Irradiance that the turning mirror lays on the board in one exposure.

    Homocentric Gaussian beam with incoherent blur, flat facets (or the cylinder), finite width and height, Fresnel
    diffraction at the height, one facet if the exposure is gated; each as ``recording.physics`` has it. Float32, hits
    within 1 µm of float64. ``recording.effects`` and ``recording.fields`` are drawn as far as they are the light's
    (`effects.gather`); those of print and camera are the photograph's, and do nothing here.

    Parameters
    ----------
    recording : Recording
    exposure : Exposure
    placement : Placement, optional
        Where everything stands; default the stated setting.
    seed : int
        Of the lattice's shifts.
    rays : int, optional
        Number of rays; rounded up to whole replicates.
    relative_error : float, optional
        In place of ``rays``: the noise to reach, as in `ScreenMap`; default the recording's ``[render]
        relative_error``. The noise of a camera's pixel that sees several bins is smaller.
    pitch : float
        Size of a bin [mm].
    lenses : BeamTable, optional
        Aberration and shape that lenses add to the beam of ``recording.laser``.

    Returns
    -------
    ScreenMap
        Over the whole board.

    Raises
    ------
    BenchsimError
        If an effect is not known or its number not physical, or no light reaches the board.

    Notes
    -----
    Tents widen the trace by pitch²/6 of variance across. Without a beam the trace is a line without width, drawn one
    bin wide.
    """
    if rays is not None and relative_error is not None:
        raise TypeError("give rays or relative_error, not both")
    backend.use()
    parts = mixture(recording)
    if len(parts) > 1:
        lights = [
            irradiance(
                replace(recording, physics=physics, effects=without(recording.effects)),
                exposure,
                placement=placement,
                seed=seed,
                rays=rays,
                relative_error=relative_error,
                pitch=pitch,
                lenses=lenses,
            )
            for _, physics in parts
        ]
        return _mixed(lights, [share for share, _ in parts])
    recording = replace(recording, physics=parts[0][1])
    s = sweep(recording, exposure, placement or place(recording.mirror, exposure), lenses)
    film = Film(recording.screen.size, pitch, *footprint(s), blur_reach(s))
    tracer = Tracer(s)
    backend.release()
    rng = np.random.default_rng(seed)
    if rays is not None:
        per_replicate = max(1, -(-rays // REPLICATES))
        mean, error = _replicates(tracer, film, per_replicate, rng)
    else:
        target = recording.render.relative_error if relative_error is None else relative_error
        per_replicate = FIRST
        mean, error = _replicates(tracer, film, per_replicate, rng)
        share = float(mean.sum()) * s.measure
        if not share > FAINT:
            raise BenchsimError(
                f"{exposure.name}: the mirror hardly meets the beam, {share:.0e} of its light reaches the board; "
                "mend mirror_position_mm, the laser's angles or [uncertainty]"
            )
        while error > target and per_replicate < MOST:
            # The noise falls at least like 1/n; the loop mends a step too short.
            per_replicate = min(int(per_replicate * max(1.5, (error / target) ** 0.75)), MOST)
            mean, error = _replicates(tracer, film, per_replicate, rng)
        if not error <= target:
            raise BenchsimError(
                f"{exposure.name}: the light's noise is {error:.1e} after {per_replicate * REPLICATES:.0e} rays, not "
                f"{target:.1e}; give a larger render.relative_error"
            )
    backend.release()  # the rays' arrays, hundreds of megabytes, are of no use to the picture
    values = film.spread(mean)
    values *= s.measure / pitch**2
    return ScreenMap(values, film.y0, film.z0, pitch, error, per_replicate * REPLICATES)


def _mixed(lights: list[ScreenMap], shares: list[float]) -> ScreenMap:
    """Shares of several lights on one board; the noise is that of all, as if it were even over the lit bins."""
    values = np.sum([w * m.values for w, m in zip(shares, lights, strict=True)], axis=0)
    lit = values > LIT * values.max()
    noise = [(w * m.relative_error * m.values[lit]) ** 2 for w, m in zip(shares, lights, strict=True)]
    error = float(np.sqrt(np.mean(np.sum(noise, axis=0) / values[lit] ** 2)))
    return replace(lights[0], values=values, relative_error=error, rays=sum(m.rays for m in lights))


def _replicates(tracer: Tracer, film: Film, n: int, rng: np.random.Generator) -> tuple[Array, float]:
    """Mean weight per ray at the film's nodes, and the relative noise of the lit ones."""
    total, squares = mi.Float(0.0), mi.Float(0.0)
    for _ in range(REPLICATES):
        cells = film.empty()
        y, z, weight, arrives, _sample = tracer(tracer.points(n, rng))
        film.add(cells, y, z, weight, arrives)
        nodes = film.nodes(cells) * opaque(1 / n)
        total += nodes
        squares += nodes * nodes
        dr.eval(total, squares)
    mean = total.numpy().astype(float) / REPLICATES
    lit = mean > LIT * mean.max()
    spread = np.maximum(squares.numpy()[lit] / REPLICATES - mean[lit] ** 2, 0) / (REPLICATES - 1)
    return mean, float(np.sqrt(np.mean(spread / mean[lit] ** 2)))
