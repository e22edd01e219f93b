"""``benchsim drone read``: somebody's own pictures of a cluster, from the lamp's glints to the heliostats' axes."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from benchsim.bench.errors import BenchsimError
from benchsim.bench.names import printable
from benchsim.bench.writing import write_csv, write_text
from benchsim.drones.estimate import FEWEST, estimate
from benchsim.drones.flight import Sightings
from benchsim.drones.heliostat import design_map
from benchsim.jobs.drone_cluster import ENU, Cluster, clusters
from benchsim.jobs.drone_flown import stated
from benchsim.jobs.drone_places import places_of
from benchsim.jobs.drone_sightings import lens_of, sightings_of
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

FORMAT = "benchsim-drone-read/1"

SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff"}

MOST = 5000
"""Pictures of a cluster."""

TOLD = 3
"""Heliostats that are named where many lack the same; the files have all."""

BESIDE = 5e3
"""Beyond the planned pattern at which pictures contradict the plan [mm]: heliostats that look at the planned point do
not shine there."""

BROAD = 3.0
"""Times the expected width of the differences, above which they contradict the stated surface."""


@dataclass(frozen=True, repr=False)
class DroneReading(Shown):
    """What pictures say of a cluster's heliostats.

    Attributes
    ----------
    plant : Plant
    cluster : Cluster
    pictures : int
    rows : tuple of dict
        For each heliostat: glints, by how much it looks beside where it was told to, its axis, the budget.
    remarks : tuple of str
        What contradicts the plan, or is left out.
    folder : Path or None
    """

    plant: Plant
    cluster: Cluster
    pictures: int
    rows: tuple[dict[str, Any], ...]
    remarks: tuple[str, ...]
    folder: Path | None = None

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``axes.json``."""
        return {
            "format": FORMAT,
            "title": self.plant.title,
            "cluster": self.cluster.number,
            "pictures": self.pictures,
            "heliostats": list(self.rows),
            "remarks": list(self.remarks),
        }

    def text(self) -> str:
        """Plain sentences for ``summary.txt``."""
        known = [r for r in self.rows if not r["says"]]
        lines = [
            f"cluster {self.cluster.number}: {self.pictures} pictures, axes of {len(known)} of "
            f"{counted(len(self.rows), 'heliostat')}"
        ]
        if known:
            head = "  looks beside where it was told to, by azimuth and elevation [mrad]"
            lines.append(f"{head}; of the axis sigma_mean, sigma_sys")
        lines += [
            f"    {r['id']:<10} {r['azimuth_off_mrad']:+8.3f} ± {r['sigma_azimuth_off_mrad']:.2f} "
            f"{r['elevation_off_mrad']:+8.3f} ± {r['sigma_elevation_off_mrad']:.2f}   "
            f"{r['sigma_mean_mrad']:.2f}, {r['sigma_sys_mrad']:.2f}   {counted(r['glints'], 'glint')}"
            for r in known
        ]
        lacking: dict[str, list[str]] = {}
        for r in self.rows:
            if r["says"]:
                lacking.setdefault(r["says"], []).append(r["id"])
        lines += [f"  of {_named(ids)}: {says}" for says, ids in lacking.items()]
        return "\n".join([*lines, *self.remarks])

    def summary(self) -> str:
        """What a person wants to know, on a terminal."""
        known = any(not r["says"] for r in self.rows)
        step = "turn them by as much the other way, and fly again" if known else "mend what is said, and read again"
        return f"{self.text()}{written(self.folder, page=True)}\nnext: {step}"

    def figures(self) -> list[Figure]:
        """The axes on the plan."""
        f = self.plant.field
        return [drone_pictures.axes_found({f.ids[k]: f.position[k] for k in self.cluster.who}, self.rows)]


@threadpool_limits.wrap(limits=1)
def drone_read(
    photos: Path | str,
    plant: Plant | Path | str,
    output: Path | str | None = None,
    *,
    camera: Path | str,
    positions: Path | str | None = None,
    cluster: int | None = None,
    allow_outside: bool = False,
    progress: Progress = silent,
) -> DroneReading:
    """Axes of a cluster's heliostats from pictures of the lamp's glints in them.

    Parameters
    ----------
    photos : path
        Folder of the pictures: JPEG, PNG or TIFF, as the sensor has them.
    plant : path
    output : path, optional
        Folder for ``axes.json``, ``axes.csv``, ``glints.csv``, a picture, ``report.html`` and
        ``summary.txt``; default: nothing.
    camera : path
        ``camera.toml`` of `calibrate`.
    positions : path, optional
        A CSV with ``name`` of the picture and ``east_m``, ``north_m``, ``up_m``, or ``latitude_deg``,
        ``longitude_deg``, ``height_m``; default EXIF's GPS tags.
    cluster : int, optional
        Of the plan of `drone`, from 1; default that whose camera point is nearest.
    allow_outside : bool
    progress : callable

    Returns
    -------
    DroneReading

    Raises
    ------
    BenchsimError
        If a file cannot be used, or pictures do not say where they were taken.
    """
    p = plant if isinstance(plant, Plant) else files.read(plant, allow_outside=allow_outside)
    folder = Path(photos)
    if not folder.is_dir():
        raise BenchsimError(f"{folder}: no such folder; name the folder that the pictures are in")
    paths = sorted(x for x in folder.iterdir() if x.suffix.lower() in SUFFIXES and not x.name.startswith("."))
    if len(paths) < 3:
        raise BenchsimError(f"{folder}: holds {counted(len(paths), 'picture')}; give those of a whole pattern")
    if len(paths) > MOST:
        raise BenchsimError(f"{folder}: holds more than {MOST} pictures; give those of one cluster")
    lens, remarks = lens_of(Path(camera))
    said = [] if positions is None else [Path(positions)]
    east = places_of(paths, p, said[0] if said else None)
    c = _cluster(p, east, cluster)
    eyes = (east - c.middle) @ ENU.T
    remarks += _beside(c, eyes)
    inputs = [*p.files, Path(camera), *said, *paths]
    with wanted_folder(output, "drone read", inputs, {"cluster": c.number}) as staging:
        found, missed = sightings_of(c, lens, paths, eyes, progress)
        rows = [_row(c, int(k), found[i], eyes, missed[i], len(paths)) for i, k in enumerate(c.who)]
        remarks += _contradictions(rows)
        result = DroneReading(
            p, c, len(paths), tuple(rows), (*p.remarks, *remarks), None if output is None else Path(output)
        )
        if staging is not None:
            write_csv(staging / "axes.csv", list(rows[0]), (r.values() for r in rows), 6)
            body = (
                [p.field.ids[k], paths[f].name, *(x / 1e3).tolist()]
                for k, s in zip(c.who, found, strict=True)
                for f, x in zip(s.frame, s.points, strict=True)
            )
            write_csv(staging / "glints.csv", ["id", "picture", "x_m", "y_m"], body, 6)
            plain, text = result.as_dict(), result.text()
            pictures = {"axes": save(result.figures()[0], staging / "axes.png")}
            write_text(staging / "axes.json", json.dumps(plain, indent=1, allow_nan=False) + "\n")
            write_text(staging / "summary.txt", text + "\n")
            write_text(staging / "report.html", page.plant_page(page_drone.read(plain, p.name, text, pictures)))
    progress("done", 1.0)
    return result


def _cluster(plant: Plant, east: Array, number: int | None) -> Cluster:
    parts = clusters(plant)
    if number is not None:
        if number > len(parts):
            raise BenchsimError(f"--cluster: the plan has {len(parts)}, not {number}; name one of them")
        return parts[number - 1]
    middle = east.mean(axis=0)
    return min(parts, key=lambda c: float(np.linalg.norm(c.target @ ENU + c.middle - middle)))


def _beside(c: Cluster, eyes: Array) -> list[str]:
    """Sentences on where the pictures were taken against the plan."""
    points, plane = c.route
    out = []
    across = np.abs((eyes - c.target) @ plane.T)
    limit = np.abs((points - c.target) @ plane.T).max(axis=0) + BESIDE
    along = np.abs((eyes - c.target) @ (c.target / np.linalg.norm(c.target)))
    away = (across > limit).any(axis=1) | (along > 2 * BESIDE)
    if away.any():
        far = np.linalg.norm(eyes - c.target, axis=1).max() / 1e3
        out.append(
            f"{away.sum()} of {len(eyes)} pictures lie beside the planned pattern, up to {far:.0f} m from where "
            f"cluster {c.number} was told to look: height, site or cluster is not as said."
        )
    if np.ptp(eyes, axis=0).max() < 100.0:
        raise BenchsimError("the pictures are all taken at one place to 0.1 m; EXIF may be rounded, give --positions")
    return out


def _row(c: Cluster, k: int, s: Sightings, eyes: Array, missed: int, pictures: int) -> dict[str, Any]:
    width, _, system = c.sigma(k)
    row: dict[str, Any] = {"id": c.plant.field.ids[k], "glints": len(s.frame), "not_found_in": missed}
    numbers = (
        "outliers", "azimuth_off_mrad", "sigma_azimuth_off_mrad", "elevation_off_mrad", "sigma_elevation_off_mrad",
        "axis_east", "axis_north", "axis_up", "sigma_ad_mrad", "sigma_ad_expected_mrad", "sigma_mean_mrad",
        "sigma_sys_mrad", "sigma_mrad", "p_normal",
    )  # fmt: skip
    row |= dict.fromkeys(numbers)
    if missed > pictures / 2:
        return row | {"says": f"the mirror is not found in {missed} of {pictures} pictures: position, pose or exposure"}
    mount = c.mount(k)
    try:
        e = estimate(s, eyes, eyes + c.lamps, mount, design_map(c.design(k)))
    except BenchsimError as error:
        return row | {"says": printable(str(error))}
    axis = e.axis @ ENU
    mean = float(stated(e).max())
    sigma = math.hypot(mean, system)
    values = (
        int((~e.kept).sum()), 1e3 * (e.mount.azimuth - mount.azimuth), 1e3 * sigma / math.cos(e.mount.elevation),
        1e3 * (e.mount.elevation - mount.elevation), 1e3 * sigma, *axis.tolist(), 1e3 * float(e.sigma_ad.max()),
        1e3 * width, 1e3 * mean, 1e3 * system, 1e3 * sigma, float(e.p_normal.min()),
    )  # fmt: skip
    return row | dict(zip(numbers, values, strict=True)) | {"says": ""}


def _named(ids: Sequence[str]) -> str:
    """Some heliostats, by their ids; many with a count."""
    if len(ids) <= TOLD:
        return ", ".join(ids)
    return f"{len(ids)} heliostats ({', '.join(ids[:TOLD])}, …)"


def _contradictions(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Sentences on what the glints say against what is stated."""
    known = [r for r in rows if not r["says"]]
    out = []
    if not known:
        out.append(
            f"No heliostat shows {FEWEST} glints: they do not look at the planned point, the lamp was off, or the "
            "pictures are not where they are said to be."
        )
    broad = [r["id"] for r in known if r["sigma_ad_mrad"] > BROAD * r["sigma_ad_expected_mrad"]]
    if broad:
        out.append(
            f"Differences are more than {BROAD:g} times as wide as the stated slopes make them: "
            f"{', '.join(broad[:5])}; surface, facets or positions are not as stated."
        )
    odd = [r["id"] for r in known if r["p_normal"] < 0.05 / max(len(known), 1)]
    if odd:
        out.append(
            f"Differences are not normal (Shapiro-Wilk): {', '.join(odd[:5])}; sigma_mean is an order of "
            "magnitude only."
        )
    if len(known) > 2:
        off = np.array([[r["azimuth_off_mrad"], r["elevation_off_mrad"]] for r in known])
        sigma = np.array([[r["sigma_azimuth_off_mrad"], r["sigma_elevation_off_mrad"]] for r in known])
        mean = off.mean(axis=0)
        if (np.abs(mean) > 4 * np.hypot(sigma.mean(axis=0), off.std(axis=0)) / math.sqrt(len(known))).any():
            out.append(
                f"All heliostats look {mean[0]:+.2f} (azimuth) and {mean[1]:+.2f} mrad beside on average: the "
                "drone's positions or the site may be shifted."
            )
    return out
