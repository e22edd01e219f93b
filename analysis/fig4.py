"""Fig. 4 of Carretero et al. 2019: deviation curves of six heliostats on June 21 at solar hours 8, 12 and 16.

One curve per hour and cylinder: where the beam's centre meets the target plane as the mirror is misaligned in elevation
(red) or azimuth (blue). Dots stand at ±12 mrad. The paper prints its locations only in its picture; these six are a
choice of near ones (a)–(c) and far ones (d)–(f), the first that of its Fig. 7(a) at full scale. Its latitude is
not printed either: the sun of Fig. 7, azimuth 101° at elevation 50° and 260° at 48°, is that of June 21 at
40.4° ± 0.4° north (half a degree of rounding in each angle).

The curves are those of ``benchsim flux`` on the shipped plant ``six``, these heliostats: where images land for errors
IE and CA with the other sign, which turn about the axes of the two cylinders; it has no r. With ``--vector`` they are
the vector model's, of other places, suns, sources of error and r if these are given.

The table gives, at the receiver's centre, the exact conic of each curve with r neglected: kind, half-angle of the cone,
radius of curvature. No chance enters.
"""

from __future__ import annotations

import argparse
import datetime
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

import benchsim as bs
from benchsim.bench import conic
from benchsim.bench.place import ideal_normal
from benchsim.plant import days, files
from benchsim.plant.model import Plant
from benchsim.plant.moment import Moment
from benchsim.vector import (
    Cylinder,
    cone,
    deviation,
    encoder_offset,
    heliostat_tilt,
    mirror_misalignment,
    section,
    solar_vector,
    sun_angles,
    to_tower,
)

Array = NDArray[np.float64]
Curves = dict[tuple[str, int, int], tuple[Array, ...]]
"""A curve's points and its dots [m] by cylinder, heliostat and hour."""

LOCATIONS = ("150,-16,-143", "80,150,-143", "100,-100,-143", "800,-350,-143", "650,450,-143", "900,0,-143")
COLOURS = {"elevation": "#d7301f", "azimuth": "#1f78b4"}
STYLES = ("-", (0, (5, 2)), (0, (1, 1.4)))
DOT = 12e-3

SIX = files.read(Path(__file__).resolve().parents[1] / "scenes" / "plants" / "six")
NAMES = {"elevation": "IE", "azimuth": "CA"}
"""The mount's error that turns about the axis of a cylinder, the other way round."""
ERRORS = 0.6 * np.linspace(-1, 1, 81) ** 3
"""Of a curve by the command [rad]: dense where a far heliostat's window is."""


@dataclass(frozen=True)
class Field:
    """What both figures share: heliostats (n, 3) [m] in the tower's frame, r, pedestal height [m], the sun's path."""

    locations: Array
    radius: float
    pedestal: float
    source: str
    latitude: float
    day_of_year: int
    facing: float
    receiver: tuple[float, float]

    def sun(self, hours: Array) -> tuple[Array, Array]:
        """S (m, 3) in the tower's frame, and the sun's elevation (m,) [rad], at solar hours (m,)."""
        azimuth, elevation = sun_angles(self.latitude, self.day_of_year, hours)
        return to_tower(solar_vector(azimuth, elevation), self.facing), elevation

    def cylinder(self, location: Array, source: Array, stands_for: str) -> Cylinder:
        """The aimed heliostat's cylinder for the chosen source of error."""
        n = ideal_normal(location, source, self.radius)
        if self.source == "tilt":
            return heliostat_tilt(location, n, self.radius, stands_for, self.pedestal)
        make = encoder_offset if self.source == "encoder" else mirror_misalignment
        return make(location, n, self.radius, stands_for)


def location(text: str) -> tuple[float, float, float]:
    """x,y,z [m] as a triple."""
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no location; write x,y,z in metres") from None
    return x, y, z


def arguments(description: str | None) -> argparse.ArgumentParser:
    """Arguments that both figures take."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--locations", type=location, nargs="+", default=[location(t) for t in LOCATIONS], metavar="X,Y,Z",
        help="heliostats' centres of rotation from the receiver's [m]: along the target's normal, west, up",
    )  # fmt: skip
    parser.add_argument("--latitude", type=float, default=40.4, help="[deg] (default %(default)s)")
    parser.add_argument("--date", type=datetime.date.fromisoformat, default=datetime.date(2019, 6, 21))
    parser.add_argument("--facing", type=float, default=0.0, help="target's normal, from north toward east [deg]")
    parser.add_argument("--source", choices=("encoder", "misalignment", "tilt"), default="encoder")
    parser.add_argument("--radius", type=float, default=0.5, help="r, axis to mirror [m] (default %(default)s)")
    parser.add_argument("--pedestal", type=float, default=4.0, help="height of the axes, for a tilt [m]")
    parser.add_argument(
        "--receiver", type=float, nargs=2, default=(14.0, 14.0), metavar=("WIDTH", "HEIGHT"), help="[m] (default 14 14)"
    )
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the picture (default ./out)")
    return parser


def field(args: argparse.Namespace) -> Field:
    """The field that the arguments describe."""
    return Field(
        np.array(args.locations),
        args.radius,
        args.pedestal,
        args.source,
        math.radians(args.latitude),
        args.date.timetuple().tm_yday,
        math.radians(args.facing),
        (args.receiver[0], args.receiver[1]),
    )


def panels(count: int, title: str, note: str) -> tuple[Figure, list[Axes]]:
    """A figure of ``count`` square panels in rows of three, with title and a note below."""
    columns = min(3, count)
    rows = -(-count // columns)
    figure = Figure(figsize=(4.3 * columns, 4.2 * rows + 1.0), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    figure.suptitle(title, fontsize=13, x=0.01, ha="left", weight="bold")
    figure.supxlabel(note, fontsize=9, x=0.01, ha="left", color="#5f6368")
    for empty in grid.flat[count:]:
        empty.set_visible(False)
    return figure, list(grid.flat[:count])


def dress(axes: Axes, f: Field, index: int, half: float) -> None:
    """Receiver, frame, label of one panel."""
    w, h = f.receiver
    axes.add_patch(
        Rectangle((-w / 2, -h / 2), w, h, facecolor="#fdf3d0", edgecolor="#e6a100", linewidth=1.0, zorder=0.5)
    )
    axes.set(xlim=(-half, half), ylim=(-half, half), aspect="equal", xlabel="y [m]", ylabel="z [m]")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="#ececec", linewidth=0.6)
    axes.set_axisbelow(True)
    c = f.locations[index]
    label = f"({chr(97 + index)})  heliostat at ({c[0]:g}, {c[1]:g}, {c[2]:g}) m, {np.linalg.norm(c):.0f} m away"
    axes.set_title(label.replace("-", "−"), fontsize=9.5, loc="left")


def misaligned(stands_for: str, error: float) -> Plant:
    """The shipped plant, every mirror misaligned by ``error`` [rad]."""
    count = len(SIX.field)
    return replace(SIX, field=replace(SIX.field, errors={NAMES[stands_for]: np.full(count, -error)}))


def landed(moments: Sequence[Moment]) -> Array:
    """Y, Z [m] of the images, (moments, heliostats, 2); along the receiver is east, Y west."""
    return np.array([m.landing for m in moments]) / 1e3 * [-1, 1]


def solar_hours(suns: Array) -> Array:
    """Of suns (m, 3), east-north-up, at the shipped plant."""
    e, n, u = suns.T
    latitude = SIX.site.latitude
    return np.asarray(12 + np.degrees(np.arctan2(-e, u * math.cos(latitude) - n * math.sin(latitude))) / 15)


def clock_at(date: datetime.date, hour: float) -> datetime.datetime:
    """The time at the shipped plant's site of a solar hour, to a second."""
    noon = days.at(f"{date}T12:00", SIX.site)
    late = float(solar_hours(days.suns([noon], SIX.site))[0]) - 12
    return noon + datetime.timedelta(seconds=round(3600 * (hour - 12 - late)))


def by_command(date: datetime.date, hours: Sequence[float], errors: Array) -> dict[str, Array]:
    """Y, Z [m] per cylinder, (heliostats, hours, errors, 2), by ``benchsim flux``; nan where nothing arrives."""
    times = [f"{clock_at(date, hour):%Y-%m-%dT%H:%M:%S}" for hour in hours]

    def at(plant: Plant, time: str) -> Moment:
        return bs.flux(plant, at=time, cells=10, irradiance=900.0).moments[0]

    plants = {s: [misaligned(s, error) for error in errors] for s in COLOURS}
    found = {s: np.array([landed([at(p, time) for p in plants[s]]) for time in times]) for s in COLOURS}
    return {s: points.transpose(2, 0, 1, 3) for s, points in found.items()}


def window_phases(cylinder: Cylinder, source: Array, half: float) -> Array:
    """ε over which the trace crosses a window of ± half, a little further on both sides."""
    scan = np.linspace(-0.6, 0.6, 4801)
    points, real = deviation(cylinder, source, scan)
    inside = real & (np.abs(points).max(axis=-1) < 1.1 * half)
    reach = np.abs(scan[inside]).max(initial=DOT)
    return np.linspace(-reach, reach, 1201)


def by_vector(f: Field, hours: Sequence[float], half: float) -> Curves:
    """Curves and dots of the vector model, by cylinder, heliostat and hour; a sun below the horizon makes none."""
    out: Curves = {}
    for i in range(len(f.locations)):
        for k, (s, up) in enumerate(zip(*f.sun(np.asarray(hours)), strict=True)):
            for stands_for in COLOURS if up > 0 else ():
                c = f.cylinder(f.locations[i], s, stands_for)
                pairs = [deviation(c, s, x) for x in (window_phases(c, s, half), np.array([-DOT, DOT]))]
                out[stands_for, i, k] = tuple(np.where(real[:, None], p, np.nan) for p, real in pairs)
    return out


def draw(f: Field, curves: Curves, hours: Sequence[float], half: float, title: str) -> Figure:
    """The figure."""
    note = (
        f"Seen from the heliostats' side: +y, west of a tower that faces north, is to the right. "
        f"Yellow: receiver, {f.receiver[0]:g} × {f.receiver[1]:g} m. Dots: misalignment of ±12 mrad."
    )
    figure, all_axes = panels(len(f.locations), title, note)
    for i, axes in enumerate(all_axes):
        dress(axes, f, i, half)
    for (stands_for, i, k), (points, dots) in curves.items():
        colour = COLOURS[stands_for]
        all_axes[i].plot(*points.T, color=colour, linewidth=1.5, linestyle=STYLES[k % 3])
        all_axes[i].plot(*dots.T, "o", color=colour, markersize=3.4, markeredgecolor="white", markeredgewidth=0.5)
    handles = [Line2D([], [], color=v, linewidth=2, label=f"{k} misalignment") for k, v in COLOURS.items()]
    handles += [
        Line2D([], [], color="#444444", linewidth=1.5, linestyle=STYLES[k % 3], label=f"{h:g} h solar time")
        for k, h in enumerate(hours)
    ]
    figure.legend(handles=handles, loc="outside upper right", ncols=len(handles), frameon=False, fontsize=9)
    return figure


def table(f: Field, hours: Sequence[float]) -> list[str]:
    """Lines of the table of conics; a sideways lean makes none."""
    lines = ["heliostat  hour_h  cylinder   kind        half_angle_deg  curvature_radius_m"]
    for i, where in enumerate(f.locations):
        for hour, s, up in zip(hours, *f.sun(np.asarray(hours)), strict=True):
            if up <= 0:
                continue
            for stands_for in COLOURS:
                c = f.cylinder(where, s, stands_for)
                if abs(c.axis @ c.normal) > 1e-9:
                    continue
                rays = cone(c.point, c.axis, c.normal, -s)
                six = section(rays)
                # a half-angle of 90° is a plane of rays: the section is a line, which rounding calls some conic
                flat = math.pi / 2 - rays.half_angle < 1e-9
                kind = "line" if flat else str(conic.geometry(six).kind)
                bend = math.inf if flat else 1 / abs(float(conic.curvature(six, np.zeros(2))))
                lines.append(
                    f"({chr(97 + i)})        {hour:6g}  {stands_for:9s}  {kind:10s}  "
                    f"{math.degrees(rays.half_angle):14.2f}  {bend:18.0f}"
                )
    return lines


def main(argv: Sequence[str] | None = None) -> Path:
    """Draw, print the table, and return the picture's path."""
    parser = arguments(__doc__)
    parser.add_argument("--hours", type=float, nargs="+", default=[8.0, 12.0, 16.0], help="solar [h]")
    parser.add_argument(
        "--window", type=float, default=100.0, help="half-width of the panels [m] (default %(default)s)"
    )
    parser.add_argument("--vector", action="store_true", help="by the vector model, which takes all other options")
    args = parser.parse_args(argv)
    f = field(args)
    title = f"Deviation curves, {args.date:%B} {args.date.day}, {args.latitude:g}° north"
    if args.vector:
        curves = by_vector(f, args.hours, args.window)
    else:
        whole, dots = (by_command(args.date, args.hours, x) for x in (ERRORS, np.array([-DOT, DOT])))
        curves = {
            (s, i, k): (whole[s][i, k], dots[s][i, k]) for s in COLOURS for i, k in np.ndindex(whole[s].shape[:2])
        }
    figure = draw(f, curves, args.hours, args.window, title)
    args.out.mkdir(parents=True, exist_ok=True)
    path = args.out / "fig4.png"
    figure.savefig(path, dpi=130)
    print("\n".join(table(f, args.hours)))
    print(f"picture: {path}")
    return path


if __name__ == "__main__":
    main()
