"""Recordings made equal in all that is no content: file sizes, metadata and times tell nothing of what is concealed."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import cv2
import numpy as np

from benchsim.bench.errors import BenchsimError

EPOCH = 946684800
"""Time of every file and folder that a judge is given: 2000-01-01 UTC [s]."""


def plain_images(folder: Path) -> None:
    """Write every PNG of a folder anew, without compression and without anything but its pixels.

    Compressed, its size would tell how noisy it is. Stored, it follows from resolution and bit depth.

    Raises
    ------
    BenchsimError
        If an image cannot be read.
    """
    for path in sorted(folder.glob("*.png")):
        counts = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
        if counts is None:
            raise BenchsimError(f"{path}: is not an image that can be read; render the case anew")
        good, data = cv2.imencode(".png", counts, [cv2.IMWRITE_PNG_COMPRESSION, 0])
        if not good:
            raise BenchsimError(f"{path}: cannot be written as PNG")
        path.write_bytes(data.tobytes())


def laid_out(source: Path, target: Path) -> None:
    """Copy a tree file by file in the order of its names, all at once, so that no time tells how long a case took."""
    target.mkdir()
    for path in sorted(source.rglob("*")):
        at = target / path.relative_to(source)
        if path.is_dir():
            at.mkdir()
        else:
            shutil.copyfile(path, at)


def timeless(folder: Path) -> None:
    """Set the time of everything in a folder, and of itself, to `EPOCH`."""
    for path in [*sorted(folder.rglob("*"), reverse=True), folder]:
        os.utime(path, (EPOCH, EPOCH))
