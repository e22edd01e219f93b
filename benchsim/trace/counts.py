"""Counts of a picture's file, which is looked at before it is unpacked: some kilobytes may unpack to gigabytes."""

from __future__ import annotations

import io
import os
import warnings
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from benchsim.bench.errors import BenchsimError
from benchsim.bench.reading import MOST_PIXELS, RAISE, read_file

# At twice that Pillow refuses even to look.
Image.MAX_IMAGE_PIXELS = max(Image.MAX_IMAGE_PIXELS or 0, MOST_PIXELS)

_SIGNATURES = (b"\x89PNG", b"\xff\xd8\xff", b"II*\0", b"MM\0*")
_HEIF_BRANDS = (b"heic", b"heix", b"hevc", b"hevx", b"heim", b"heis", b"mif1", b"msf1", b"avif")
"""Brands of ISO/IEC 23008-12 and of AV1 pictures in the box ``ftyp`` that such a file begins with."""


def read_counts(path: Path, mode: int = cv2.IMREAD_UNCHANGED) -> tuple[NDArray, bool]:
    """Counts as they stand in the file, rows by columns (by blue, green, red), and whether it is a JPEG.

    EXIF orientation is not applied, if `mode` does not ask for it.

    Parameters
    ----------
    path : Path
    mode : int
        Of OpenCV: other channels, or turned upright.

    Raises
    ------
    BenchsimError
        If the file is no PNG, TIFF or JPEG, is damaged, or has more than `MOST_PIXELS`; of HEIC and raw pictures it
        says what to give instead.
    """
    if not os.path.exists(path):
        raise BenchsimError(f"{path.name}: not there (looked in {path.parent}); add the image or mend its name")
    data = read_file(path)
    if not data:
        raise BenchsimError(f"{path.name}: an empty file; copy the image again")
    if data[4:8] == b"ftyp" and data[8:12] in _HEIF_BRANDS:
        raise BenchsimError(
            f"{path.name}: a HEIC (or AVIF) picture, which is not read; export it as JPEG in full size, and set the "
            "phone to JPEG before the next (iPhone: Settings, Camera, Formats, Most Compatible)"
        )
    if path.suffix.lower() == ".dng":
        raise BenchsimError(
            f"{path.name}: a raw picture, which is not read; give the JPEG that the phone writes beside it, or develop "
            "it as TIFF of 16 bit without lens correction"
        )
    if not data.startswith(_SIGNATURES):
        raise BenchsimError(f"{path.name}: not an image; give a PNG, TIFF or JPEG")
    lossy = data.startswith(b"\xff\xd8\xff")
    # Decoders differ in whether a truncated file is an error or a grey remainder; the end marks tell.
    whole = _ends(data) if lossy else (b"IEND" in data[-4096:]) if data[0] == 0x89 else True
    counts = None
    if whole:
        _check_pixels(path.name, data)
        logging = cv2.utils.logging
        previous = logging.setLogLevel(logging.LOG_LEVEL_SILENT)
        try:
            counts = cv2.imdecode(np.frombuffer(data, np.uint8), mode)
        except cv2.error:
            counts = None
        finally:
            logging.setLogLevel(previous)
    if counts is None:
        raise BenchsimError(f"{path.name}: truncated or damaged; copy the image again")
    return counts, lossy


def _ends(jpeg: bytes) -> bool:
    """Whether the picture itself has its end mark: its thumbnail has one of its own, and phones append a short film.

    Marks must follow one another up to the picture: over what lies between, Pillow goes byte by byte.
    """
    at = 2
    while at + 4 <= len(jpeg) and jpeg[at] == 0xFF and jpeg[at + 1] != 0xDA:
        at += 1 if jpeg[at + 1] == 0xFF else 2 + int.from_bytes(jpeg[at + 2 : at + 4], "big")
    return jpeg[at : at + 2] == b"\xff\xda" and jpeg.find(b"\xff\xd9", at) >= 0


def _check_pixels(name: str, data: bytes) -> None:
    """Refuse a picture whose header states more pixels than are unpacked."""
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(io.BytesIO(data)) as picture:
            pixels = picture.width * picture.height
    except Image.DecompressionBombError:
        pixels = MOST_PIXELS + 1
    except Exception:  # Pillow lets through whatever its parsers stumble on.
        raise BenchsimError(f"{name}: truncated or damaged; copy the image again") from None
    if pixels > MOST_PIXELS:
        raise BenchsimError(
            f"{name}: more than {MOST_PIXELS / 1e6:.0f} million pixels, which is the most; give a smaller picture, or "
            f"raise all limits with {RAISE}"
        )
