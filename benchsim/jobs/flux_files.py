"""Files of ``benchsim flux``: maps, pictures, the table of heliostats, and what is for programs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.names import file_name
from benchsim.bench.writing import write_csv, write_text
from benchsim.jobs.flux_result import FluxResult
from benchsim.reports import page, page_flux
from benchsim.reports.pictures import save

Array = NDArray[np.float64]


def write(r: FluxResult, folder: Path) -> None:
    """Everything that a result has, into an empty folder."""
    *pictures, plan = r.figures()
    count = len(r.plant.receivers)
    names = [x.name for x in r.plant.receivers]
    shown: dict[str, bytes] = {}
    for start, kind, words in ((0, "flux", "on {}"), (count, "parting", "on {}, Monte Carlo less product")):
        for name, picture in zip(names, pictures[start : start + count], strict=start == 0 or bool(r.carlo)):
            shown[words.format(name)] = save(picture, folder / f"{kind}-{file_name(name)}.png")
    shown["what each mirror brings, from above"] = save(plan, folder / "field.png")
    _maps(r, folder)
    header, rows = table(r)
    write_csv(folder / "heliostats.csv", header, rows, 6)
    plain, text = r.as_dict(), r.text()
    write_text(folder / "flux.json", json.dumps(plain, indent=1, allow_nan=False) + "\n")
    write_text(folder / "summary.txt", text + "\n")
    write_text(folder / "report.html", page.plant_page(page_flux.shown(plain, r.plant.name, text, header, rows, shown)))


def _maps(r: FluxResult, folder: Path) -> None:
    what = "energy_kwh_m2" if r.step is not None else "flux_kw_m2"
    noise, by_rays = r.noise(), r.maps(r.carlo) if r.carlo else ()
    for k, (receiver, mesh, values) in enumerate(zip(r.plant.receivers, r.moments[0].meshes, r.maps(), strict=True)):
        along, up = np.meshgrid(mesh.u / 1e3, mesh.v / 1e3, indexing="ij")
        columns = {"along_m": along, "up_m": up, what: values}
        if by_rays:
            columns[f"monte_carlo_{what}"] = by_rays[k]
        if noise:
            columns[f"sigma_{what}"] = noise[k]
        rows = np.stack([c.ravel() for c in columns.values()], axis=1).tolist()
        write_csv(folder / f"flux-{file_name(receiver.name)}.csv", list(columns), rows, 6)


def table(r: FluxResult) -> tuple[list[str], list[list[str | float | None]]]:
    """Header and rows of the heliostats, the costliest first where costs are there."""
    f, day = r.plant.field, r.step is not None
    columns: dict[str, Array] = dict(zip(("east_m", "north_m", "up_m"), f.position.T / 1e3, strict=True))
    columns["energy_kwh" if day else "power_kw"] = r.total("power")
    if r.moments[0].noise is not None:
        squares = sum(m.noise.power**2 for m in r.moments if m.noise is not None)
        columns["sigma_kwh" if day else "sigma_kw"] = np.sqrt(squares) * r.stands / 1e3
    columns |= {n: r.mean(n) for n in ("cosine", "shaded", "blocked", "transmitted", "spillage")}
    columns["image_rms_m"] = r.mean("image_rms") / 1e3
    if not day:
        columns |= dict(zip(("centroid_along_m", "centroid_up_m"), r.moments[0].landing.T / 1e3, strict=True))
    if r.carlo:
        columns["monte_carlo_energy_kwh" if day else "monte_carlo_power_kw"] = (
            np.sum([m.power for m in r.carlo], axis=0) * r.stands / 1e3
        )
    if r.rank is not None:
        columns |= {
            "lost_kwh": r.rank.lost,
            "over_limit_kwh": r.rank.over,
            "cost_sigma_kwh": r.rank.sigma,
            "recalibrated_kwh": r.rank.recalibrated,
            "reaimed_kwh": r.rank.reaimed,
            "reaim_along_m": r.rank.shift[:, 0] / 1e3,
            "reaim_up_m": r.rank.shift[:, 1] / 1e3,
        }
    values = np.stack(list(columns.values()), axis=1).tolist()
    names = [x.name for x in r.plant.receivers]
    rows = [[f.ids[k], names[f.receiver[k]], *(None if x != x else x for x in values[k])] for k in r.order]
    return ["id", "receiver", *columns], rows
