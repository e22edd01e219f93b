"""Fig. 5 of Carretero et al. 2019: drift of the beam over a day for fixed misalignments of 0 to 12 mrad.

For six heliostats on June 21: where the beam's centre stands on the target plane from morning to evening when the
mirror is misaligned by a fixed angle in elevation (red) or azimuth (blue). The table gives the solar hours in which it
stays on the receiver. Heliostats and latitude are those of ``fig4.py``. The receiver of 14 m square is chosen so that,
as the paper says, heliostat (a) stays on it all day up to 12 mrad and (d) not for 4 mrad; its sentence about (b), an
azimuth error of 12 mrad that finds the receiver "only at 16pm or before 8am", holds here in its afternoon half. No
chance enters.

The drift is that of ``benchsim flux`` on the shipped plant ``six``, these heliostats, through the day, of the errors of
``fig4.py``; or, with ``--vector``, the vector model's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from fig4 import COLOURS, Array, Field, arguments, dress, field, landed, misaligned, panels, solar_hours
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

import benchsim as bs
from benchsim.vector import deviation

MARKED = (8.0, 12.0, 16.0)
MARKERS = ("^", "o", "s")


def drift(f: Field, errors: Array, hours: Array) -> dict[str, Array]:
    """Y, Z [m] per cylinder, (locations, hours, errors, 2); nan where no real ray arrives."""
    sources, _ = f.sun(hours)
    out = {}
    for stands_for in COLOURS:
        points = np.full((len(f.locations), len(hours), len(errors), 2), np.nan)
        for i, where in enumerate(f.locations):
            for j, s in enumerate(sources):
                p, real = deviation(f.cylinder(where, s, stands_for), s, errors)
                points[i, j] = np.where(real[:, None], p, np.nan)
        out[stands_for] = points
    return out


def by_command(errors: Array, date: str, step: float, lowest: float) -> tuple[Array, dict[str, Array]]:
    """Solar hours, and `drift`, by ``benchsim flux`` on the shipped plant; it takes the middles of a day's steps."""
    out = {}
    for stands_for in COLOURS:
        plants = [misaligned(stands_for, error) for error in errors]
        made = [bs.flux(p, day=date, step=step / 60, cells=10, irradiance=900.0).moments for p in plants]
        suns = np.array([m.sun for m in made[0]])
        up = suns[:, 2] > math.sin(lowest)
        out[stands_for] = np.array([landed(moments)[up] for moments in made]).transpose(2, 1, 0, 3)
    return solar_hours(suns[up]), out


def daylight(f: Field, lowest: float, step: float) -> Array:
    """Solar hours with the sun above ``lowest`` [rad], every ``step`` minutes."""
    hours = np.arange(0.0, 24.0, step / 60)
    return hours[f.sun(hours)[1] > lowest]


def clock(hour: float) -> str:
    """8.5 as 08:30."""
    minutes = round(hour * 60)
    return f"{minutes // 60:02d}:{minutes % 60:02d}"


def intervals(hours: Array, inside: np.ndarray) -> list[tuple[float, float]]:
    """First and last hour of every unbroken run."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], inside.astype(int), [0]])))
    return [(float(hours[a]), float(hours[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def on_receiver(f: Field, points: Array) -> np.ndarray:
    """Which points (..., 2) [m] lie on the receiver."""
    return np.all(np.abs(points) <= np.array(f.receiver) / 2, axis=-1)


def table(f: Field, errors: Array, hours: Array, drifts: dict[str, Array]) -> list[str]:
    """Lines of two tables: how long the beam stays on the receiver, and when, if neither all day nor never."""
    step = hours[1] - hours[0]
    head = "".join(f"{error * 1e3:6g}" for error in errors)
    lines = ["hours_on_receiver by error_mrad", f"heliostat  cylinder  {head}"]
    spans = ["solar time on the receiver, where it is part of the day", "heliostat  cylinder   error_mrad  solar_time"]
    for i in range(len(f.locations)):
        for stands_for, points in drifts.items():
            inside = on_receiver(f, points[i])
            label = f"({chr(97 + i)})        {stands_for:9s}"
            lines.append(label + " " + "".join(f"{n * step:6.1f}" for n in inside.sum(axis=0)))
            for k, error in enumerate(errors):
                if inside[:, k].any() and not inside[:, k].all():
                    runs = ", ".join(f"{clock(a)}–{clock(b)}" for a, b in intervals(hours, inside[:, k]))
                    spans.append(f"{label}  {error * 1e3:10g}  {runs}")
    return [*lines, "", *spans]


def shade(colour: str, weight: float) -> tuple[float, ...]:
    """``colour`` mixed with white; weight 1 is the colour itself."""
    return tuple(1 - weight * (1 - part) for part in to_rgb(colour))


def draw(f: Field, errors: Array, hours: Array, drifts: dict[str, Array], half: float, title: str) -> Figure:
    """The figure."""
    note = (
        "Seen from the heliostats' side: +y, west of a tower that faces north, is to the right. "
        f"Yellow: receiver, {f.receiver[0]:g} × {f.receiver[1]:g} m. "
        "Along each line the misalignment is fixed and the day passes."
    )
    figure, all_axes = panels(len(f.locations), title, note)
    weights = np.linspace(0.3, 1.0, len(errors))
    marked = [int(np.argmin(np.abs(hours - h))) for h in MARKED]
    for i, axes in enumerate(all_axes):
        dress(axes, f, i, half)
        for stands_for, points in drifts.items():
            for k, error in enumerate(errors):
                colour = shade(COLOURS[stands_for], weights[k])
                axes.plot(*points[i, :, k].T, color=colour, linewidth=1.4)
                if error:
                    for j, marker in zip(marked, MARKERS, strict=True):
                        axes.plot(*points[i, j, k], marker, color=colour, markersize=4, markeredgecolor="white",
                                  markeredgewidth=0.5)  # fmt: skip
            y, z = points[i, marked[1], -1]
            axes.annotate(
                f"{errors[-1] * 1e3:g} mrad", (y, z), xytext=(0, -9) if abs(z) > abs(y) else (-6, 0),
                textcoords="offset points", ha="center" if abs(z) > abs(y) else "right",
                va="top" if abs(z) > abs(y) else "center", fontsize=8, color=COLOURS[stands_for],
            )  # fmt: skip
        axes.plot(0, 0, "+", color="black", markersize=7)
    handles = [Line2D([], [], color=v, linewidth=2, label=f"{k} misalignment") for k, v in COLOURS.items()]
    handles.append(
        Line2D([], [], color="none", label=f"pale to full: {errors[0] * 1e3:g} to {errors[-1] * 1e3:g} mrad")
    )
    handles += [
        Line2D([], [], color="#444444", marker=m, linestyle="none", markersize=5, label=f"{h:g} h")
        for h, m in zip(MARKED, MARKERS, strict=True)
    ]
    figure.legend(handles=handles, loc="outside upper right", ncols=len(handles), frameon=False, fontsize=9)
    return figure


def main(argv: Sequence[str] | None = None) -> Path:
    """Draw, print the table, and return the picture's path."""
    parser = arguments(__doc__)
    parser.add_argument("--errors", type=float, nargs="+", default=[0, 2, 4, 6, 8, 10, 12], help="[mrad]")
    parser.add_argument("--lowest-sun", type=float, default=5.0, help="elevation that begins the day [deg]")
    parser.add_argument("--step", type=float, default=5.0, help="[min] (default %(default)s)")
    parser.add_argument("--window", type=float, default=30.0, help="half-width of the panels [m] (default %(default)s)")
    parser.add_argument("--vector", action="store_true", help="by the vector model, which takes all other options")
    args = parser.parse_args(argv)
    f = field(args)
    errors = np.array(args.errors) * 1e-3
    hours = daylight(f, np.radians(args.lowest_sun), args.step)
    if len(hours) < 2:
        parser.error(f"the sun does not rise {args.lowest_sun:g}° high on {args.date} at latitude {args.latitude:g}°")
    if args.vector:
        drifts = drift(f, errors, hours)
    else:
        hours, drifts = by_command(errors, args.date.isoformat(), args.step, np.radians(args.lowest_sun))
    title = f"Drift over the day, {args.date:%B} {args.date.day}, {args.latitude:g}° north"
    figure = draw(f, errors, hours, drifts, args.window, title)
    args.out.mkdir(parents=True, exist_ok=True)
    path = args.out / "fig5.png"
    figure.savefig(path, dpi=130)
    day = f"{clock(hours[0])} to {clock(hours[-1])} solar time, every {args.step:g} min"
    print(f"sun above {args.lowest_sun:g}° from {day}; receiver {f.receiver[0]:g} × {f.receiver[1]:g} m\n")
    print("\n".join(table(f, errors, hours, drifts)))
    print(f"picture: {path}")
    return path


if __name__ == "__main__":
    main()
