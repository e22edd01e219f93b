"""The board's shape: how far its surface stands from the plane that the recording states, and how the board is turned.

Board frame: y, z on the board, x its height toward the mirror; all rolls with the board about its centre.
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

Array = NDArray[np.float64]
Effects = Mapping[str, Mapping[str, float]]

EFFECTS: Mapping[str, tuple[str, ...]] = {
    "screen-distance": ("sx",),
    "screen-tilt": ("st_y", "st_z"),
    "screen-bow": ("bow_y", "bow_z"),
    "screen-rotation": ("srot",),
}

FIELDS = ("height",)


@dataclass(frozen=True)
class Surface:
    """x = distance + slope_y y + slope_z z + ½ (bow_y y² + bow_z z²) + field(y, z), in mm and 1/mm."""

    distance: float = 0.0
    slope: tuple[float, float] = (0.0, 0.0)
    bow: tuple[float, float] = (0.0, 0.0)
    field: Field | None = None

    @property
    def flat(self) -> bool:
        """Whether it is the plane x = 0."""
        return not (self.distance or any(self.slope) or any(self.bow)) and self.field is None

    def smooth(self, y: Any, z: Any) -> tuple[Any, Any, Any]:
        """Height without the field, and its derivatives along y and z; of any kind of array."""
        (sy, sz), (by, bz) = self.slope, self.bow
        slope_y, slope_z = sy + by * y, sz + bz * z
        return self.distance + 0.5 * (y * (sy + slope_y) + z * (sz + slope_z)), slope_y, slope_z

    def height(self, y: Any, z: Any) -> Array:
        """Height over the plane [mm] at (y, z) [mm], arrays that broadcast."""
        y, z = np.asarray(y, float), np.asarray(z, float)
        h = self.smooth(y, z)[0]
        return np.asarray(h if self.field is None else h + evaluate(self.field, y, z)[0])


def surface(effects: Effects, fields: Mapping[str, Field]) -> Surface:
    """The surface of a recording's effects (file units: mm, mrad, 1/m) and height field."""
    tilt, bow = effects.get("screen-tilt", {}), effects.get("screen-bow", {})
    return Surface(
        float(effects.get("screen-distance", {}).get("sx", 0.0)),
        # st_z is the slope along y, a turn about z; st_y the slope along z.
        (1e-3 * tilt.get("st_z", 0.0), 1e-3 * tilt.get("st_y", 0.0)),
        (1e-3 * bow.get("bow_y", 0.0), 1e-3 * bow.get("bow_z", 0.0)),
        fields.get("height"),
    )


def turned(placement: Placement, effects: Effects) -> Placement:
    """The placement with the board, marks and all, turned by ``srot`` about its own x: roll has the same axis."""
    angle = 1e-3 * effects.get("screen-rotation", {}).get("srot", 0.0)
    if angle == 0:
        return placement
    turn = Rotation.from_rotvec([angle, 0.0, 0.0]).as_matrix()
    return replace(placement, screen_rotation=placement.screen_rotation @ turn)
