"""Values of JSON files under dotted keys, or one sentence that names file and key."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchsim.bench.errors import BenchsimError
from benchsim.bench.reading import load_json
from benchsim.instruments.mount.records import Array


def load(path: Path) -> Mapping[str, Any]:
    """A JSON object."""
    value = load_json(path)
    if not isinstance(value, dict):
        raise BenchsimError(f"{path}: is no JSON object; mend the file")
    return value


def value(path: Path, data: Mapping[str, Any], key: str) -> Any:
    """What stands under a dotted key."""
    at: Any = data
    for part in key.split("."):
        if not isinstance(at, Mapping) or part not in at:
            raise BenchsimError(f"{path}: {key}: is missing; add it")
        at = at[part]
    return at


def number(path: Path, data: Mapping[str, Any], key: str) -> float:
    """A finite number under a dotted key."""
    return number_in(path, key, value(path, data, key))


def number_in(path: Path, key: str, found: Any) -> float:
    """A finite number that stands under a key."""
    if not finite(found):
        raise BenchsimError(f"{path}: {key}: {short(found)} is no finite number; mend it")
    return float(found)


def finite(found: Any) -> bool:
    """Whether a value is a finite number."""
    # An integer may be too large to be a float.
    return not isinstance(found, bool) and isinstance(found, int | float) and -1e300 < found < 1e300


def short(found: Any) -> str:
    """A value as it is quoted in a sentence."""
    return repr(found) if len(repr(found)) < 80 else f"{repr(found)[:60]}…"


def triple(path: Path, data: Mapping[str, Any], key: str) -> Array:
    """Latitude and longitude [deg] and height [m] under a dotted key."""
    found = value(path, data, key)
    good = isinstance(found, list) and len(found) == 3 and all(finite(v) for v in found)
    if not good or abs(found[0]) > 90 or abs(found[1]) > 360 or not -500 < found[2] < 9000:
        raise BenchsimError(f"{path}: {key}: {short(found)} is not [latitude deg, longitude deg, height m]; mend it")
    return np.array(found, float)
