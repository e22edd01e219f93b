"""``benchsim flux``: the flux that a plant makes on its receivers, at a time, in a day or a year; who loses what."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from benchsim.bench.errors import BenchsimError
from benchsim.bench.names import file_name
from benchsim.bench.writing import write_csv, write_text
from benchsim.fluxes.day import clear_sky
from benchsim.instruments.mount import solar, stamps
from benchsim.instruments.mount.records import toward
from benchsim.jobs.output import wanted_folder, written
from benchsim.jobs.progress import Progress, silent
from benchsim.jobs.shown import Shown
from benchsim.plant import files
from benchsim.plant.model import Plant
from benchsim.plant.moment import Moment, meshes, moment
from benchsim.reports import flux_pictures
from benchsim.reports.pictures import save

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

FORMAT = "benchsim-flux/1"

KINDS = ("stated", "none", "drawn", "diagnosed")
"""Whose errors of the mounts are taken."""

QUARTERS = ("03-21", "06-21", "09-22", "12-21")
"""Days that stand for a year: the sun's longitude is a quarter of its circle apart."""

LEVELS = (0.25, 0.5, 0.75)
"""Contours of a picture, in parts of the peak, unless they are said."""

COARSE = 1e-3
"""Change by the grid's edge correction above which a remark is due."""

TOLD = 5
"""Heliostats of a summary; the files have all."""


@dataclass(frozen=True)
class Rank:
    """What the mounts' errors cost each heliostat in a day or a year.

    Attributes
    ----------
    lost : (n,)
        Energy on the receiver without errors less with them [kWh]: what a calibration would bring back.
    sigma : (n,)
        Of it, to first order in the errors' own sigmas [kWh].
    """

    lost: Array
    sigma: Array


@dataclass(frozen=True, repr=False)
class FluxResult(Shown):
    """What a plant does at a time, or through a day.

    Attributes
    ----------
    plant : Plant
    times : tuple of datetime
        In the site's zone.
    moments : tuple of Moment
    step : float or None
        Between the times of a day [h]; None: a single time.
    stands : float
        For which each time stands in sums [h]: the step, and of a year as many days as each of its four does.
    errors : {"stated", "none", "drawn", "diagnosed"}
    seed : int
        Of the drawn errors.
    levels : tuple of float
        Of the contours [kW/m²], or kWh/m² of a day; empty: parts of the peak.
    rank : Rank or None
    folder : Path or None
    """

    plant: Plant
    times: tuple[datetime, ...]
    moments: tuple[Moment, ...]
    step: float | None
    stands: float
    errors: str
    seed: int
    levels: tuple[float, ...]
    rank: Rank | None = None
    folder: Path | None = None

    def total(self, name: str) -> Array:
        """Of every heliostat: the sum of ``power`` or ``reflected`` through day or year [kWh], or its value [kW]."""
        return np.asarray(sum(getattr(m, name) for m in self.moments)) * self.stands / 1e3

    def mean(self, name: str) -> Array:
        """Of every heliostat: a mean through the day, by the light that the mirror would reflect were it alone."""
        weight = np.array([m.reflected for m in self.moments])
        values = np.array([getattr(m, name) for m in self.moments])
        return np.asarray((weight * values).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-12))

    def maps(self) -> tuple[Array, ...]:
        """On each receiver: flux [kW/m²], or energy of day or year [kWh/m²]."""
        parts = zip(*(m.flux for m in self.moments), strict=True)
        return tuple(np.asarray(sum(p)) * self.stands / 1e3 for p in parts)

    def losses(self) -> dict[str, float]:
        """Of all the light that the mirrors would reflect were they alone, what part is lost where."""
        out = {"shaded": 0.0, "blocked": 0.0, "absorbed_by_air": 0.0, "spilled": 0.0}
        whole = 0.0
        for m in self.moments:
            rest = m.reflected * (1 - m.shaded - m.blocked)
            out["shaded"] += float(m.reflected @ m.shaded)
            out["blocked"] += float(m.reflected @ m.blocked)
            out["absorbed_by_air"] += float(rest @ (1 - m.transmitted))
            out["spilled"] += float((rest * m.transmitted) @ m.spillage)
            whole += float(m.reflected.sum())
        return {k: v / whole if whole else 0.0 for k, v in out.items()}

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``flux.json``."""
        f = self.plant.field
        unit = "kw" if self.step is None else "kwh"
        out: dict[str, Any] = {
            "format": FORMAT,
            "title": self.plant.title,
            "engine": "error-function product",
            "errors": self.errors,
            "seed": self.seed if self.errors == "drawn" else None,
            "heliostats": len(f),
            "step_h": self.step,
            "each_stands_for_h": self.stands,
            "times": [
                {
                    "time": t.isoformat(),
                    "sun_azimuth_deg": float(np.degrees(np.arctan2(m.sun[0], m.sun[1])) % 360),
                    "sun_elevation_deg": float(np.degrees(np.arcsin(m.sun[2]))),
                    "irradiance_w_m2": m.irradiance,
                    "power_kw": float(m.power.sum()) / 1e3,
                    "peak_kw_m2": [float(x.max()) / 1e3 for x in m.flux],
                }
                for t, m in zip(self.times, self.moments, strict=True)
            ],
            "receivers": [
                {
                    "name": r.name,
                    "kind": r.kind,
                    f"on_it_{unit}": float(self.total("power")[f.receiver == k].sum()),
                    f"peak_{unit}_m2": float(values.max()),
                }
                for k, (r, values) in enumerate(zip(self.plant.receivers, self.maps(), strict=True))
            ],
            "losses": self.losses(),
            "grid_error": max(m.grid for m in self.moments),
            "remarks": list(self.plant.remarks),
        }
        if self.rank is not None:
            order = np.argsort(-self.rank.lost)
            out["rank"] = [
                {"id": f.ids[k], "lost_kwh": float(self.rank.lost[k]), "sigma_kwh": float(self.rank.sigma[k])}
                for k in order
            ]
        return out

    def text(self) -> str:
        """Plain sentences for ``summary.txt``."""
        plain, n = self.as_dict(), len(self.plant.field)
        of = {
            "none": "without errors of the mounts",
            "stated": "errors of the mounts as stated",
            "drawn": f"errors of the mounts drawn with seed {self.seed}",
            "diagnosed": "errors of the mounts as diagnosed",
        }[self.errors]
        name = self.plant.title or self.plant.path.resolve().parent.name
        if self.step is None:
            t = plain["times"][0]
            when = (
                f"{self.times[0]:%Y-%m-%d %H:%M %Z}, sun {t['sun_azimuth_deg']:.1f}° from north and "
                f"{t['sun_elevation_deg']:.1f}° high, {t['irradiance_w_m2']:.0f} W/m²"
            )
            unit = "kW"
        else:
            days = list(dict.fromkeys(f"{t:%Y-%m-%d}" for t in self.times))
            what = "the year by " if len(days) > 1 else ""
            when = f"{what}{', '.join(days)}, {len(self.times)} times {self.step:g} h apart"
            unit = "kWh"
        lines = [f"{name}: {n} heliostat{'s' if n != 1 else ''}, {when}; {of}"]
        lines += [
            f"  {r['name']}: {r[f'on_it_{unit.lower()}']:.4g} {unit}, peak {r[f'peak_{unit.lower()}_m2']:.4g} {unit}/m²"
            for r in plain["receivers"]
        ]
        parts = ", ".join(f"{k.replace('_', ' ')} {100 * v:.2f} %" for k, v in plain["losses"].items())
        lines.append(f"  of the light that the mirrors would reflect were each alone: {parts}")
        if self.rank is not None:
            cost = float(self.rank.lost.sum())
            lines.append(f"  errors of the mounts cost {cost:.4g} kWh in that time; first to be calibrated:")
            lines += [
                f"    {r['id']:<12} {r['lost_kwh']:9.3g} ± {r['sigma_kwh']:.2g} kWh" for r in plain["rank"][:TOLD]
            ]
        if plain["grid_error"] > COARSE:
            lines.append(
                f"  cells are wide for the spots, shares off by up to {plain['grid_error']:.1g}; give more with --cells"
            )
        return "\n".join([*lines, *self.plant.remarks])

    def summary(self) -> str:
        """What a person wants to know, on a terminal."""
        return self.text() + written(self.folder)

    def figures(self) -> list[Figure]:
        """The flux on each receiver, and the field."""
        day = self.step is not None
        out = []
        for receiver, mesh, values in zip(self.plant.receivers, self.moments[0].meshes, self.maps(), strict=True):
            levels = self.levels or tuple(x * float(values.max()) for x in LEVELS)
            out.append(flux_pictures.flux(receiver.name, receiver.kind, mesh.u, mesh.v, values, levels, day))
        f = self.plant.field
        values = self.total("power") / (f.area / 1e6)
        return [*out, flux_pictures.field(f.position, values, day)]


@threadpool_limits.wrap(limits=1)
def flux(
    plant: Plant | Path | str,
    output: Path | str | None = None,
    *,
    at: str | None = None,
    day: str | None = None,
    year: int | None = None,
    step: float = 1.0,
    errors: str | None = None,
    seed: int = 0,
    irradiance: float | None = None,
    cells: int | None = None,
    levels: Sequence[float] = (),
    rank: bool = False,
    allow_outside: bool = False,
    progress: Progress = silent,
) -> FluxResult:
    """Compute the flux that a plant makes on its receivers, by the product of error functions.

    Parameters
    ----------
    plant : path
        ``plant.toml``, or the folder that holds it.
    output : path, optional
        Folder for ``flux.json``, ``heliostats.csv``, maps, pictures and ``summary.txt``; default: nothing is written.
    at : str, optional
        A time of ISO 8601; without a zone in the site's.
    day : str, optional
        A date instead, in the site's zone: sums through the day.
    year : int, optional
        A year instead: sums by four days, the equinoxes and solstices, each of which stands for a quarter of it.
    step : float
        For which each time of a day stands, which is its middle [h].
    errors : {"stated", "none", "drawn", "diagnosed"}, optional
        Of the mounts. Default: as diagnosed where the plant names a diagnosis, else as stated.
    seed : int
        Of drawn errors: as stated, and normal about that with their sigmas.
    irradiance : float, optional
        On a plane that faces the sun [W/m²]; default a clear sky's.
    cells : int, optional
        Of a map along and up; default half as wide as the narrowest spot's sigma, 60 to 300.
    levels : sequence of float
        Of contours [kW/m²], or kWh/m² of a day; default parts of the peak.
    rank : bool
        With ``day`` or ``year``: what the errors cost each heliostat.
    allow_outside : bool
        Whether the plant's tables may lie outside of its folder.
    progress : callable

    Returns
    -------
    FluxResult

    Raises
    ------
    BenchsimError
        If the plant, the time or an option cannot be used.
    """
    p = plant if isinstance(plant, Plant) else files.read(plant, allow_outside=allow_outside)
    if [at, day, year].count(None) != 2:
        raise BenchsimError("--at, --day, --year: give one of them, a time, a date or a year")
    if rank and at is not None:
        raise BenchsimError("--rank: what errors cost is summed through a day; give --day or --year")
    kind = errors or ("diagnosed" if p.diagnosed else "stated")
    if kind not in KINDS:
        raise BenchsimError(f"--errors: {kind!r} is none of {', '.join(KINDS)}")
    stated, sigmas = mount_errors(p, kind, seed)
    days = [day] if day is not None else [f"{year:04d}-{d}" for d in QUARTERS] if year is not None else []
    times = [_time(at, p)] if at is not None else [t for d in days for t in _times(d, step, p)]
    # A day has a whole number of steps.
    stands = 1.0 if at is not None else 24 / round(24 / step) * (1 if day is not None else 365.25 / len(days))
    suns = _suns(times, p)
    up = [k for k in range(len(times)) if suns[k, 2] > 0]
    if not up:
        low = float(np.degrees(np.arcsin(suns[:, 2].max())))
        raise BenchsimError(
            f"--{'at' if at else 'day' if day else 'year'}: the sun is {-low:.1f} deg below the horizon; name another"
        )
    sky = np.full(len(times), irradiance) if irradiance is not None else clear_sky(suns, p.site.elevation)
    grids = meshes(p, cells)
    options = {"at": at, "day": day, "year": year, "step": step, "errors": kind, "seed": seed, "irradiance": irradiance}
    with wanted_folder(output, "flux", p.files, options) as staging:

        def through(errors: Mapping[str, Array], what: str, start: float, end: float) -> tuple[Moment, ...]:
            out = []
            for done, k in enumerate(up):
                progress(what, start + (end - start) * done / len(up))
                out.append(moment(p, suns[k], float(sky[k]), errors, grids))
            return tuple(out)

        share = 1 / (2 + len(sigmas)) if rank else 1.0
        moments = through(stated, "flux", 0.0, 0.95 * share)
        found = _rank(stated, sigmas, moments, through, share, stands) if rank else None
        result = FluxResult(
            p, tuple(times[k] for k in up), moments, None if at is not None else step, stands, kind, seed,
            tuple(levels), found, None if output is None else Path(output),
        )  # fmt: skip
        if staging is not None:
            _write(result, staging)
    progress("done", 1.0)
    return result


def mount_errors(plant: Plant, kind: str, seed: int) -> tuple[Mapping[str, Array], Mapping[str, Array]]:
    """Errors of the mounts and their sigmas [rad], (n,) by name: as stated, none, drawn, or as diagnosed."""
    f = plant.field
    if kind == "none":
        return {}, {}
    if kind == "diagnosed":
        if plant.diagnosed is None:
            raise BenchsimError(
                f"{plant.path.name}: heliostats.diagnosed: is missing, so nothing is as diagnosed; name a field.csv"
            )
        return plant.diagnosed
    if kind == "stated":
        return f.errors, f.sigmas
    rng = np.random.default_rng(seed)
    zero = np.zeros(len(f))
    return {
        n: f.errors.get(n, zero) + f.sigmas.get(n, zero) * rng.standard_normal(len(f))
        for n in dict.fromkeys((*f.errors, *f.sigmas))
    }, f.sigmas


def _time(text: str | None, plant: Plant) -> datetime:
    time = stamps.parsed(text)
    if time is None:
        raise BenchsimError(f"--at: {str(text)[:40]!r} is no time from 1950 to 2100; write it like 2026-06-21T12:00")
    return time.astimezone(plant.site.zone) if time.tzinfo else time.replace(tzinfo=plant.site.zone)


def _times(text: str, step: float, plant: Plant) -> list[datetime]:
    try:
        first = date.fromisoformat(text)
    except ValueError:
        first = None
    if first is None or not 1950 <= first.year <= 2100:
        raise BenchsimError(f"--day, --year: {text[:40]!r} is no date from 1950 to 2100; write it like 2026-06-21")
    if not 1 / 60 <= step <= 6:
        raise BenchsimError(f"--step: {step:g} h is out of range; it must be from a minute, 0.0167, to 6 h")
    start = datetime(first.year, first.month, first.day, tzinfo=plant.site.zone).astimezone(UTC)
    count = round(24 / step)
    return [(start + timedelta(hours=24 * (k + 0.5) / count)).astimezone(plant.site.zone) for k in range(count)]


def _suns(times: Sequence[datetime], plant: Plant) -> Array:
    """Apparent suns, (T, 3)."""
    azimuth, elevation = np.radians(solar.almanac(np.array([t.timestamp() for t in times]), plant.site.place)).T
    return toward(azimuth, elevation)


def _rank(
    errors: Mapping[str, Array],
    sigmas: Mapping[str, Array],
    moments: tuple[Moment, ...],
    through: Any,
    share: float,
    stands: float,
) -> Rank:
    def energy(some: tuple[Moment, ...]) -> Array:
        return np.asarray(sum(m.power for m in some)) * stands / 1e3

    with_errors = energy(moments)
    lost = energy(through({}, "flux without errors", 0.95 * share, 1.9 * share)) - with_errors
    variance = np.zeros_like(lost)
    for k, (name, sigma) in enumerate(sigmas.items()):
        moved = {**errors, name: errors.get(name, 0.0) + sigma}
        variance += (
            energy(through(moved, f"flux with {name} a sigma larger", (1.9 + k) * share, (2.9 + k) * share))
            - with_errors
        ) ** 2
    return Rank(lost, np.sqrt(variance))


def _write(r: FluxResult, folder: Path) -> None:
    f, day = r.plant.field, r.step is not None
    unit = "kwh" if day else "kw"
    *pictures, plan = r.figures()
    for receiver, mesh, values, picture in zip(r.plant.receivers, r.moments[0].meshes, r.maps(), pictures, strict=True):
        name = file_name(receiver.name)
        along, up = np.meshgrid(mesh.u / 1e3, mesh.v / 1e3, indexing="ij")
        write_csv(
            folder / f"flux-{name}.csv",
            ["along_m", "up_m", f"{'energy' if day else 'flux'}_{unit}_m2"],
            np.stack([along.ravel(), up.ravel(), values.ravel()], axis=1).tolist(),
            6,
        )
        save(picture, folder / f"flux-{name}.png")
    save(plan, folder / "field.png")
    columns = [x / 1e3 for x in f.position.T] + [r.total("power")]
    columns += [r.mean(n) for n in ("cosine", "shaded", "blocked", "transmitted", "spillage", "image_rms")]
    columns[-1] = columns[-1] / 1e3
    header = [
        "id",
        "receiver",
        "east_m",
        "north_m",
        "up_m",
        "energy_kwh" if day else "power_kw",
        "cosine",
        "shaded",
        "blocked",
        "transmitted",
        "spillage",
        "image_rms_m",
    ]
    if not day:
        header += ["centroid_along_m", "centroid_up_m"]
        columns += list(r.moments[0].landing.T / 1e3)
    if r.rank is not None:
        header += ["lost_kwh", "lost_sigma_kwh"]
        columns += [r.rank.lost, r.rank.sigma]
    order = np.argsort(-r.rank.lost) if r.rank is not None else np.arange(len(f))
    table = np.stack(columns, axis=1).tolist()
    names = [x.name for x in r.plant.receivers]
    rows = ([f.ids[k], names[f.receiver[k]], *(None if x != x else x for x in table[k])] for k in order)
    write_csv(folder / "heliostats.csv", header, rows, 6)
    write_text(folder / "flux.json", json.dumps(r.as_dict(), indent=1, allow_nan=False) + "\n")
    write_text(folder / "summary.txt", r.text() + "\n")
