"""A mount with what was found in it, as ``predict`` and ``export`` take it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from benchsim.bench.errors import BenchsimError
from benchsim.instruments.mount import paint, stated
from benchsim.instruments.mount import problem as mount_problem
from benchsim.instruments.mount.records import Mount, Session


def read(path: Path, tower: Path | None = None) -> Session:
    """Read a mount and the records that it was learnt from; a heliostat's bare properties have none.

    Parameters
    ----------
    path : Path
        An ``amended.toml``, a pointing file, a PAINT folder, or the file of a heliostat's properties.
    tower : Path, optional
        Tower file; default that which the file names, or the one beside or above it.

    Returns
    -------
    Session
        A heliostat's file and its tower are the last of its files.

    Raises
    ------
    BenchsimError
        If it is nothing of the kind, or cannot be used.
    """
    if path.suffix == ".json" and path.is_file() and not any(path.match(c) for c in paint.CALIBRATION):
        return paint.bare(path, tower)
    if not stated.recognises(path) or path.suffix == ".json":
        raise BenchsimError(
            f"{path}: is neither an amended.toml of a mount nor a heliostat's properties in the PAINT format; name "
            "what benchsim diagnose wrote"
        )
    if path.is_dir() and not paint.holds_recordings(path):
        return paint.bare(path, tower)
    session = stated.read(path, tower)
    return session if session.learnt is not None else replace(session, mount=as_stated(session))


def as_stated(session: Session) -> Mount:
    """The mount without what was found; a telescope's with the encoder zeros that its records show, which nobody
    states."""
    if session.mount.observes != "sky":
        return session.mount
    bare = replace(session.mount, zero=np.zeros(2))
    return replace(bare, zero=mount_problem.zeros(bare, session.records))
