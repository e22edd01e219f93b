"""Records of another time, read as of a mount that is known: of the same mount, whatever its other file says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.errors import BenchsimError
from benchsim.instruments.mount import paint, paint_heliostat, pointing, stated
from benchsim.instruments.mount.records import Function, Mount, Records, Session

ANOTHER_MM = 3500.0
"""Apart by more, two positions are of two heliostats; a wrong survey is corrected by less (`effects`)."""

SAME_MM = 0.1
"""Positions that differ by less are equal: a file has them in degrees."""

ORDER = "time.order"
"""The function of the record's number (`attachments`)."""


def read(session: Session, recordings: Path) -> tuple[Session, list[str]]:
    """The mount with other records, and what is to be said of them.

    Parameters
    ----------
    session : Session
        Of the mount; a heliostat's file and its tower are the last of its files.
    recordings : Path
        A PAINT folder, or a pointing file; its own heliostat's file, if any, is compared and not used.

    Raises
    ------
    BenchsimError
        If it is neither, cannot be read, or is of another mount.
    """
    folder = recordings.is_dir()
    read_as_such = folder or (recordings.suffix != ".toml" and pointing.recognises(recordings))
    if not stated.recognises(recordings) or not read_as_such:
        raise BenchsimError(f"{recordings}: is neither a folder of PAINT recordings nor a pointing file; name one")
    if folder != (session.mount.observes == "spot"):
        here, there = ("a telescope", "a heliostat") if folder else ("a heliostat", "a telescope")
        raise BenchsimError(
            f"{recordings}: holds records of {there}, {session.path} is of {here}; name two of one mount"
        )
    if folder:
        tower = session.files[-1]
        records, held, said = paint.records_of(recordings, tower, session.mount)
        own = paint.heliostat_of(recordings)
        remarks = [*said, *(_differing(session, own, tower) if own.exists() else ())]
        files = (*session.files[-2:], *held)
    else:
        other = pointing.read(recordings)
        records, files = other.records, (recordings,)
        remarks = list(other.remarks)
    later = replace(session, title=recordings.resolve().stem, records=records)
    if not folder and recordings.resolve() != session.files[-1].resolve():
        later, more = _after(later)
        remarks += more
    named = (session.path, *files) if session.path.is_file() else files
    return replace(later, files=tuple(dict.fromkeys(named))), remarks


def among(records: Records, others: Records) -> NDArray[np.bool_]:
    """Which records are among others, by what they read and where the light came from, whatever their names."""

    def rows(r: Records) -> list[tuple[float, ...]]:
        return [tuple(row) for row in np.column_stack([r.reading, r.source]).round(9).tolist()]

    known = set(rows(others))
    return np.array([row in known for row in rows(records)], bool)


def _after(later: Session) -> tuple[Session, list[str]]:
    """A telescope on another night: what went with time is as it ended, since its stars are counted anew."""
    effects, fields, said = dict(later.effects), dict(later.fields), []
    if "change-point" in effects:
        effects["change-point"] = {**effects["change-point"], "change": -1.0}
        said.append("The mount's change was in another night; all of these records are taken to be after it.")
    if ORDER in fields:
        last = int(np.argmax(fields[ORDER].knots[:, 0]))
        values = {k: v[[last]] for k, v in fields[ORDER].values.items()}
        fields[ORDER] = Function(fields[ORDER].knots[[last]], values)
        said.append("What went with the number of the record is taken as it was at the end of the night learnt from.")
    return replace(later, effects=effects, fields=fields), said


def _differing(session: Session, heliostat: Path, tower: Path) -> list[str]:
    """What the recordings' own heliostat file says otherwise."""
    here, there = session.mount, paint_heliostat.read(heliostat, tower)[0]
    apart = float(np.linalg.norm(here.position - there.position))
    # A heliostat may be found to stand elsewhere, and its file to say so; an amended.toml names the file as it was.
    if apart > ANOTHER_MM and session.path.suffix == ".toml":
        raise BenchsimError(
            f"{heliostat}: heliostat_position: {apart / 1e3:.3g} m from that of {session.path}: another heliostat; "
            "name recordings of the same"
        )
    other = [f"place, {apart / 1e3:.3g} m away"] if apart > SAME_MM else []
    other += [] if _kinematics_alike(here, there) else ["kinematics"]
    if not other:
        return []
    return [
        f"{heliostat} states another {' and other '.join(other)} than {session.files[-2]}, which is used: the "
        "heliostat was rebuilt or surveyed anew in between, or one of the files is amended."
    ]


def _kinematics_alike(a: Mount, b: Mount) -> bool:
    pairs = ((a.joints, b.joints), (a.tilts, b.tilts), (a.normal, b.normal))
    return a.actuators == b.actuators and all(np.allclose(x, y, atol=1e-9) for x, y in pairs)
