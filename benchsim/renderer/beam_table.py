"""What a real beam has beyond the homocentric Gaussian one: aberration and shape, as polynomials over its section."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Coefficients = tuple[Any, ...]

ORDER = 7
"""Highest power; spherical aberration and coma of the slopes are of the third and second."""


@dataclass(frozen=True)
class BeamTable:
    """Slopes and density of a beam in the plane through its reference point, relative to the homocentric Gaussian beam.

    Coordinates are (a, b) = (x, y)/(``reach`` w), w being the beam's 1/e² radius; beyond the unit circle the values at
    its edge hold. x is horizontal, y is up, and x × y is the direction of travel.

    Attributes
    ----------
    reach : float
        Radius up to which the table was made, in units of w.
    slope_x, slope_y : tuple
        Coefficients (in the order of `powers`) of the ray's slope less curvature times position [rad].
    log_ratio : tuple
        Of the logarithm of the power's density over the Gaussian's.
    """

    reach: float
    slope_x: Coefficients
    slope_y: Coefficients
    log_ratio: Coefficients


def powers(order: int = ORDER) -> list[tuple[int, int]]:
    """Exponents (i, j) of a^i b^j, by i and then by j, i + j ≤ order."""
    return [(i, j) for i in range(order + 1) for j in range(order + 1 - i)]


def monomials(a: Array, b: Array) -> Array:
    """Values (n, terms) of all monomials at points (n,)."""
    return np.stack([a**i * b**j for i, j in powers()], axis=-1)


def slopes_of_monomials(a: Array, b: Array) -> tuple[Array, Array]:
    """Their derivatives with respect to a and to b, (n, terms) each."""
    by_a = np.stack([i * a ** max(i - 1, 0) * b**j for i, j in powers()], axis=-1)
    by_b = np.stack([j * a**i * b ** max(j - 1, 0) for i, j in powers()], axis=-1)
    return by_a, by_b


def polynomial(coefficients: Coefficients, a: Any, b: Any) -> Any:
    """Value of a polynomial at points, which are NumPy's or Dr.Jit's arrays; Horner's scheme."""
    rows, at = [], 0
    for i in range(ORDER + 1):
        rows.append(coefficients[at : at + ORDER + 1 - i])
        at += ORDER + 1 - i
    value: Any = 0.0 * a
    for row in reversed(rows):
        inner: Any = 0.0 * b
        for c in reversed(row):
            inner = inner * b + c
        value = value * a + inner
    return value


def onto_disc(a: Any, b: Any) -> tuple[Any, Any]:
    """Points moved radially onto the unit disc if they lie outside."""
    m: Any = np if isinstance(a, (float, np.floating, np.ndarray)) else dr
    shrink = 1.0 / m.sqrt(m.maximum(1.0, a * a + b * b))
    return a * shrink, b * shrink


def axes(direction: Array) -> tuple[Array, Array]:
    """Unit vectors x (horizontal) and y (up) of a beam's section, world frame; for a vertical beam y is world x."""
    up = np.array([0.0, 0.0, 1.0])
    if np.hypot(direction[0], direction[1]) < 1e-9:
        up = np.array([1.0, 0.0, 0.0])
    x = np.cross(up, direction)
    x = x / np.linalg.norm(x)
    return x, np.cross(direction, x)
