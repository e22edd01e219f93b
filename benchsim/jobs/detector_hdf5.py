"""A record of detectors in HDF5: columns as a CSV has them, as datasets at the top of the file.

A file from a stranger must not reach others: what lies in another file, or has to be unpacked by a plug-in, is refused.
"""

from __future__ import annotations

import io
import math
import re

import h5py
import numpy as np
from numpy.typing import NDArray

from benchsim.reports.quantities import counted

Array = NDArray[np.float64]

SIGNATURE = b"\x89HDF\r\n\x1a\n"
USER_BLOCKS = (0, *(512 << k for k in range(12)))
"""Before it a writer's own block may stand, of MATLAB's 512 bytes (HDF5 File Format Specification, II.A)."""

PLAIN_FILTERS = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32, h5py.h5z.FILTER_LZF}
"""Compressions that h5py itself unpacks; others are libraries looked up by name."""

FASTEST = 1e6
"""Below which a sampling rate is [Hz]."""

ALL_AT_ONCE = "samples"
"""A dataset of samples by detectors, in the order of ``detectors.csv``."""

ONE = re.compile(r"detector_\d+")
"""A dataset of one detector's samples."""


def is_hdf5(body: bytes) -> bool:
    """Whether a file begins as HDF5 does."""
    return any(body.startswith(SIGNATURE, start) for start in USER_BLOCKS)


def columns(body: bytes, most: int, count: int) -> tuple[dict[str, Array], float | None]:
    """Columns by name, of equal length, and the sampling rate [Hz] if the file states ``rate_hz``.

    Parameters
    ----------
    body : bytes
    most : int
        Of numbers that may be unpacked.
    count : int
        Of the plan's detectors.

    Raises
    ------
    ValueError
        With a sentence, if the file is not such a record.
    """
    try:
        with h5py.File(io.BytesIO(body), "r") as file:
            found = _columns(file, most, count)
            rate = file.attrs.get("rate_hz", file[ALL_AT_ONCE].attrs.get("rate_hz") if ALL_AT_ONCE in file else None)
    except (OSError, RuntimeError, KeyError, TypeError, MemoryError, UnicodeError, SystemError) as error:
        raise ValueError("is no HDF5 that can be read; save it anew, without links or plug-ins") from error
    if rate is None:
        return found, None
    rate = np.asarray(rate)
    if rate.size != 1 or rate.dtype.kind not in "iuf":
        raise ValueError("attribute rate_hz: is not one number; mend it")
    value = float(rate.ravel()[0])
    if not 0 < value < FASTEST:
        raise ValueError(f"attribute rate_hz: is {value:g}; give samples a second, above 0 and below {FASTEST:g}")
    return found, value


def _columns(file: h5py.File, most: int, count: int) -> dict[str, Array]:
    out: dict[str, Array] = {}
    left = most
    for name in file:
        if not isinstance(file.get(name, getlink=True), h5py.HardLink):
            raise ValueError(f"{name!r:.60} lies elsewhere; put the numbers themselves into the file")
        data = file[name]
        if not isinstance(data, h5py.Dataset) or data.dtype.kind not in "iuf" or data.ndim != 1 + (name == ALL_AT_ONCE):
            # What a writer puts beside the samples, of whatever kind, is not read.
            if name in (ALL_AT_ONCE, "time_s") or ONE.fullmatch(name):
                raise ValueError(f"{name!r:.60} {_is_not(data)}")
            continue
        plist = data.id.get_create_plist()
        filters = {plist.get_filter(k)[0] for k in range(plist.get_nfilters())}
        if data.external or data.is_virtual or not filters <= PLAIN_FILTERS:
            raise ValueError(f"dataset {name!r:.60} lies elsewhere or is packed by a plug-in; save it plain or by gzip")
        # A chunk is unpacked whole, however little of it is used.
        left -= max(data.size or 0, math.prod(data.chunks or ()))
        if left < 0:
            raise ValueError(f"holds more than {most:,} numbers, or chunks as large; cut the record")
        if name != ALL_AT_ONCE:
            out[name] = np.asarray(data[()], float)
            continue
        if data.shape[1] > count:
            mend = "transpose it, a row for each time" if data.shape[0] <= count else "leave the other columns out"
            rows, wide = data.shape
            raise ValueError(f"'{ALL_AT_ONCE}' has {rows} rows and {wide} columns, the plan {count} detectors; {mend}")
        if any(map(ONE.fullmatch, file)):
            raise ValueError(f"holds '{ALL_AT_ONCE}' and datasets detector_…; leave one of both out")
        out |= {f"detector_{k + 1}": np.asarray(c, float) for k, c in enumerate(data[()].T)}
    if len({len(c) for c in out.values()}) > 1:
        raise ValueError("its datasets are of different lengths; give one sample of each detector at each time")
    return out


def _is_not(data: h5py.Dataset | h5py.Group) -> str:
    """What is wrong with what stands where samples should, and what mends it."""
    if not isinstance(data, h5py.Dataset):
        return "is a group; put a dataset of the samples at the top of the file"
    if data.dtype.kind not in "iuf":
        return "holds no numbers; save it as integers or floats"
    return f"has {counted(data.ndim, 'dimension')}; give samples by detectors, or of one detector a value for each time"
