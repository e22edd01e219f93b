"""Where a drone's pictures were taken: by their EXIF, or by somebody's table."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from benchsim.bench.errors import BenchsimError
from benchsim.plant import tables
from benchsim.plant.model import Plant

Array = NDArray[np.float64]

GPS = 0x8825

ABROAD = 5e7
"""From the plant [mm]: no drone that looks at it is so far away."""


def gps(path: Path) -> Array | None:
    """Latitude, longitude [deg] and height [m] that EXIF states; None if it does not, or not in numbers."""
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path) as picture:
            tags = dict(picture.getexif().get_ifd(GPS))
        angles = []
        for reference, value in ((1, 2), (3, 4)):
            d, m, s = (float(x) for x in tags[value])
            sign = -1.0 if str(tags[reference]).strip("\0 ").upper() in ("S", "W") else 1.0
            angles.append(sign * (d + m / 60 + s / 3600))
        below = tags.get(5) in (1, b"\x01", b"\x03", 3)
        place = np.array([*angles, -float(tags[6]) if below else float(tags[6])])
    # Pillow lets through whatever its parsers stumble on; tags may be missing, or no numbers.
    except Exception:
        return None
    fits = np.isfinite(place).all() and abs(place[0]) <= 90 and abs(place[1]) <= 360 and abs(place[2]) < 1e4
    return place if fits else None


def places_of(paths: Sequence[Path], plant: Plant, table: Path | None) -> Array:
    """(n, 3) east, north, up [mm] of the camera in each picture."""
    if table is None:
        found = [gps(x) for x in paths]
        empty = next((x for x in paths if not x.stat().st_size), None)
        if empty is not None:
            raise BenchsimError(f"{empty.name}: is an empty file; copy it again")
        lacking = [x.name for x, place in zip(paths, found, strict=True) if place is None]
        if lacking:
            raise BenchsimError(
                f"{lacking[0]}: EXIF does not say where it was taken, as of {len(lacking)} of {len(paths)} pictures; "
                "give --positions"
            )
        places = np.array([x for x in found if x is not None])
        out = tables.geographic(places, plant.site.place)
        far = int(np.argmax(np.linalg.norm(out, axis=1)))
        if np.linalg.norm(out[far]) > ABROAD:
            fix = (
                "GPS had no fix" if not np.abs(places[far, :2]).max() > 0.1 else "a sign, or the plant's site, is wrong"
            )
            raise BenchsimError(
                f"{paths[far].name}: EXIF places it {np.linalg.norm(out[far]) / 1e6:.0f} km from the plant, at "
                f"{places[far, 0]:.4f}, {places[far, 1]:.4f}: {fix}; give --positions or mend [site]"
            )
        return out
    rows = read_positions(table, plant)
    lost = next((x.name for x in paths if x.name not in rows), None)
    if lost is not None:
        raise BenchsimError(f"{table}: name: {lost} is not in it; add where it was taken")
    return np.array([rows[x.name] for x in paths])


def read_positions(path: Path, plant: Plant) -> dict[str, Array]:
    """Places (3,) east, north, up [mm] by the pictures' names."""
    table = tables.cells(path)
    local = tables.LOCAL[0] in [c.strip() for c in table.rows[0][1]]
    names = tables.LOCAL if local else ("latitude_deg", "longitude_deg", "height_m")
    ranges = ((-1e5, 1e5),) * 3 if local else ((-90.0, 90.0), (-180.0, 360.0), (-500.0, 1e4))
    columns = tables.columns_of(table, ["name", *names], lambda n: True)
    out = {}
    for line, row in table.rows[1:]:
        values = [table.number(line, n, row[columns[n]], *r) for n, r in zip(names, ranges, strict=True)]
        if any(math.isnan(v) for v in values):
            raise table.fail(line, names[0], "is empty; write where the picture was taken")
        place = np.array(values)
        out[row[columns["name"]].strip()] = (
            1e3 * place if local else tables.geographic(place[None], plant.site.place)[0]
        )
    return out
