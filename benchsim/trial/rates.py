"""Binomial rates with their intervals, held against bars."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any


def wilson(k: int, n: int, z: float) -> tuple[float, float]:
    """Wilson's interval of a proportion; z = 1.645 makes each bound one-sided 95 %."""
    if n == 0:
        return 0.0, 1.0
    p = k / n
    middle, half = p + z * z / (2 * n), z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return max(0.0, (middle - half) / (1 + z * z / n)), min(1.0, (middle + half) / (1 + z * z / n))


def judged(k: int, n: int, bar: float, at_least: bool) -> str:
    """met: the point estimate meets the bar; missed: the one-sided 95 % interval excludes it; else open."""
    if n == 0:
        return "no cases"
    low, high = wilson(k, n, 1.645)
    p = k / n
    if (p >= bar) if at_least else (p <= bar):
        return "met"
    return "missed" if (high < bar if at_least else low > bar) else "open"


@dataclass(frozen=True)
class Rate:
    """How often something happened, and the bar that it is held against."""

    quantity: str
    k: int
    n: int
    bar: float
    at_least: bool = True

    def plain(self) -> dict[str, Any]:
        """For ``score.json``."""
        low, high = wilson(self.k, self.n, 1.96)
        state = judged(self.k, self.n, self.bar, self.at_least)
        return {
            "quantity": self.quantity,
            "bar": f"{'≥' if self.at_least else '≤'} {100 * self.bar:g} %",
            "value": f"{100 * self.k / self.n:.1f} % ({self.k} of {self.n})" if self.n else "–",
            "interval": f"{100 * low:.1f} … {100 * high:.1f} %" if self.n else "–",
            "n": self.n,
            "k": self.k,
            "state": "open" if state == "no cases" else state,
        }
