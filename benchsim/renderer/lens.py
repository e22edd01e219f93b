"""What the true lens and the read-out do to the picture: where the light of a pixel comes from.

A ray of sight goes through the lens (Brown's model, the effects' coefficients added), is then moved by the free pixel
field, and is read out by rows while the camera shakes: each row as a whole is exposed at one moment, so that it is
displaced as a whole.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.errors import BenchsimError
from benchsim.bench.fields import Field, evaluate
from benchsim.bench.model import Camera

Array = NDArray[np.float64]
Effects = Mapping[str, Mapping[str, float]]

EFFECTS: Mapping[str, tuple[str, ...]] = {
    "radial-distortion": ("k1", "k2"),
    "tangential-distortion": ("p1", "p2"),
    "rolling-shutter": ("rs_s", "rs_c", "rs_period"),
}

FIELDS = ("pixel",)

PERIOD = 1400.0
"""Rows per period of the shake where the file gives none."""

_STEPS = 30


def true_camera(camera: Camera, effects: Effects) -> Camera:
    """The camera with the effects' coefficients added to those of its lens."""
    radial, tangential = effects.get("radial-distortion", {}), effects.get("tangential-distortion", {})
    if not radial and not tangential:
        return camera
    k1, k2, p1, p2, k3 = camera.distortion
    k1, k2 = k1 + radial.get("k1", 0.0), k2 + radial.get("k2", 0.0)
    return replace(camera, distortion=(k1, k2, p1 + tangential.get("p1", 0.0), p2 + tangential.get("p2", 0.0), k3))


def row_shift(camera: Camera, effects: Effects, rows: Array) -> Array:
    """Displacement along u of whole rows while they are read out [px].

    Raises
    ------
    BenchsimError
        If the period is not positive.
    """
    shake = effects.get("rolling-shutter", {})
    period = shake.get("rs_period", PERIOD)
    if not period > 0:
        raise BenchsimError("effects.rolling-shutter.rs_period: must be above 0; give the rows of one period")
    phase = 2 * np.pi * (np.asarray(rows, float) - camera.principal_point[1]) / period
    return np.asarray(shake.get("rs_s", 0.0) * np.sin(phase) + shake.get("rs_c", 0.0) * np.cos(phase))


@dataclass(frozen=True)
class Sources:
    """Where on an ideal sensor behind the lens the light of each pixel comes from.

    Attributes
    ----------
    u, v : (rows, columns) px
    slope : (4, rows, columns)
        ∂u/∂u', ∂u/∂v', ∂v/∂u', ∂v/∂v' within a pixel (u', v'); a row's displacement is the same all over its pixels.
    """

    u: Array
    v: Array
    slope: Array


def sources(
    camera: Camera, effects: Effects, fields: Mapping[str, Field], window: tuple[slice, slice]
) -> Sources | None:
    """Sources of the pixels of a window (rows, columns); None where every pixel is its own.

    Raises
    ------
    BenchsimError
        If the pixel field folds the picture over.
    """
    shaken = any(effects.get("rolling-shutter", {}).get(key, 0.0) for key in ("rs_s", "rs_c"))
    field = fields.get("pixel")
    if not shaken and field is None:
        return None
    rows = np.arange(window[0].start, window[0].stop, dtype=float)
    columns = np.arange(window[1].start, window[1].stop, dtype=float)
    v, u = np.meshgrid(rows, columns, indexing="ij")
    before = u - row_shift(camera, effects, rows)[:, None]
    one, zero = np.ones_like(u), np.zeros_like(u)
    if field is None:
        return Sources(before, v, np.stack([one, zero, zero, one]))
    qu, qv = before.copy(), v.copy()
    miss = np.inf
    for _ in range(_STEPS):
        du, dv = evaluate(field, qu, qv)
        miss = max(np.abs(qu + du - before).max(), np.abs(qv + dv - v).max())
        qu, qv = before - du, v - dv
        if miss < 1e-5:
            break
    falls = (np.diff(field.table()[k], axis=k).min(axis=1 - k) <= -np.diff(field.knots[k]) for k in (0, 1))
    if miss > 1e-2 or any(f.any() for f in falls):
        raise BenchsimError("fields.pixel: folds the picture over; give values that change by less than 1 px per px")
    h = 0.5
    along_u, along_v = (
        (evaluate(field, qu + a, qv + b) - evaluate(field, qu - a, qv - b)) / (2 * h) for a, b in ((h, 0.0), (0.0, h))
    )
    a, b, c, d = 1 + along_u[0], along_v[0], along_u[1], 1 + along_v[1]
    return Sources(qu, qv, np.stack([d, -b, -c, a]) / (a * d - b * c))


def reach(effects: Effects, fields: Mapping[str, Field]) -> int:
    """Pixels by which the picture may be displaced beyond the lens's own image."""
    shake = effects.get("rolling-shutter", {})
    most = abs(shake.get("rs_s", 0.0)) + abs(shake.get("rs_c", 0.0))
    if "pixel" in fields:
        most += float(np.abs(fields["pixel"].table()).max())
    return int(np.ceil(most))
