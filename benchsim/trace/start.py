"""From a coarse curve to one that runs along the line's own light to a tenth of a pixel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from benchsim.trace.background import darker, row_median
from benchsim.trace.band import Band, band_along, smooth_curve
from benchsim.trace.picture import FAINT, KEPT, LEAST_PROFILES, OFF_PICTURE, Picture, Unmeasurable
from benchsim.trace.ridge import CoarseCurve

Array = NDArray[np.float64]

BEYOND = 60.0
"""How far the curve is followed beyond the ends that the coarse search saw [px]."""


def centred_curve(picture: Picture, coarse: CoarseCurve, reach: float) -> tuple[BSpline, tuple[float, float], float]:
    """Smooth curve through the light's centroids near a coarse curve.

    Centroids under a Gaussian weight, pooled over 15 px along the curve, moved to their fixed point; twice, the
    second time with the line's own width. Another line within the first weight pulls the start toward it, not the end.

    Parameters
    ----------
    picture, coarse, reach
        As of :func:`benchsim.trace.line.measure_line`.

    Returns
    -------
    curve : BSpline of (u, v)
        By arc length [px].
    span : (low, high)
        Its range.
    fwhm : float
        Full width at half maximum of the mean profile [px].

    Raises
    ------
    Unmeasurable
    """
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(coarse.points, axis=0), axis=1))])
    span = (-BEYOND, float(length[-1]) + BEYOND)
    curve = smooth_curve(length, coarse.points, np.ones(len(length)), span, 160.0)
    half_width, fwhm = 2 * reach + 16.0, 0.0
    for _ in range(2):
        band = band_in(picture, curve, span, half_width)
        use = band.inside & (band.take(picture.blocked) == KEPT)
        use &= ~darker(picture, band, use)
        light = np.where(use, band.take(picture.signal), np.nan)
        light = light - row_median(light)[:, None]
        offset, weight = _centroids(band.t, band.n, light, span, half_width, fwhm)
        lit = weight > 0
        fwhm = _full_width(band.n[lit] - offset[lit, None], light[lit], half_width)
        points = band.point + offset[:, None] * band.normal
        first, last = band.t[lit][0] - BEYOND / 2, band.t[lit][-1] + BEYOND / 2
        points = points[(band.t >= first) & (band.t <= last)]
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        span = (0.0, float(length[-1]))
        curve = smooth_curve(length, points, np.ones(len(length)), span, 80.0)
        half_width = 3.0 * fwhm + 8.0
    return curve, span, fwhm


def band_in(picture: Picture, curve: BSpline, span: tuple[float, float], half_width: float) -> Band:
    """`band_along` of a curve in a picture; raises `Unmeasurable` if it lies outside."""
    band = band_along(curve, span, half_width, picture.signal.shape)
    if band is None:
        raise Unmeasurable("it lies outside of the picture", OFF_PICTURE)
    return band


def _centroids(
    t: Array, n: Array, light: Array, span: tuple[float, float], half_width: float, fwhm: float
) -> tuple[Array, Array]:
    """Smooth offset (k,) of the light's centroid [px], and weight (k,), 0 where no light is. ``fwhm`` 0: not known."""
    known = np.isfinite(light)
    value = np.where(known, light, 0.0)
    noise = max(1.4826 * float(np.median(np.abs(light[known]))) if known.any() else 0.0, 1e-30)
    offset, pool = np.zeros(len(t)), np.ones(15)
    sigma = max(1.0, fwhm) if fwhm else half_width / 3
    for _ in range(5):
        x = n - offset[:, None]
        w = np.exp(-0.5 * (x / sigma) ** 2)
        # Cut by a mark or the board's edge a row's centroid is not the line's.
        whole = (w * known).sum(axis=1) > 0.98 * np.sqrt(2 * np.pi) * sigma
        w = w * value * whole[:, None]
        flux, pull = (np.convolve(a, pool, "same") for a in (w.sum(axis=1), (w * x).sum(axis=1)))
        pooled = np.maximum(np.convolve(whole, pool, "same"), 1)
        significance = np.where(whole, flux / (noise * np.sqrt(pooled * sigma * np.sqrt(np.pi))), 0.0)
        weight = np.where(significance > 4, np.minimum(significance, 50.0) ** 2, 0.0)
        if (weight > 0).sum() < LEAST_PROFILES:
            raise Unmeasurable(
                f"{(weight > 0).sum()} profiles along it hold light and {LEAST_PROFILES} are needed", FAINT
            )
        # Under a weight of the line's own width the centroid sees half of the shift.
        move = np.where(weight > 0, 2 * pull / np.where(flux > 0, flux, 1.0), 0.0)
        target = offset + np.clip(move, -2 * sigma, 2 * sigma)
        offset = np.clip(smooth_curve(t, target, weight + 1e-9, span, 80.0)(t), -half_width, half_width)
        if not fwhm:
            sigma = max(0.7 * sigma, 2.0)
    return offset, weight


def _full_width(x: Array, light: Array, half_width: float) -> float:
    """Full width at half maximum of the mean profile [px], at least 1.5."""
    good = np.isfinite(light) & (np.abs(x) < half_width)
    index = np.floor((x[good] + half_width) * 2).astype(int)
    total = np.bincount(index, light[good], minlength=int(4 * half_width) + 1)
    mean = total / np.maximum(np.bincount(index, minlength=len(total)), 1)
    mean = np.convolve(mean, [0.25, 0.5, 0.25], "same")
    top = int(np.argmax(mean))
    half = 0.5 * mean[top]
    low = top - np.argmax(mean[top::-1] < half) if (mean[: top + 1] < half).any() else 0
    high = top + np.argmax(mean[top:] < half) if (mean[top:] < half).any() else len(mean) - 1
    return max(1.5, 0.5 * float(high - low))
