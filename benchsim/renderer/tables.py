"""Free fields where a kernel can read them."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from benchsim.bench.fields import Field, evaluate


class Table:
    """A field of one or two coordinates; multilinear, held beyond its outermost knots.

    Called with NumPy's arrays it is `bench.fields.evaluate`, in float64; with Dr.Jit's it looks the knots up, in
    float32.
    """

    def __init__(self, f: Field) -> None:
        self.field = f
        self._knots: list[Any] | None = None
        self._values: Any = None

    def __call__(self, *at: Any) -> tuple[Any, ...]:
        """The field's components at its coordinates."""
        if all(isinstance(x, (float, np.ndarray, np.floating)) for x in at):
            return tuple(evaluate(self.field, *at))
        if self._knots is None:
            self._knots = [mi.Float(np.array(k, np.float32)) for k in self.field.knots]
            self._values = [mi.Float(np.array(v, np.float32)) for v in self.field.values]
        found = [self._cell(axis, mi.Float(x)) for axis, x in enumerate(at)]
        corners: list[tuple[Any, Any]] = [(mi.UInt32(0), mi.Float(1.0))]
        for (cell, share), knots in zip(found, self.field.knots, strict=True):
            n = len(knots)
            corners = [
                (index * n + cell + step, weight * (share if step else 1.0 - share))
                for index, weight in corners
                for step in (0, 1)
            ]
        return tuple(sum(w * dr.gather(mi.Float, v, i) for i, w in corners) for v in self._values)

    def _cell(self, axis: int, x: Any) -> tuple[Any, Any]:
        """Index of the knot below x, and x' place between it and the next."""
        assert self._knots is not None
        knots, n = self._knots[axis], len(self.field.knots[axis])
        # The first knot from 1 on that lies beyond x; at most the last.
        above = dr.binary_search(1, n - 1, lambda i: dr.gather(mi.Float, knots, i) <= x)
        below = mi.UInt32(above) - 1
        low, high = dr.gather(mi.Float, knots, below), dr.gather(mi.Float, knots, below + 1)
        return below, dr.clip((x - low) / (high - low), 0.0, 1.0)


def table(fields: Any, name: str) -> Table | None:
    """The field of that name of a recording, or None."""
    return Table(fields[name]) if name in fields else None
