"""Which heliostats a field has: a folder of their folders, or a list of them."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path

from benchsim.bench.errors import BenchsimError
from benchsim.bench.names import file_name
from benchsim.bench.paths import inside
from benchsim.bench.reading import TABLE_BYTES, read_file
from benchsim.instruments.mount import paint

INDEX = ("id", "path")
"""Columns that a list of heliostats has to have; ``tower`` may be a third."""


@dataclass(frozen=True)
class Heliostat:
    """One heliostat of a field: its name, folder, and tower file where that was named."""

    name: str
    folder: Path
    tower: Path | None


def heliostats(source: Path, tower: Path | None, allow_outside: bool = False) -> list[Heliostat]:
    """The heliostats of a folder or of a list."""
    if source.is_file():
        return _listed(source, tower, allow_outside)
    if not source.is_dir():
        raise BenchsimError(f"{source}: no such folder; name the folder that holds the heliostats' folders, or a list")
    inner = sorted(p for p in source.iterdir() if p.is_dir() and not p.name.startswith(".") and paint.recognises(p))
    if not inner:
        raise BenchsimError(
            f"{source}: holds no folder of a heliostat's PAINT files; name the folder above them, or a CSV file with "
            "the columns id and path"
        )
    unfit = next((p for p in inner if file_name(p.name) != p.name), None)
    if unfit is not None:
        raise BenchsimError(f"{unfit}: is no name for a heliostat; rename the folder")
    return [Heliostat(p.name, p, tower) for p in inner]


def _listed(source: Path, tower: Path | None, allow_outside: bool) -> list[Heliostat]:
    try:
        rows = list(csv.DictReader(io.StringIO(read_file(source, TABLE_BYTES).decode("utf-8-sig"))))
    except (UnicodeDecodeError, csv.Error) as error:
        raise BenchsimError(f"{source}: is no list of heliostats ({error}); write a CSV with id and path") from None
    out: dict[str, Heliostat] = {}
    for number, row in enumerate(rows, 2):
        missing = next((key for key in INDEX if not (row.get(key) or "").strip()), None)
        if missing:
            raise BenchsimError(f"{source}, line {number}: {missing}: is missing; the columns are id, path and tower")
        name, own = row["id"].strip(), (row.get("tower") or "").strip()
        if name in out or file_name(name) != name:
            raise BenchsimError(f"{source}, line {number}: id: {name!r} is there twice or no name; mend it")
        places = {
            key: inside(source.parent, row[key].strip(), f"{source}, line {number}: {key}", allow_outside=allow_outside)
            for key in ("path", *(("tower",) if own else ()))
        }
        out[name] = Heliostat(name, places["path"], places.get("tower", tower))
    if not out:
        raise BenchsimError(f"{source}: lists no heliostat; write a line for each, with id and path")
    return list(out.values())
