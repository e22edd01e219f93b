"""The board's light beside the line: what is not board, and how the room's light slopes across the line."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from benchsim.trace.band import Band
from benchsim.trace.picture import Picture
from benchsim.trace.shape import legendre

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def darker(picture: Picture, band: Band, board: Mask) -> Mask:
    """Pixels darker than the board by five sigma, grown by two: light only adds, so that is print or no board.

    ``board``: pixels of the band that mostly show the board. Nothing where a dark picture was subtracted.
    """
    if picture.dark:
        return np.zeros(board.shape, bool)
    light = np.asarray(band.take(picture.signal), float)
    level = ndimage.median_filter(row_median(np.where(board, light, np.nan)), 101, mode="nearest")[:, None]
    off: Array = light - level
    size = np.abs(off[board])
    sigma = 1.4826 * float(np.median(size)) if board.any() else 0.0
    # Of a quiet picture in few counts most pixels are alike: what differs by one of them is no print.
    sigma = max(sigma, float(np.min(size, where=size > 0, initial=np.inf))) if (size > 0).any() else sigma
    dark = np.zeros(picture.signal.shape, np.uint8)
    hit = band.inside & (off < -5 * sigma)
    dark[band.v[hit], band.u[hit]] = 1
    return band.take(cv2.dilate(dark, np.ones((5, 5), np.uint8)).astype(bool)) & band.inside


def row_median(light: Array) -> Array:
    """Median of each row, nan left out; 0 for a row of nothing else."""
    known = np.isfinite(light)
    count = known.sum(axis=1)
    # Unknown ones sort to the end.
    ordered = np.sort(np.where(known, light, np.inf), axis=1)
    row, middle = np.arange(len(light)), np.maximum(count - 1, 0) / 2
    median = (ordered[row, np.floor(middle).astype(int)] + ordered[row, np.ceil(middle).astype(int)]) / 2
    return np.where(count > 0, median, 0.0)


def slope_across(
    band: Band, light: Array, flank: Mask, flux: Array, core: float, span: tuple[float, float]
) -> tuple[Array, Array]:
    """Slope of the background across the line, quadratic along it, where there is no dark picture.

    Fitted together with the line's own lopsided tail (see `shape`), which would pass for a slope.

    Parameters
    ----------
    band : Band
    light : (k, m) array
    flank : (k, m) mask
        Free board outside of the line's window.
    flux : (k,) array
        Of the line [light · px].
    core : float
        Half width of the window [px].
    span : (low, high)
        Of the curve [px].

    Returns
    -------
    slope : (k,) ndarray [light/px]
    factor : (k, 3) ndarray
        Its error per unit normal.
    """
    count = np.maximum(flank.sum(axis=1), 1)[:, None]

    def centred(a: Array) -> Array:
        return np.where(flank, a - (a * flank).sum(axis=1, keepdims=True) / count, 0.0)

    x = centred(band.n)
    tail = centred(flux[:, None] * np.sign(band.n) / np.maximum(np.abs(band.n), core) ** 3)
    terms = legendre(band.t, span, 2)
    design = np.concatenate([(x[..., None] * terms[:, None, :])[flank], tail[flank][:, None]], axis=1)
    size = np.maximum(np.abs(design).max(axis=0), 1e-30)
    design /= size
    y = centred(light)[flank]
    inverse = np.linalg.pinv(design.T @ design)
    coefficients = inverse @ (design.T @ y)
    variance = float(((y - design @ coefficients) ** 2).sum() / max(len(y) - len(band.t), 1))
    terms = terms / size[:3]
    value, vector = np.linalg.eigh(inverse[:3, :3] * variance)
    return terms @ coefficients[:3], terms @ (vector * np.sqrt(np.maximum(value, 0.0)))
