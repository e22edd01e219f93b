"""What the pages of a drone's flight show: clusters, the budget of uncertainty, and what a flight told."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

from benchsim.reports import page_plant
from benchsim.reports.page_plant import Column
from benchsim.reports.quantities import counted

CAPTIONS = {
    "plan": "from above: heliostats, and the pattern that each cluster looks at",
    "side": "the same from the east",
    "errors": "errors of the virtual flight over their stated σ",
    "axes": "by how much each heliostat looks beside where it was told to",
}
"""By file."""

BUDGET = {
    "sigma_ad_mrad": "width of the angular differences (σ_ad)",
    "sigma_ad_expected_mrad": "the same, as the stated surface makes it",
    "sigma_mean_mrad": "of the mean of the glints (σ_mean)",
    "sigma_sys_mrad": "of what all glints share (σ_sys)",
    "sigma_mrad": "both together, of an axis",
}
"""What an axis' uncertainty is made of, by key."""

PLANNED = {
    "id": Column("heliostat"),
    "cluster": Column("cluster", 0),
    "sigma_mrad": Column("σ expected (mrad)", 3),
    "error_x_mrad": Column("flown: error about x (mrad)", 3, "flown_sigma_x_mrad"),
    "error_y_mrad": Column("about y (mrad)", 3, "flown_sigma_y_mrad"),
    "sigma_mean_mrad": Column("σ_mean (mrad)", 3),
    "sigma_sys_mrad": Column("σ_sys (mrad)", 3),
    "azimuth_deg": Column("azimuth to command (deg)", 2),
    "elevation_deg": Column("elevation (deg)", 2),
    "distance_m": Column("distance (m)", 1),
    "first_picture": Column("pictures from", 0),
    "last_picture": Column("to", 0),
    "glints": Column("glints", 1),
    "flown_glints": Column("flown: glints", 0),
    "flown_outliers": Column("outliers", 0),
    "stands": Column("stands"),
    "says": Column("says"),
}

CLUSTERS = {
    "number": Column("cluster"),
    "count": Column("heliostats", 0),
    "pictures": Column("pictures", 0),
    "latitude_deg": Column("latitude (deg)", 7),
    "longitude_deg": Column("longitude (deg)", 7),
    "height_m": Column("height (m)", 1),
    "ids": Column("of them"),
}

READ = {
    "id": Column("heliostat"),
    "azimuth_off_mrad": Column("azimuth beside (mrad)", 3, "sigma_azimuth_off_mrad"),
    "elevation_off_mrad": Column("elevation beside (mrad)", 3, "sigma_elevation_off_mrad"),
    "glints": Column("glints", 0),
    "outliers": Column("outliers", 0),
    "not_found_in": Column("not found in pictures", 0),
    "sigma_ad_mrad": Column("σ_ad (mrad)", 3),
    "sigma_mean_mrad": Column("σ_mean (mrad)", 3),
    "sigma_sys_mrad": Column("σ_sys (mrad)", 3),
    "p_normal": Column("p of normal", 3),
    "says": Column("says"),
}


def planned(plain: Mapping[str, Any], name: str, summary: str, pictures: Mapping[str, bytes]) -> dict[str, Any]:
    """What the template is given of a plan.

    Parameters
    ----------
    plain : mapping
        ``drone.json``.
    name : str
        Of the plant.
    summary : str
        ``summary.txt``.
    pictures : mapping of str to bytes
        PNG by a key of `CAPTIONS`.
    """
    rows = [r | {"stands": "behind another" if r["hidden"] else ""} for r in plain["heliostats"]]
    clusters = [
        c | c["camera_point"] | {"count": len(c["heliostats"]), "ids": ", ".join(c["heliostats"])}
        for c in plain["clusters"]
    ]
    flown = [abs(r[k]) for r in rows for k in ("error_x_mrad", "error_y_mrad") if r.get(k) is not None]
    return page_plant.shown(
        name,
        "a drone's flight",
        f"{median(r['sigma_mrad'] for r in rows):.2g} mrad expected of an axis",
        summary,
        pictures={CAPTIONS[k]: png for k, png in pictures.items()},
        maps="The flight",
        sections=[
            _budget(rows, [("errors of the virtual flight, each angle, as they are (no σ)", flown)] if flown else []),
            page_plant.section(
                "clusters",
                "Clusters and pictures",
                page_plant.table(CLUSTERS, clusters),
                says="Places are of the camera point, at which a cluster's heliostats look: its pattern's middle.",
            ),
        ],
        heliostats=page_plant.table(PLANNED, rows),
    )


def read(plain: Mapping[str, Any], name: str, summary: str, pictures: Mapping[str, bytes]) -> dict[str, Any]:
    """What the template is given of pictures that were read.

    Parameters
    ----------
    plain : mapping
        ``axes.json``.
    name, summary, pictures
        As in `planned`.
    """
    rows = plain["heliostats"]
    known = [r for r in rows if not r["says"]]
    return page_plant.shown(
        name,
        "a drone's pictures",
        f"axes of {len(known)} of {counted(len(rows), 'heliostat')}",
        summary,
        against=plain["remarks"],
        pictures={CAPTIONS[k]: png for k, png in pictures.items()},
        sections=[_budget(known, [])] if known else [],
        heliostats=page_plant.table(READ, rows),
    )


def _budget(rows: Sequence[Mapping[str, Any]], more: Sequence[tuple[str, Sequence[float]]]) -> dict[str, Any]:
    parts = [(says, [r[k] for r in rows]) for k, says in BUDGET.items() if k in rows[0]]
    columns = {"part": Column("1 σ of"), "median": Column("median (mrad)", 3), "largest": Column("largest (mrad)", 3)}
    lines = [{"part": says, "median": median(x), "largest": max(x)} for says, x in (*parts, *more)]
    return page_plant.section("budget", "What the uncertainty is made of", page_plant.table(columns, lines))
