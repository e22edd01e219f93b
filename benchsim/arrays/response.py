"""What a prism's line is at every detector, from the vector model: the measurement's own forward model.

Derivation. A prism that turns about a reflects the sun's centre onto a cone about a whose half-angle α is that
between the rays and a, R·a = −S·a (``benchsim.vector.cone``), and each direction of the sun onto a cone of its own.
Seen along the ray d from the mirror to a detector, at the polar angle β from a, the sun's image passes as the azimuth ψ
= 2ε about a runs; image centre and d are θ apart, with

    sin²(θ/2) = sin²((β − α)/2) + sin α sin β sin²(ψ/2).

So only u = β − α matters, the angle by which the trace misses the detector. The line's amplitude is the fundamental of
the passage over the period 4π/N of ψ (N facets): F(u) = ∫ I(θ) cos(Nψ/2) dψ, the sun's brightness along a chord,
averaged over the facet's length, times cos(incidence on the facet) cos(incidence on the detector) / D². Its phase is −N
ε with ε the angle at which the facet bisects S and d about a. The mirror's point P(ε) is that of the vector model
(Carretero 2019, Eq. (9)), so ε and d are found together in a few steps.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from benchsim.arrays.plant import Plant
from benchsim.vector import Cylinder

Array = NDArray[np.float64]

_CHORD = np.linspace(-1, 1, 65)[1:-1]
"""Nodes along a chord of the beam, in parts of its longest: even ones, for what vanishes smoothly at its ends."""

_ACROSS = np.linspace(-1, 1, 81)
"""Nodes across the beam, in parts of its edge."""


def sight(cylinder: Cylinder, plant: Plant, points: Array) -> tuple[Array, Array, Array, Array]:
    """How a prism sees points of the tower.

    Parameters
    ----------
    cylinder : Cylinder
        The prism.
    plant : Plant
    points : (m, 3) array
        [mm]

    Returns
    -------
    miss : (m,) ndarray
        u = β − α, by how much the trace misses the point [rad].
    phase : (m,) ndarray
        ε at which light passes closest [rad].
    weight : (m,) ndarray
        cos(incidence on the facet) cos(incidence on the detector) / D² [1/mm²]; 0 where the facet does not face both.
    distance : (m,) ndarray
        D [mm].
    """
    a, n, s = cylinder.axis, cylinder.normal, plant.source
    side = np.cross(a, n)
    # along n, along a × n and along a, from the pivot; P(ε) = r (cos ε, sin ε, 0) there (vector.positions written out)
    y_n, y_side, y_a = ((points - cylinder.pivot) @ np.stack([n, side, a], axis=-1)).T
    r = cylinder.radius
    sun = np.arctan2(s @ side, s @ n)
    phase = np.zeros(len(points))
    # P(ε) moves by the prism's radius at most: each step gains a factor radius/distance
    for _ in range(4):
        out_n, out_side = y_n - r * np.cos(phase), y_side - r * np.sin(phase)
        phase = sun + 0.5 * np.mod(np.arctan2(out_side, out_n) - sun + np.pi, 2 * np.pi) - 0.5 * np.pi
    across = np.hypot(out_n, out_side)
    distance = np.hypot(across, y_a)
    miss = np.arctan2(across, y_a) - np.arccos(np.clip(-s @ a, -1, 1))
    on_facet = (np.cos(phase) * out_n + np.sin(phase) * out_side) / distance
    on_detector = -(out_n * n[0] + out_side * side[0] + y_a * a[0]) / distance
    weight = np.maximum(on_facet, 0) * np.maximum(on_detector, 0) / distance**2
    return miss, phase, weight, distance


def response(cylinder: Cylinder, plant: Plant) -> NDArray[np.complex128]:
    """Complex amplitude (m,) of a prism's line at all detectors, up to one factor for the prism (power and phase)."""
    miss, phase, weight, distance = sight(cylinder, plant, plant.detectors)
    alpha = float(np.arccos(np.clip(-plant.source @ cylinder.axis, -1, 1)))
    spread = 0.5 * plant.prism_height / distance * np.sin(alpha)
    integral = profile(alpha, plant).antiderivative()
    edge = plant.beam.edge
    low, high = (integral(np.clip(miss + k * spread, -edge, edge)) for k in (-1, 1))
    return weight * (high - low) / (2 * spread) * np.exp(-1j * plant.facets * phase)


def profile(alpha: float, plant: Plant) -> CubicSpline:
    """F(u), the fundamental of the beam's radiance along its chord at the angle u from its centre, for |u| < its
    edge."""
    edge = plant.beam.edge
    u = edge * _ACROSS[:, None]
    both = np.sin(alpha) * np.sin(alpha + u)
    longest = 2 * np.arcsin(np.minimum(np.sin(edge / 2) / np.sqrt(both), 1.0))
    psi = longest * _CHORD
    square = 4 * (np.sin(u / 2) ** 2 + both * np.sin(psi / 2) ** 2)
    light = plant.beam.radiance(square) * np.cos(0.5 * plant.facets * psi)
    return CubicSpline(u[:, 0], light.sum(axis=1) * longest[:, 0] * (_CHORD[1] - _CHORD[0]))
