"""What bright pixels do on the sensor: charge that spills toward +v, and the free shift by brightness.

Both act on the charge of the laser's light alone. The room's charge lies evenly over the board: spilled along v it is
the same again, and it counts for no brightness, as "brightness" in the catalogue is the trace's own.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from benchsim.bench.fields import Field, evaluate

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Effects = Mapping[str, Mapping[str, float]]

EFFECTS: Mapping[str, tuple[str, ...]] = {"saturation": ("sat",)}

FIELDS = ("brightness",)

_SLAB = (20, 4)
"""Half length across and half width along the ridge of the profile at the brightest pixel [px]."""


def carry(laser: Image, effects: Effects) -> float:
    """How far the charge of the brightest pixel is carried [px], so that its profile's centroid moves by ``sat``.

    A pixel's charge q is carried by c (q/peak)². Over a profile q(n) that moves the centroid by c ∫q³/(peak² ∫q): a
    profile of the same shape and the brightness b moves by b² of that, whatever its width.

    Parameters
    ----------
    laser : (rows, columns)
        Mean charge of the laser's light, blurred by the lens.
    effects : mapping

    Returns
    -------
    float
        c; 0 without the effect.
    """
    sat = float(effects.get("saturation", {}).get("sat", 0.0))
    if sat == 0 or not laser.any():
        return 0.0
    row, column = np.unravel_index(int(laser.argmax()), laser.shape)
    span = _SLAB[0]
    low_v, low_u = max(0, row - span), max(0, column - span)
    cut = laser[low_v : row + span + 1, low_u : column + span + 1].astype(float)
    v, u = np.indices(cut.shape, float)
    v, u = v + low_v - row, u + low_u - column
    weight = cut**2
    spread = np.array([[(weight * a * b).sum() for a in (u, v)] for b in (u, v)])
    # The ridge runs along the longest axis of its own moments.
    along = np.linalg.eigh(spread)[1][:, 1]
    profile = cut[np.abs(u * along[0] + v * along[1]) <= _SLAB[1]]
    return sat * float(profile.sum() / (profile * (profile / cut.max()) ** 2).sum())


def spill(laser: Image, distance: float, peak: float) -> Image:
    """Charge carried toward +v by ``distance`` (charge/peak)² pixels; what leaves the last row is lost.

    Parameters
    ----------
    laser : (rows, columns) float32
    distance : float
        As `carry` gives it [px]; < 0 toward −v.
    peak : float
        Charge that is carried so far.
    """
    if distance == 0:
        return laser
    if distance < 0:
        return np.ascontiguousarray(spill(laser[::-1], -distance, peak)[::-1])
    far = np.float32(distance) * (laser / np.float32(peak)) ** 2
    whole = np.floor(far).astype(int)
    part = laser * (far - whole)
    out = np.zeros_like(laser)
    rows = len(laser)
    for k in range(min(int(whole.max()), rows - 1) + 1):
        here = whole == k
        out[k:] += np.where(here, laser - part, 0)[: rows - k]
        if k + 1 < rows:
            out[k + 1 :] += np.where(here, part, 0)[: rows - k - 1]
    return out


def level(laser: Image, window: float = 6.0) -> Array:
    """Brightness of the ridge next to every pixel, 1 at the brightest: mean weighted with the brightness' 8th power.

    The power follows the crest; the symmetric window takes no side on a crest that brightens along itself.
    """
    q = laser.astype(float) / float(laser.max())
    high = q**8
    bottom = gaussian_filter(high, window)
    value = gaussian_filter(high * q, window) / np.maximum(bottom, 1e-60)
    value[bottom < 1e-60] = 0.0
    return np.asarray(value / value.flat[int(laser.argmax())])


def displaced(laser: Image, fields: Mapping[str, Field]) -> Image:
    """The trace's light moved as the brightness field has it for the ridge's own brightness."""
    field = fields.get("brightness")
    if field is None or not laser.any():
        return laser
    du, dv = evaluate(field, level(laser))
    v, u = np.indices(laser.shape, float)
    moved = map_coordinates(laser.astype(float), [v - dv, u - du], order=3, mode="nearest")
    return np.maximum(moved, 0).astype(np.float32)


def arrived(laser: Image, effects: Effects, fields: Mapping[str, Field]) -> Image:
    """Mean laser charge where it is read: moved by brightness, then spilled.

    Parameters
    ----------
    laser : (rows, columns)
        Any scale, blurred by the lens; a part of the picture that holds all of the trace is enough.
    effects, fields : mapping
        Of the recording; what is not of the sensor is passed over.
    """
    if "brightness" not in fields and "saturation" not in effects:
        return laser
    moved = displaced(laser, fields)
    return spill(moved, carry(moved, effects), float(moved.max()))
