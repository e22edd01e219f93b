"""TOML files as they come: read, and no name in them that a terminal would obey."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchsim.bench.errors import BenchsimError
from benchsim.bench.names import printable
from benchsim.bench.reading import TOML_BYTES, read_file

DEEPEST = 16
"""Tables and lists within one another; a recording's own are four."""


def load_toml(file: Path) -> dict[str, Any]:
    """What a TOML file holds.

    Raises
    ------
    BenchsimError
        If it cannot be read, is no TOML, or too deep, or a key or text of it has characters that steer a terminal, or
        line breaks.
    """
    body = read_file(file, TOML_BYTES)
    try:
        data = tomllib.loads(body.decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise BenchsimError(f"{file}: not a text file in UTF-8; give a TOML file") from None
    except RecursionError:
        raise BenchsimError(f"{file.name}: not valid TOML: its brackets nest too deeply; mend the file") from None
    except ValueError as error:
        raise BenchsimError(f"{file.name}: not valid TOML: {error}; mend that line") from None
    for key, found in _leaves(data, "", 0):
        if isinstance(found, int) and not -(2**63) <= found < 2**63:
            raise BenchsimError(f"{file.name}: {key}: is larger than integers of TOML (64 bits); mend it")
        if isinstance(found, str) and printable(found) != found:
            raise BenchsimError(
                f"{file.name}: {key}: {found[:60]!r} has a line break or a control character; remove it"
            )
        if isinstance(found, list | dict):
            raise BenchsimError(f"{file.name}: {key[:60]}: nests deeper than {DEEPEST} tables; mend it")
    return data


def _leaves(value: Any, key: str, depth: int) -> Iterator[tuple[str, Any]]:
    """Every key, text and number, with where it stands; and what lies too deep."""
    if depth > DEEPEST or not isinstance(value, list | dict):
        yield key, value
    elif isinstance(value, dict):
        for name, inner in value.items():
            where = f"{key}.{name}".lstrip(".")
            yield where, name
            yield from _leaves(inner, where, depth + 1)
    else:
        for number, inner in enumerate(value, 1):
            yield from _leaves(inner, f"{key}[{number}]", depth + 1)
