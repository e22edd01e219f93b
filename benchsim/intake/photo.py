"""What a photograph's file says of itself: size, bit depth, and, from EXIF, orientation, time, exposure and lens."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.names import printable
from benchsim.calibration.exif import directories
from benchsim.trace.counts import read_counts

SUFFIXES = {".png", ".tif", ".tiff", ".jpg", ".jpeg", ".heic", ".heif", ".avif"}
"""Of what is taken for a photograph in a folder. HEIC is among them so that it is refused by name, not passed over."""

DIAGONAL_35MM = 43.27
"""Of a frame of 24 mm × 36 mm [mm]: what EXIF's focal length "in 35 mm film" refers to."""

UPRIGHT = {1: "as the sensor has it", 3: "turned by 180°", 6: "phone upright", 8: "phone upright, head down"}
"""EXIF's orientations that are turns; the others are mirrored."""


MERGED = (2, 3, 6, 7, 8)
"""Values of EXIF's CustomRendered that say so: HDR, panorama, portrait. Apple's own; 4 is the single exposure that it
keeps beside a merged one (ExifTool's table of tag 0xA401)."""


@dataclass(frozen=True)
class Photo:
    """What one file says; None where it says nothing.

    Attributes
    ----------
    path : Path
    resolution : (width, height) px
        Of the sensor: EXIF orientation is not applied.
    bit_depth : int
    lossy : bool
        JPEG.
    orientation : int
        EXIF 0x0112; 1 is as the sensor has it.
    time : datetime or None
        Of the exposure, in the camera's own clock.
    exposure : s, or None
    iso, aperture, focal, focal_35mm, zoom : float or None
        Sensitivity; f-number; focal length [mm], and what it would be on 35 mm film [mm]; digital zoom.
    model : str
        Maker and model, "" if not told.
    hdr : bool
        The camera says that it merged several exposures.
    """

    path: Path
    resolution: tuple[int, int]
    bit_depth: int
    lossy: bool
    orientation: int = 1
    time: datetime | None = None
    exposure: float | None = None
    iso: float | None = None
    aperture: float | None = None
    focal: float | None = None
    focal_35mm: float | None = None
    zoom: float | None = None
    model: str = ""
    hdr: bool = False

    @property
    def lens(self) -> tuple[Any, ...]:
        """What must be alike in all pictures of one calibration."""
        return self.model, self.resolution, self.focal, self.zoom if self.zoom not in (0.0, None) else 1.0

    @property
    def focal_px(self) -> float | None:
        """Focal length [px] as EXIF has it; whole millimetres of 35 mm film make it good to some percent."""
        if not self.focal_35mm:
            return None
        return self.focal_35mm / DIAGONAL_35MM * float(np.hypot(*self.resolution))


def read_photo(path: Path) -> tuple[Photo, NDArray]:
    """What a picture's file says, and its counts as `read_counts` has them.

    Raises
    ------
    BenchsimError
        As `read_counts`: not there, no picture, damaged, HEIC.
    """
    counts, lossy = read_counts(path)
    h, w = counts.shape[:2]
    tags, own = directories(path)
    return (
        Photo(
            path=path,
            resolution=(w, h),
            bit_depth=16 if counts.dtype == np.uint16 else 8,
            lossy=lossy,
            orientation=int(_number(tags.get(0x0112)) or 1),
            time=_time(own),
            exposure=_number(own.get(0x829A)),
            iso=_number(own.get(0x8827)),
            aperture=_number(own.get(0x829D)),
            focal=_number(own.get(0x920A)),
            focal_35mm=_number(own.get(0xA405)),
            zoom=_number(own.get(0xA404)),
            model=printable(" ".join(str(tags[t]).strip("\0 ") for t in (0x010F, 0x0110) if tags.get(t))),
            hdr=int(_number(own.get(0xA401)) or 0) in MERGED,
        ),
        counts,
    )


def _number(value: Any) -> float | None:
    if isinstance(value, tuple):
        value = value[0] if value else None
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if np.isfinite(number) else None


def _time(own: Any) -> datetime | None:
    try:
        time = datetime.strptime(str(own.get(0x9003) or own.get(0x9004)).strip("\0 "), "%Y:%m:%d %H:%M:%S")
    except ValueError:
        return None
    part = str(own.get(0x9291) or "").strip("\0 ")
    return time.replace(microsecond=int(f"{part:0<6}"[:6])) if part.isdigit() else time
