"""The board: how it is moved and turned as a whole, and how its surface rises from its plane.

Board frame: y, z along the board, x along its normal, toward the mirror; all rolls with the board about its centre.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchsim.bench.fields import Field, evaluate
from benchsim.bench.place import Placement
from benchsim.renderer.effects import MRAD, PER_M, value

Array = NDArray[np.float64]
Effects = Mapping[str, Mapping[str, float]]

EFFECTS: Mapping[str, tuple[str, ...]] = {
    "screen-distance": ("sx",),
    "screen-tilt": ("st_y", "st_z"),
    "screen-bow": ("bow_y", "bow_z"),
    "screen-rotation": ("srot",),
}

AS_A_WHOLE = ("screen-distance", "screen-tilt", "screen-rotation")
"""Those that `turned` applies: a pose of the camera that was solved from the board's own marks holds them already."""

FIELDS = ("height",)


@dataclass(frozen=True)
class Surface:
    """x = ½ (bow_y y² + bow_z z²) + field(y, z), in mm and 1/mm."""

    bow: tuple[float, float] = (0.0, 0.0)
    field: Field | None = None

    @property
    def flat(self) -> bool:
        """Whether it is the plane x = 0."""
        return not any(self.bow) and self.field is None

    def smooth(self, y: Any, z: Any) -> tuple[Any, Any, Any]:
        """Height without the field, and its derivatives along y and z; of any kind of array."""
        slope_y, slope_z = self.bow[0] * y, self.bow[1] * z
        return 0.5 * (y * slope_y + z * slope_z), slope_y, slope_z

    def height(self, y: Any, z: Any) -> Array:
        """Height over the plane [mm] at (y, z) [mm], arrays that broadcast."""
        y, z = np.asarray(y, float), np.asarray(z, float)
        h = self.smooth(y, z)[0]
        return np.asarray(h if self.field is None else h + evaluate(self.field, y, z)[0])


def surface(effects: Effects, fields: Mapping[str, Field]) -> Surface:
    """The surface of a recording's effects (file units: 1/m) and height field."""
    return Surface(
        (value(effects, "screen-bow", "bow_y", PER_M), value(effects, "screen-bow", "bow_z", PER_M)),
        fields.get("height"),
    )


def turned(placement: Placement, effects: Effects) -> Placement:
    """The placement with the board, marks and all, moved along x, tilted, and rolled about its own normal.

    The tilt is the turn about an axis in the board's plane that gives it the slopes st_z along y and st_y along z:
    about +y for the one along z, about −z for the one along y, by the angle whose tangent is the steepest slope.
    """
    moved = value(effects, "screen-distance", "sx")
    roll = value(effects, "screen-rotation", "srot", MRAD)
    slope_y, slope_z = (value(effects, "screen-tilt", k, MRAD) for k in ("st_z", "st_y"))
    if not any((moved, roll, slope_y, slope_z)):
        return placement
    steepest = np.hypot(slope_y, slope_z)
    share = np.arctan(steepest) / steepest if steepest else 1.0
    tilt = Rotation.from_rotvec([0.0, share * slope_z, -share * slope_y])
    turn = (tilt * Rotation.from_rotvec([roll, 0.0, 0.0])).as_matrix()
    return replace(
        placement,
        screen_rotation=placement.screen_rotation @ turn,
        screen_origin=placement.screen_origin + np.array([moved, 0.0, 0.0]),
    )
