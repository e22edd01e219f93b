"""What bright light does on the sensor: charge that spills toward +v, and the free shift by brightness.

Both act on the charge of the laser's light alone. The room's charge lies evenly over the board: spilled along v it is
the same again, and it counts for no brightness, as "brightness" in the catalogue is the trace's own. A line is moved as
a whole, by the brightness of its crest: the catalogue says how far spilled charge moves its centroid, and what becomes
of the profile is each sensor's own.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates

from benchsim.bench.fields import Field, evaluate

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Effects = Mapping[str, Mapping[str, float]]

EFFECTS: Mapping[str, tuple[str, ...]] = {"saturation": ("sat",)}

FIELDS = ("brightness",)


def level(laser: Image, window: float = 3.0) -> Array:
    """Brightness of the crest nearest to every pixel, 1 at the brightest.

    The crest's is a mean weighted with the profile's 8th power, relative to the crest's own brightness, so that it
    takes no side on one that brightens along itself; it is found twice for that.
    """
    q = laser.astype(float) / float(laser.max())
    crest = np.ones_like(q)
    for _ in range(2):
        high = np.divide(q, crest, out=np.zeros_like(q), where=crest > 0) ** 8
        bottom = gaussian_filter(high, window)
        crest = np.where(bottom < 1e-60, 0.0, gaussian_filter(high * q, window) / np.maximum(bottom, 1e-60))
    core = (q > 0.9 * crest) & (crest > 0)
    crest = gaussian_filter(core * crest, window) / np.maximum(gaussian_filter(core.astype(float), window), 1e-60)
    nearest = distance_transform_edt(~core, return_distances=False, return_indices=True)
    return np.asarray(gaussian_filter(crest[tuple(nearest)], 0.5 * window) / crest.flat[int(laser.argmax())])


def arrived(laser: Image, effects: Effects, fields: Mapping[str, Field]) -> Image:
    """The laser's charge where it is read: moved along v by saturation, and as the brightness field has it.

    Parameters
    ----------
    laser : (rows, columns)
        Any scale, blurred by the lens; a part of the picture that holds all of the trace is enough.
    effects, fields : mapping
        Of the recording; what is not of the sensor is passed over.
    """
    sat, field = effects.get("saturation", {}).get("sat", 0.0), fields.get("brightness")
    if not (sat or field) or not laser.any():
        return laser
    bright = level(laser)
    du, dv = np.zeros((2, *laser.shape)) if field is None else evaluate(field, bright)
    v, u = np.indices(laser.shape, float)
    moved = map_coordinates(laser.astype(float), [v - dv - sat * bright**2, u - du], order=3, mode="nearest")
    return np.maximum(moved, 0).astype(np.float32)
