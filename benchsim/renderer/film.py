"""Bins on the board along the trace.

A hit is shared between the four nearest bins with tent weights, which keeps the centroid of what lies between. For
speed the four shares of a hit lie side by side in memory (one packet in place of four scattered additions), and only a
band about the trace is kept.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from benchsim.renderer.tracer import opaque, opaque_uint

Array = NDArray[np.float64]

EXPANDED_BYTES = 512 << 20
"""Memory that the threads' own copies may take; above it hits are added atomically, which is slower."""


def _band(rows: Array, columns: Array, n_rows: int, n_columns: int, reach: float) -> tuple[NDArray[np.int64], int]:
    """First column of every row and width of a band that holds points with ``reach`` columns and rows about them."""
    low, high = np.full(n_rows, np.inf), np.full(n_rows, -np.inf)
    known = np.isfinite(rows) & np.isfinite(columns)
    at, column = np.clip(rows[known].astype(int), 0, n_rows - 1), columns[known]
    np.minimum.at(low, at, column)
    np.maximum.at(high, at, column)
    # Points are samples of the trace: a row between two of them holds what its neighbours hold.
    size = 2 * int(reach) + 17
    low = minimum_filter1d(low, size) - reach
    high = maximum_filter1d(high, size) + reach
    held = np.isfinite(low)
    if not held.any():
        return np.zeros(n_rows, int), 1
    first = np.clip(np.floor(np.where(held, low, 0)), 0, n_columns - 1).astype(int)
    last = np.clip(np.ceil(np.where(held, high, 0)), 0, n_columns - 1).astype(int)
    width = int((last - first).max()) + 1
    return np.minimum(first, n_columns - width), width


class Film:
    """Nodes at the bins' centres, one more on every side; cells between them collect the hits.

    Attributes
    ----------
    ny, nz : int
        Bins of the board.
    y0, z0, pitch : mm
        Centre of bin (0, 0), and the distance of bins.
    """

    def __init__(self, size: tuple[float, float], pitch: float, y: Array, z: Array, reach: float) -> None:
        self.pitch = pitch
        self.ny, self.nz = (max(1, int(np.ceil(s / pitch - 1e-9))) for s in size)
        self.y0, self.z0 = -(self.ny - 1) / 2 * pitch, -(self.nz - 1) / 2 * pitch
        # In cells of the padded grid: cell (i, j) lies between nodes i, i + 1 and j, j + 1.
        y, z = (y - self.y0) / pitch + 1, (z - self.z0) / pitch + 1
        far = reach / pitch
        on = (y > -far) & (y < self.ny + 1 + far) & (z > -far) & (z < self.nz + 1 + far)
        y, z = np.where(on, y, np.nan), np.where(on, z, np.nan)
        upright = _band(z, y, self.nz + 1, self.ny + 1, far)
        lying = _band(y, z, self.ny + 1, self.nz + 1, far)
        self.lying = lying[1] * (self.ny + 1) < upright[1] * (self.nz + 1)
        self.first, self.width = lying if self.lying else upright
        self.rows, self.columns = (self.ny, self.nz) if self.lying else (self.nz, self.ny)
        self._first = mi.UInt32(self.first.astype(np.uint32))
        self._origin = tuple(opaque(v) for v in (self.y0 - pitch, self.z0 - pitch))
        self._scale = opaque(1 / pitch)
        copies = dr.thread_count() * 16 * self.first.size * self.width
        expand = str(mi.variant()).startswith("llvm") and copies < EXPANDED_BYTES
        self._mode = dr.ReduceMode.Expand if expand else dr.ReduceMode.Auto
        # Bands of neighbouring rows of nodes draw on two rows of cells.
        before = np.concatenate([self.first[:1], self.first])
        after = np.concatenate([self.first, self.first[-1:]])
        self.node_first = np.minimum(before, after)
        self.node_width = int((np.maximum(before, after) - self.node_first).max()) + self.width + 1

    def empty(self) -> Any:
        """Cells without light."""
        return dr.zeros(mi.Float, 4 * self.first.size * self.width)

    def add(self, cells: Any, y: Any, z: Any, weight: Any, active: Any) -> None:
        """Share ``weight`` at (y, z) [mm] between the four nearest nodes."""
        fy, fz = (y - self._origin[0]) * self._scale, (z - self._origin[1]) * self._scale
        across, along = (fz, fy) if self.lying else (fy, fz)
        active = active & (across >= 0) & (along >= 0) & (across < self.columns + 1) & (along < self.rows + 1)
        row, column = mi.UInt32(along), mi.UInt32(across)
        across, along = across - mi.Float(column), along - mi.Float(row)
        place = column - dr.gather(mi.UInt32, self._first, row, active)  # below the band it wraps to a large number
        active &= place < self.width
        upper = weight * along
        lower = weight - upper
        right, far = lower * across, upper * across
        packet = mi.Vector4f(lower - right, right, upper - far, far)
        dr.scatter_add(cells, packet, row * self.width + place, active, self._mode)

    def nodes(self, cells: Any) -> Any:
        """Sum of the shares at every node of the band, (rows + 2) × node_width values."""
        lane = dr.arange(mi.UInt32, (self.rows + 2) * self.node_width)
        row, place = lane // opaque_uint(self.node_width), lane % opaque_uint(self.node_width)
        column = place + dr.gather(mi.UInt32, mi.UInt32(self.node_first.astype(np.uint32)), row)
        total = mi.Float(0.0)
        for down in (0, 1):
            inside = (row >= down) & (row - down < self.rows + 1)
            cell_row = row - down
            start = dr.gather(mi.UInt32, self._first, cell_row, inside)
            for left in (0, 1):
                at = column - left - start
                here = inside & (at < self.width)
                index = (cell_row * self.width + at) * 4 + (2 * down + left)
                total += dr.gather(mi.Float, cells, index, here)
        return total

    def spread(self, nodes: Array) -> Array:
        """Values of the band's nodes as (nz, ny) bins of the board."""
        dense = np.zeros((self.rows + 2, self.columns + 2))
        for row, first, own in zip(dense, self.node_first, nodes.reshape(self.rows + 2, self.node_width), strict=True):
            row[first : first + self.node_width] = own[: len(row) - first]
        dense = dense[1:-1, 1:-1]
        return np.ascontiguousarray(dense.T) if self.lying else dense
