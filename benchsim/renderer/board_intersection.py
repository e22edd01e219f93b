"""Where a ray that meets the board's plane meets its surface instead."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.model import Recording
from benchsim.bench.place import Placement
from benchsim.renderer.laser import Vec, dot
from benchsim.renderer.surface import Surface, surface
from benchsim.renderer.tables import Table

Array = NDArray[np.float64]

STEPS = 5
"""Of Newton's method; the field of height enters without its slope, so that each step leaves the slope's share."""


SETTLED = 0.01
"""Last step of a hit that has been found [mm]; from there on it is some 1e-4 of this."""


@dataclass(frozen=True)
class Landing:
    """The board's surface, and its axes and the chief ray's components along them; triples of the rotor's frame."""

    y_axis: Vec
    z_axis: Vec
    chief: tuple[Any, Any]
    bow: tuple[Any, Any]
    field: Table | None
    highest: Any

    def land(self, y: Any, z: Any, q: Vec, approach: Any) -> tuple[Any, Any, Any, Any]:
        """x, y, z of the hit in the board's frame, and whether it is one, from its plane's hit; ``approach`` is g·N.

        A curved surface goes on beyond the board, where a ray that nearly runs along it may meet it again: only what
        lies within ``highest`` [mm] of the plane is the board.
        """
        along_y = (self.chief[0] + dot(q, self.y_axis)) / approach
        along_z = (self.chief[1] + dot(q, self.z_axis)) / approach
        s = Surface(self.bow)
        x: Any = 0.0 * y
        step: Any = x
        for _ in range(STEPS):
            at_y, at_z = y + x * along_y, z + x * along_z
            height, by_y, by_z = s.smooth(at_y, at_z)
            if self.field is not None:
                height = height + self.field(at_y, at_z)[0]
            step = (height - x) / (1.0 - by_y * along_y - by_z * along_z)
            x = x + step
        return x, y + x * along_y, z + x * along_z, (abs(x) <= self.highest) & (abs(step) < SETTLED)


def landing(recording: Recording, placement: Placement, rotor: Array, chief: Array) -> Landing | None:
    """The board's surface in a recording; None if it is the plane that it is meant to be.

    ``rotor``: rows are the rotor's unit vectors; ``chief``: R in its frame.
    """
    s = surface(recording.effects, recording.fields)
    if s.flat:
        return None
    over = np.linspace(-0.6, 0.6, 49)
    y, z = np.meshgrid(over * recording.screen.size[0], over * recording.screen.size[1])
    highest = 1.0 + 1.2 * float(np.abs(s.height(y, z)).max())
    _, ey, ez = (rotor @ placement.screen_rotation).T
    return Landing(
        tuple(ey.tolist()),
        tuple(ez.tolist()),
        (float(chief @ ey), float(chief @ ez)),
        s.bow,
        None if s.field is None else Table(s.field),
        highest,
    )
