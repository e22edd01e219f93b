"""Which effects and free fields `renderer` draws, gathered from the modules that draw them.

A module that draws effects says so in two constants: ``EFFECTS``, name → parameters, in the names and units of the
recording's ``[effects]``; and ``FIELDS``, names of free fields. A parameter that ends in ``*`` stands for a row of
them, one per facet. Nothing else needs to be told of a new effect.
"""

from __future__ import annotations

import importlib
import math
import pkgutil
import re
from collections.abc import Mapping
from functools import lru_cache

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Recording

Effects = Mapping[str, Mapping[str, float]]

MRAD, PER_M = 1e-3, 1e-3
"""Units of the file in rad and in 1/mm."""


@lru_cache(maxsize=1)
def gather() -> tuple[dict[str, tuple[str, ...]], frozenset[str]]:
    """Effects with their parameters, and free fields, of all modules of `renderer`."""
    effects: dict[str, tuple[str, ...]] = {}
    fields: set[str] = set()
    # By its name, for the room itself may be under way of being imported.
    room = importlib.import_module("benchsim.renderer")
    for found in pkgutil.iter_modules(room.__path__):
        module = importlib.import_module(f"benchsim.renderer.{found.name}")
        effects |= getattr(module, "EFFECTS", {})
        fields |= set(getattr(module, "FIELDS", ()))
    return effects, frozenset(fields)


def value(effects: Effects, name: str, parameter: str, unit: float = 1.0) -> float:
    """A parameter of an effect times ``unit``; 0 if the recording has it not."""
    return unit * float(effects.get(name, {}).get(parameter, 0.0))


def check(recording: Recording) -> None:
    """Raise BenchsimError if an effect, a parameter or a field is not drawn here, or a number is not finite."""
    effects, fields = gather()
    for name, own in recording.effects.items():
        where = f"{recording.path}: [effects.{name}]"
        if name not in effects:
            raise BenchsimError(
                f"{where} is not an effect that render draws; choose one of {', '.join(sorted(effects))}"
            )
        for key, number in own.items():
            row = next((p[:-1] for p in effects[name] if p.endswith("*") and re.fullmatch(rf"{p[:-1]}\d+", key)), None)
            if key not in effects[name] and row is None:
                known = ", ".join(p.replace("*", "0 …") for p in effects[name])
                raise BenchsimError(f"{where} has no parameter {key}; it takes {known}")
            if row is not None and int(key[len(row) :]) >= recording.mirror.facets:
                raise BenchsimError(f"{where} {key}: the mirror has the facets 0 … {recording.mirror.facets - 1} only")
            if not math.isfinite(number):
                raise BenchsimError(f"{where} {key} = {number}: give a finite number")
    for name in recording.fields:
        if name not in fields:
            raise BenchsimError(
                f"{recording.path}: [fields.{name}] is not a field that render draws; choose one of "
                f"{', '.join(sorted(fields))}"
            )
