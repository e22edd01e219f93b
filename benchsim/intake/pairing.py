"""Which photographs are dark pictures of which others: by name, or by what the laser adds."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from benchsim.intake.photo import Photo

Array = NDArray[np.float64]

WIDTH = 1000
"""Pictures are compared at about this many columns: a line 3 px wide in 12 MP still keeps half of its contrast."""

SEEN = 8.0
"""What one picture must have over the other, in sigma of their difference, to count."""

LEAST_SIGMA = 1.0
"""Below this nothing is noise of a picture of 8 bits, but its rounding [counts]."""

FEWEST = 150
"""Pixels of the reduced picture that must show it: a line across a third of its height."""

ONE_SIDED = 4.0
"""How many times as many pixels must have gained as have lost: two pictures of two lines gain and lose alike."""


def laser_light(counts: NDArray) -> Array:
    """A small picture of what is red beyond the room's light; of a mono picture, all light. In counts of 8 bits.

    Nothing here is linear in light: good for telling on from off, not for measuring.
    """
    scale = np.float32(1.0 if counts.dtype == np.uint8 else 255.0 / 65535.0)
    factor = max(1, round(counts.shape[1] / WIDTH))
    size = (counts.shape[1] // factor, counts.shape[0] // factor)
    # Means of whole counts would be rounded to whole counts.
    small = np.asarray(cv2.resize(counts.astype(np.float32) * scale, size, interpolation=cv2.INTER_AREA), float)
    if small.ndim == 2 or small.shape[2] < 3:
        return small if small.ndim == 2 else small[..., 0]
    green, red = small[..., 1], small[..., 2]
    bright = green > green.mean()
    ratio = float(np.median(red[bright]) / max(float(np.median(green[bright])), 1.0))
    return np.asarray(red - ratio * green)


def gain(first: Array, second: Array) -> int:
    """+1 where the first picture shows light that the second does not, -1 for the reverse, 0 for neither or both."""
    if first.shape != second.shape:
        return 0
    difference = first - second
    sigma = max(float(np.median(np.abs(difference - np.median(difference)))) / 0.6745, LEAST_SIGMA)
    more, less = int((difference > SEEN * sigma).sum()), int((difference < -SEEN * sigma).sum())
    if more >= FEWEST and more > ONE_SIDED * less:
        return 1
    if less >= FEWEST and less > ONE_SIDED * more:
        return -1
    return 0


def pair(photos: Sequence[Photo], light: Sequence[Array]) -> list[tuple[int, int | None]]:
    """Photographs with their dark pictures, as indices.

    Parameters
    ----------
    photos : sequence of Photo
        In the order in which they were taken.
    light : sequence of arrays
        `laser_light` of each.

    Returns
    -------
    list of (int, int or None)
        Photograph and dark picture, in the order of the photographs. ``NAME-dark.EXT`` belongs to ``NAME.EXT``; of
        the others a picture and the next one are a pair if one shows light that the other does not.
    """
    by_name = {p.path.stem: i for i, p in enumerate(photos)}
    dark: dict[int, int] = {}
    for i, p in enumerate(photos):
        if p.path.stem.endswith("-dark") and p.path.stem.removesuffix("-dark") in by_name:
            dark[by_name[p.path.stem.removesuffix("-dark")]] = i
    left = [i for i in range(len(photos)) if i not in dark and i not in dark.values()]
    at = 0
    while at < len(left) - 1:
        i, j = left[at], left[at + 1]
        same = photos[i].lens == photos[j].lens and photos[i].orientation == photos[j].orientation
        which = gain(light[i], light[j]) if same else 0
        if which:
            dark[i if which > 0 else j] = j if which > 0 else i
            at += 1
        at += 1
    return [(i, dark.get(i)) for i in range(len(photos)) if i not in dark.values()]
