"""``benchsim drone``: a flight over a plant planned, with the uncertainty to be expected, and flown virtually."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from benchsim.bench.errors import BenchsimError
from benchsim.bench.writing import write_csv, write_text
from benchsim.drones.estimate import FEWEST
from benchsim.jobs.drone_cluster import ENU, Cluster, clusters
from benchsim.jobs.drone_flown import Flown, fly
from benchsim.jobs.flux_choices import DroneSurface
from benchsim.jobs.output import wanted_folder, written
from benchsim.jobs.progress import Progress, silent
from benchsim.jobs.shown import Shown
from benchsim.plant import files
from benchsim.plant.model import Plant
from benchsim.reports import drone_pictures, page, page_drone
from benchsim.reports.pictures import save
from benchsim.reports.quantities import counted

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

FORMAT = "benchsim-drone/1"

CLIMB = 5.0
"""Lowest height of the drone over the highest mirror [m]."""


@dataclass(frozen=True, repr=False)
class DroneResult(Shown):
    """A flight over a plant.

    Attributes
    ----------
    plant : Plant
    clusters : tuple of Cluster
    hidden : mapping of int to bool
        Whether another mirror of the cluster stands before a heliostat of the field.
    flown : mapping of int to Flown, or None
        By index into the field.
    seed : int
    surface : {"design", "measured"}
        With which the glints are compared.
    folder : Path or None
    """

    plant: Plant
    clusters: tuple[Cluster, ...]
    hidden: dict[int, bool]
    flown: dict[int, Flown] | None = None
    seed: int = 0
    surface: str = "design"
    folder: Path | None = None

    def rows(self) -> list[dict[str, Any]]:
        """For each heliostat: cluster, where it has to look, pictures that show it, and what is to be expected."""
        return self._rows

    @cached_property
    def _rows(self) -> list[dict[str, Any]]:
        out: list[dict[str, Any]] = []
        f = self.plant.field
        for c in self.clusters:
            east = c.target @ ENU + c.middle
            for k in c.who:
                mount, frames = c.mount(int(k)), c.seen(int(k))
                width, mean, system = c.sigma(int(k), self.surface == "measured")
                row: dict[str, Any] = {"id": f.ids[k], "cluster": c.number}
                row |= dict(zip(("aim_east_m", "aim_north_m", "aim_up_m"), (east / 1e3).tolist(), strict=True))
                row |= {
                    "azimuth_deg": float(np.degrees(mount.azimuth)) % 360,
                    "elevation_deg": float(np.degrees(mount.elevation)),
                    "distance_m": c.distance(int(k)) / 1e3,
                    "first_picture": int(frames[0]) + 1 if len(frames) else None,
                    "last_picture": int(frames[-1]) + 1 if len(frames) else None,
                    "pictures": len(frames),
                    "glints": c.glints(int(k)),
                    "pictures_with_glints": c.frames(int(k)),
                    "hidden": int(self.hidden[int(k)]),
                    "sigma_ad_mrad": 1e3 * width,
                    "sigma_mean_mrad": 1e3 * mean,
                    "sigma_sys_mrad": 1e3 * system,
                    "sigma_mrad": 1e3 * float(np.hypot(mean, system)),
                }
                if self.flown is not None:
                    row |= self.flown[int(k)].row()
                out.append(row)
        return out

    @property
    def pictures(self) -> int:
        """Of all clusters."""
        return sum(len(c.route[0]) for c in self.clusters)

    def pulls(self) -> Array:
        """Errors over stated sigmas of the virtual flight."""
        some = [x.pull for x in (self.flown or {}).values() if not x.says]
        return np.concatenate(some) if some else np.zeros(0)

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``drone.json``."""
        pulls = self.pulls()
        return {
            "format": FORMAT,
            "title": self.plant.title,
            "pictures": self.pictures,
            "seconds": self.pictures * self.plant.drone.each,
            "surface": self.surface,
            "clusters": [
                {
                    "number": c.number,
                    "heliostats": [self.plant.field.ids[k] for k in c.who],
                    "pictures": len(c.route[0]),
                    "camera_point": dict(
                        zip(("latitude_deg", "longitude_deg", "height_m"), c.geographic(c.target[None])[0], strict=True)
                    ),
                }
                for c in self.clusters
            ],
            "flown": None
            if self.flown is None
            else {
                "seed": self.seed,
                "estimated": len(pulls) // 2,
                "pulls_rms": float(np.sqrt(np.mean(pulls**2))) if len(pulls) else None,
                "within_one_sigma": float(np.mean(np.abs(pulls) < 1)) if len(pulls) else None,
            },
            "heliostats": self.rows(),
            "remarks": list(self.plant.remarks),
        }

    def text(self) -> str:
        """Plain sentences for ``summary.txt``."""
        f, d, rows = self.plant.field, self.plant.drone, self.rows()
        sigma = np.array([[r["sigma_mean_mrad"], r["sigma_sys_mrad"], r["sigma_mrad"]] for r in rows])
        middle = np.median(sigma, axis=0)
        heights = [float(x) for c in self.clusters for x in ((c.route[0][:, 2] + c.middle[2]) / 1e3)[[0, -1]]]
        minutes = self.pictures * d.each / 60
        lines = [
            f"{self.plant.name}: {counted(len(f), 'heliostat')} in {counted(len(self.clusters), 'cluster')}, "
            f"{self.pictures} pictures {d.pitch / 1e3:g} m apart, {min(heights):.0f} to {max(heights):.0f} m over the "
            f"origin, {minutes:.0f} min of pictures",
            f"  expected of each axis (medians): sigma_mean {middle[0]:.2g}, sigma_sys {middle[1]:.2g}, together "
            f"{middle[2]:.2g} mrad; largest {sigma[:, 2].max():.2g} mrad",
        ]
        few = sum(r["glints"] < 2 * FEWEST for r in rows)
        if few:
            show = "shows" if few == 1 else "show"
            lines.append(
                f"  {counted(few, 'heliostat')} {show} fewer than {2 * FEWEST} glints; make drone.pitch_m smaller"
            )
        if hidden := sum(self.hidden.values()):
            lines.append(f"  hidden behind other mirrors: {counted(hidden, 'heliostat')}; look from higher up")
        if min(heights) < CLIMB + float(f.position[:, 2].max()) / 1e3:
            lines.append("  the drone would come too near to the mirrors; make drone.elevation_deg larger")
        if self.flown is not None:
            pulls = self.pulls()
            errors = np.array([x.error for x in self.flown.values() if not x.says])
            said = len(self.flown) - len(errors)
            told = ", with a measured map of each mirror" if self.surface == "measured" else ""
            if len(errors):
                lines.append(
                    f"  flown virtually, seed {self.seed}{told}: errors {1e3 * np.sqrt(np.mean(errors**2)):.2g} mrad "
                    f"rms, {np.sqrt(np.mean(pulls**2)):.2f} of the stated sigma; within one sigma "
                    f"{100 * np.mean(np.abs(pulls) < 1):.0f} %"
                )
            if said:
                lines.append(f"  of {counted(said, 'heliostat')} nothing could be said, see heliostats.csv")
        return "\n".join([*lines, *self.plant.remarks])

    def summary(self) -> str:
        """What a person wants to know, on a terminal."""
        plant = self.plant.path.parent
        step = (
            f"benchsim drone plan {plant} --fly flies it virtually"
            if self.flown is None
            else f"benchsim drone read PHOTOS {plant} --camera camera.toml evaluates your own pictures"
        )
        return self.text() + written(self.folder, page=True) + f"\nnext: {step}"

    def figures(self) -> list[Figure]:
        """The plan, its side view, and the errors of a virtual flight."""
        rows = {r["id"]: r for r in self.rows()}
        f = self.plant.field
        sigma = np.array([rows[i]["sigma_mrad"] for i in f.ids])
        of = np.array([rows[i]["cluster"] for i in f.ids])
        points = [c.route[0] @ ENU + c.middle for c in self.clusters]
        out = [draw(f.position, of, sigma, points) for draw in (drone_pictures.plan, drone_pictures.side)]
        if self.flown is not None and len(self.pulls()):
            out.append(drone_pictures.pulls(self.pulls()))
        return out


@threadpool_limits.wrap(limits=1)
def drone(
    plant: Plant | Path | str,
    output: Path | str | None = None,
    *,
    virtual: bool = False,
    surface: str = "design",
    seed: int = 0,
    allow_outside: bool = False,
    progress: Progress = silent,
) -> DroneResult:
    """Plan a drone's flight over a plant: where from which heliostat shows its lamp, and how well that tells its axis.

    Parameters
    ----------
    plant : path
        ``plant.toml``, or the folder that holds it.
    output : path, optional
        Folder for ``drone.json``, ``waypoints.csv``, ``flight.kml``, ``heliostats.csv``, pictures, ``report.html`` and
        ``summary.txt``; default: nothing is written.
    virtual : bool
        Fly it: errors drawn, glints computed, axes estimated.
    surface : {"design", "measured"}
        With which the glints are compared: as the drawings have it, or a deflectometer's map of each mirror.
    seed : int
        Of the virtual flight.
    allow_outside : bool
        Whether the plant's tables may lie outside of its folder.
    progress : callable

    Returns
    -------
    DroneResult

    Raises
    ------
    BenchsimError
        If the plant cannot be used, or such a pattern not be flown.
    """
    p = plant if isinstance(plant, Plant) else files.read(plant, allow_outside=allow_outside)
    if p.field.kinematics != "az-el":
        raise BenchsimError(
            f"{p.path.name}: heliostats.kinematics: the drone's estimate turns azimuth and elevation; "
            f"{p.field.kinematics} mounts are not read by it"
        )
    if surface not in tuple(DroneSurface):
        raise BenchsimError(f"--surface: {surface!r} is none of {', '.join(DroneSurface)}; mend it")
    parts = clusters(p)
    hidden: dict[int, bool] = {}
    for k, c in enumerate(parts):
        progress("plan", 0.1 * k / len(parts))
        hidden |= dict(zip(c.who.tolist(), c.hidden().tolist(), strict=True))
    with wanted_folder(output, "drone", p.files, {"virtual": virtual, "seed": seed, "surface": surface}) as staging:
        flown = fly(parts, seed, surface, lambda done: progress("flight", 0.1 + 0.85 * done)) if virtual else None
        result = DroneResult(p, tuple(parts), hidden, flown, seed, surface, None if output is None else Path(output))
        if staging is not None:
            _write(result, staging)
    progress("done", 1.0)
    return result


def _write(r: DroneResult, folder: Path) -> None:
    header = [
        "cluster", "picture", "time_s", "latitude_deg", "longitude_deg", "height_m", "east_m", "north_m", "up_m",
        "camera_azimuth_deg", "camera_elevation_deg",
    ]  # fmt: skip
    rows, lines, start = [], [], 0.0
    for c in r.clusters:
        points = c.route[0]
        places = c.geographic(points)
        east = (points @ ENU + c.middle) / 1e3
        away = -points
        azimuth = np.degrees(np.arctan2(-away[:, 1], away[:, 0])) % 360
        high = np.degrees(np.arcsin(away[:, 2] / np.linalg.norm(away, axis=1)))
        for k in range(len(points)):
            # Strings: a place to the millimetre needs ten digits, a height seven.
            where = [f"{places[k, 0]:.9f}", f"{places[k, 1]:.9f}", f"{places[k, 2]:.3f}"]
            rest = [f"{x:.3f}" for x in (*east[k], azimuth[k], high[k])]
            rows.append([c.number, k + 1, f"{start + k * r.plant.drone.each:g}", *where, *rest])
        start += len(points) * r.plant.drone.each
        path = " ".join(f"{lon:.9f},{lat:.9f},{h:.3f}" for lat, lon, h in places)
        names = escape(", ".join(r.plant.field.ids[k] for k in c.who))
        lines.append(
            f"<Placemark><name>cluster {c.number}</name><description>{names}</description><LineString>"
            f"<altitudeMode>absolute</altitudeMode><coordinates>{path}</coordinates></LineString></Placemark>"
        )
    write_csv(folder / "waypoints.csv", header, rows)
    write_text(
        folder / "flight.kml",
        '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2"><Document>\n'
        + "\n".join(lines)
        + "\n</Document></kml>\n",
    )
    table = r.rows()
    write_csv(folder / "heliostats.csv", list(table[0]), (row.values() for row in table), 9)
    drawn = zip(("plan", "side", "errors"), r.figures(), strict=False)
    pictures = {name: save(figure, folder / f"{name}.png") for name, figure in drawn}
    plain, text = r.as_dict(), r.text()
    write_text(folder / "drone.json", json.dumps(plain, indent=1, allow_nan=False) + "\n")
    write_text(folder / "summary.txt", text + "\n")
    write_text(folder / "report.html", page.plant_page(page_drone.planned(plain, r.plant.name, text, pictures)))
