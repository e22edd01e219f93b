"""Pictures as a phone writes them: JPEG with EXIF, a red line over a grey board, or the board alone."""

from datetime import datetime, timedelta

import numpy as np
from PIL import Image

EXIF = {
    "time": 0x9003, "exposure": 0x829A, "iso": 0x8827, "aperture": 0x829D, "focal": 0x920A, "focal_35mm": 0xA405,
    "zoom": 0xA404, "rendered": 0xA401,
}  # fmt: skip
TOP = {"orientation": 0x0112, "maker": 0x010F, "model": 0x0110}
BEGIN = datetime(2026, 5, 4, 9, 0, 0)


def picture(line=None, size=(320, 240), seed=0):
    """A grey board that grows brighter to the right, with print; ``line``: column of a red line, None without."""
    rng = np.random.default_rng(seed)
    w, h = size
    grey = np.linspace(90, 150, w)[None, :] * np.ones((h, 1))
    grey[60:100, 40:80] = 15
    planes = np.stack([grey] * 3, axis=-1)
    if line is not None:
        planes[..., 0] += 120 * np.exp(-0.5 * ((np.arange(w) - line) / 1.5) ** 2)[None, :]
    return np.clip(planes + rng.normal(0, 1.5, planes.shape), 0, 255).astype(np.uint8)


def save(path, counts, seconds=0.0, **tags):
    """A JPEG taken so many seconds after nine, with EXIF."""
    said = {
        "orientation": 1, "maker": "Acme", "model": "P1", "exposure": 0.5, "iso": 50, "focal": 5.6, "focal_35mm": 26,
        "zoom": 1.0, "time": (BEGIN + timedelta(seconds=seconds)).strftime("%Y:%m:%d %H:%M:%S"),
    } | tags  # fmt: skip
    exif = Image.Exif()
    own = exif[0x8769] = {}
    for key, value in said.items():
        if value is not None:
            (exif if key in TOP else own)[TOP.get(key) or EXIF[key]] = value
    Image.fromarray(counts).save(path, quality=92, exif=exif)
    return path
