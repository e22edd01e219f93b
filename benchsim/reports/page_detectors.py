"""What the pages of detector arrays show: who is seen when, labels, places, and what a record told."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from benchsim.reports import page_plant
from benchsim.reports.page_plant import Column
from benchsim.reports.quantities import counted

CAPTIONS = {
    "plan": "from above: how often each heliostat is seen, where the arrays hang, and where they look",
    "arrays": "the arrays, as who stands in the field sees them",
    "hours": "hour by hour",
    "sigma": "median and range over the times at which a heliostat is seen",
    "loop": "true misalignments before and after one correction, by what the arrays said",
    "measured": "the larger of both angles that were measured",
}
"""By file."""

MEASURED = {
    "outcome": Column("outcome"),
    "raise_mrad": Column("raise the normal (mrad)", 4, "sigma_raise_mrad"),
    "turn_azimuth_mrad": Column("turn it clockwise from above (mrad)", 4, "sigma_turn_azimuth_mrad"),
    "elevation_mrad": Column("elevation (mrad)", 4, "sigma_elevation_mrad"),
    "true_elevation_mrad": Column("true (mrad)", 4),
    "azimuth_mrad": Column("azimuth (mrad)", 4, "sigma_azimuth_mrad"),
    "true_azimuth_mrad": Column("true (mrad)", 4),
}

PLANNED = {
    "id": Column("heliostat"),
    "seen": Column("seen (% of times)", 1),
    "hidden": Column("hidden (%)", 1),
    "expected_elevation_mrad": Column("σ elevation (mrad)", 4),
    "expected_azimuth_mrad": Column("σ azimuth (mrad)", 4),
    **MEASURED,
    "round": Column("round", 0),
    "rate_elevation_hz": Column("label elevation (Hz)", 3),
    "rate_azimuth_hz": Column("label azimuth (Hz)", 3),
    "east_m": Column("east (m)", 1),
    "north_m": Column("north (m)", 1),
    "says": Column("says"),
}

ARRAYS = {
    "name": Column("array"),
    "along": Column("runs"),
    "detectors": Column("detectors", 0),
    "pitch_m": Column("apart (m)", 3),
    "offset_m": Column("beside the centre (m)", 2),
    "from_m": Column("from (m)", 2),
    "to_m": Column("to (m)", 2),
}

HOURS = {
    "time": Column("time"),
    "seen": Column("seen (%)", 1),
    "hidden": Column("hidden (%)", 1),
    "sigma_mrad": Column("σ, median (mrad)", 4),
}

OUTCOMES = {"outcome": Column("outcome"), "count": Column("heliostats", 0), "means": Column("means")}


def planned(plain: Mapping[str, Any], name: str, summary: str, pictures: Mapping[str, bytes]) -> dict[str, Any]:
    """What the template is given of a plan.

    Parameters
    ----------
    plain : mapping
        ``detectors.json``.
    name : str
        Of the plant.
    summary : str
        ``summary.txt``.
    pictures : mapping of str to bytes
        PNG by a key of `CAPTIONS`.
    """
    count = len(plain["heliostats"])
    record = {r["id"]: r for r in plain.get("record", {}).get("heliostats", ())}
    rows = []
    for r in plain["heliostats"]:
        expected = {f"expected_{k}_mrad": r[f"sigma_{k}_mrad"] for k in ("elevation", "azimuth")}
        told = record.get(r["id"], {})
        rows.append({**r, **expected, "seen": 100 * r["seen"], "hidden": 100 * r["hidden"], **told, "says": r["says"]})
    sections = [_arrays(plain), _labels(plain)]
    if len(plain["times"]) > 1:
        hours = [
            {**t, "time": t["time"][:16].replace("T", " "), **{k: 100 * t[k] / count for k in ("seen", "hidden")}}
            for t in plain["times"]
        ]
        sections.append(page_plant.section("hours", "Hour by hour", page_plant.table(HOURS, hours)))
    if "record" in plain:
        sections.append(_outcomes(plain["record"]))
    return page_plant.shown(
        name,
        "detector arrays",
        f"{100 * plain['share_seen']:.1f} % of heliostats and times are seen",
        summary,
        pictures={CAPTIONS[k]: png for k, png in pictures.items()},
        maps="In the field and at the receiver",
        sections=sections,
        heliostats=page_plant.table(PLANNED, rows, {"round"} if plain["rounds"] == 1 else ()),
    )


def read(
    plain: Mapping[str, Any], name: str, summary: str, pictures: Mapping[str, bytes], against: str = ""
) -> dict[str, Any]:
    """What the template is given of a record that was read.

    Parameters
    ----------
    plain : mapping
        ``record.json``.
    name, summary, pictures
        As in `planned`.
    against : str
        What keeps the record from being used, if anything does.
    """
    measured, count = plain["outcomes"].get("measured", 0), len(plain["heliostats"])
    means = plain["outcome_means"]
    # A sentence that is but what the outcome means stands above, once.
    rows = [r | {"says": "" if r["says"] == means[r["outcome"]] else r["says"]} for r in plain["heliostats"]]
    return page_plant.shown(
        name,
        "a record of detectors",
        f"{measured} of {counted(count, 'heliostat')} measured" + (f"; {against}" if against else ""),
        summary,
        against=plain["remarks"],
        pictures={CAPTIONS[k]: png for k, png in pictures.items()},
        sections=[_outcomes(plain)],
        heliostats=page_plant.table({"id": Column("heliostat"), **MEASURED, "says": Column("says")}, rows),
    )


def _arrays(plain: Mapping[str, Any]) -> dict[str, Any]:
    before = plain["share_seen_as_stated"]
    says = "As detectors.toml has them" + (
        f", to be put into plant.toml: placed anew; those stated see {100 * before:.1f} %."
        if before is not None
        else "."
    )
    arrays = [a | {"detectors": round((a["to_m"] - a["from_m"]) / a["pitch_m"]) + 1} for a in plain["arrays"]]
    return page_plant.section("arrays", "The arrays", page_plant.table(ARRAYS, arrays), says=says)


def _labels(plain: Mapping[str, Any]) -> dict[str, Any]:
    rates = [r[f"rate_{k}_hz"] for r in plain["heliostats"] for k in ("elevation", "azimuth")]
    rates = [x for x in rates if x is not None]
    clash = "; ".join(f"{a:.4g} and {b:.4g} Hz" for a, b in plain["clashes_hz"])
    apart = plain["labels_apart"] / plain["record_s"]
    rows = [
        ("record", f"{plain['record_s']:.4g} s, {plain['sample_rate_hz']} samples a second"),
        ("rounds", str(plain["rounds"])),
        (
            "labels",
            f"{min(rates):.4g} to {max(rates):.4g} Hz, {apart:.2g} Hz apart or more",
        ),
        ("beat or share a harmonic", clash or "none"),
    ]
    columns = {"what": Column("of a record"), "value": Column("planned")}
    table = page_plant.table(columns, [{"what": a, "value": b} for a, b in rows])
    return page_plant.section("labels", "Labels and record", table)


def _outcomes(record: Mapping[str, Any]) -> dict[str, Any]:
    means = record["outcome_means"]
    rows = [{"outcome": k, "count": n, "means": means[k]} for k, n in record["outcomes"].items()]
    return page_plant.section("record", "The record", page_plant.table(OUTCOMES, rows))
