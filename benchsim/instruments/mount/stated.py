"""What was found put into a simulation: a small TOML file that names its recordings and states effects.

::

    format = "benchsim-mount/1"
    recordings = "../AA39"              # PAINT folder or pointing file, relative to this file
    tower = "../tower-measurements.json"   # optional

    [effects.axis-tilt]
    tilt_n = -18.2                      # unit of the catalogue

    [fields."mount.elevation"]          # laws without a name: `functions`
    knots = [[0.3], [0.9], [1.2]]
    IA_mrad = [0.1, 0.4, -0.2]
    IE_mrad = [0.0, 1.1, 1.9]

    [prediction]                        # how sure it is, which only predictions need; optional
    sigma_mrad = [0.2, 0.4]             # errors of a record on another day, across and up, mrad of the normal
    change_mrad = 0.6                   # by which the mount changes until then, in each; 0 if left out
    parameters = ["survey_e", "tilt_n"] # what was fitted, and its covariance in the units of the catalogue
    covariance = [[310.0, -1.2], [-1.2, 0.5]]
    zeros_arcsec = [1205.2, 2.9]        # telescopes: of the encoders, IA and IE, true less read

A change of the mount is stated between two records, ``change = 2041.5``: by their own numbers, which are the first in
their names, so that it holds of any records of that mount; where names have none, by their place in the file.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from benchsim.bench.errors import BenchsimError
from benchsim.bench.names import printable
from benchsim.bench.paths import inside
from benchsim.bench.toml_file import load_toml
from benchsim.bench.writing import write_text
from benchsim.instruments.mount import effects, functions, paint, pointing
from benchsim.instruments.mount import problem as mount_problem
from benchsim.instruments.mount.records import UNITS, Array, Function, Learnt, Session

FORMAT = "benchsim-mount/1"
_KEYS = {"format", "recordings", "tower", "effects", "fields", "prediction"}

ROUNDED = 1e-6
"""Part of a correlation by which a covariance may differ from its transpose: digits that a file leaves out."""


def recognises(path: Path) -> bool:
    """Whether a path is recordings of a mount: a PAINT folder, a pointing file, or such a TOML file."""
    if path.is_dir() or (path.is_file() and paint.recognises(path)):
        return paint.recognises(path)
    if not path.is_file():
        return False
    if path.suffix == ".toml":
        with path.open(encoding="utf-8", errors="replace") as file:
            return FORMAT in file.read(2000)
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
    data = load_toml(path)
    unknown = sorted(set(data) - _KEYS)
    if unknown:
        raise BenchsimError(f"{path}: {unknown[0]}: is no key; the keys are {', '.join(sorted(_KEYS))}")
    named = data.get("recordings")
    if not isinstance(named, str):
        raise BenchsimError(f"{path}: recordings: {named!r} is no path; name a PAINT folder or a pointing file")
    where = inside(path.parent, named, f"{path}: recordings", allow_outside=True)
    if not where.exists() or (where.is_file() and where.suffix == ".toml"):
        raise BenchsimError(f"{path}: recordings: {where} does not exist or is no recording; correct the path")
    stated, found = data.get("tower"), data.get("effects", {})
    if stated is not None and not isinstance(stated, str):
        raise BenchsimError(f"{path}: tower: {stated!r} is no path; name the file of the tower")
    if not isinstance(found, dict) or not all(isinstance(v, dict) for v in found.values()):
        raise BenchsimError(f"{path}: effects: is no table of effects; write [effects.NAME] with a line per parameter")
    if stated is not None and tower is None:
        tower = inside(path.parent, stated, f"{path}: tower", allow_outside=True)
    session = read(where, tower)
    _check(path, session, found)
    session = replace(session, title=printable(path.stem), path=path, files=(path, *session.files), effects=found)
    session = replace(session, fields=_functions(path, session, data.get("fields", {})))
    if "prediction" not in data:
        return session
    learnt = _learnt(path, session, data["prediction"])
    mount = session.mount if learnt.zeros is None else replace(session.mount, zero=learnt.zeros)
    return replace(session, mount=mount, learnt=learnt)


def write(
    session: Session,
    found: Mapping[str, Mapping[str, float]],
    fields: Mapping[str, Function],
    path: Path,
    target: Path,
    learnt: Learnt | None = None,
) -> None:
    """Write a session with stated effects and functions so that it stands in the folder ``target``."""
    source, tower = session.path, None
    if session.path.suffix == ".toml":
        data = load_toml(session.path)
        source = inside(session.path.parent, data["recordings"], f"{session.path}: recordings", allow_outside=True)
    if source.is_dir():
        tower = session.files[-1]
    document = tomlkit.document()
    document["format"] = FORMAT
    document["recordings"] = os.path.relpath(source.resolve(), target.resolve())
    if tower is not None:
        document["tower"] = os.path.relpath(tower.resolve(), target.resolve())
    if found:
        document["effects"] = {n: {k: float(f"{v:.12g}") for k, v in terms.items()} for n, terms in found.items()}
    if fields:
        document["fields"] = {
            name: {"knots": _plain(f.knots), **{k: _plain(v) for k, v in f.values.items()}}
            for name, f in fields.items()
        }
    if learnt is not None:
        zeros = {} if learnt.zeros is None else {"zeros_arcsec": _plain(learnt.zeros / UNITS["arcsec"])}
        document["prediction"] = {
            "sigma_mrad": _plain(learnt.sigma),
            **({"change_mrad": learnt.change} if learnt.change else {}),
            "parameters": list(learnt.parameters),
            "covariance": _plain(learnt.covariance),
            **zeros,
        }
    write_text(path, tomlkit.dumps(document))


def _plain(values: Array) -> list[Any]:
    """Nested lists of numbers as a file has them."""
    return [_plain(v) if np.ndim(v) else float(f"{v:.9g}") for v in values]


def _functions(path: Path, session: Session, tables: Any) -> dict[str, Function]:
    """The functions of a file, checked."""
    if not isinstance(tables, dict):
        raise BenchsimError(f"{path}: fields: is no table of functions; write [fields.NAME] with knots and values")
    known = {f.name: f for f in mount_problem.functions_of(session)} if tables else {}
    out = {}
    for name, table in tables.items():
        if name not in known or not isinstance(table, dict):
            raise BenchsimError(f"{path}: fields.{name}: is no function of this mount; there are {', '.join(known)}")
        form = known[name]
        wide = form.where.shape[1]
        wanted = {"knots": 2, **{functions.key(i, form): 1 for i in form.inputs}}
        if set(table) != set(wanted):
            raise BenchsimError(f"{path}: fields.{name}: has {', '.join(table)}; it has to have {', '.join(wanted)}")
        arrays = {}
        for key, dimensions in wanted.items():
            try:
                arrays[key] = np.array(table[key], float)
            except (TypeError, ValueError):
                arrays[key] = np.zeros(0)
            fits = arrays[key].ndim == dimensions and len(arrays[key]) == len(table["knots"]) > 0
            fits = fits and (dimensions == 1 or arrays[key].shape[1] == wide) and bool(np.isfinite(arrays[key]).all())
            if not fits:
                shape = f"a list of {wide} numbers" if dimensions == 2 else "a number"
                raise BenchsimError(f"{path}: fields.{name}.{key}: write {shape} for each of the knots, at least one")
        out[name] = Function(arrays.pop("knots"), arrays)
    return out


def _learnt(path: Path, session: Session, table: Any) -> Learnt:
    """The table of what predictions rest on, checked."""
    if not isinstance(table, dict):
        raise BenchsimError(f"{path}: prediction: is no table; write [prediction] as benchsim diagnose does, or none")
    sky = session.mount.observes == "sky"
    wanted = {"sigma_mrad", "parameters", "covariance", *(("zeros_arcsec",) if sky else ())}
    if set(table) - {"change_mrad"} != wanted:
        listed = ", ".join(sorted(wanted))
        raise BenchsimError(f"{path}: prediction: has {', '.join(table) or 'nothing'}; it has to have {listed}")
    names, known = table["parameters"], {p.name for p in mount_problem.fitted(session)}
    if not isinstance(names, list) or not set(map(str, names)) <= known or len(set(map(str, names))) < len(names):
        raise BenchsimError(
            f"{path}: prediction.parameters: {names!r}: there are {', '.join(sorted(known))}, each once"
        )

    def numbers(key: str, shape: tuple[int, ...]) -> Array:
        try:
            found = np.array(table[key], float).reshape(shape)
        except (TypeError, ValueError):
            found = np.full(shape, np.nan)
        if not np.isfinite(found).all():
            many = f"{' times '.join(map(str, shape))} finite numbers" if shape else "a finite number"
            raise BenchsimError(f"{path}: prediction.{key}: write {many}")
        return found

    sigma, covariance = numbers("sigma_mrad", (2,)), numbers("covariance", (len(names),) * 2)
    change = float(numbers("change_mrad", ())) if "change_mrad" in table else 0.0
    scale = np.sqrt(np.abs(np.diag(covariance)))
    unit = covariance / np.maximum(np.outer(scale, scale), 1e-300)
    if (
        change < 0
        or (sigma < 0).any()
        or (np.diag(covariance) < 0).any()
        or np.abs(unit - unit.T).max(initial=0.0) > ROUNDED
    ):
        raise BenchsimError(
            f"{path}: prediction: sigma_mrad, change_mrad or covariance is none of errors; mend it, or remove the table"
        )
    zeros = numbers("zeros_arcsec", (2,)) * UNITS["arcsec"] if sky else None
    return Learnt(sigma, tuple(names), covariance, zeros, change)


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
