"""Files of a record of detectors, as somebody wrote them: samples as CSV or WAV, labels as CSV."""

from __future__ import annotations

import io
import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.io import wavfile

from benchsim.bench.errors import BenchsimError
from benchsim.bench.names import printable
from benchsim.bench.reading import RECORD_BYTES, read_file
from benchsim.jobs.detector_station import watch
from benchsim.plant import tables
from benchsim.plant.model import Plant

Array = NDArray[np.float64]

FEWEST = 200
"""Samples of a detector: fewer say nothing of the noise between labels."""


def read_labels(path: Path, plant: Plant) -> dict[str, Array]:
    """Labels by id [Hz], of every heliostat of a plant that has any."""
    table = tables.cells(path)
    wanted = ["id", "rate_elevation_hz", "rate_azimuth_hz"]
    places = tables.columns_of(table, wanted, lambda n: True)
    p = plant.prisms
    out = {name: np.array([p.low, p.high]) for name in plant.field.ids}
    told = set()
    for line, row in table.rows[1:]:
        name = row[places["id"]].strip()
        if name not in out:
            raise table.fail(line, "id", f"{printable(name)[:60]!r} is no heliostat of the plant; mend it")
        f = np.array([table.number(line, k, row[places[k]], p.low, p.high) for k in wanted[1:]])
        if np.isfinite(f).all():
            out[name] = f
            told.add(name)
    w = watch(plant)
    lacking = [plant.field.ids[k] for k in w.who if plant.field.ids[k] not in told]
    if lacking:
        raise BenchsimError(f"{path}: rate_elevation_hz, rate_azimuth_hz: {lacking[0]} has none; add its labels")
    return out


def read_record(path: Path, count: int) -> tuple[float, Array, NDArray[np.int_]]:
    """Sampling rate [Hz], samples (m, samples), and which of ``count`` detectors they are, (m,) from 0.

    Raises
    ------
    BenchsimError
        If the file is no such record.
    """
    body = read_file(path, RECORD_BYTES)
    if body[:4] in (b"RIFF", b"RIFX", b"RF64"):
        return _wav(path, body, count)
    return _csv(path, body, count)


def _wav(path: Path, body: bytes, count: int) -> tuple[float, Array, NDArray[np.int_]]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            rate, data = wavfile.read(io.BytesIO(body))
        values = np.asarray(data)
        whole = values.ndim == 2 and values.dtype.kind in "iuf" and rate > 0
    # What stands in a damaged file decides which error it is.
    except Exception:
        raise BenchsimError(f"{path}: is no WAV that can be read; write PCM or floats, all channels in one") from None
    if not whole or values.shape[1] != count:
        n = values.shape[1] if values.ndim == 2 else 1
        raise BenchsimError(
            f"{path}: has {n} channels, the plan {count} detectors; write one for each, in the order of detectors.csv"
        )
    return float(rate), np.asarray(values.T, float), np.arange(count)


def _csv(path: Path, body: bytes, count: int) -> tuple[float, Array, NDArray[np.int_]]:
    def fail(says: str) -> BenchsimError:
        return BenchsimError(f"{path}: {says}")

    try:
        head, _, rest = body.decode("utf-8-sig").partition("\n")
    except UnicodeDecodeError:
        raise fail("is neither WAV nor CSV in UTF-8; save it so") from None
    separator = max(",;\t", key=head.count)
    names = [c.strip() for c in head.strip().split(separator)]
    known = {f"detector_{k + 1}": k for k in range(count)}
    if names[0] != "time_s" or len(names) < 2:
        raise fail("the first line names no columns time_s, detector_1 and so on; add it")
    odd = next((n for n in names[1:] if n not in known or names.count(n) > 1), None)
    if odd is not None:
        raise fail(f"{printable(odd)[:40]!r} is none of detector_1 to detector_{count}, or is there twice; mend it")
    try:
        table = np.loadtxt(io.StringIO(rest), delimiter=separator, ndmin=2, comments=None)
    except (ValueError, OverflowError) as error:
        raise fail(f"a line is not of numbers ({printable(str(error))[:120]}); mend it") from None
    if table.shape[1] != len(names) or len(table) < FEWEST:
        raise fail(f"has {len(table)} lines of {table.shape[1]} numbers; give {FEWEST} or more of {len(names)}")
    steps = np.diff(table[:, 0])
    with np.errstate(all="ignore"):
        mean = float(np.mean(steps))
        even = np.isfinite(mean) and mean > 1e-6 and np.abs(steps - mean).max() < 0.05 * mean
    if not even:
        raise fail("time_s: does not grow by equal steps; resample the record")
    return 1 / mean, table[:, 1:].T, np.array([known[n] for n in names[1:]])
