"""What was found put into a simulation: a small TOML file that names its recordings and states effects.

::

    format = "benchsim-mount/1"
    recordings = "../AA39"              # PAINT folder or pointing file, relative to this file
    tower = "../tower-measurements.json"   # optional

    [effects.axis-tilt]
    tilt_n = -18.2                      # unit of the catalogue

A change of the mount is stated between two records, ``change = 2041.5``: by their numbers where their names are
numbers, so that it holds of any records of that mount, else by their place in the file.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import ParseError

from benchsim.bench.errors import BenchsimError
from benchsim.bench.writing import write_text
from benchsim.instruments.mount import effects, paint, pointing
from benchsim.instruments.mount.records import Session

FORMAT = "benchsim-mount/1"
_KEYS = {"format", "recordings", "tower", "effects"}


def recognises(path: Path) -> bool:
    """Whether a path is recordings of a mount: a PAINT folder, a pointing file, or such a TOML file."""
    if path.is_dir() or (path.is_file() and paint.recognises(path)):
        return paint.recognises(path)
    if not path.is_file():
        return False
    if path.suffix == ".toml":
        return FORMAT in path.read_text(encoding="utf-8", errors="replace")[:2000]
    return path.suffix not in (".json",) and pointing.recognises(path)


def read(path: Path, tower: Path | None = None) -> Session:
    """Read recordings of a mount, the reader chosen by content.

    Parameters
    ----------
    path : Path
    tower : Path, optional
        Tower file of PAINT recordings.

    Raises
    ------
    BenchsimError
        As the readers; or if the TOML file has an unknown key, effect or parameter.
    """
    if path.is_dir() or paint.recognises(path):
        return paint.read(path, tower)
    if path.suffix != ".toml":
        return pointing.read(path)
    data = _toml(path)
    unknown = sorted(set(data) - _KEYS)
    if unknown:
        raise BenchsimError(f"{path}: {unknown[0]}: is no key; the keys are {', '.join(sorted(_KEYS))}")
    named = data.get("recordings")
    if not isinstance(named, str):
        raise BenchsimError(f"{path}: recordings: {named!r} is no path; name a PAINT folder or a pointing file")
    where = path.parent / named
    if not where.exists() or (where.is_file() and where.suffix == ".toml"):
        raise BenchsimError(f"{path}: recordings: {where} does not exist or is no recording; correct the path")
    stated, found = data.get("tower"), data.get("effects", {})
    if stated is not None and not isinstance(stated, str):
        raise BenchsimError(f"{path}: tower: {stated!r} is no path; name the file of the tower")
    if not isinstance(found, dict) or not all(isinstance(v, dict) for v in found.values()):
        raise BenchsimError(f"{path}: effects: is no table of effects; write [effects.NAME] with a line per parameter")
    session = read(where, tower or (path.parent / stated if stated is not None else None))
    _check(path, session, found)
    return replace(session, title=path.stem, path=path, files=(path, *session.files), effects=found)


def write(session: Session, found: Mapping[str, Mapping[str, float]], path: Path, target: Path) -> None:
    """Write a session with stated effects so that it stands in the folder ``target``."""
    source, tower = session.path, None
    if session.path.suffix == ".toml":
        data = _toml(session.path)
        source = session.path.parent / str(data["recordings"])
    if source.is_dir():
        tower = session.files[-1]
    document = tomlkit.document()
    document["format"] = FORMAT
    document["recordings"] = os.path.relpath(source.resolve(), target.resolve())
    if tower is not None:
        document["tower"] = os.path.relpath(tower.resolve(), target.resolve())
    if found:
        document["effects"] = {n: {k: float(f"{v:.12g}") for k, v in terms.items()} for n, terms in found.items()}
    write_text(path, tomlkit.dumps(document))


def _toml(path: Path) -> dict[str, Any]:
    try:
        return tomlkit.parse(path.read_text(encoding="utf-8-sig")).unwrap()
    except OSError as error:
        raise BenchsimError(f"{path}: cannot be read ({error.strerror}); name a file") from None
    except (ParseError, UnicodeDecodeError) as error:
        raise BenchsimError(f"{path}: is no TOML ({error}); mend the file") from None


def _check(path: Path, session: Session, found: Mapping[str, Mapping[str, Any]]) -> None:
    everything = effects.candidates(session.mount, session.records, every=True)
    known = {e.name: [p.name for p in e.parameters] for e in everything}
    for name, terms in found.items():
        if name not in known:
            raise BenchsimError(f"{path}: effects.{name}: is no effect of this mount; there are {', '.join(known)}")
        for term, value in terms.items():
            if term not in known[name]:
                raise BenchsimError(
                    f"{path}: effects.{name}.{term}: is no parameter; there are {', '.join(known[name])}"
                )
            if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
                raise BenchsimError(f"{path}: effects.{name}.{term}: {value!r} is no finite number; mend it")
