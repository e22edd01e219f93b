"""What a phone itself writes about its lens into every picture."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from PIL import Image

_IFD = 0x8769
_TAGS = {
    "FocalLength": (37386, "mm"),
    "FocalLengthIn35mmFilm": (41989, "mm"),
    "DigitalZoomRatio": (41988, ""),
    "LensModel": (42036, ""),
    "FNumber": (33437, ""),
}
"""EXIF 3.0 (CIPA DC-008), 4.6.5: tags that change with the lens or its zoom, and their units. A phone's aperture does
not move: another number is another lens."""


def directories(path: Path) -> tuple[dict[int, Any], dict[int, Any]]:
    """EXIF's first directory and its own one; empty where there is none or it cannot be read."""
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path) as picture:
            exif = picture.getexif()
            return dict(exif), dict(exif.get_ifd(_IFD))
    except Exception:  # Pillow lets through whatever its parsers stumble on.
        return {}, {}


def lens_tags(path: Path) -> dict[str, str]:
    """Tags that change with the lens, as words; empty where the picture carries none."""
    tags, out = directories(path)[1], {}
    for name, (number, unit) in _TAGS.items():
        if number not in tags:
            continue
        try:
            value = float(tags[number])
        except (TypeError, ValueError, ZeroDivisionError):
            out[name] = str(tags[number]).strip("\0 ")
            continue
        # A zoom of 0 is "not used" (EXIF 3.0), the same as 1.
        value = 1.0 if name == "DigitalZoomRatio" and value == 0 else value
        out[name] = f"{value:.4g} {unit}".strip()
    return out


def changed(tags: Mapping[str, Mapping[str, str]], names: Sequence[str]) -> str:
    """The first tag that is not the same in all pictures that carry it, in words; "" if there is none."""
    for tag in _TAGS:
        seen: dict[str, str] = {}
        for name in names:
            if tag in tags[name]:
                seen.setdefault(tags[name][tag], name)
        if len(seen) > 1:
            (a, first), (b, second) = list(seen.items())[:2]
            return f"EXIF says {tag} {a} in {first} and {b} in {second}"
    return ""
