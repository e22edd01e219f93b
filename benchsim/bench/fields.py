"""Free fields: tabulated functions, one or two per element of the light's path, in that element's own coordinate.

A field is physics without a name: what an attachment, a law or an unknown cause adds to an element. `rays` and
`renderer` both take them; the recording's file holds them as ``[fields.NAME]`` with one list of knots per coordinate
and one (nested) list of values per component.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_MRAD, _DEG, _H = 1e-3, math.pi / 180, 3600.0


@dataclass(frozen=True)
class Form:
    """What a field of one name means: keys in the file, and the factor from the file's unit to mm, rad, s or px."""

    element: str
    coordinates: tuple[tuple[str, float], ...]
    components: tuple[tuple[str, float], ...]
    says: str


FORMS: Mapping[str, Form] = {
    "angle": Form(
        "source",
        (("u_mm", 1.0), ("v_mm", 1.0)),
        (("along_u_mrad", _MRAD), ("along_v_mrad", _MRAD)),
        "added to the direction of the beam's ray through (u, v) of the plane at the mirror perpendicular to the beam",
    ),
    "stage": Form(
        "source",
        (("azimuth_deg", _DEG), ("elevation_deg", _DEG)),
        (("azimuth_mrad", _MRAD), ("elevation_mrad", _MRAD)),
        "added to the laser's dials, by their stated values",
    ),
    "lean": Form(
        "mirror",
        (("phase_deg", _DEG), ("facet", 1.0)),
        (("lean_mrad", _MRAD),),
        "lean of the reflecting facet's normal toward +axis, by its turn from the aimed one and by the facet's number",
    ),
    "kick": Form(
        "air",
        (("y_mm", 1.0), ("z_mm", 1.0)),
        (("kick_y_mrad", _MRAD), ("kick_z_mrad", _MRAD)),
        "turn of the light on its way from mirror to screen, by where it crosses the plane half way",
    ),
    "height": Form(
        "screen",
        (("y_mm", 1.0), ("z_mm", 1.0)),
        (("x_mm", 1.0),),
        "height of the board's surface over its plane, toward the mirror, by board coordinates",
    ),
    "shift": Form(
        "screen",
        (("y_mm", 1.0), ("z_mm", 1.0)),
        (("dy_mm", 1.0), ("dz_mm", 1.0)),
        "a mark printed at nominal (y, z) lies at (y + dy, z + dz) of the board",
    ),
    "pixel": Form(
        "camera",
        (("u_px", 1.0), ("v_px", 1.0)),
        (("du_px", 1.0), ("dv_px", 1.0)),
        "what the camera as stated would see at (u, v) appears at (u + du, v + dv), all cameras",
    ),
    "brightness": Form(
        "camera",
        (("level", 1.0),),
        (("du_px", 1.0), ("dv_px", 1.0)),
        "shift of the trace in the picture by its peak brightness across, 1 at the exposure's brightest",
    ),
    "time": Form(
        "time",
        (("t_h", _H),),
        (("dy_mm", 1.0), ("dz_mm", 1.0)),
        "shift of the light on the screen along world y and z, by the time of the exposure",
    ),
}
"""Every field, its coordinates and components in the order of the arrays."""


@dataclass(frozen=True)
class Field:
    """Values on a grid of knots.

    Attributes
    ----------
    knots : one tuple per coordinate
        Growing, at least two each [mm, rad, s, px].
    values : one tuple per component
        In C order of the knots [mm, rad, px].
    """

    knots: tuple[tuple[float, ...], ...]
    values: tuple[tuple[float, ...], ...]

    def table(self) -> Array:
        """Values as an array (components, knots of the first coordinate, …)."""
        return np.array(self.values, float).reshape(len(self.values), *(len(k) for k in self.knots))


def field(knots: Sequence[Sequence[float] | Array], values: Any) -> Field:
    """Field of arrays: ``values`` is (components, knots of the first coordinate, …)."""
    table = np.asarray(values, float)
    return Field(tuple(tuple(float(x) for x in k) for k in knots), tuple(tuple(row.ravel().tolist()) for row in table))


def prepared(f: Field) -> Callable[..., Array]:
    """`evaluate` of one field as a function of the coordinates alone, for many calls: the table is made once."""
    knots = [np.array(k) for k in f.knots]
    table = f.table()
    corners = np.ascontiguousarray(table.reshape(len(table), -1))
    strides = [int(np.prod([len(k) for k in knots[i + 1 :]], dtype=int)) for i in range(len(knots))]

    def at(*coordinates: Any) -> Array:
        values = np.broadcast_arrays(*(np.asarray(c, float) for c in coordinates))
        base = np.zeros(values[0].shape, dtype=np.intp)
        parts = []
        for c, k, stride in zip(values, knots, strides, strict=True):
            i = np.clip(np.searchsorted(k, c, side="right") - 1, 0, len(k) - 2)
            base += stride * i
            parts.append(np.clip((c - k[i]) / (k[i + 1] - k[i]), 0.0, 1.0))
        out = np.zeros((len(corners), *base.shape))
        for which in product((0, 1), repeat=len(knots)):
            share = np.ones(base.shape)
            for on, part in zip(which, parts, strict=True):
                share = share * (part if on else 1.0 - part)
            offset = sum(on * stride for on, stride in zip(which, strides, strict=True))
            out += share * corners[:, base + offset]
        return out

    return at


def evaluate(f: Field, *coordinates: Any) -> Array:
    """Multilinear interpolation, held constant beyond the outermost knots.

    Parameters
    ----------
    f : Field
    *coordinates : arrays that broadcast together, one per coordinate of the field

    Returns
    -------
    (components, ...) ndarray
    """
    return prepared(f)(*coordinates)
