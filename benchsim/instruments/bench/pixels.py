"""Pixels about a trace with their noise: what is compared with renders, and what the light's asymmetry is read from."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, gaussian_filter, maximum_filter

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Recording
from benchsim.instruments.bench.observed import Observed
from benchsim.rays import project
from benchsim.trace.band import Band, band_along, smooth_curve
from benchsim.trace.extract import read_photographs
from benchsim.trace.marks import board_corners
from benchsim.trace.speckle import Grain, Whitener, measure_grain, whitener

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

WIDTHS = 3.0
"""Pixels within so many rms widths of the trace are compared."""

FLANK = 8.0
"""Pixels beyond on either side that tell the background [px]."""


@dataclass(frozen=True)
class Pixels:
    """Pixels of the band about a trace, in the order of the trace (p,), and their noise.

    Attributes
    ----------
    band : Band
    u, v : (p,) int
        Column and row.
    t, n : (p,) px
        Along and across the trace.
    light : (p,)
        Less the dark picture if there is one.
    background : (p,) or None
        As the flanks tell it; None with a dark picture.
    grain : Grain
    inner : (p,) bool
        Within `WIDTHS` of the trace.
    half : float
        That distance [px].
    """

    band: Band
    u: NDArray[np.intp]
    v: NDArray[np.intp]
    t: Array
    n: Array
    light: Array
    background: Array | None
    grain: Grain
    inner: Mask
    half: float

    def white(self, within: float) -> Whitener:
        """Of the pixels within so many widths."""
        return whitener(self.u, self.v, self.t, self.grain, np.abs(self.n) <= self.half * within / WIDTHS)

    def background_terms(self, always: bool = False) -> Array:
        """What the background may be, (p, terms); none with a dark picture unless ``always``."""
        if self.background is None and not always:
            return np.zeros((len(self.t), 0))
        return _background_terms(self.t, self.n, (0.0, float(self.t.max())))


def about_trace(recording: Recording, observed: Observed) -> Pixels:
    """Pixels about the trace of an exposure, those within four pixels of what is not free board left out.

    Parameters
    ----------
    recording : Recording
    observed : Observed
        Where the trace is in the picture.

    Raises
    ------
    BenchsimError
        If its light is not linear, its width unknown, or too few pixels are free.
    """
    photograph, dark = read_photographs(recording, recording.exposures[observed.index])
    if not photograph.linear:
        raise BenchsimError("its gamma is unknown, so that light cannot be compared")
    if not len(observed.width2):
        raise BenchsimError("its width was not measured, so that it is not known which pixels are the trace's")
    light = photograph.light.astype(float)
    pedestal = np.zeros_like(light)
    if dark is not None:
        light = light - dark.light
        pedestal = 2 * gaussian_filter(np.maximum(dark.light, 0).astype(float), 3.0)
    seen = observed.view
    on_board = np.column_stack([np.zeros(len(observed.points)), observed.points])
    uv = project(seen.camera, seen.rotation, seen.translation, on_board)
    t = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(uv, axis=0), axis=1))])
    span = (0.0, float(t[-1]))
    curve = smooth_curve(t, uv, np.ones(len(t)), span)
    half = WIDTHS * float(np.median(np.sqrt(observed.width2) / observed.mm_per_px))
    band = band_along(curve, span, half + FLANK, light.shape)
    if band is None:
        raise BenchsimError("its trace lies outside of the picture; mend the camera")
    good = binary_erosion(free_board(recording, observed), np.ones((9, 9), bool), border_value=0)
    good &= ~maximum_filter(photograph.saturated, 3)
    use = band.inside & band.take(good)
    row = np.nonzero(use)[0]
    u, v, n = band.u[use], band.v[use], band.n[use]
    inner = np.abs(n) <= half
    if inner.sum() < 500:
        raise BenchsimError(f"only {inner.sum()} of its pixels show the trace on free board; show more of it")
    along, value = band.t[row], light[v, u]
    background = None
    if dark is None:
        terms = _background_terms(along, n, span)
        flank = ~inner
        background = terms @ np.linalg.lstsq(terms[flank], value[flank], rcond=None)[0]
    grain = measure_grain(u, v, along, n, value, pedestal[v, u], np.zeros(len(u)) if background is None else background)
    return Pixels(band, u, v, along, n, value, background, grain, inner, half)


def pixels_of(recording: Recording, observed: Observed) -> Pixels | None:
    """Pixels about the trace of an exposure's photograph; None if its gamma is unknown or too few are free."""
    try:
        return about_trace(recording, observed)
    except BenchsimError:
        return None


def free_board(recording: Recording, observed: Observed) -> Mask:
    """Pixels (rows, columns) that see the board beside its marks, by the solved pose."""
    seen = observed.view
    width, height = seen.camera.resolution

    def filled(mask: NDArray[np.uint8], outline: Array, value: int) -> None:
        """Fill a polygon of board coordinates (n, 2) [mm]."""
        side = np.linspace(0, 1, 20, endpoint=False)[:, None]
        edges = [a + side * (b - a) for a, b in zip(outline, np.roll(outline, -1, axis=0), strict=True)]
        board = np.concatenate(edges)
        uv = project(seen.camera, seen.rotation, seen.translation, np.column_stack([np.zeros(len(board)), board]))
        if np.isfinite(uv).all() and np.abs(uv).max() < 2**15:
            cv2.fillPoly(mask, [np.round(uv * 16).astype(np.int32)], value, shift=4)

    out = np.zeros((height, width), np.uint8)
    y, z = np.asarray(recording.screen.size) / 2
    filled(out, np.array([(y, z), (-y, z), (-y, -z), (y, -z)]), 1)
    if recording.screen.marks is not None and recording.screen.marks.ids:
        corners = board_corners(recording.screen.marks)
        centre = corners.mean(axis=1, keepdims=True)
        # The white margin is one module, an eighth of the square, wide; its print may reflect otherwise than the board.
        for outline in centre + (corners - centre) * (1 + 2 / 8):
            filled(out, outline, 0)
    return out > 0


def _background_terms(t: Array, n: Array, span: tuple[float, float]) -> Array:
    """Cubic along the trace, linear across it."""
    along = np.polynomial.legendre.legvander(2 * (t - span[0]) / (span[1] - span[0]) - 1, 3)
    return np.concatenate([along, along[:, :2] * (n / np.abs(n).max())[:, None]], axis=1)
