"""Fields laid out by rule: radial stagger."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.errors import BenchsimError

Array = NDArray[np.float64]


def radial_stagger(
    count: int, width: float, height: float, first: float, tower: float, half_angle: float = math.pi
) -> Array:
    """Places of heliostats in rings around a tower, every ring staggered against the one before, (n, 2) mm.

    A mirror needs a circle of its diagonal. A zone begins with as many as fit around its first ring; its rings keep
    that number, turned by half a step from one to the next, until a ring has room for twice as many and a new zone
    begins (Collado & Guallar 2012, https://doi.org/10.1016/j.renene.2012.03.011, with Δα the diagonal over the radius
    and rings cos 30° of the diagonal apart at least). Further out rings lie ΔR = h (1.44 cot θ − 1.094 + 3.068 θ −
    1.1256 θ²) apart, θ the receiver's elevation in radians as the mirror sees it (Stine & Geyer, Power From The Sun,
    chapter 10, for DELSOL): a wide field, of little shading. DELSOL's own, as SolarPILOT's code has it, is
    (h/2)(1.1442 cot θ − 1.0935 + 3.0684 θ − 1.1256 θ²), less than half of it.

    Parameters
    ----------
    count : int
    width, height : float
        Of a mirror [mm].
    first : float
        Radius of the first ring [mm].
    tower : float
        Height of the receiver above the mirrors [mm].
    half_angle : float
        To either side of north that rings reach [rad].

    Returns
    -------
    (count, 2) array
        East and north, from the innermost ring, within a ring from north outward.
    """
    diagonal = math.hypot(width, height)
    out: list[tuple[float, float]] = []
    radius, start, stagger = first, first, False
    step = diagonal / first
    while len(out) < count:
        if radius > 1e8:
            raise BenchsimError(f"heliostats: {count} of them find no place within 100 km; ask for fewer")
        if radius >= 2 * start:
            start, step, stagger = radius, diagonal / radius, False
        # All around, a whole number fits; of a sector the step is kept.
        whole = half_angle >= math.pi
        fitted = 2 * math.pi / math.floor(2 * math.pi / step) if whole else step
        most = math.floor(half_angle / fitted) + 1
        around = [(k + 0.5 * stagger) * fitted for k in range(-most, most + 1)]
        ring = sorted((a for a in around if -half_angle < a <= half_angle + 1e-9), key=lambda a: (abs(round(a, 12)), a))
        if whole:
            ring = ring[: round(2 * math.pi / fitted)]
        out += [(radius * math.sin(a), radius * math.cos(a)) for a in ring]
        theta = math.atan2(tower, radius)
        spaced = height * (1.44 / math.tan(theta) - 1.094 + 3.068 * theta - 1.1256 * theta**2)
        radius += max(diagonal * math.cos(math.pi / 6), spaced)
        stagger = not stagger
    return np.array(out[:count])
