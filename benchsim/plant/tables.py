"""Heliostats from tables: benchsim's own, SolarPILOT's, SolTrace's, ``benchsim field``'s, and folders of PAINT.

All tables are CSV in metres and degrees; columns of benchsim's own are found by their names:

- ``id``, and ``east_m``, ``north_m``, ``up_m`` of the mirror's centre, or ``latitude_deg``, ``longitude_deg``,
  ``elevation_m``;
- if they differ from ``[heliostats]``: ``width_m``, ``height_m``, ``facets_across``, ``facets_up``, ``focal_m``,
  ``canting_m``, ``receiver``, ``aim_east_m``, ``aim_north_m``, ``aim_up_m``, and errors as in ``[errors]``.

SolarPILOT's layout (its own example ``deploy/api/test_field.csv``) has no header: number of the template, x east,
y north, z up; further columns are not read. With a header, columns are ``x``, ``y``, ``z`` or ``x_location`` and so on.
SolTrace's elements: whether it is used (0, 1), x, y, z, the aim's x, y, z, rotation about z, and, if it is there, the
aperture's letter with its size (``r``, width, height); x east, y north, z up, as SolarPILOT writes them. What SolTrace
calls the aim only says how an element stands at one moment and is not read. Commas, semicolons or tabulators.
"""

from __future__ import annotations

import csv
import difflib
import io
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.errors import BenchsimError
from benchsim.bench.names import printable
from benchsim.bench.reading import TABLE_BYTES, read_file
from benchsim.instruments.mount import paint
from benchsim.instruments.mount.geodesy import enu
from benchsim.plant.model import ERRORS
from benchsim.plant.schema import MOST_HELIOSTATS

Array = NDArray[np.float64]

NUMBER = re.compile(r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d{1,3})?", re.ASCII)

LOCAL, GEOGRAPHIC = ("east_m", "north_m", "up_m"), ("latitude_deg", "longitude_deg", "elevation_m")
AIM = ("aim_east_m", "aim_north_m", "aim_up_m")
RANGES = {
    **dict.fromkeys((*LOCAL, *AIM), (-1e5, 1e5)),
    "latitude_deg": (-90.0, 90.0),
    "longitude_deg": (-180.0, 360.0),
    "elevation_m": (-500.0, 1e4),
    "width_m": (0.1, 50.0),
    "height_m": (0.1, 50.0),
    "facets_across": (1.0, 1000.0),
    "facets_up": (1.0, 1000.0),
    "focal_m": (1.0, 1e5),
    "canting_m": (1.0, 1e5),
    **{
        f"{e}{s}_mrad": (-100.0 if not s else 0.0, 100.0)
        for names in ERRORS.values()
        for e in names
        for s in ("", "_sigma")
    },
}
"""Columns of numbers and what is plausible in them."""

FAR_MM = 1e8
"""From the plant's origin: a heliostat further away stands at another plant."""


@dataclass(frozen=True)
class Rows:
    """Heliostats of a table.

    Attributes
    ----------
    ids : tuple of str
    columns : mapping of str to (n,)
        By the names of benchsim's own table, in its units; nan where a cell is empty.
    receiver : tuple of str
        Empty where the table does not say it.
    files : tuple of Path
    kinematics : str
    remarks : tuple of str
    """

    ids: tuple[str, ...]
    columns: Mapping[str, Array]
    receiver: tuple[str, ...] = ()
    files: tuple[Path, ...] = ()
    kinematics: str = "az-el"
    remarks: tuple[str, ...] = field(default=())


@dataclass(frozen=True)
class Cells:
    """A CSV file: its rows with their lines' numbers."""

    path: Path
    rows: tuple[tuple[int, list[str]], ...]

    def fail(self, line: int, column: str | int, says: str) -> BenchsimError:
        """A complaint about a cell."""
        where = f"column {column}" if isinstance(column, int) else column
        return BenchsimError(f"{self.path}, line {line}: {where[:60]}: {says}")

    def number(self, line: int, column: str | int, text: str, low: float, high: float) -> float:
        """A number in its range; nan of an empty cell."""
        text = text.strip()
        if not text:
            return math.nan
        if not NUMBER.fullmatch(text):
            raise self.fail(line, column, f"{text[:40]!r} is no number; write one, with a point")
        value = float(text)
        if not low <= value <= high:
            raise self.fail(line, column, f"{value:g} is out of range; it must be {low:g} to {high:g} (check the unit)")
        return value


def cells(path: Path) -> Cells:
    """Rows of a CSV file that are not empty.

    Raises
    ------
    BenchsimError
        If it cannot be read, is no CSV, or has more rows than a plant may have heliostats.
    """
    try:
        text = read_file(path, TABLE_BYTES).decode("utf-8-sig")
        first = text.partition("\n")[0]
        separator = max(",;\t", key=first.count)
        reader = csv.reader(io.StringIO(text), delimiter=separator, strict=True)
        rows = []
        for row in reader:
            if any(c.strip() for c in row):
                rows.append((reader.line_num, row))
            if len(rows) > MOST_HELIOSTATS + 1:
                raise BenchsimError(f"{path}: has more than {MOST_HELIOSTATS} lines; divide the field")
    except UnicodeDecodeError:
        raise BenchsimError(f"{path}: is not in UTF-8; save it so") from None
    except csv.Error as error:
        raise BenchsimError(f"{path}: is no CSV ({error}); mend it") from None
    if not rows:
        raise BenchsimError(f"{path}: is empty; write a line for each heliostat")
    return Cells(path, tuple(rows))


def columns_of(table: Cells, wanted: Sequence[str], known: Callable[[str], bool]) -> dict[str, int]:
    """Places of the columns that a header names, each of which has to be known and those wanted there."""
    line, header = table.rows[0]
    places: dict[str, int] = {}
    if all(NUMBER.fullmatch(c.strip()) for c in header if c.strip()):
        raise table.fail(
            line, 1, 'numbers stand where the columns are named; write a header, or say whose table it is: '
            'heliostats.format = "solarpilot" or "soltrace"',
        )  # fmt: skip
    for k, name in enumerate(c.strip() for c in header):
        if name in places:
            raise table.fail(line, printable(name), "is there twice; remove one")
        if not known(name):
            near = difflib.get_close_matches(name, [*RANGES, "id", "receiver"], n=1)
            mend = f"did you mean {near[0]}? if not, remove it" if near else "rename it, or remove it"
            raise table.fail(line, printable(name), f"is no column known here; {mend}")
        places[name] = k
    missing = next((w for w in wanted if w not in places), None)
    if missing:
        raise table.fail(line, missing, "this column is missing; add it")
    for number, row in table.rows[1:]:
        if len(row) != len(header):
            raise table.fail(number, len(row), f"the line has {len(row)} cells, the header {len(header)}; mend it")
    return places


def own(path: Path) -> Rows:
    """benchsim's own table."""
    table = cells(path)
    places = columns_of(table, ["id"], lambda n: n in RANGES or n in ("id", "receiver"))
    local = LOCAL[0] in places
    for name in LOCAL if local else GEOGRAPHIC:
        if name not in places:
            raise table.fail(
                table.rows[0][0], name, f"this column is missing; give {', '.join(LOCAL)} or {', '.join(GEOGRAPHIC)}"
            )
    body = table.rows[1:]
    columns = {
        name: np.array([table.number(line, name, row[k], *RANGES[name]) for line, row in body])
        for name, k in places.items()
        if name in RANGES
    }
    _filled(table, {n: columns[n] for n in (LOCAL if local else GEOGRAPHIC)}, "write where the mirror's centre is")
    receiver = tuple(row[places["receiver"]].strip() for _, row in body) if "receiver" in places else ()
    return Rows(_ids(table, [(line, row[places["id"]]) for line, row in body]), columns, receiver, (path,))


def _filled(table: Cells, columns: Mapping[str, Array], mend: str) -> None:
    """Refuse an empty cell of these columns, which begin below the header."""
    for name, values in columns.items():
        empty = np.flatnonzero(np.isnan(values))
        if len(empty):
            raise table.fail(table.rows[1 + empty[0]][0], name, f"is empty; {mend}")


def _ids(table: Cells, found: Sequence[tuple[int, str]]) -> tuple[str, ...]:
    seen: set[str] = set()
    for line, text in found:
        name = text.strip()
        if not name or name in seen or printable(name) != name or len(name) > 60:
            raise table.fail(
                line, "id", f"{printable(name)[:60]!r} is there twice, or no name of 1 to 60 characters; mend it"
            )
        seen.add(name)
    if not found:
        raise BenchsimError(f"{table.path}: lists no heliostat; write a line for each")
    return tuple(text.strip() for _, text in found)


def solarpilot(path: Path) -> Rows:
    """SolarPILOT's layout."""
    return _xyz(path, 1)


def soltrace(path: Path) -> Rows:
    """SolTrace's elements; those that are not used are left out."""
    return _xyz(path, 1, elements=True)


def _xyz(path: Path, start: int, elements: bool = False) -> Rows:
    table = cells(path)
    header = [c.strip().lower() for c in table.rows[0][1]]
    at = list(range(start, start + 3))
    body = table.rows
    if not NUMBER.fullmatch(header[-1] if len(header) < 4 else header[1]):
        body = body[1:]
        for names in (("x", "y", "z"), ("x_location", "y_location", "z_location"), ("pos-x", "pos-y", "pos-z")):
            if set(names) <= set(header):
                at = [header.index(n) for n in names]
    columns: dict[str, list[float]] = {n: [] for n in LOCAL}
    sizes: dict[str, list[float]] = {"width_m": [], "height_m": []}
    lines = []
    for line, row in body:
        if len(row) <= max(at):
            raise table.fail(line, len(row) + 1, "is missing; a line needs a number, x, y and z")
        if elements and row[0].strip() in ("0", "false", "False"):
            continue
        for name, k in zip(LOCAL, at, strict=True):
            value = table.number(line, k + 1, row[k], -1e5, 1e5)
            if math.isnan(value):
                raise table.fail(line, k + 1, "is empty; write x, y and z in m")
            columns[name].append(value)
        if elements and len(row) > 10 and row[8].strip() == "r":
            for (name, into), k in zip(sizes.items(), (9, 10), strict=True):
                into.append(table.number(line, k + 1, row[k], *RANGES[name]))
        else:
            for into in sizes.values():
                into.append(math.nan)
        lines.append(line)
    if not lines:
        raise BenchsimError(f"{path}: lists no heliostat; write a line for each")
    found = {**columns, **(sizes if elements else {})}
    return Rows(
        tuple(str(k + 1) for k in range(len(lines))),
        {k: np.array(v) for k, v in found.items()},
        files=(path,),
        remarks=(f"{path.name} names no heliostat: they are called by their order, 1 to {len(lines)}.",),
    )


def diagnosed_table(path: Path) -> tuple[Rows, dict[str, str]]:
    """What ``benchsim field`` wrote: heliostats with their places, and by id the sizes of what was found."""
    table = cells(path)
    places = columns_of(table, ["id", *LOCAL, "sizes"], lambda n: True)
    body = table.rows[1:]
    ids = _ids(table, [(line, row[places["id"]]) for line, row in body])
    columns = {n: np.array([table.number(line, n, row[places[n]], *RANGES[n]) for line, row in body]) for n in LOCAL}
    _filled(table, columns, "make the table again with 'benchsim field'")
    sizes = {i: row[places["sizes"]] for i, (_, row) in zip(ids, body, strict=True)}
    return Rows(ids, columns, files=(path,), kinematics="east-west"), sizes


SIZE = re.compile(rf"(\w+) = ({NUMBER.pattern}) ± ({NUMBER.pattern}) mrad", re.ASCII)


def diagnosed_errors(
    path: Path, ids: Sequence[str], kinematics: str
) -> tuple[dict[str, Array], dict[str, Array], tuple[str, ...]]:
    """Errors and their sigmas of a diagnosis, attached to heliostats by id.

    Parameters
    ----------
    path : Path
        ``field.csv``.
    ids : sequence of str
        The plant's heliostats.
    kinematics : str
        Whose errors are looked for.

    Returns
    -------
    errors, sigmas : mapping of str to (n,)
        [rad]; 0 of heliostats that were not diagnosed.
    remarks : tuple of str
        Who is missing, and what was found that is no error of such a mount.
    """
    _, sizes = diagnosed_table(path)
    errors = {n: np.zeros(len(ids)) for n in ERRORS[kinematics]}
    sigmas = {n: np.zeros(len(ids)) for n in ERRORS[kinematics]}
    unused: dict[str, int] = {}
    for k, name in enumerate(ids):
        for part in filter(None, (p.strip().lstrip("'") for p in sizes.get(name, "").split(";"))):
            match = SIZE.fullmatch(part)
            if match and match[1] in errors:
                value, sigma = float(match[2]), float(match[3])
                if not (abs(value) <= 100 and 0 <= sigma <= 100):
                    raise BenchsimError(
                        f"{path}: sizes: {part[:60]!r} of {name} is no error of a mount; make it again with "
                        "'benchsim field'"
                    )
                errors[match[1]][k], sigmas[match[1]][k] = 1e-3 * value, 1e-3 * sigma
            else:
                what = part.partition(" =")[0][:30]
                unused[what] = unused.get(what, 0) + 1
    missing = sum(i not in sizes for i in ids)
    if missing == len(ids):
        theirs = next(iter(sizes), "none")
        raise BenchsimError(
            f"{path}: holds no heliostat of the plant: {theirs[:30]!r} is one of its ids, {ids[0]!r} one of the "
            "plant's; mend the ids or heliostats.diagnosed"
        )
    remarks = []
    if missing:
        remarks.append(
            f"{missing} of {len(ids)} heliostats are not in {path.name}: as diagnosed they are without errors."
        )
    if unused:
        said = ", ".join(f"{k} ({n})" for k, n in sorted(unused.items(), key=lambda x: -x[1])[:6])
        remarks.append(f"{path.name}: found, but no angle of an {kinematics} mount, and left out, of how many: {said}.")
    return errors, sigmas, tuple(remarks)


def paint_tree(folder: Path, tower: Path | None) -> Rows:
    """A folder of heliostats' PAINT folders."""
    if not folder.is_dir():
        raise BenchsimError(f"{folder}: no such folder; name the folder that holds the heliostats' folders")
    inner = sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith(".") and paint.recognises(p))
    if not inner:
        raise BenchsimError(f"{folder}: holds no folder of a heliostat's PAINT files; name the folder above them")
    if len(inner) > MOST_HELIOSTATS:
        raise BenchsimError(f"{folder}: holds more than {MOST_HELIOSTATS} heliostats; divide the field")
    sessions = [paint.bare(p, tower) for p in inner]
    position = np.array([s.mount.position for s in sessions]) / 1e3
    files = tuple(f for s in sessions for f in s.files)
    return Rows(
        tuple(printable(p.name) for p in inner),
        dict(zip(LOCAL, position.T, strict=True)),
        files=tuple(dict.fromkeys(files)),
        kinematics="east-west",
        remarks=("Places are those of the axes in the PAINT files, about the plant's reference in the tower file.",),
    )


def geographic(places: Array, origin: Array) -> Array:
    """East, north, up (n, 3) [mm] of latitude, longitude [deg], height [m] about an origin of that form."""
    return np.array([enu(p, origin) for p in places])


def placed(rows: Rows, origin: Array) -> Array:
    """Positions (n, 3) in mm, of local or geographic columns; ``origin``: latitude, longitude [deg], height [m]."""
    if LOCAL[0] in rows.columns:
        return 1e3 * np.stack([rows.columns[n] for n in LOCAL], axis=1)
    out = geographic(np.stack([rows.columns[n] for n in GEOGRAPHIC], axis=1), origin)
    far = np.linalg.norm(out, axis=1)
    if far.max() > FAR_MM:
        k = int(far.argmax())
        raise BenchsimError(
            f"{rows.files[0]}: latitude_deg, longitude_deg: {rows.ids[k]} stands {far[k] / 1e6:.3g} km from the site; "
            "mend it or the [site]"
        )
    return out
