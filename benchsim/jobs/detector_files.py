"""Files of a record of detectors, as somebody wrote them: samples as CSV, WAV or HDF5, labels as CSV."""

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
from benchsim.jobs import detector_hdf5
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
    try:
        if detector_hdf5.is_hdf5(body):
            return _columns(*detector_hdf5.columns(body, RECORD_BYTES // 8, count), count)
        return _columns(_csv(body), None, count)
    except ValueError as error:
        raise BenchsimError(f"{path}: {error}") from None


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


def _csv(body: bytes) -> dict[str, Array]:
    try:
        head, _, rest = body.decode("utf-8-sig").partition("\n")
    except UnicodeDecodeError:
        raise ValueError("is neither WAV nor HDF5 nor CSV in UTF-8; save it so") from None
    separator = max(",;\t", key=head.count)
    names = [c.strip() for c in head.strip().split(separator)]
    if names[0] != "time_s" or len(names) < 2:
        raise ValueError("the first line names no columns time_s, detector_1 and so on; add it")
    twice = next((n for n in names if names.count(n) > 1), None)
    if twice is not None:
        raise ValueError(f"{printable(twice)[:40]!r} is there twice; mend it")
    try:
        table = np.loadtxt(io.StringIO(rest), delimiter=separator, ndmin=2, comments=None)
    except (ValueError, OverflowError) as error:
        raise ValueError(f"a line is not of numbers ({printable(str(error))[:120]}); mend it") from None
    if table.shape[1] != len(names):
        raise ValueError(f"has lines of {table.shape[1]} numbers under {len(names)} names; mend it")
    return dict(zip(names, table.T, strict=True))


def _columns(columns: dict[str, Array], rate: float | None, count: int) -> tuple[float, Array, NDArray[np.int_]]:
    columns = dict(columns)
    times = columns.pop("time_s", None)
    known = {f"detector_{k + 1}": k for k in range(count)}
    odd = next((n for n in columns if n not in known), None)
    if odd is not None:
        raise ValueError(f"{printable(odd)[:40]!r} is none of detector_1 to detector_{count}; mend it")
    length = len(next(iter(columns.values()), ()))
    if length < FEWEST:
        raise ValueError(f"has {length} samples of {len(columns)} detectors; give {FEWEST} or more")
    if times is not None:
        with np.errstate(all="ignore"):
            step = float(np.mean(np.diff(times)))
            even = np.isfinite(step) and step > 1e-6 and np.abs(np.diff(times) - step).max() < 0.05 * step
        if not even:
            raise ValueError("time_s: does not grow by equal steps; resample the record")
        rate = 1 / step
    if rate is None or not 0 < rate < detector_hdf5.FASTEST:
        raise ValueError("states no sampling rate; add time_s, or an attribute rate_hz in Hz")
    # Crossings are found along the arrays, whatever the order of the columns.
    order = sorted(columns, key=known.__getitem__)
    return rate, np.array([columns[n] for n in order]), np.array([known[n] for n in order])
