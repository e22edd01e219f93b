"""What changes in the course of a recording, and shaking: displacements of the light on the screen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.fields import Field, evaluate
from benchsim.bench.model import Exposure, Recording
from benchsim.bench.place import Placement
from benchsim.rays.laser import over, some

Array = NDArray[np.float64]
Effects = Mapping[str, Mapping[str, float]]

EFFECTS: Mapping[str, tuple[str, ...]] = {"drift": ("dry", "drz"), "vibration": ("amp", "freq")}
"""Effects of time, with their parameters; a vibration's frequency is not observable."""


@dataclass(frozen=True)
class TimeEffects:
    """Displacement of the light in one exposure; nothing by default.

    Attributes
    ----------
    shift : (y, z) mm
        World frame.
    shake : float
        rms per direction of an isotropic random displacement, averaged over the exposure [mm].
    """

    shift: tuple[float, float] = (0.0, 0.0)
    shake: float = 0.0

    def on_board(self, placement: Placement) -> Array | None:
        """The shift in board coordinates, (2,) [mm]; None without any."""
        if not some(*self.shift):
            return None
        y, z = (over(v) for v in self.shift)
        return np.asarray(y * placement.screen_rotation[..., 1, 1:] + z * placement.screen_rotation[..., 2, 1:])


def effects(tables: Effects, fields: Mapping[str, Field], recording: Recording, exposure: Exposure) -> TimeEffects:
    """The share of time in a recording's effects (file units: mm/h, mm) and fields.

    A drift starts with the recording's earliest exposure; a field goes by the time that the file states.
    """
    y = z = 0.0
    if drift := tables.get("drift"):
        hours = (exposure.time - min(e.time for e in recording.exposures)) / 3600.0
        y, z = hours * drift.get("dry", 0.0), hours * drift.get("drz", 0.0)
    if "time" in fields:
        more = evaluate(fields["time"], exposure.time)
        y, z = y + float(more[0]), z + float(more[1])
    return TimeEffects((y, z), abs(tables.get("vibration", {}).get("amp", 0.0)))
