"""When recordings of heliostats were taken: the stamps in UTC that lie beside them.

A recording's time is looked for in its STAC item ``NUMBER-calibration-item-stac.json`` (``properties.datetime``, as
PAINT publishes it), under ``datetime`` or ``timestamp`` in the recording itself, and in the nearest
``timestamps.json`` beside or above it, ``{"HELIOSTAT_NUMBER": "2022-06-12T13:20:13Z"}``. A stamp without a zone is UTC.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from benchsim.bench.errors import BenchsimError
from benchsim.instruments.mount.json_values import load, short
from benchsim.instruments.mount.records import Array

TABLE = "timestamps.json"
ITEM = "{}-calibration-item-stac.json"
KEYS = ("datetime", "timestamp")


def read(recordings: Sequence[tuple[Path, Mapping[str, Any]]], heliostat: str) -> tuple[Array, tuple[Path, ...]]:
    """Times of recordings and the files that they were read of.

    Parameters
    ----------
    recordings : sequence of (Path, mapping)
        Files and what they hold, all of one folder.
    heliostat : str
        Its name, as it stands in the table's keys.

    Returns
    -------
    times : (n,) array
        Seconds since 1970-01-01 UTC; nan where there is no stamp.
    files : tuple of Path
        Beside the recordings themselves.

    Raises
    ------
    BenchsimError
        If a stamp is no time; the message names file and key.
    """
    folder = recordings[0][0].parent.resolve()
    table = next((p / TABLE for p in (folder, *folder.parents[:4]) if (p / TABLE).is_file()), None)
    stamps = load(table) if table else {}
    # Numbers are unique in a plant: they find a recording whose folder has another name.
    by_number = {key.rsplit("_", 1)[-1]: key for key in stamps}
    times, files = [], [] if table is None else [table]
    for path, data in recordings:
        number = path.name.replace("_", "-").split("-", 1)[0]
        held: list[tuple[Path, str, Any]] = []
        item = path.parent / ITEM.format(number)
        if item.is_file():
            files.append(item)
            properties = load(item).get("properties")
            held.append(
                (item, "properties.datetime", properties.get("datetime") if isinstance(properties, dict) else None)
            )
        held += [(path, key, data.get(key)) for key in KEYS]
        key = f"{heliostat}_{number}"
        key = key if key in stamps else by_number.get(number, key)
        held.append((table or folder, key, stamps.get(key)))
        times.append(next((_seconds(*found) for found in held if found[2] is not None), float("nan")))
    return np.array(times), tuple(files)


def parsed(stamp: Any) -> datetime | None:
    """A time of ISO 8601, of a year that the sun's place is known in; None if it is none."""
    try:
        time = datetime.fromisoformat(stamp)
    except (TypeError, ValueError):
        return None
    return time if 1950 <= time.year <= 2100 else None


def _seconds(path: Path, key: str, stamp: Any) -> float:
    time = parsed(stamp)
    if time is None:
        raise BenchsimError(f"{path}: {key}: {short(stamp)} is no time; write UTC as 2022-06-12T13:20:13Z")
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()
