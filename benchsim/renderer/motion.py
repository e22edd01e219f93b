"""What moves the light on the board: slowly from exposure to exposure, and fast within one.

Drift and the field of time shift the light as a whole, along the world's y and z; the element that carries the motion
is left open, as the catalogue leaves it. Vibration likewise: no optics library draws a random motion, so every ray is
displaced by a draw of its own from the round Gaussian that the exposure averages over. Its frequency does nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from benchsim.bench.fields import evaluate
from benchsim.bench.model import Exposure, Recording
from benchsim.bench.place import Placement
from benchsim.renderer.effects import value

EFFECTS = {"drift": ("dry", "drz"), "vibration": ("amp", "freq")}
FIELDS = ("time",)

TIMED = ("drift",)
"""Effects by which light differs from one exposure to the next though everything stands alike."""

_HOUR = 3600.0


@dataclass(frozen=True)
class Motion:
    """``shift`` [mm] of the light along the board's y and z; ``shake`` [mm], rms of its random motion along each."""

    shift: tuple[Any, Any] = (0.0, 0.0)
    shake: Any = 0.0
    shakes: bool = False


def motion(recording: Recording, exposure: Exposure, placement: Placement) -> Motion | None:
    """The motion in one exposure; None if there is none. Drift counts from the recording's earliest exposure."""
    effects = recording.effects
    first = min(e.time for e in recording.exposures)
    hours = (exposure.time - first) / _HOUR
    world = np.array([0.0, hours * value(effects, "drift", "dry"), hours * value(effects, "drift", "drz")])
    if "time" in recording.fields:
        world[1:] += evaluate(recording.fields["time"], exposure.time)
    shake = abs(value(effects, "vibration", "amp"))
    if not world.any() and not shake:
        return None
    _, ey, ez = placement.screen_rotation.T
    return Motion((float(world @ ey), float(world @ ez)), shake, shake > 0)
