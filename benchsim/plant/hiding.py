"""Mirrors that stand before others: whether a ray from a mirror's middle meets one of its neighbours."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BATCH = 2_000_000
"""Pairs of ray and mirror at once: 150 MB."""


def hidden(position: Array, normals: Array, width: Array, height: Array, ways: Array) -> NDArray[np.bool_]:
    """Whether rays that leave mirrors' middles meet another mirror.

    Parameters
    ----------
    position, normals : (n, 3)
        [mm]; edges of ``width`` are horizontal.
    width, height : (n,)
        [mm]
    ways : (3,) or (n, 3)
        Where the rays go.

    Returns
    -------
    (n,) ndarray of bool
    """
    n = len(position)
    across = np.cross([0.0, 0.0, 1.0], normals)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    up = np.cross(normals, across)
    rays = np.broadcast_to(ways, (n, 3))
    out = np.zeros(n, bool)
    size = max(1, BATCH // n)
    for start in range(0, n, size):
        some = slice(start, min(start + size, n))
        apart = position[None] - position[some, None]
        slant = rays[some] @ normals.T
        with np.errstate(divide="ignore", invalid="ignore"):
            way = (apart * normals).sum(axis=2) / slant
            met = way[..., None] * rays[some, None] - apart
            on = (np.abs((met * across).sum(axis=2)) < width / 2) & (np.abs((met * up).sum(axis=2)) < height / 2)
        # A ray meets its own mirror where it begins.
        out[some] = (on & (way > 1.0)).any(axis=1)
    return out
