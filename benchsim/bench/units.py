"""The spelling of units, one table for all rooms: every unit that a file or a table of results holds stands here."""

from __future__ import annotations

from collections.abc import Mapping

IN_TEXT: Mapping[str, str] = {
    "1": "",
    "1e-3": "×10⁻³",
    "mm": "mm",
    "1/m": "1/m",
    "mrad": "mrad",
    "mrad/mm2": "mrad/mm²",
    "deg": "deg",
    "arcsec": "arcsec",
    "px": "px",
    "rows": "rows",
    "K/m": "K/m",
    "mm/h": "mm/h",
    "Hz": "Hz",
    "s": "s",
    "record": "record",
}
"""Unit as files hold it → as sentences for readers show it: a pure number has none, and ``1e-3`` is a factor."""
