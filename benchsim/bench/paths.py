"""Paths that stand in a file: whoever sent the file must not choose which of the reader's own files are shown."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from benchsim.bench.errors import BenchsimError
from benchsim.bench.reading import file_hash, load_json

FILE = "recording.toml"
"""Of a recording, in its folder."""

STAMP = "benchsim.json"
"""In every folder that benchsim wrote: the command, hashes of its inputs, versions, options and defaults."""


def inside(folder: Path, name: Any, key: str, *, allow_outside: bool = False) -> Path:
    """Path of what a file names, which has to lie in the file's folder, links resolved.

    Every path that comes from a file is made here. ``recordings`` and ``tower`` in the ``amended.toml`` of a mount lead
    out by their nature, and are read as ``allow_outside``: what is not a record in their format is refused. The
    pictures in the ``amended.toml`` of a bench lie in its recording: they may if the folder's `STAMP` holds their hash,
    since whoever wrote that had them. Whether anything is there is left to the reader.

    Parameters
    ----------
    folder : Path
        Of the file.
    name : str
        As it stands in the file, relative to the folder.
    key : str
        File and key, for the complaint.
    allow_outside : bool
        Whether it may lie elsewhere.

    Raises
    ------
    BenchsimError
        If it is no path, or leads out of the folder.
    """
    try:
        path: Path = folder / name
        real = Path(os.path.realpath(path))
        real.exists()
    except (OSError, TypeError, ValueError):
        raise BenchsimError(f"{key}: {str(name)[:60]!r} cannot be followed; name a file in {folder}") from None
    if not allow_outside and not real.is_relative_to(os.path.realpath(folder)) and not _was_read(real, folder):
        raise BenchsimError(
            f"{key}: '{name}' leads out of {folder}; put it there, or say --allow-outside if you trust who wrote this"
        )
    return path


def _was_read(path: Path, folder: Path) -> bool:
    """Whether a file is one that the folder's writer had."""
    try:
        read = load_json(folder / STAMP)["inputs"].values()
        return path.is_file() and file_hash(path) in read
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return False
