"""Daily drift curves of heliostats: how each error of the mount moves the spot through a day, and four mixed sets.

    python analysis/drift.py [-o out/drift] [--set CA=3,IA=-2 --at -34,60]

The plant of Lara-Cerecedo et al. 2016 (https://doi.org/10.1155/2016/3158091, Fig. 7): latitude 29 deg, receiver 32 m up
on the north face of the tower, summer solstice. The heliostat is driven as if it had no errors; what is drawn is where
the ray from its centre meets the receiver's plane, in solar hours. Errors in mrad, TPOINT's codes: zenith angle β of
the paper is −IE, its γ IA, its ξ CA; its tilt ε toward κ is AN = ε cos κ, AW = ε sin κ.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchsim.instruments.mount import axes
from benchsim.instruments.mount.next_recordings import OBLIQUITY, sun_at
from benchsim.instruments.mount.records import Mount, angles

Array = NDArray[np.float64]

LATITUDE = np.radians(29.0)
RECEIVER = np.array([0.0, 0.0, 32.0])
HOURS = np.arange(-5.0, 5.01, 0.25)
"""From noon: 7:00 to 17:00."""

TERMS = {
    "IA": "azimuth offset",
    "IE": "elevation offset",
    "CA": "canting",
    "AN": "pedestal leaning south",
    "AW": "pedestal leaning west",
    "NPAE": "axes not perpendicular",
    "TF": "sag",
}

PLACES = ((0.0, 34.1), (-67.5, 167.0), (14.2, 66.7), (60.0, 90.0))
"""East and north of the tower [m]: near, far, and to either side."""

SETS = (
    {"IA": 2.0, "IE": -1.5, "CA": 1.0, "AN": 0.5, "AW": -2.0},
    {"IA": -1.0, "IE": 1.0, "CA": -2.5, "AN": 2.0, "AW": 1.0},
    {"IA": 3.0, "IE": 0.5, "CA": -3.0, "AN": -1.0, "AW": 0.5},
    {"IA": -2.0, "IE": -2.0, "CA": 2.0, "AN": 1.0, "AW": 3.0},
)
"""Error sets between −3 and 3 mrad, as the paper draws its own (it does not print them)."""


def curve(place: tuple[float, float], errors: dict[str, float], declination: float = OBLIQUITY) -> tuple[Array, Array]:
    """Where the spot is through a day.

    Parameters
    ----------
    place : (float, float)
        Heliostat east and north of the tower [m].
    errors : mapping of str to float
        [mrad]
    declination : float
        Of the sun [rad].

    Returns
    -------
    spot : (n, 2) array
        East and up from the receiver's centre [m].
    hours : (n,) array
        From noon; hours at which the sun is up and in front of the mirror.
    """
    position = np.array([*place, 0.0])
    toward_receiver = (RECEIVER - position) / np.linalg.norm(RECEIVER - position)
    sun = np.stack([sun_at(LATITUDE, declination, h) for h in HOURS])
    keep = (sun[:, 2] > np.sin(np.radians(5))) & (sun @ toward_receiver > -0.9)
    sun = sun[keep]
    reading = np.column_stack(angles(sun + toward_receiver))
    x = {k: np.full(len(sun), 1e-3 * v) for k, v in errors.items()}
    normal, _ = axes.pointing(Mount("az-el", "spot"), reading, x)
    beam = axes.reflected(normal, sun)
    reach = (RECEIVER[1] - position[1]) / beam[:, 1]
    spot = position + reach[:, None] * beam - RECEIVER
    return spot[:, [0, 2]], HOURS[keep]


def drawn(ax: Axes, spot: Array, hours: Array, colour: str, label: str | None = None) -> None:
    """A curve with a dot every two hours and the morning marked."""
    ax.plot(*spot.T, color=colour, linewidth=1.1, label=label)
    even = np.isclose(hours % 2, 0)
    ax.plot(*spot[even].T, "o", color=colour, markersize=3)
    ax.plot(*spot[:1].T, "s", color=colour, markersize=4.5)


def framed(ax: Axes, title: str) -> None:
    """Equal scales about the receiver's centre."""
    ax.axhline(0, color="#bbbbbb", linewidth=0.6)
    ax.axvline(0, color="#bbbbbb", linewidth=0.6)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_title(title, fontsize=9)
    ax.tick_params(labelsize=7)
    ax.spines[["top", "right"]].set_visible(False)


COLOURS = ("#5e3c99", "#e66101", "#1f78b4", "#35978f")


def main() -> None:
    """Draw both pictures and print how far each curve wanders."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("out/drift"))
    parser.add_argument("--set", help="errors of one more curve [mrad]: CA=3,IA=-2")
    parser.add_argument("--at", default="0,34.1", help="its heliostat, east and north [m]")
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(13.5, 7.0), layout="constrained")
    for k, (term, words) in enumerate(TERMS.items()):
        ax = figure.add_subplot(2, 4, k + 1)
        for place, colour in zip(PLACES, COLOURS, strict=True):
            spot, hours = curve(place, {term: 3.0})
            drawn(ax, spot, hours, colour, f"({place[0]:g}, {place[1]:g}) m" if k == 0 else None)
            wander = np.ptp(spot, axis=0)
            print(
                f"{term:<5}3 mrad at ({place[0]:6.1f}, {place[1]:6.1f}) m: wanders {wander[0]:.3f} x {wander[1]:.3f} m"
            )
        framed(ax, f"{term} = 3 mrad: {words}")
        if k == 0:
            ax.legend(fontsize=7)
    figure.supxlabel("east of the receiver's centre (m)", fontsize=9)
    figure.supylabel("up (m)", fontsize=9)
    figure.suptitle("What each error does to the spot, summer solstice, 7:00 (square) to 17:00 solar time", fontsize=10)
    figure.savefig(args.output / "terms.png", dpi=120)
    mixed = list(zip(PLACES, SETS, strict=True))
    if args.set:
        east, north = (float(v) for v in args.at.split(","))
        mixed.append(((east, north), {k: float(v) for k, v in (p.split("=") for p in args.set.split(","))}))
    figure = Figure(figsize=(3.6 * len(mixed), 3.9), layout="constrained")
    for k, (place, errors) in enumerate(mixed):
        ax = figure.add_subplot(1, len(mixed), k + 1)
        for declination, colour, word in (
            (OBLIQUITY, "#b2182b", "June"),
            (0.0, "#7f6000", "March"),
            (-OBLIQUITY, "#2166ac", "December"),
        ):
            drawn(ax, *curve(place, errors, declination), colour, word)
        said = ", ".join(f"{n} {v:g}" for n, v in errors.items())
        framed(ax, f"({place[0]:g}, {place[1]:g}) m\n{said} mrad")
        if k == 0:
            ax.legend(fontsize=7)
    figure.supxlabel("east of the receiver's centre (m)", fontsize=9)
    figure.suptitle("Daily drift of four heliostats, each with its own errors", fontsize=10)
    figure.savefig(args.output / "sets.png", dpi=120)


if __name__ == "__main__":
    main()
