"""What the page of a plant's flux shows: sentences and tables from ``flux.json`` and ``heliostats.csv``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from benchsim.reports import page_plant
from benchsim.reports.page_plant import Column
from benchsim.reports.quantities import said

COLUMNS = {
    "id": Column("heliostat"),
    "receiver": Column("aims at"),
    "lost_kwh": Column("errors lose (kWh)", 2, "cost_sigma_kwh"),
    "over_limit_kwh": Column("put above a limit (kWh)", 2),
    "recalibrated_kwh": Column("calibration brings back (kWh)", 2),
    "reaimed_kwh": Column("a shifted aim brings back (kWh)", 2),
    "reaim_along_m": Column("shift along (m)", 2),
    "reaim_up_m": Column("shift up (m)", 2),
    "power_kw": Column("power (kW)", 2),
    "energy_kwh": Column("energy (kWh)", 1),
    "monte_carlo_power_kw": Column("Monte Carlo (kW)", 2),
    "monte_carlo_energy_kwh": Column("Monte Carlo (kWh)", 1),
    "cosine": Column("cosine", 3),
    "shaded": Column("shaded", 3),
    "blocked": Column("blocked", 3),
    "spillage": Column("spilled", 3),
    "image_rms_m": Column("image rms (m)", 2),
    "east_m": Column("east (m)", 1),
    "north_m": Column("north (m)", 1),
}
"""What the errors cost first, as a phone shows three or four; those in which a plant has but one value are left out."""

CAUSES = {
    "says": Column("simplified"),
    "power": Column("power (%)", 2, "power_sigma"),
    "peak": Column("peak (%)", 2, "peak_sigma"),
}


def shown(
    flux: Mapping[str, Any], name: str, summary: str, header: Sequence[str], rows: Sequence[Sequence[Any]],
    pictures: Mapping[str, bytes],
) -> dict[str, Any]:  # fmt: skip
    """What the template is given.

    Parameters
    ----------
    flux : mapping
        ``flux.json``.
    name : str
        Of the plant.
    summary : str
        ``summary.txt``.
    header, rows : sequences
        Of ``heliostats.csv``.
    pictures : mapping of str to bytes
        PNG by caption.
    """
    several = len(flux["receivers"]) > 1
    left_out = {k for k, there in (("receiver", several), ("over_limit_kwh", "limits" in flux)) if not there}
    unit = "kw" if flux["step_h"] is None else "kwh"
    total = said(sum(r[f"on_it_{unit}"] for r in flux["receivers"]), {"kw": "kW", "kwh": "kWh"}[unit])
    return page_plant.shown(
        name,
        "flux",
        f"{total} on the receiver{'s' if several else ''}",
        summary,
        pictures=pictures,
        maps="On the receivers and in the field",
        sections=[_engines(flux["partings"])] if "partings" in flux else [],
        heliostats=page_plant.table(COLUMNS, [dict(zip(header, row, strict=True)) for row in rows], left_out),
        order="The costliest first." if "rank" in flux else "",
    )


def _engines(partings: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    tables = []
    for p in partings:
        on, peak = (
            f"product {x['product']:.4g} {unit}, Monte Carlo {x['monte_carlo']:.4g} ± {x['sigma']:.2g} {unit}"
            for x, unit in ((p["power_kw"], "kW"), (p["peak_kw_m2"], "kW/m²"))
        )
        apart = 1e3 * math.hypot(*p["centroid_apart_m"])
        caption = f"{p['receiver']}: power by {on}; at the peak by {peak}; centroids {apart:.0f} mm apart"
        rows = [{k: v if k == "says" else 100 * v for k, v in c.items()} for c in p["causes"]]
        tables.append(page_plant.table(CAUSES, rows, caption=caption))
    says = (
        f"The product of error functions simplifies; at {partings[0]['time'][:16].replace('T', ' ')} Monte Carlo was "
        "made once more with each of its simplifications, one after the other."
    )
    return page_plant.section("engines", "Where the engines part", *tables, says=says)
