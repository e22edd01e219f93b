"""One ridge measured in the picture: from the coarse curve to centres with sigmas, all in pixels."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, stats
from scipy.interpolate import BSpline

from benchsim.trace.band import Band, band_along, smooth_curve
from benchsim.trace.noise import FALSE_ALARM, CentreNoise, centre_noise, fit_pixel_noise, spline_basis
from benchsim.trace.profile import Profiles, fit_profiles
from benchsim.trace.ridge import CoarseCurve
from benchsim.trace.shape import Shape, fit_shape, legendre

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

KEPT, OFF_PICTURE, OFF_BOARD, ON_MARK, SATURATED, FAINT, MISSHAPEN, STRAY = range(8)
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
}

FAINT_SIGMA = 5.0
"""Flux over its sigma below which the centre's error is not Gaussian any more; 3e-7 false alarms per profile."""

LEAST_PROFILES = 20

BEYOND = 60.0
"""How far the curve is followed beyond the ends that the coarse search saw [px]."""


@dataclass(frozen=True)
class Line:
    """A measured ridge in pixels; arrays over the kept profiles (k,) unless said otherwise.

    ``t`` along it; ``uv`` (k, 2) centres; ``tangent``, ``normal`` (k, 2) unit; ``sigma``, ``width`` across it [px];
    ``flux`` [light · px]; ``skewness``; ``saturated`` fraction of the core; ``shape_factor`` (k, r): error of all centres
    together through the line's shape and the background's slope, per unit normal [px]. ``noise``; ``core`` half width
    [px]. ``dropped_uv`` (m, 2), ``dropped_status`` (m,): profiles not kept. ``curve``, ``span``: the smooth base curve.
    """

    t: Array
    uv: Array
    tangent: Array
    normal: Array
    sigma: Array
    width: Array
    flux: Array
    skewness: Array
    saturated: Array
    shape_factor: Array
    noise: CentreNoise
    core: float
    half_width: float
    dropped_uv: Array
    dropped_status: NDArray[np.intp]
    curve: BSpline
    span: tuple[float, float]


@dataclass(frozen=True)
class Picture:
    """What the ridge is measured in, all (h, w).

    ``signal``: laser light, dark subtracted if there is one. ``pedestal``: smooth light that was subtracted, or is part of
    the noise besides the signal's own model. ``blocked``: `KEPT`, or the status of a profile whose core lies here.
    ``saturated``. ``ceiling``: light at which a pixel saturates. ``dark``: whether a dark picture was subtracted.
    """

    signal: Array
    pedestal: Array
    blocked: NDArray[np.uint8]
    saturated: Mask
    ceiling: float
    dark: bool


def measure_line(picture: Picture, coarse: CoarseCurve, reach: float) -> Line | None:
    """Measure the ridge near a coarse curve.

    The centre is the centroid of the light within ±``core`` of it across the curve: the line's shape (`shape`) is fitted
    to every profile, and the shape's centroid gives the position. Pixels that are saturated, or that the fitted line lifts
    to within four sigma of it, are left out.

    Parameters
    ----------
    picture : Picture
    coarse : CoarseCurve
    reach : float
        How far off the coarse curve may be [px].

    Returns
    -------
    Line, or None where fewer than `LEAST_PROFILES` profiles are measurable.
    """
    shape = picture.signal.shape
    step = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(coarse.points, axis=0), axis=1))])
    start = smooth_curve(step, coarse.points, np.ones(len(step)), (-BEYOND, step[-1] + BEYOND), 160.0)
    found = _centred(picture, start, (-BEYOND, step[-1] + BEYOND), reach)
    if found is None:
        return None
    curve, span, fwhm = found
    core = 1.2 * fwhm + 1.5
    half_width = core + (10.0 if picture.dark else 16.0)
    band = band_along(curve, span, half_width, shape)
    if band is None:
        return None
    return _measured(picture, band, curve, span, core, half_width)


def _centred(
    picture: Picture, start: BSpline, span: tuple[float, float], reach: float
) -> tuple[BSpline, tuple[float, float], float] | None:
    """Base curve through the smoothed centroids of the light near a coarse curve, its span, and the line's FWHM [px]."""
    half_width = 2 * reach + 16.0
    curve, fwhm = start, np.inf
    for _ in range(2):
        band = band_along(curve, span, half_width, picture.signal.shape)
        if band is None:
            return None
        use = band.inside & (band.take(picture.blocked) == KEPT)
        use &= ~_darker(picture, band, use)
        light = np.where(use, band.take(picture.signal), np.nan)
        with np.errstate(all="ignore"):
            light = light - _row_median(light)[:, None]
        noise = 1.4826 * np.nanmedian(np.abs(light))
        offset = np.zeros(len(band.t))
        sigma = half_width / 3 if not np.isfinite(fwhm) else max(1.0, fwhm)
        for _ in range(5):
            x = band.n - offset[:, None]
            w = np.where(np.isfinite(light), np.exp(-0.5 * (x / sigma) ** 2), 0.0)
            value = np.nan_to_num(light)
            flux = (w * value).sum(axis=1)
            pull = (w * value * x).sum(axis=1)
            # Rows pooled over 15 px, so that a faint line is centred too; weight as the squared significance.
            flux, pull = (np.convolve(a, np.ones(15), "same") for a in (flux, pull))
            significance = flux / max(noise * np.sqrt(15 * sigma * 1.77), 1e-30)
            weight = np.where(significance > 4, np.minimum(significance, 50.0) ** 2, 0.0)
            if (weight > 0).sum() < LEAST_PROFILES:
                return None
            move = np.clip(np.where(weight > 0, 2 * pull / np.where(flux > 0, flux, 1.0), 0), -2 * sigma, 2 * sigma)
            offset = smooth_curve(band.t, offset + move, weight + 1e-9, span, 80.0)(band.t)
            offset = np.clip(offset, -half_width, half_width)
            sigma = max(0.7 * sigma, 2.0) if not np.isfinite(fwhm) else sigma
        lit = weight > 0
        fwhm = _full_width(band.n[lit] - offset[lit, None], light[lit], half_width)
        points = band.point + offset[:, None] * band.normal
        first, last = band.t[lit][0], band.t[lit][-1]
        low, high = max(first - BEYOND / 2, band.t[0]), min(last + BEYOND / 2, band.t[-1])
        inner = (band.t >= low) & (band.t <= high)
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points[inner], axis=0), axis=1))])
        span = (0.0, float(length[-1]))
        if span[1] < LEAST_PROFILES:
            return None
        curve = smooth_curve(length, points[inner], np.ones(len(length)), span, 80.0)
        half_width = 3.0 * fwhm + 8.0
    return curve, span, fwhm


def _darker(picture: Picture, band: Band, board: Mask) -> Mask:
    """Pixels darker than the board by five sigma, grown by two: light only adds, so that is print or no board.

    ``board``: pixels of the band that mostly show the board. Nothing where a dark picture was subtracted.
    """
    if picture.dark:
        return np.zeros(board.shape, bool)
    light = band.take(picture.signal)
    level = ndimage.median_filter(_row_median(np.where(board, light, np.nan)), 101, mode="nearest")[:, None]
    sigma = 1.4826 * np.median(np.abs((light - level)[board])) if board.any() else 0.0
    dark = np.zeros(picture.signal.shape, np.uint8)
    hit = band.inside & (light < level - 5 * sigma)
    dark[band.v[hit], band.u[hit]] = 1
    return band.take(cv2.dilate(dark, np.ones((5, 5), np.uint8)).astype(bool)) & band.inside


def _row_median(light: Array) -> Array:
    empty = ~np.isfinite(light).any(axis=1)
    filled = np.where(empty[:, None], 0.0, light)
    return np.nanmedian(filled, axis=1)


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


def _measured(
    picture: Picture, band: Band, curve: BSpline, span: tuple[float, float], core: float, half_width: float
) -> Line | None:
    signal, level0 = band.take(picture.signal).astype(float), band.take(picture.pedestal).astype(float)
    blocked = np.where(band.inside, band.take(picture.blocked), 0)
    inner = band.inside & (np.abs(band.n) <= core)
    blocked[_darker(picture, band, band.inside & ~inner & (blocked == KEPT)) & (blocked == KEPT)] = ON_MARK
    clipped = band.take(cv2.dilate(picture.saturated.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool))
    clipped &= band.inside
    status = _obstacles(picture, band, blocked, inner, core)
    usable = band.inside & (blocked == KEPT)
    open_rows = status == KEPT
    if open_rows.sum() < LEAST_PROFILES:
        return None
    unsaturated = usable & ~clipped
    flank = usable & ~inner
    background = (signal * flank).sum(axis=1) / np.maximum(flank.sum(axis=1), 1)
    flux = ((signal - background[:, None]) * (inner & usable)).sum(axis=1)
    window = np.ones(15)
    flux = np.convolve(flux * open_rows, window, "same") / np.maximum(np.convolve(open_rows, window, "same"), 1)
    slope, slope_factor = _slope(picture, band, signal, flank & ~clipped & open_rows[:, None], flux, core, span)
    signal = signal - slope[:, None] * band.n
    spread = (
        signal[flank & open_rows[:, None]]
        - np.broadcast_to(background[:, None], signal.shape)[flank & open_rows[:, None]]
    )
    floor = float(np.mean(spread**2)) + 1e-30
    level = level0 + np.maximum(signal, 0)
    base_level = max(float(np.median(level[flank & open_rows[:, None]])), 1e-30)
    # First guess of the noise: all of the flank's variance is shot noise.
    variance = np.maximum(floor * (1 + (level - base_level) / base_level), 0.3 * floor)
    rows = open_rows & (flux > 0)
    fit: Profiles | None = None
    shape: Shape | None = None
    use, zoom = unsaturated, np.ones(len(band.t))
    for turn in range(3):
        if rows.sum() < LEAST_PROFILES:
            return None
        y = signal - background[:, None]
        x = band.n / zoom[:, None]
        near = use & (np.abs(x) <= half_width)
        pick = near & rows[:, None]
        row = np.nonzero(pick)[0]
        scale = flux / zoom
        shape = fit_shape(
            x[pick], band.t[row], y[pick] / scale[row], scale[row] ** 2 / variance[pick], span, core, half_width
        )
        weight = np.where(near, 1 / variance, 0.0)
        fit = fit_profiles(x, signal, weight, band.t, shape, None if turn < 2 else fit)
        strong = open_rows & (fit.flux > FAINT_SIGMA * fit.flux_sigma)
        rows = strong & (fit.shift_sigma < core / 3) & (np.abs(fit.shift) < core / 2)
        rows &= ~_misshapen(fit, rows)
        if rows.sum() < LEAST_PROFILES:
            return None
        pick = near & rows[:, None]
        level = level0 + fit.model
        noise = fit_pixel_noise((signal - fit.model)[pick], level[pick], fit.line[pick], fit.leverage[pick])
        variance = noise.variance(level, fit.line)
        background, flux = fit.background, np.maximum(fit.flux * zoom, 1e-30)
        if turn == 0:
            zoom = _zoom(shape, fit, band.t, rows, span)
            flux = np.maximum(fit.flux, 1e-30)
        if clipped.any():
            use = unsaturated & (_total(picture, band, fit.model) < picture.ceiling - 4 * np.sqrt(variance))
    assert fit is not None and shape is not None
    return _judged(band, zoom, curve, span, shape, fit, status, strong, clipped & inner, inner, slope_factor)


def _zoom(shape: Shape, fit: Profiles, t: Array, rows: Mask, span: tuple[float, float]) -> Array:
    """Width of the line along it over its mean, a quadratic in t: what then changes is the shape alone."""
    terms = legendre(t, span, 2)
    log_width = fit.stretch + np.log(shape.width(t))
    weight = np.where(rows, fit.flux / np.maximum(fit.flux_sigma, 1e-30), 0.0)
    coefficients = np.linalg.lstsq(terms * weight[:, None], log_width * weight, rcond=None)[0]
    # Within a factor of two: beyond, the profiles are too poor to say.
    return np.exp(np.clip(terms[:, 1:] @ coefficients[1:], -0.7, 0.7))


def _total(picture: Picture, band: Band, model: Array) -> Array:
    """Light that the picture itself holds at the band's pixels: half of the pedestal is the dark picture's own."""
    return model + (0.5 * band.take(picture.pedestal) if picture.dark else 0.0)


def _obstacles(picture: Picture, band: Band, blocked: Array, inner: Mask, core: float) -> NDArray[np.intp]:
    h, w = picture.signal.shape
    status = np.where(inner, blocked, KEPT).max(axis=1).astype(np.intp)
    for side in (-core, core):
        end = band.point + side * band.normal
        out = (end < 0).any(axis=1) | (end[:, 0] > w - 1) | (end[:, 1] > h - 1)
        status[out] = OFF_PICTURE
    flank = (band.inside & ~inner & (blocked == KEPT)).sum(axis=1)
    status[(status == KEPT) & (flank < 3)] = OFF_BOARD
    return status


def _slope(
    picture: Picture, band: Band, signal: Array, flank: Mask, flux: Array, core: float, span: tuple[float, float]
) -> tuple[Array, Array | None]:
    """Slope of the background across the line, quadratic along it, and its error factor; zero with a dark picture.

    Fitted together with the line's own lopsided tail (see `shape`), which would pass for a slope.
    """
    if picture.dark:
        return np.zeros(len(band.t)), None
    count = np.maximum(flank.sum(axis=1), 1)[:, None]

    def centred(a: Array) -> Array:
        return np.where(flank, a - (a * flank).sum(axis=1, keepdims=True) / count, 0.0)

    x = centred(band.n)
    tail = centred(flux[:, None] * np.sign(band.n) / np.maximum(np.abs(band.n), core) ** 3)
    terms = legendre(band.t, span, 2)
    design = np.concatenate([(x[..., None] * terms[:, None, :])[flank], tail[flank][:, None]], axis=1)
    size = np.maximum(np.abs(design).max(axis=0), 1e-30)
    design /= size
    y = centred(signal)[flank]
    inverse = np.linalg.pinv(design.T @ design)
    coefficients = inverse @ (design.T @ y)
    variance = float(((y - design @ coefficients) ** 2).sum() / max(len(y) - len(band.t), 1))
    terms = terms / size[:3]
    value, vector = np.linalg.eigh(inverse[:3, :3] * variance)
    return terms @ coefficients[:3], terms @ (vector * np.sqrt(np.maximum(value, 0.0)))


def _judged(
    band: Band,
    zoom: Array,
    curve: BSpline,
    span: tuple[float, float],
    shape: Shape,
    fit: Profiles,
    status: NDArray[np.intp],
    strong: Mask,
    clipped: Mask,
    inner: Mask,
    slope_factor: Array | None,
) -> Line | None:
    """Discard what is not a clean profile, calibrate the sigmas, put the parts together."""
    t = band.t
    saturated = clipped.sum(axis=1) / np.maximum(inner.sum(axis=1), 1)
    width = shape.width(t) * np.exp(fit.stretch) * zoom
    shift_sigma = fit.shift_sigma * zoom
    status = status.copy()
    loose = (fit.shift_sigma > 0.5 * shape.width(t)) | (np.abs(fit.shift) > shape.core / 2)
    status[(status == KEPT) & loose & (saturated > 0)] = SATURATED
    status[(status == KEPT) & (~strong | loose)] = FAINT
    kept = status == KEPT
    if kept.sum() < LEAST_PROFILES:
        return None
    status[kept & _misshapen(fit, kept)] = MISSHAPEN
    kept = status == KEPT
    if kept.sum() < LEAST_PROFILES:
        return None
    offset = (fit.shift + shape.centroid(t)) * zoom
    noise, threshold = None, stats.norm.isf(FALSE_ALARM / (2 * max(kept.sum(), 1)))
    for _ in range(3):
        basis = spline_basis(t[kept], span, 40.0)
        noise = centre_noise(t[kept], offset[kept], shift_sigma[kept], basis)
        smooth = smooth_curve(t[kept], offset[kept], shift_sigma[kept] ** -2, span)
        pull = (offset - smooth(t)) / shift_sigma
        middle = 1.4826 * np.median(np.abs(pull[kept]))
        stray = kept & (np.abs(pull) > threshold * max(middle, noise.scale if middle == 0 else middle))
        if not stray.any():
            break
        status[stray] = STRAY
        kept = status == KEPT
        if kept.sum() < LEAST_PROFILES:
            return None
    assert noise is not None
    k = np.flatnonzero(kept)
    sigma = shift_sigma[k] * noise.scale
    factor = [_beyond_shifts(shape, t[k], sigma / zoom[k], noise) * zoom[k, None]]
    if slope_factor is not None:
        # Of n, not of n over the width: one power of the width from the slope, one from the centre, none from the flux.
        response = shape.slope_response * zoom[k] ** 3 / (fit.flux * zoom)[k]
        factor.append(slope_factor[k] * response[:, None])
    normal = band.normal[k]
    gone = np.flatnonzero(status != KEPT)
    return Line(
        t[k],
        band.point[k] + offset[k, None] * normal,
        np.stack([normal[:, 1], -normal[:, 0]], axis=1),
        normal,
        sigma,
        width[k],
        (fit.flux * zoom)[k],
        shape.skewness(t[k]),
        saturated[k],
        np.concatenate(factor, axis=1),
        noise,
        shape.core,
        shape.half_width,
        band.point[gone],
        status[gone],
        curve,
        span,
    )


def _misshapen(fit: Profiles, among: Mask) -> Mask:
    """Profiles whose chi² is out of line with the others'.

    The cube root of chi² is nearly normal (Wilson & Hilferty 1931); its centre and spread are the picture's own.
    """
    if among.sum() < LEAST_PROFILES:
        return np.zeros(len(among), bool)
    freedom = np.maximum(fit.pixels - 4, 1)
    root = np.cbrt(fit.chi2 / freedom) * np.sqrt(9 * freedom / 2)
    centre = np.median(root[among])
    spread = max(1.4826 * float(np.median(np.abs(root[among] - centre))), 1.0)
    return root - centre > stats.norm.isf(FALSE_ALARM / among.sum()) * spread


def _beyond_shifts(shape: Shape, t: Array, sigma: Array, noise: CentreNoise) -> Array:
    """The part of the centroid's common error that the independent errors of the profiles do not contain already.

    The shape is measured on the same pixels: its smooth shifts are the profiles' own noise, averaged. Only what the
    centroid is worse than that comes on top.
    """
    inflation = 1 + noise.correlation_length
    factor = shape.factor * noise.scale * np.sqrt(inflation)
    terms = legendre(t, shape.span, shape.order) / shape.integral(t)[:, None]
    own = np.linalg.inv(np.einsum("k,ka,kb->ab", 1 / sigma**2, terms, terms)) * inflation
    value, vector = np.linalg.eigh(factor @ factor.T - own)
    return terms @ (vector * np.sqrt(np.maximum(value, 0.0)))
