"""What the page of a plant's flux shows: sentences and tables from ``flux.json`` and ``heliostats.csv``."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping, Sequence
from typing import Any

from markupsafe import Markup

from benchsim.reports.quantities import said

MOST_ROWS = 500
"""Heliostats of the table: more would make the page slow to sort on a phone; the CSV file has all."""

HEADS = {
    "id": ("heliostat", None),
    "receiver": ("aims at", None),
    "east_m": ("east (m)", 1),
    "north_m": ("north (m)", 1),
    "power_kw": ("power (kW)", 2),
    "energy_kwh": ("energy (kWh)", 1),
    "cosine": ("cosine", 3),
    "shaded": ("shaded", 3),
    "blocked": ("blocked", 3),
    "spillage": ("spilled", 3),
    "image_rms_m": ("image rms (m)", 2),
    "monte_carlo_power_kw": ("Monte Carlo (kW)", 2),
    "monte_carlo_energy_kwh": ("Monte Carlo (kWh)", 1),
    "lost_kwh": ("errors lose (kWh)", 2),
    "over_limit_kwh": ("put above a limit (kWh)", 2),
    "cost_sigma_kwh": ("± (kWh)", 2),
    "recalibrated_kwh": ("calibration brings back (kWh)", 2),
    "reaimed_kwh": ("a shifted aim brings back (kWh)", 2),
    "reaim_along_m": ("shift along (m)", 2),
    "reaim_up_m": ("shift up (m)", 2),
}
"""Columns that are shown, with their decimals; those in which a plant has but one value are left out."""


def shown(
    flux: Mapping[str, Any], summary: str, header: Sequence[str], rows: Sequence[Sequence[Any]],
    pictures: Mapping[str, bytes],
) -> dict[str, Any]:  # fmt: skip
    """What the template is given.

    Parameters
    ----------
    flux : mapping
        ``flux.json``.
    summary : str
        ``summary.txt``; its first line is the title, the others follow.
    header, rows : sequences
        Of ``heliostats.csv``.
    pictures : mapping of str to bytes
        PNG by caption.
    """
    first, *rest = summary.splitlines()
    several = len(flux["receivers"]) > 1
    limited = "limits" in flux
    left_out = {name for name, there in (("receiver", several), ("over_limit_kwh", limited)) if not there}
    columns = [k for k, name in enumerate(header) if name in HEADS and name not in left_out]
    heads = [HEADS[header[k]] for k in columns]
    unit = "kw" if flux["step_h"] is None else "kwh"
    return {
        "flux": flux,
        "first": first,
        # What is indented twice, and what leads to it, has a table of its own.
        "rest": [line for line in rest if not line.startswith("    ") and not line.endswith(":")],
        "total": said(sum(r[f"on_it_{unit}"] for r in flux["receivers"]), {"kw": "kW", "kwh": "kWh"}[unit]),
        "losses": [(k.replace("_", " "), 100 * v) for k, v in flux["losses"].items()],
        "heads": [(words, decimals is not None) for words, decimals in heads],
        "rows": [
            [_cell(row[k], decimals) for k, (_, decimals) in zip(columns, heads, strict=True)]
            for row in rows[:MOST_ROWS]
        ],
        "left_away": max(0, len(rows) - MOST_ROWS),
        "pictures": [
            (caption, Markup("data:image/png;base64," + b64encode(png).decode("ascii")))
            for caption, png in pictures.items()
        ],
    }


def _cell(value: Any, decimals: int | None) -> str:
    return "" if value is None else str(value) if decimals is None else f"{value:.{decimals}f}"
