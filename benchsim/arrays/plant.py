"""The plant: heliostats with two prisms each, and two arrays of detectors around the receiver.

The paper says that two arrays of detectors stand outside the receiver and that every prism turns at its own rate
(Carretero 2019, sections 2 and 4.3); it prints no position, count, power or rate. What is assumed in their place stands
in :class:`Assumptions`, each with its reason. :class:`Plant` is what of it an operator knows: the simulation of light
and noise takes both, the measurement the plant alone.

Prisms and axes are in the order of :data:`KINDS`, elevation first. A misalignment is a pair (ε, φ) in that order: the
heliostat is turned about its centre of rotation C by the vector ε a_e + φ a_a, with a_e = z × n and a_a = n × (z × n)
the axes of the paper's two cylinders. The *elevation prism* turns about a_e, so an error ε only lets its light pass
earlier or later: its trace tells φ, and the azimuth prism's trace tells ε.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from scipy.special import ive

from benchsim.bench.errors import BenchsimError
from benchsim.bench.place import ideal_normal, rotation_axis
from benchsim.vector import Cylinder

Array = NDArray[np.float64]

KINDS = ("elevation", "azimuth")
"""The cylinder that a prism stands for; also the component of a misalignment."""

ARRAYS = ("horizontal", "vertical")
"""The arrays: along y above the receiver, along z beside it."""


@dataclass(frozen=True)
class Assumptions:
    """What the paper does not print. Lengths in mm, irradiances in W/m², rates in Hz.

    Attributes
    ----------
    array_offset : float
        Distance of either array from the receiver's centre: the receiver of Fig. 5 is 14 m square
        (``analysis/fig5.py``), and 2 m beyond its edge the detectors are out of its heat.
    array_half_length : float
        A heliostat 900 m away that is 10 mrad off puts its trace 18 m from the middle.
    pitch : float
        The sun's image is 1.9 m wide from the nearest heliostats: four detectors across it.
    heliostat_radius : float
        r, axis to mirror, for the aim by Eq. (17); as in ``analysis/fig4.py``.
    prism_radius, prism_height : float
        Inscribed radius and length of the prism, which stands at C: with 36 facets of 26 × 150 mm a body that turns at
        four to five revolutions per second. From 150 m a facet looks a tenth of the sun's width.
    facets : int
        Each sweeps its light over 4π/facets = 20°, enough for both arrays from the nearest heliostat and no more:
        light swept elsewhere is lost.
    reflectance : float
        Glass mirror in use.
    direct_irradiance, sun_radius, limb_darkening, facet_error
        Clear sky; the sun's mean radius [rad]; u of I(μ) = 1 − u (1 − μ), between 0.6 at 550 nm and 0.4 at 900 nm for
        silicon; rms slope error of a facet [rad], which blurs the sun's image by twice as much in each direction.
    background : float
        Steady light on a detector whose hood shows it the field: ground and sky at 100 W/m² on average;
        ``background_spread`` is the relative half-width over the detectors.
    flicker_common, flicker_local, flicker_corner : float
        Relative rms of sunlight's flicker, alike for all light (haze), and of each detector's own background
        (turbulence, swaying mirrors beside the receiver); both fall as 1/f² in power above the corner. Day-time
        scintillation of a source as wide as the sun is about 1e-3; the slope is that of a first-order process,
        shallower than Kolmogorov's 8/3 and so the harder case at the labels.
    detector_area, responsivity : float
        Silicon photodiode of 1 cm² [mm²], [A/W].
    amplifier_noise : float
        Current noise of amplifier and 24-bit converter with 5 mA full scale, one-sided [A/√Hz].
    rate_low, rate_high : float
        Band of the labels: above the flicker, below the converter's 200 Hz, and within one octave, so that no prism's
        overtone falls on another's label.
    sample_rate, duration : float
        The converter's filter passes 0.4 of the sampling rate and stops 0.5: the labels pass, their overtones (from 254
        Hz) do not, and each prism is one line. The duration makes 200 labels stand seven line widths apart. (A faster
        converter would record up to 40 overtones and more of the light; one line per prism is what lock-ins read.)
    rate_error : float
        Relative rms of a prism's true rate about its label: a quartz clock.
    drive_error : float
        Relative rms by which a drive turns further, or less far, than it is told.
    gain_spread : float
        Relative rms of the detectors' responsivities about their mean, as calibrated; the paper's heliostats are so far
        that it hardly matters.
    """

    array_offset: float = 9000.0
    array_half_length: float = 20000.0
    pitch: float = 500.0
    heliostat_radius: float = 500.0
    prism_radius: float = 150.0
    prism_height: float = 150.0
    facets: int = 36
    reflectance: float = 0.9
    direct_irradiance: float = 900.0
    sun_radius: float = 4.65e-3
    limb_darkening: float = 0.5
    facet_error: float = 0.25e-3
    background: float = 100.0
    background_spread: float = 0.5
    flicker_common: float = 2e-3
    flicker_local: float = 1e-3
    flicker_corner: float = 0.5
    detector_area: float = 100.0
    responsivity: float = 0.5
    amplifier_noise: float = 3.5e-10
    rate_low: float = 127.0
    rate_high: float = 197.0
    sample_rate: float = 500.0
    duration: float = 20.0
    rate_error: float = 1e-6
    drive_error: float = 0.02
    gain_spread: float = 0.0


@dataclass(frozen=True, eq=False)
class Beam:
    """The sun as a facet reflects it: its limb-darkened disc, blurred by the facet's slope errors.

    Attributes
    ----------
    edge : float
        Angle from the centre beyond which it is dark [rad].
    by_square : CubicSpline
        Radiance over direct irradiance [1/sr], a function of the angle's *square*.
    """

    edge: float
    by_square: CubicSpline

    def radiance(self, square: ArrayLike) -> Array:
        """Radiance over direct irradiance at squared angles (...) from the centre [1/sr]."""
        q = np.asarray(square, float)
        return np.where(q < self.edge**2, self.by_square(np.clip(q, 0, self.edge**2)), 0.0)


def beam(assumptions: Assumptions) -> Beam:
    """Beam of a facet: the disc's rings, each blurred by an isotropic Gaussian of 2 × the slope error."""
    return _beam(assumptions.sun_radius, 2 * assumptions.facet_error, assumptions.limb_darkening)


@lru_cache(maxsize=16)
def _beam(rho: float, blur: float, u: float) -> Beam:
    nodes, weights = leggauss(400)
    ring, weights = 0.5 * rho * (nodes + 1), 0.5 * rho * weights
    disc = (1 - u * (1 - np.sqrt(1 - (ring / rho) ** 2))) / (np.pi * rho**2 * (1 - u / 3))
    edge = rho + 5 * blur
    theta = np.linspace(0, edge, 161)[:, None]
    # the Gaussian about a ring's point, averaged over the ring: exp(−(r² + θ²)/2σ²) I₀(rθ/σ²), kept from overflow
    spread = np.exp(-0.5 * ((ring - theta) / blur) ** 2) * ive(0, ring * theta / blur**2)
    return Beam(edge, CubicSpline(theta[:, 0] ** 2, spread @ (weights * disc * ring) / blur**2))


@dataclass(frozen=True)
class Line:
    """One array of detectors: a straight row on the plane x = 0.

    Attributes
    ----------
    name : str
    upright : bool
        Along z; otherwise along y.
    offset : float
        z of an array along y, y of an upright one [mm].
    low, high : float
        Where its first detector stands along it, and beyond which there is none [mm].
    pitch : float
        [mm]
    """

    name: str
    upright: bool
    offset: float
    low: float
    high: float
    pitch: float

    @property
    def along(self) -> Array:
        """Of its detectors [mm]."""
        count = int((self.high - self.low) / self.pitch + 1e-6) + 1
        return np.asarray(self.low + self.pitch * np.arange(count), float)

    def places(self, along: Array) -> Array:
        """(k, 3) of points along it."""
        zero, off = np.zeros_like(along), np.full_like(along, self.offset)
        return np.stack([zero, off, along] if self.upright else [zero, along, off], axis=-1)


def two_lines(assumptions: Assumptions) -> tuple[Line, ...]:
    """The paper's arrays."""
    half = assumptions.array_half_length // assumptions.pitch * assumptions.pitch
    return tuple(
        Line(name, upright, assumptions.array_offset, -half, half, assumptions.pitch)
        for name, upright in zip(ARRAYS, (False, True), strict=True)
    )


@dataclass(frozen=True, eq=False)
class Plant:
    """What whoever measures knows: nominal geometry, labels, sampling. World frame, mm.

    Attributes
    ----------
    heliostats : (n, 3) ndarray
        C, the centres of rotation.
    source : (3,) ndarray
        S, unit, toward the sun.
    rates : (n, 2) ndarray
        Facets that pass per second, of the elevation and the azimuth prism [Hz]: the labels.
    detectors : (m, 3) ndarray
        On the plane x = 0, facing +x.
    member : (m,) ndarray of int
        Index into ``arrays``.
    along : (m,) ndarray
        y of the horizontal array's detectors, z of the vertical one's.
    heliostat_radius, prism_radius, prism_height, facets, sample_rate
        As in :class:`Assumptions`.
    beam : Beam
        The light that one point of a facet reflects.
    samples : int
        Per detector and record.
    arrays : tuple of str
        Their names.
    aims : (n, 3) ndarray or None
        Where the heliostats aim; None: at the origin.
    gain_spread : float
        As in :class:`Assumptions`.
    """

    heliostats: Array
    source: Array
    rates: Array
    detectors: Array
    member: NDArray[np.int_]
    along: Array
    heliostat_radius: float
    prism_radius: float
    prism_height: float
    facets: int
    beam: Beam
    sample_rate: float
    samples: int
    arrays: tuple[str, ...] = ARRAYS
    aims: Array | None = None
    gain_spread: float = 0.0

    @property
    def duration(self) -> float:
        """T of one record [s]."""
        return self.samples / self.sample_rate

    @cached_property
    def frames(self) -> Array:
        """Aimed bodies (n, 3, 3): rows n, a_e, a_a of each heliostat."""
        from_aim = self.heliostats if self.aims is None else self.heliostats - self.aims
        if self.heliostat_radius == 0:
            return _frames(from_aim, self.source)
        normals = [ideal_normal(c, self.source, self.heliostat_radius) for c in from_aim]
        return np.array([[n, *(rotation_axis(n, kind) for kind in KINDS)] for n in normals])


def _frames(from_aim: Array, source: Array) -> Array:
    """`Plant.frames` where mirrors turn about their own middles: all at once, without iteration."""
    normals = source - from_aim / np.linalg.norm(from_aim, axis=1, keepdims=True)
    flat = np.cross([0.0, 0.0, 1.0], normals)
    lengths = np.linalg.norm(flat, axis=1)
    if lengths.min() < 1e-9:
        raise BenchsimError("a heliostat's normal is vertical, so that its elevation axis is not defined; move it")
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    flat /= lengths[:, None]
    return np.stack([normals, flat, np.cross(normals, flat)], axis=1)


def build(
    heliostats: ArrayLike,
    source: ArrayLike,
    assumptions: Assumptions | None = None,
    rates: ArrayLike | None = None,
    lines: Sequence[Line] | None = None,
    aims: ArrayLike | None = None,
) -> Plant:
    """The plant of some heliostats under a sun.

    Parameters
    ----------
    heliostats : (n, 3) array
        C [mm].
    source : (3,) array
        S, unit, toward the sun.
    assumptions : Assumptions, optional
    rates : (n, 2) array, optional
        Labels [Hz]; default: evenly over the band, dealt so that the two prisms of a heliostat and near
        heliostats are far apart.
    lines : sequence of Line, optional
        The arrays; default the two of `two_lines`.
    aims : (n, 3) array, optional
        Default the origin [mm].

    Raises
    ------
    BenchsimError
        If a label lies outside the band that the converter passes, or the sun does not shine on the field.
    """
    a = assumptions or Assumptions()
    c, s = np.asarray(heliostats, float), np.asarray(source, float)
    if s[2] <= 0:
        raise BenchsimError("source: the sun is below the horizon; give an hour of the day")
    f = labels(len(c), a) if rates is None else np.asarray(rates, float)
    if f.shape != (len(c), 2) or f.min() < a.rate_low or f.max() > a.rate_high:
        raise BenchsimError(
            f"rates: give two per heliostat, between {a.rate_low:g} and {a.rate_high:g} Hz, where labels are passed"
        )
    rows = tuple(lines or two_lines(a))
    along = [r.along for r in rows]
    return Plant(
        c, s, f, np.concatenate([r.places(x) for r, x in zip(rows, along, strict=True)]),
        np.repeat(np.arange(len(rows)), [len(x) for x in along]), np.concatenate(along), a.heliostat_radius,
        a.prism_radius, a.prism_height, a.facets, beam(a), a.sample_rate, round(a.duration * a.sample_rate),
        tuple(r.name for r in rows), None if aims is None else np.asarray(aims, float),
        a.gain_spread,
    )  # fmt: skip


def labels(count: int, assumptions: Assumptions) -> Array:
    """Labels (count, 2) [Hz], evenly spaced over the band; a multiplicative step deals them, no chance enters."""
    total = 2 * count
    step = next(k for k in range(max(1, round(0.382 * total)), 2 * total) if np.gcd(k, total) == 1)
    place = (step * np.arange(total)) % total
    return np.linspace(assumptions.rate_low, assumptions.rate_high, total)[place].reshape(count, 2)


def prism(plant: Plant, heliostat: int, kind: int, misalignment: ArrayLike = (0.0, 0.0)) -> Cylinder:
    """A prism of a misaligned heliostat as a cylinder of the vector model.

    Parameters
    ----------
    plant : Plant
    heliostat, kind : int
        Index of the heliostat, and into :data:`KINDS`.
    misalignment : (2,) array
        (ε, φ) [rad], as the module's docstring defines them.

    Returns
    -------
    Cylinder
        About the prism's axis at C, facet 0 looking along n where the prism's phase is 0.
    """
    frame = plant.frames[heliostat]
    normal, axis = (
        frame[[0, 1 + kind]] @ Rotation.from_rotvec(np.asarray(misalignment, float) @ frame[1:]).as_matrix().T
    )
    centre = plant.heliostats[heliostat]
    return Cylinder(centre, axis, centre + plant.prism_radius * normal, normal)


def sector(named: Sequence[Sequence[float]], count: int = 100) -> Array:
    """Heliostats (count, 3) [mm]: those named [m], and others over bearings of ±65° from 150 to 900 m.

    The others fill the sector evenly by area (golden-ratio bearings). No plant's layout: a spread of distances and
    bearings.
    """
    rest = count - len(named)
    i = np.arange(rest) + 0.5
    distance = np.sqrt(150.0**2 + (900.0**2 - 150.0**2) * i / max(rest, 1))
    bearing = np.radians(130.0) * (np.mod(i * (np.sqrt(5) - 1) / 2, 1.0) - 0.5)
    others = np.stack([distance * np.cos(bearing), distance * np.sin(bearing), np.full(rest, -143.0)], axis=-1)
    return 1e3 * np.concatenate([np.reshape(np.asarray(named, float), (-1, 3)), others])
