"""What a ridge is measured in, and what may become of its profiles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.floating]
Mask = NDArray[np.bool_]

KEPT, OFF_PICTURE, OFF_BOARD, ON_MARK, SATURATED, FAINT, MISSHAPEN, STRAY, CROSSING = range(9)
"""What became of a profile."""

STATUS = {
    KEPT: "kept",
    OFF_PICTURE: "the profile reaches beyond the picture",
    OFF_BOARD: "the profile reaches beyond the board's edge",
    ON_MARK: "the profile crosses a mark",
    SATURATED: "too few unsaturated pixels to place the centre",
    FAINT: "flux below five sigma of its noise",
    MISSHAPEN: "not the shape of the other profiles: hot pixel, scratch, second light",
    STRAY: "centre farther from the smooth curve than noise explains",
    CROSSING: "the profile crosses another ridge",
}


LEAST_PROFILES = 20
"""Profiles that a ridge must have."""


class Unmeasurable(Exception):
    """A ridge that cannot be measured; ``status`` is what befell most of its profiles."""

    def __init__(self, message: str, status: int) -> None:
        super().__init__(message)
        self.status = status


@dataclass(frozen=True)
class Picture:
    """What the ridge is measured in, all (h, w).

    ``signal``: laser light, dark subtracted if there is one. ``pedestal``: smooth light that adds to the noise besides
    the signal's own: twice the dark picture's, which is under the signal and was subtracted; 0 without one.
    ``blocked``: `KEPT`, or the status of a profile whose window lies here. ``saturated``. ``ceiling``: light at which a
    pixel saturates. ``dark``: whether a dark picture was subtracted.
    """

    signal: Image
    pedestal: Image
    blocked: NDArray[np.uint8]
    saturated: Mask
    ceiling: float
    dark: bool


def require(status: NDArray[np.intp]) -> Mask:
    """Which profiles are kept; raises `Unmeasurable` if they are fewer than `LEAST_PROFILES`."""
    kept = status == KEPT
    if kept.sum() < LEAST_PROFILES:
        count = np.bincount(status[~kept], minlength=len(STATUS))
        worst = int(np.argmax(count))
        raise Unmeasurable(
            f"{kept.sum()} of {len(status)} profiles are usable and {LEAST_PROFILES} are needed ({count[worst]}: "
            f"{STATUS[worst]})",
            worst,
        )
    return kept
