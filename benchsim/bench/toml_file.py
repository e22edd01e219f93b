"""TOML files as they come: read, and no name in them that a terminal would obey."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchsim.bench.errors import BenchsimError
from benchsim.bench.names import printable


def load_toml(file: Path) -> dict[str, Any]:
    """What a TOML file holds.

    Raises
    ------
    BenchsimError
        If it cannot be read, is no TOML, or a key or text of it has characters that steer a terminal, or line breaks.
    """
    try:
        data = tomllib.loads(file.read_bytes().decode("utf-8-sig"))
    except OSError as error:
        raise BenchsimError(f"{file}: cannot be read ({error.strerror}); check the path and its permissions") from None
    except UnicodeDecodeError:
        raise BenchsimError(f"{file}: not a text file in UTF-8; give a TOML file") from None
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise BenchsimError(f"{file.name}: not valid TOML: {error}; mend that line") from None
    for key, text in _texts(data, ""):
        if printable(text) != text:
            raise BenchsimError(f"{file.name}: {key}: {text[:60]!r} has a line break or a control character; remove it")
    return data


def _texts(value: Any, key: str) -> Iterator[tuple[str, str]]:
    """Every key and every text, with where it stands."""
    if isinstance(value, str):
        yield key, value
    elif isinstance(value, dict):
        for name, inner in value.items():
            where = f"{key}.{name}".lstrip(".")
            yield where, name
            yield from _texts(inner, where)
    elif isinstance(value, list):
        for number, inner in enumerate(value, 1):
            yield from _texts(inner, f"{key}[{number}]")
