"""Plants to begin with: a field laid out by radial stagger."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.writing import write_csv, write_text
from benchsim.plant.files import NAME
from benchsim.plant.layout import radial_stagger
from benchsim.plant.tables import LOCAL

Array = NDArray[np.float64]

MOST = 20_000
"""Heliostats of a field that is laid out."""

TABLE = "heliostats.csv"

RADIAL = """\
# A plant: site, receivers, optics, and a field of heliostats in {table}. Change what is not as yours.
# Keys carry their unit; places are in m east, north and up of the tower's foot.
format = "benchsim-plant/1"
title = "Radial stagger"

[site]
latitude_deg = 37.09
longitude_deg = -2.36
elevation_m = 500.0
time_zone = "Europe/Madrid"
attenuation = "clear"          # of the air; "none" leaves it out

[[receiver]]                   # one such table for each
name = "receiver"
kind = "plane"                 # or "aperture" of a cavity, or "cylinder" with diameter_m
centre_m = [0.0, 0.0, {tower:g}]
width_m = {receiver:g}
height_m = {receiver:g}
azimuth_deg = 0.0              # where it looks: from north through east
elevation_deg = -20.0          # and above the horizon

[sun]
shape = "buie"                 # or "pillbox", "gaussian", "table"
csr = 0.05

[optics]
slope_mrad = 1.0               # 1 sigma of the mirror's normal in one direction
specularity_mrad = 0.3         # 1 sigma of the reflected ray in one direction
reflectance = 0.93
soiling = 0.05

[heliostats]
table = "{table}"
width_m = 4.0
height_m = 3.0
facets = [2, 2]

[errors]                       # of the mounts, of all where the table has no column of that name
IA_sigma_mrad = 0.7            # azimuth; IE elevation, CA canting, AN and AW tilt of the axis
IE_sigma_mrad = 0.7
"""


def radial(folder: Path, count: int) -> None:
    """Write a plant of heliostats in radial stagger to 60 deg on either side of north; the tower grows with it."""
    grown = math.sqrt(max(count, 25) / 100)
    tower, receiver = round(40 * grown, 1), round(2 * grown, 1)
    places = radial_stagger(count, 4e3, 3e3, 30e3 * grown, 1e3 * (tower - 2.5), math.radians(60)) / 1e3
    _write(folder, places, 2.5, RADIAL.format(table=TABLE, tower=tower, receiver=receiver))


def _write(folder: Path, places: Array, up: float, text: str) -> None:
    """The table of places (n, 2) and their height [m], and the plant's file."""
    digits = len(str(len(places)))
    rows = [[f"H{k:0{digits}d}", round(float(e), 3), round(float(n), 3), up] for k, (e, n) in enumerate(places, 1)]
    write_csv(folder / TABLE, ["id", *LOCAL], rows)
    write_text(folder / NAME, text)
