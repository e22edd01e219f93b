"""The truth: what the detectors record, in time, from the geometry of facets that pass.

Nothing here knows cones, traces or labels. At each of many angles of a turning prism, points of the facet that passes
are joined with a detector; the law of reflection says from where in the sky light would reach it, and the sun's
radiance there, if it is the sun, falls on the detector with the two cosines over the squared distance. That is one
passage. The passages of all prisms are laid into the detector's current at their instants, at ``OVERSAMPLE`` times the
sampling rate; the converter's filter and decimation, background, flicker, shot and amplifier noise follow.

    y_i(t) = (B_i (1 + l_i(t)) + Σ_k m_ki(t)) (1 + g(t)) + white noise

Left out: the sun's motion, which the heliostat follows (an aligned trace moves by 0.1 mrad across itself in 20 s at
most, evenly to both sides of the record's middle, whose geometry is meant), the sun's aureole, tilts of single
facets, quantisation, saturation.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from benchsim.arrays.plant import Assumptions, Plant

Array = NDArray[np.float64]

ELEMENTARY_CHARGE = 1.602176634e-19
"""[C], exact."""

OVERSAMPLE = 16
"""Currents are simulated at this multiple of the sampling rate, each sample a triangle-weighted mean of the light, so
that overtones that fold into the band are below 1e-4 of the fundamental."""

_TAPS = 52 * OVERSAMPLE + 1
"""Of the converter's filter: flat to 0.4 of the sampling rate, −80 dB from 0.5 on."""

_COARSE, _FINE = 48, 256
"""Angles of the search for the passage over one facet's turn, and over the passage."""


@dataclass(frozen=True, eq=False)
class Truth:
    """What nobody measuring knows.

    Attributes
    ----------
    misalignment : (n, 2) ndarray
        (ε, φ) of each heliostat [rad].
    phase : (n, 2) ndarray
        Angle of each prism at t = 0 [rad].
    transmission : (n, 2) ndarray
        Share of each prism's light that is neither shaded nor blocked; 0 is blocked.
    rate_error : (n, 2) ndarray
        Relative error of each prism's rate.
    facet_reflectance : (n, 2, facets) ndarray
        Of each facet over the mean; ones unless facets differ.
    """

    misalignment: Array
    phase: Array
    transmission: Array
    rate_error: Array
    facet_reflectance: Array


def draw_truth(
    plant: Plant, assumptions: Assumptions, misalignment: ArrayLike, rng: np.random.Generator, facet_spread: float = 0.0
) -> Truth:
    """Truth with drawn phases and rates; nothing blocked.

    Parameters
    ----------
    plant, assumptions
    misalignment : (n, 2) array
        [rad]
    rng : Generator
    facet_spread : float
        Relative rms of the facets' reflectances about their mean.
    """
    n = len(plant.heliostats)
    spread = 1 + facet_spread * rng.standard_normal((n, 2, plant.facets))
    return Truth(
        np.asarray(misalignment, float),
        rng.uniform(0, 2 * np.pi, (n, 2)),
        np.ones((n, 2)),
        assumptions.rate_error * rng.standard_normal((n, 2)),
        spread / spread.mean(axis=-1, keepdims=True),
    )


@dataclass(frozen=True, eq=False)
class Passage:
    """Light of one facet that passes, on the detectors that it reaches.

    Attributes
    ----------
    detectors : (k,) ndarray of int
    first : (k,) ndarray
        Angle of the prism, from where a facet looks along n, at the first column of ``light`` [rad].
    step : float
        Between columns [rad].
    light : (k, q) ndarray
        Irradiance for unit direct irradiance and reflectance.
    """

    detectors: NDArray[np.int_]
    first: Array
    step: float
    light: Array = field(repr=False)


def passage(plant: Plant, heliostat: int, kind: int, misalignment: Array) -> Passage:
    """One facet's passage, by tracing detectors back to the sky at many angles of the prism.

    Facet points are q = r n + w t + h a from C, with n and t turning about a; a detector stands at y from C. The ray
    is d = (y − q)/|y − q|, and the light would come from v = 2 (n·d) n − d; only v·S, the cosines and the distance
    matter, so that the products of y and S with n, t and a are all that is needed.
    """
    frame = plant.frames[heliostat]
    body = frame @ Rotation.from_rotvec(misalignment @ frame[1:]).as_matrix().T
    normal, axis = body[0], body[1 + kind]
    side = np.cross(axis, normal)
    r, source = plant.prism_radius, plant.source
    across, height = r * np.tan(np.pi / plant.facets), plant.prism_height / 2

    def seen_from(detectors: Array, angles: Array, w: float, h: float) -> tuple[Array, Array, Array, Array]:
        """v·S, n·d, −d_x and |y − q| of detectors (k, 3) at angles (k, q) or (q,)."""
        y = detectors - plant.heliostats[heliostat]
        c, s = np.cos(angles), np.sin(angles)
        yn, yt = (u[:, None] * c + v[:, None] * s for u, v in ((y @ normal, y @ side), (y @ side, -y @ normal)))
        sn, st = (u * c + v * s for u, v in ((source @ normal, source @ side), (source @ side, -source @ normal)))
        nx, tx = c * normal[0] + s * side[0], c * side[0] - s * normal[0]
        ya, ys, yy = y @ axis, y @ source, np.sum(y * y, axis=1)
        length = np.sqrt(yy[:, None] - 2 * (r * yn + w * yt + h * ya[:, None]) + (r * r + w * w + h * h))
        nd = (yn - r) / length
        sd = (ys[:, None] - r * sn - w * st - h * (source @ axis)) / length
        dx = (y[:, :1] - r * nx - w * tx - h * axis[0]) / length
        return 2 * nd * sn - sd, nd, -dx, length

    turn = 2 * np.pi / plant.facets
    coarse = turn * (np.arange(-1, _COARSE + 1) / _COARSE - 0.5)  # one turn of a facet, and a neighbour at either end
    near, _, _, length = seen_from(plant.detectors, coarse, 0.0, 0.0)
    best = 1 + np.argmax(near[:, 1:-1], axis=1)
    rows = np.arange(len(best))
    before, at, after = (near[rows, best + k] for k in (-1, 0, 1))
    shift = 0.5 * (before - after) / np.minimum(before - 2 * at + after, -1e-30)
    peak = at + 0.25 * (after - before) * shift  # of the parabola: the cosine of the nearest approach
    reach = plant.beam.edge + 1.2 * height / length[:, 0]
    seen = np.flatnonzero(np.arccos(np.clip(peak, -1, 1)) < reach + 1e-4)
    middle = coarse[best[seen]] + np.clip(shift[seen], -1, 1) * turn / _COARSE
    # the reflected ray turns twice as fast as the facet, on a circle about the axis through the source
    half = 1.1 * (reach.max() + 1.2 * across / length.min()) / (2 * np.linalg.norm(np.cross(axis, source)))
    offsets = np.linspace(-half, half, _FINE)
    angles = middle[:, None] + offsets

    light = np.zeros(angles.shape)
    nodes_h, weights_h = leggauss(4)
    nodes_w, weights_w = leggauss(2)
    for u, wu in zip(nodes_h, weights_h, strict=True):
        for v, wv in zip(nodes_w, weights_w, strict=True):
            sky, nd, facing, length = seen_from(plant.detectors[seen], angles, v * across, u * height)
            radiance = plant.beam.radiance(2 * (1 - sky))
            area = wu * wv * across * height
            light += area * radiance * np.maximum(nd, 0) * np.maximum(facing, 0) / length**2
    return Passage(seen, angles[:, 0], float(offsets[1] - offsets[0]), light)


def clean(plant: Plant, assumptions: Assumptions, truth: Truth, heliostats: list[int] | None = None) -> Array:
    """Irradiance that the prisms put on the detectors, as the converter passes it, without noise (m, samples) [W/m²].

    Parameters
    ----------
    plant, assumptions, truth
    heliostats : list of int, optional
        Those that shine; default all.
    """
    from scipy import signal  # half a second, which planning does without

    dt = 1 / (plant.sample_rate * OVERSAMPLE)
    lead = _TAPS // 2
    count = plant.samples * OVERSAMPLE
    padded = count + 2 * lead
    current = np.zeros((len(plant.detectors), padded))
    for k in range(len(plant.heliostats)) if heliostats is None else heliostats:
        for kind in range(2):
            if truth.transmission[k, kind] > 0:
                _lay(current, plant, truth, k, kind, dt, lead)
    current *= assumptions.direct_irradiance * assumptions.reflectance
    taps = signal.firwin(_TAPS, 0.45 * plant.sample_rate, window=("kaiser", 8.0), fs=plant.sample_rate * OVERSAMPLE)
    out = np.zeros((len(plant.detectors), plant.samples))
    for i in np.flatnonzero(current.any(axis=1)):
        out[i] = signal.upfirdn(taps, current[i], 1, OVERSAMPLE)[2 * lead // OVERSAMPLE :][: plant.samples]
    return out


def _lay(current: Array, plant: Plant, truth: Truth, k: int, kind: int, dt: float, lead: int) -> None:
    """Lay all passages of a prism into the currents."""
    from scipy import signal  # half a second, which planning does without

    one = passage(plant, k, kind, truth.misalignment[k])
    if not len(one.detectors):
        return
    rate = plant.rates[k, kind] * (1 + truth.rate_error[k, kind])
    speed = 2 * np.pi * rate / plant.facets
    step = one.step / speed
    # each sample is the mean of the light under a triangle of half-width dt: the passage drawn out once and for all
    half = int(np.ceil(dt / step))
    triangle = np.maximum(0, 1 - np.abs(np.arange(-half, half + 1)) * step / dt)
    shape = signal.fftconvolve(one.light, triangle[None, :] / triangle.sum(), axes=1)
    shape[:, [0, -1]] = 0.0
    grid = step * np.arange(shape.shape[1])
    start = (one.first - truth.phase[k, kind]) / speed - half * step
    early, late = -lead * dt - grid[-1], (current.shape[1] - lead) * dt
    first = int(np.floor((early - start.max()) * rate))
    number = np.arange(first, int(np.ceil((late - start.min()) * rate)) + 1)
    facet = truth.facet_reflectance[k, kind][-number % plant.facets] * truth.transmission[k, kind]
    width = int(np.ceil(grid[-1] / dt)) + 1
    for i, s, form in zip(one.detectors, start, shape, strict=True):
        begins = s + number / rate
        index = np.ceil(begins / dt).astype(int)
        for j in range(width):
            value = facet * np.interp((index + j) * dt - begins, grid, form, right=0.0)
            where = index + j + lead
            keep = (where >= 0) & (where < current.shape[1])
            # passages are further apart than they are long, so that no index comes twice
            current[i, where[keep]] += value[keep]


def background(plant: Plant, assumptions: Assumptions, rng: np.random.Generator) -> Array:
    """Steady light on each detector (m,) [W/m²]."""
    spread = assumptions.background_spread
    return assumptions.background * rng.uniform(1 - spread, 1 + spread, len(plant.detectors))


def record(
    plant: Plant, assumptions: Assumptions, truth: Truth, steady: Array, rng: np.random.Generator,
    light: Array | None = None,
) -> Array:  # fmt: skip
    """What the converter writes (m, samples) [W/m² on the detector].

    Parameters
    ----------
    plant, assumptions, truth
    steady : (m,) array
        :func:`background`.
    rng : Generator
    light : (m, samples) array, optional
        :func:`clean`, if it is known already.
    """
    a = assumptions
    beams = clean(plant, a, truth) if light is None else light
    common = 1 + _flicker(a.flicker_common, a, (1, plant.samples), rng)
    local = 1 + _flicker(a.flicker_local, a, beams.shape, rng)
    total = (steady[:, None] * local + beams) * common
    if a.gain_spread:
        total = total * (1 + a.gain_spread * rng.standard_normal((len(total), 1)))
    return total + np.sqrt(white_level(a, total) * plant.sample_rate / 2) * rng.standard_normal(total.shape)


def white_level(assumptions: Assumptions, irradiance: ArrayLike) -> Array:
    """One-sided density of shot and amplifier noise at an irradiance, as irradiance [(W/m²)²/Hz]."""
    per = assumptions.responsivity * assumptions.detector_area * 1e-6
    shot = 2 * ELEMENTARY_CHARGE * per * np.asarray(irradiance, float)
    return (shot + assumptions.amplifier_noise**2) / per**2


def flicker_density(assumptions: Assumptions, rms: float, rate: ArrayLike) -> Array:
    """One-sided density of flicker of a relative rms at frequencies (...) [1/Hz]."""
    corner, f = assumptions.flicker_corner, np.asarray(rate, float)
    return 2 * rms**2 * corner / (np.pi * (corner**2 + f**2))


def _flicker(rms: float, assumptions: Assumptions, shape: tuple[int, int], rng: np.random.Generator) -> Array:
    """First-order process, stationary, along the last axis, as the converter's filter passes it."""
    from scipy import signal  # half a second, which planning does without

    finer = 4
    rate = assumptions.sample_rate * finer
    taps = signal.firwin(_TAPS // 4 + 1, 0.45 * assumptions.sample_rate, window=("kaiser", 8.0), fs=rate)
    memory = np.exp(-2 * np.pi * assumptions.flicker_corner / rate)
    count = shape[1] * finer + len(taps)
    kicks = rms * np.sqrt(1 - memory**2) * rng.standard_normal((shape[0], count))
    kicks[:, 0] /= np.sqrt(1 - memory**2)
    fine = signal.lfilter([1.0], [1.0, -memory], kicks, axis=-1)
    skip = len(taps) // finer + 1
    return np.asarray(signal.upfirdn(taps, fine, 1, finer, axis=-1)[:, skip : skip + shape[1]])
