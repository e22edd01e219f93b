"""Mirrors that stand before others: whether a ray from a mirror's middle meets one of its neighbours."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchsim.plant.shading import along

Array = NDArray[np.float64]


def hidden(
    position: Array, normals: Array, width: Array, height: Array, ways: Array, reach: ArrayLike = np.inf
) -> NDArray[np.bool_]:
    """Whether rays that leave mirrors' middles meet another mirror.

    Parameters
    ----------
    position, normals : (n, 3)
        [mm]; edges of ``width`` are horizontal.
    width, height : (n,)
        [mm]
    ways : (3,) or (n, 3)
        Where the rays go, of any length.
    reach : float or (n,)
        How far they go [mm]; default without end, as to the sun.

    Returns
    -------
    (n,) ndarray of bool
    """
    n = len(position)
    radius = np.hypot(width, height) / 2
    rays = np.broadcast_to(ways, (n, 3)) / np.linalg.norm(np.broadcast_to(ways, (n, 3)), axis=1, keepdims=True)
    field = float(np.linalg.norm(np.ptp(position, axis=0)) + 2 * radius.max())
    far = np.broadcast_to(np.asarray(reach, float), n)
    i, j = along(position, radius, rays, np.minimum(far, field))
    across = np.cross([0.0, 0.0, 1.0], normals)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    up = np.cross(normals, across)
    apart = position[j] - position[i]
    with np.errstate(divide="ignore", invalid="ignore"):
        way = (apart * normals[j]).sum(axis=1) / (rays[i] * normals[j]).sum(axis=1)
        met = way[:, None] * rays[i] - apart
        on = (np.abs((met * across[j]).sum(axis=1)) < width[j] / 2) & (
            np.abs((met * up[j]).sum(axis=1)) < height[j] / 2
        )
    out = np.zeros(n, bool)
    out[i[on & (way > 0) & (way < far[i])]] = True
    return out
