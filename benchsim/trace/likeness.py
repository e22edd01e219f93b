"""How much what was traced looks like a laser's line: letters, textures and edges can be traced too."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, median_filter

from benchsim.trace.line import Line

LIMIT = 0.5
"""Score below which it is none. Of 112 pictures without a line (640 x 480), of which half could not be traced at all,
none scored above 0.39; seven rendered photographs scored 0.70 to 0.79, since marks interrupt them, 16 arcs 0.88 to
0.96."""

CLUTTER = 5.0
"""Contrast that counts half."""

UNEVEN = 0.1
"""Relative scatter of the width that counts half."""

ASIDE = 4.0
"""Where the line ends and what else is there begins, in its widths (1 sigma): its flanks are below 1e-3 there."""

NEAR = 24.0
"""Where its surroundings end, in its widths: marks and the board's edges are beyond for most of a line."""

POOLED, ALONG = 9, 101
"""Profiles whose median width is compared with that of more: noise goes, a width that drifts along a line stays."""

MOST_PROFILES = 200
"""Profiles that are looked at to the edges of the picture."""


@dataclass(frozen=True)
class Likeness:
    """Of a traced ridge.

    Attributes
    ----------
    contrast
        Height of the crest over the median of what lies around it, in scatters of that.
    continuity
        Fraction of its length in pixels that could be measured.
    unevenness
        Relative scatter of its width from one stretch of ten pixels to the next.
    single
        Fraction of its profiles on whose normal nothing else is half as bright.
    """

    contrast: float
    continuity: float
    unevenness: float
    single: float

    @property
    def score(self) -> float:
        """All four in one, 0 to 1."""
        contrast = self.contrast / (self.contrast + CLUTTER)
        return float(contrast * self.continuity * self.single / (1 + (self.unevenness / UNEVEN) ** 2))

    def as_dict(self) -> dict[str, float]:
        """Plain values."""
        return {"score": self.score, "limit": LIMIT, **asdict(self)}

    def words(self) -> str:
        """For a person."""
        return (
            f"{self.score:.2f} of 1 (a line: {LIMIT} and more): crest {self.contrast:.0f} times the scatter of what "
            f"is around it, {100 * self.continuity:.0f} % of its length measured, width uneven by "
            f"{100 * self.unevenness:.0f} %, alone on {100 * self.single:.0f} % of its normals"
        )


def likeness(signal: NDArray, line: Line) -> Likeness:
    """Look at a measured ridge and its surroundings in a picture.

    Parameters
    ----------
    signal : (h, w)
        Light, as the line was measured in it.
    line : Line

    Returns
    -------
    Likeness
    """
    width = max(float(np.median(line.width)), 0.5)
    some = np.unique(np.linspace(0, len(line.t) - 1, MOST_PROFILES).astype(int))
    height, across = signal.shape
    # Blurred as the line is wide, so that steps of a width miss nothing and single pixels count little.
    calm = cv2.GaussianBlur(np.asarray(signal, np.float32), (0, 0), max(0.7 * width, 0.7))
    off = np.arange(ASIDE * width, np.hypot(height, across), width)
    off = np.concatenate([-off, off])
    points = line.uv[some, None, :] + off[None, :, None] * line.normal[some, None, :]
    within = ((points >= 0) & (points <= [across - 1, height - 1])).all(axis=2)
    seen = (within & (np.abs(off) <= NEAR * width)).sum(axis=1) > 2
    pooled = median_filter(line.width, POOLED, mode="nearest")
    uneven = 1.4826 * float(np.median(np.abs(pooled - median_filter(line.width, ALONG, mode="nearest")))) / width
    continuity = min(len(line.t) / (line.span[1] - line.span[0] + 1.0), 1.0)
    if not seen.any():
        return Likeness(0.0, continuity, uneven, 0.0)
    beside = np.where(within, map_coordinates(calm, [points[..., 1], points[..., 0]], order=1, mode="nearest"), np.nan)
    beside, (u, v) = beside[seen], line.uv[some[seen]].T
    crest = map_coordinates(calm, [v, u], order=1, mode="nearest")
    near = np.where(np.abs(off) <= NEAR * width, beside, np.nan)
    ground = np.nanmedian(near, axis=1)
    above = beside - ground[:, None]
    scatter = 1.4826 * float(np.nanmedian(np.abs(near - ground[:, None])))
    peak = crest - ground
    return Likeness(
        contrast=max(float(np.median(peak)), 0.0) / max(scatter, 1e-12),
        continuity=continuity,
        unevenness=uneven,
        single=float(np.mean(np.nanmax(above, axis=1) < 0.5 * peak)),
    )
