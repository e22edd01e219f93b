"""What ``benchsim flux`` found: sums, sentences, pictures."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from benchsim.jobs.flux_choices import FluxEngine
from benchsim.jobs.flux_cost import Cost
from benchsim.jobs.flux_engines import Parting, over_cells
from benchsim.jobs.output import written
from benchsim.jobs.shown import Shown
from benchsim.plant.model import Plant
from benchsim.plant.moment import Moment, over_limit
from benchsim.reports import flux_pictures
from benchsim.reports.quantities import counted, said, short

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

FORMAT = "benchsim-flux/1"

SAID = {
    FluxEngine.product: "error-function product",
    FluxEngine.carlo: "Monte Carlo",
    FluxEngine.both: "error-function product, Monte Carlo beside it",
}

LEVELS = (0.25, 0.5, 0.75)
"""Contours of a picture, in parts of the peak, unless they are said."""

COARSE = 1e-3
"""Change by the grid's edge correction above which a remark is due."""

SURE = "standard error of a receiver's power or brightest cell, the larger"
"""What Monte Carlo's accuracy is of."""

TOLD = 5
"""Heliostats of a summary; the files have all."""


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
    engine : {"product", "carlo", "both"}
        Of both, ``moments`` are the product's.
    carlo : tuple of Moment
        By Monte Carlo, beside the product's, where both were asked for.
    partings : tuple of Parting
        Where both part, at the time of the most power.
    rank : Cost or None
    folder : Path or None
    clear : bool
        Whether the sky is a clear one, and not of a stated irradiance.
    dark : tuple of str
        Days of a year without sun.
    """

    plant: Plant
    times: tuple[datetime, ...]
    moments: tuple[Moment, ...]
    step: float | None
    stands: float
    errors: str
    seed: int
    levels: tuple[float, ...]
    engine: str = "product"
    carlo: tuple[Moment, ...] = ()
    partings: tuple[Parting, ...] = ()
    rank: Cost | None = None
    folder: Path | None = None
    clear: bool = True
    dark: tuple[str, ...] = ()

    def total(self, name: str) -> Array:
        """Of every heliostat: the sum of ``power`` or ``reflected`` through day or year [kWh], or its value [kW]."""
        return np.asarray(sum(getattr(m, name) for m in self.moments)) * self.stands / 1e3

    def mean(self, name: str) -> Array:
        """Of every heliostat: a mean through the day, by the light that the mirror would reflect were it alone."""
        weight = np.array([m.reflected for m in self.moments])
        values = np.array([getattr(m, name) for m in self.moments])
        return np.asarray((weight * values).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-12))

    def maps(self, moments: tuple[Moment, ...] = ()) -> tuple[Array, ...]:
        """On each receiver: flux [kW/m²], or energy of day or year [kWh/m²]; of `moments`, or others."""
        parts = zip(*(m.flux for m in moments or self.moments), strict=True)
        return tuple(np.asarray(sum(p)) * self.stands / 1e3 for p in parts)

    def noise(self) -> tuple[Array, ...]:
        """Standard errors of the Monte Carlo's maps, in their unit; none without one."""
        parts = zip(*(m.noise.flux for m in self.carlo or self.moments if m.noise is not None), strict=True)
        return tuple(np.sqrt(sum(x**2 for x in p)) * self.stands / 1e3 for p in parts)

    def on_receivers(self) -> Array:
        """Power [kW], or energy of day or year [kWh], of each receiver."""
        return np.asarray(sum(m.received for m in self.moments)) * self.stands / 1e3

    def limits(self) -> list[dict[str, Any]]:
        """Of every receiver with a limit: its name, the largest peak, when that is, and what is above the limit.

        By Monte Carlo where that was asked for: its noise reads peaks high, the product's simplifications low.
        """
        best = self.carlo or self.moments
        over = np.array([over_limit(self.plant, m) for m in best])
        out = []
        for k, r in enumerate(self.plant.receivers):
            if r.peak_limit is None:
                continue
            peaks = [float(m.flux[k].max()) for m in best]
            at = int(np.argmax(peaks))
            out.append(
                {
                    "receiver": r.name,
                    "peak_limit_kw_m2": r.peak_limit / 1e3,
                    "peak_kw_m2": peaks[at] / 1e3,
                    "at": self.times[at].isoformat(),
                    f"over_limit_{self.unit.lower()}": float(over[:, k].sum()) * self.stands / 1e3,
                    "times_over": int((np.array(peaks) > r.peak_limit).sum()),
                }
            )
        return out

    @property
    def unit(self) -> str:
        """Of a single time kW, of sums kWh."""
        return "kW" if self.step is None else "kWh"

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
        unit, on = self.unit.lower(), self.on_receivers()
        out: dict[str, Any] = {
            "format": FORMAT,
            "title": self.plant.title,
            "engine": SAID[FluxEngine(self.engine)],
            "errors": self.errors,
            "seed": self.seed if self.errors == "drawn" else None,
            "heliostats": len(f),
            "step_h": self.step,
            "each_stands_for_h": self.stands,
            "days_without_sun": list(self.dark),
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
                    f"on_it_{unit}": float(on[k]),
                    f"peak_{unit}_m2": float(values.max()),
                }
                for k, (r, values) in enumerate(zip(self.plant.receivers, self.maps(), strict=True))
            ],
            "losses": self.losses(),
            "grid_error": max(m.grid for m in self.moments),
            "remarks": list(self.plant.remarks),
        }
        if limits := self.limits():
            out["limits"] = limits
        traced = [(m.noise, float(m.received.sum())) for m in self.carlo or self.moments if m.noise is not None]
        if traced:
            # Errors of the times are independent of each other; where nothing is lit there is no relative one.
            lit = [(x.accuracy, power) for x, power in traced if power]
            together = float(np.hypot.reduce([a * power for a, power in lit])) if lit else None
            out["monte_carlo"] = {
                "rays": sum(x.rays for x, _ in traced),
                "accuracy": together and together / sum(power for _, power in lit),
                "accuracy_at_worst_time": max((a for a, _ in lit), default=None),
            }
        if self.partings:
            out["partings"] = [
                {
                    "receiver": p.receiver,
                    "time": self.times[self.brightest].isoformat(),
                    **{
                        f"{what}_{u}": dict(zip(("product", "monte_carlo", "sigma"), values, strict=True))
                        for what, u, values in (("power", "kw", p.power), ("peak", "kw_m2", p.peak))
                    },
                    "centroid_apart_m": list(p.centroid),
                    "causes": [
                        {"says": w, "power": a, "power_sigma": sa, "peak": b, "peak_sigma": sb}
                        for w, (a, sa), (b, sb) in p.causes
                    ],
                }
                for p in self.partings
            ]
        if self.rank is not None:
            out["rank"] = [
                {
                    "id": f.ids[k],
                    "lost_kwh": float(self.rank.lost[k]),
                    "over_limit_kwh": float(self.rank.over[k]),
                    "sigma_kwh": float(self.rank.sigma[k]),
                    "recalibrated_kwh": float(self.rank.recalibrated[k]),
                    "reaimed_kwh": float(self.rank.reaimed[k]),
                    "shift_m": [float(x) / 1e3 for x in self.rank.shift[k]],
                }
                for k in self.order
            ]
        return out

    @property
    def order(self) -> NDArray[np.int64]:
        """Heliostats by what their errors cost, or as the plant has them."""
        return np.argsort(-self.rank.total) if self.rank is not None else np.arange(len(self.plant.field))

    def text(self) -> str:
        """Plain sentences for ``summary.txt``."""
        plain = self.as_dict()
        of = {
            "none": "without errors of the mounts",
            "stated": self._stated(),
            "drawn": f"errors of the mounts drawn with seed {self.seed}",
            "diagnosed": "errors of the mounts as diagnosed",
        }[self.errors]
        if self.step is None:
            t = plain["times"][0]
            when = (
                f"{self.times[0]:%Y-%m-%d %H:%M %Z}, sun {t['sun_azimuth_deg']:.1f}° from north and "
                f"{t['sun_elevation_deg']:.1f}° high, {t['irradiance_w_m2']:.0f} W/m²"
            )
        else:
            days = list(dict.fromkeys(f"{t:%Y-%m-%d}" for t in self.times))
            what = "the year by " if len(days) + len(self.dark) > 1 else ""
            sky = " under a clear sky" if self.clear else ""
            when = f"{what}{', '.join(days)}, {counted(len(self.times), 'time')} {self.step:g} h apart{sky}"
        unit = self.unit
        lines = [f"{self.plant.name}: {counted(len(self.plant.field), 'heliostat')}, {when}; {of}"]
        if self.dark:
            lines.append(
                f"  the sun does not rise on {', '.join(self.dark)}: nothing is added for that part of the year"
            )
        for r in plain["receivers"]:
            on, peak = r[f"on_it_{unit.lower()}"], r[f"peak_{unit.lower()}_m2"]
            lines.append(f"  {r['name']}: {said(on, unit)}, peak {said(peak, unit)}/m²")
        parts = ", ".join(f"{k.replace('_', ' ')} {100 * v:.2f} %" for k, v in plain["losses"].items())
        lines.append(f"  of the light that the mirrors would reflect were each alone: {parts}")
        lines += self._more(plain)
        if plain["grid_error"] > COARSE:
            lines.append(
                f"  cells are wide for the spots, shares off by up to {plain['grid_error']:.1g}; give more with --cells"
            )
        return "\n".join([*lines, *self.plant.remarks])

    def _stated(self) -> str:
        f = self.plant.field
        if any(map(np.any, f.errors.values())):
            return "errors of the mounts as stated"
        only = "of which only sigmas are stated" if any(map(np.any, f.sigmas.values())) else "as none are stated"
        return f"without errors of the mounts, {only}"

    def _more(self, plain: dict[str, Any]) -> list[str]:
        """Sentences on Monte Carlo, limits and what errors cost."""
        lines = []
        if "monte_carlo" in plain:
            m = plain["monte_carlo"]
            error = "no receiver is lit"
            if m["accuracy"] is not None:
                error = f"{SURE}: {100 * m['accuracy']:.2g} %"
                if len(self.times) > 1:
                    error += f" of all times together, {100 * m['accuracy_at_worst_time']:.2g} % at the worst"
            lines.append(f"  Monte Carlo: {m['rays'] / 1e6:.3g} million rays, {error}")
        if self.partings:
            when = f"{self.times[self.brightest]:%Y-%m-%d %H:%M}, " if self.step is not None else ""
            lines.append(f"  where the engines part, {when}and by what of the product's:")
            lines += [s for p in self.partings for s in p.sentences()]
        by = " by Monte Carlo" if self.carlo else ""
        for x in plain.get("limits", []):
            over = x[f"over_limit_{self.unit.lower()}"]
            what = f"{said(over, self.unit, 3)} are above it" if x["times_over"] else "it is kept"
            many = f" at {x['times_over']} of {len(self.times)} times" if self.step is not None and over else ""
            lines.append(
                f"  {x['receiver']}: limit {x['peak_limit_kw_m2']:.4g} kW/m², largest peak {x['peak_kw_m2']:.4g}{by}; "
                f"{what}{many}"
            )
        if self.rank is not None and not (self.rank.lost.any() or self.rank.over.any()):
            only = "only their sigma is stated" if self.rank.sigma.any() else "none are stated"
            lines.append(f"  errors of the mounts cost nothing: {only}; --errors drawn shows what such errors would")
        elif self.rank is not None:
            lines += self._ranked(self.rank, plain["rank"][:TOLD])
        return lines

    def _ranked(self, r: Cost, first: list[dict[str, Any]]) -> list[str]:
        """Sentences on what errors cost, on whom it pays to mend, and on the costliest."""

        def brings(kwh: float) -> str:
            return f"{'brings back' if kwh >= 0 else 'loses another'} {said(abs(kwh), 'kWh')}"

        worth, lost = r.recalibrated > 0, float(r.lost.sum())
        put = (
            f" and put {said(r.over.sum(), 'kWh', 3)} above a limit"
            if any(x.peak_limit for x in self.plant.receivers)
            else ""
        )
        pays = (
            f"to calibrate the {worth.sum()} of {len(worth)} that gain by it {brings(r.recalibrated[worth].sum())}"
            if worth.any()
            else "to calibrate pays for none, as their sigmas leave as much to lose"
        )
        below = any(min(x["recalibrated_kwh"], x["reaimed_kwh"]) < 0 for x in first)
        return [
            f"  errors of the mounts {'cost' if lost >= 0 else 'bring'} {said(abs(lost), 'kWh')} in that time{put}; "
            f"{pays}, to shift all aims by constants {brings(r.reaimed.sum())}",
            "  costliest: cost, brought back by calibrating, and by a shift (along, up)"
            f"{'; below 0 more is lost' if below else ''}:",
            *(
                f"    {x['id']:<12} {short(x['lost_kwh'] + x['over_limit_kwh'], 3):>9} ± {short(x['sigma_kwh'], 2)} "
                f"kWh, {short(x['recalibrated_kwh'], 3)}, {short(x['reaimed_kwh'], 3)} "
                f"({x['shift_m'][0]:+.2f} m, {x['shift_m'][1]:+.2f} m)"
                for x in first
            ),
        ]

    @property
    def brightest(self) -> int:
        """The time of the most power."""
        return int(np.argmax([m.power.sum() for m in self.moments]))

    def summary(self) -> str:
        """What a person wants to know, on a terminal."""
        next_step = "\nnext: --engine both says by how much the product's simplifications move power and peak"
        return self.text() + written(self.folder, page=True) + (next_step if self.engine == "product" else "")

    def figures(self) -> list[Figure]:
        """The flux on each receiver, where engines part on it, and the field."""
        day = self.step is not None
        out = []
        for receiver, mesh, values in zip(self.plant.receivers, self.moments[0].meshes, self.maps(), strict=True):
            levels = self.levels or tuple(x * float(values.max()) for x in LEVELS)
            out.append(flux_pictures.flux(receiver.name, receiver.kind, mesh.u, mesh.v, values, levels, day))
        if self.carlo:
            pairs = zip(self.plant.receivers, self.moments[0].meshes, self.maps(), self.maps(self.carlo), strict=True)
            for receiver, mesh, values, by_rays in pairs:
                flat = over_cells(values, receiver.kind == "cylinder")
                out.append(flux_pictures.difference(receiver.name, receiver.kind, mesh.u, mesh.v, by_rays - flat, day))
        f = self.plant.field
        values = self.total("power") / (f.area / 1e6)
        return [*out, flux_pictures.field(f.position, values, day)]
