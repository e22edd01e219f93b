"""Bodies of files that somebody sent: ordinary files alone, and none larger than what is read there can be."""

from __future__ import annotations

import hashlib
import json
import os
import stat
from pathlib import Path
from typing import Any

from benchsim.bench.errors import BenchsimError

RAISE = "BENCHSIM_LIMITS"
"""Variable of the environment by which all limits are multiplied, 1 to 9999: processes that are started have it too."""

_said = os.environ.get(RAISE, "1")
RAISED = int(_said) if _said in map(str, range(1, 10_000)) else 1

MIB = 2**20
TOML_BYTES, TABLE_BYTES, JSON_BYTES, RECORD_BYTES, PICTURE_BYTES = (RAISED * n * MIB for n in (1, 16, 64, 256, 512))
"""Largest files that are read; the page of the format lists them."""

_KIND = {
    TOML_BYTES: "a TOML file",
    TABLE_BYTES: "a table",
    JSON_BYTES: "a JSON file",
    RECORD_BYTES: "a record",
    PICTURE_BYTES: "a picture",
}

MOST_PIXELS = RAISED * 50_000_000
"""Of a picture: the largest sensors of phones, as they are read out in full; 16 bits in colour are 300 MB."""


def read_file(path: Path, most: int = PICTURE_BYTES) -> bytes:
    """Body of an ordinary file, whose size is looked at first.

    Parameters
    ----------
    path : Path
    most : int
        Bytes that it may have.

    Raises
    ------
    BenchsimError
        If it cannot be read, is larger, or is no ordinary file: pipes wait for ever and devices never end.
    """
    try:
        # Else opening a pipe waits for its writer.
        with open(os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)), "rb") as file:
            found = os.fstat(file.fileno())
            if not stat.S_ISREG(found.st_mode):
                raise BenchsimError(f"{path}: is no ordinary file; give a file that is stored on the disk")
            if found.st_size > most:
                raise BenchsimError(
                    f"{path}: has {found.st_size} bytes, {_KIND[most]} may have {most // MIB} MiB; check its name, or "
                    f"raise all limits with {RAISE}"
                )
            return file.read(most)
    except OSError as error:
        raise BenchsimError(f"{path}: cannot be read ({error.strerror}); check the path and its permissions") from None
    except ValueError as error:
        if isinstance(error, BenchsimError):
            raise
        raise BenchsimError(f"{path}: cannot be the name of a file; mend it") from None


def load_json(path: Path) -> Any:
    """What a JSON file holds.

    Raises
    ------
    BenchsimError
        If it cannot be read or is no JSON.
    """
    data = read_file(path, JSON_BYTES)
    try:
        return json.loads(data.decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise BenchsimError(f"{path}: is not in UTF-8; save it so") from None
    except RecursionError:
        raise BenchsimError(f"{path}: is no JSON that can be read: it nests too deeply; mend the file") from None
    except ValueError as error:
        raise BenchsimError(f"{path}: is no JSON ({error}); mend the file") from None


def file_hash(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    return hashlib.sha256(read_file(path)).hexdigest()
