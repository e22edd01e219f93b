"""The bench of one exposure as its light meets it, and the nodes on a facet at which rays are traced."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.model import Laser, Mirror, Physics, Screen
from benchsim.bench.place import Placement
from benchsim.rays import laser as source
from benchsim.rays import plane
from benchsim.rays.effects import Elements
from benchsim.rays.laser import some

Array = NDArray[np.float64]

MOST = 128
"""Cap on the nodes in one direction; beams narrower than a twentieth of the facet reach it and are placed less well."""


@dataclass(frozen=True, eq=False)
class Bench:
    """What one exposure's light meets.

    ``facet`` is the gated facet, or None; ``parts`` what the elements do beyond their tables, and ``placement`` where
    they then stand (`Elements.turned`).
    """

    laser: Laser
    mirror: Mirror
    physics: Physics
    screen: Screen
    placement: Placement
    facet: int | None = None
    parts: Elements = field(default_factory=Elements)

    @property
    def facets(self) -> bool:
        """Whether light is reflected by flat facets; otherwise by a cylinder of the same r."""
        return self.physics.facets and self.mirror.shape == "polygon"

    @property
    def radius(self) -> float:
        """Distance of the facet, glass or not, from the axis of rotation [mm]."""
        return self.mirror.radius + self.parts.polygon.pivot

    @cached_property
    def beam(self) -> source.Beam:
        """The beam where it stands."""
        return source.beam(self.laser, self.placement, self.parts.source)

    @cached_property
    def shift(self) -> Array | None:
        """Displacement of the light on the board, (2,) [mm]."""
        return self.parts.timing.on_board(self.placement)

    @cached_property
    def frame(self) -> plane.Frame | None:
        """Of the closed form of what the light does; None where it does not hold."""
        parts = self.parts
        bent = parts.polygon.uneven or some(parts.polygon.glass, parts.polygon.curvature)
        if bent or not (self.physics.beam and parts.source.homocentric and parts.air.still and parts.board.flat):
            return None
        return plane.frame(self.placement, self.beam, self.radius, self.shift)

    @property
    def exposure_per_phase(self) -> float:
        """Share of the revolution per radian of one reflecting normal's turn [1/rad], summed over what reflects.

        N facets, or the gated one, each pass any phase once a revolution. A cylinder stands in the beam all the time:
        its share is 1 per radian of its surface. The pencil without beam or facets has one ray at each phase.
        """
        if self.physics.beam and not self.facets:
            return 1.0
        return (self.mirror.facets if self.facets and self.facet is None else 1) / (2 * np.pi)


def nodes_needed(bench: Bench) -> tuple[int, int]:
    """Gauss–Legendre nodes over a facet's width and height that place the centre line to 1e-7 mm.

    The facet's half sides in units of the beam's waist decide; measured against 80 × 40 nodes over beam diameters of
    1 to 40 mm, on twelve settings disturbed by 2 σ.
    """
    w = float(np.min(bench.laser.waist))
    across = 4 + int(np.ceil(5 * bench.mirror.facet_width / 2 / w))
    along = 3 + int(np.ceil(6 * bench.mirror.height / 2 / w))
    return min(across, MOST), min(along, MOST)


@lru_cache(maxsize=32)
def _gauss(n: int) -> tuple[Array, Array]:
    return np.polynomial.legendre.leggauss(n)


def facet_nodes(bench: Bench, across: int, along: int) -> tuple[Array, Array, Array]:
    """Gauss–Legendre nodes on a facet.

    Returns
    -------
    t : (across, 1) ndarray [mm]
    h : (1, along) ndarray [mm]
    weight : (across, along) ndarray [mm²]
        For a cylinder a single t = 0 with weight r, the width of surface that a radian of phase sweeps. A single ray
        has one node of weight 1.
    """
    if not bench.physics.beam:
        return np.zeros((1, 1)), np.zeros((1, 1)), np.ones((1, 1))
    u, w = _gauss(along)
    half = bench.mirror.height / 2
    if not bench.facets:
        return np.zeros((1, 1)), half * u[None, :], bench.radius * half * w[None, :]
    v, z = _gauss(across)
    wide = bench.mirror.facet_width / 2
    return wide * v[:, None], half * u[None, :], wide * half * np.outer(z, w)
