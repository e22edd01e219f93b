"""One ridge measured in the picture: from the coarse curve to centres with sigmas, all in pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.interpolate import BSpline

from benchsim.trace.background import darker, slope_across
from benchsim.trace.band import Band, smooth_curve
from benchsim.trace.noise import FALSE_ALARM, CentreNoise, centre_noise, fit_pixel_noise, spline_basis
from benchsim.trace.picture import (
    FAINT,
    KEPT,
    LEAST_PROFILES,
    MISSHAPEN,
    OFF_BOARD,
    OFF_PICTURE,
    ON_MARK,
    SATURATED,
    STRAY,
    Picture,
    Unmeasurable,
    require,
)
from benchsim.trace.profile import Profiles, calm, fit_profiles, light_of, stretches
from benchsim.trace.ridge import CoarseCurve
from benchsim.trace.shape import MAX_ORDER, Shape, fit_shape, legendre
from benchsim.trace.start import band_in, centred_curve

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rows = NDArray[np.intp]

FAINT_SIGMA = 5.0
"""Flux over its sigma below which the centre's error is not Gaussian any more; 3e-7 false alarms per profile."""

CORE = (1.2, 1.5)
"""Half width of the window: so many FWHM plus so many pixels. Holds the main peak of a slit's diffraction pattern and
4 sigma of a blurred line; its noise grows as the power 3/2."""

FLANK = (10.0, 16.0)
"""Background to either side of the window [px], with and without a dark picture; without, its slope must be told
from the line's lopsided tail."""


FREE = 0.2
"""Share of the profiles that must be free of saturated pixels: from them the crest's shape is known to the others."""


@dataclass(frozen=True)
class Line:
    """A measured ridge in pixels; arrays over the kept profiles (k,) unless said otherwise.

    Attributes
    ----------
    t : px
        Along it.
    uv, tangent, normal : (k, 2)
        Centres [px], unit vectors.
    sigma, width : px
        Across it.
    flux : light · px
    skewness
    saturated
        Fraction of the window.
    shape_factor : (k, r) px
        Error of all centres together through the line's shape and the background's slope, per unit normal.
    noise : CentreNoise
    core, half_width : float
        Half widths of the window and of what was fitted [px].
    dropped_uv : (m, 2), dropped_status : (m,)
        Profiles not kept.
    curve, span
        The smooth base curve and its range.
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


def measure_line(picture: Picture, coarse: CoarseCurve, reach: float) -> Line:
    """Measure the ridge near a coarse curve.

    The line's mean shape is fitted to every profile, and the shape's `centre.centre` gives the position. Saturated
    pixels are left out, and those that their neighbourhood lifts to within four sigma of it, two of speckle: only the
    ones that noise lowered would stay. Speckle that saturates a twentieth of the crest still makes a line one or two
    per cent too wide: expose shorter.

    Parameters
    ----------
    picture : Picture
    coarse : CoarseCurve
    reach : float
        How far off the coarse curve may be [px].

    Returns
    -------
    Line

    Raises
    ------
    Unmeasurable
        Where fewer than `LEAST_PROFILES` profiles can be measured.
    """
    curve, span, fwhm = centred_curve(picture, coarse, reach)
    core = CORE[0] * fwhm + CORE[1]
    half_width = core + FLANK[0 if picture.dark else 1]
    band = band_in(picture, curve, span, half_width)
    view = _view(picture, band, core)
    fitted = _fit(view, span, core, half_width)
    return _judged(view, fitted, curve, span)


@dataclass(frozen=True)
class _View:
    """The picture as the band sees it, (k, m) unless said otherwise.

    ``light`` is the signal; ``pedestal`` counts for the noise only, ``under`` lies under the signal in the photograph.
    ``core`` inside the window; ``usable`` free board; ``clipped`` saturated. ``status`` (k,).
    """

    band: Band
    light: Array
    pedestal: Array
    under: Array
    ceiling: float
    dark: bool
    core: Mask
    usable: Mask
    clipped: Mask
    status: NDArray[np.intp]


def _view(picture: Picture, band: Band, core: float) -> _View:
    light = band.take(picture.signal).astype(float)
    pedestal = band.take(picture.pedestal).astype(float) if picture.dark else np.zeros_like(light)
    blocked = np.where(band.inside, band.take(picture.blocked), KEPT)
    inner = band.inside & (np.abs(band.n) <= core)
    blocked[darker(picture, band, band.inside & ~inner & (blocked == KEPT)) & (blocked == KEPT)] = ON_MARK
    near = cv2.dilate(picture.saturated.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    clipped = band.take(near) & band.inside
    usable = band.inside & (blocked == KEPT)
    status = np.where(inner, blocked, KEPT).max(axis=1).astype(np.intp)
    height, width = picture.signal.shape
    for side in (-core, core):
        u, v = (band.point + side * band.normal).T
        status[(u < 0) | (v < 0) | (u > width - 1) | (v > height - 1)] = OFF_PICTURE
    status[(status == KEPT) & ((usable & ~inner).sum(axis=1) < 3)] = OFF_BOARD
    return _View(
        band,
        light,
        pedestal,
        pedestal / 2,
        picture.ceiling,
        picture.dark,
        inner,
        usable,
        clipped,
        status,
    )


@dataclass(frozen=True)
class _Fitted:
    """``shape`` and ``profiles`` in units of (n − ``drift``) / ``zoom``; ``strong`` (k,): flux well above its noise.

    ``moved`` (k,): by how much what the fit leaves of each profile's light moves its centre.
    """

    shape: Shape
    profiles: Profiles
    drift: Array
    zoom: Array
    strong: Mask
    moved: Array
    slope_factor: Array | None


def _fit(view: _View, span: tuple[float, float], core: float, half_width: float) -> _Fitted:
    """Shape and profiles in turn: first one shape with a rough noise, then with the noise, places and widths found.

    A shape that changes along a curve which drifts off the line takes the drift for a change. Where the crest is
    saturated nothing contradicts it, so shapes may change only about a curve that the profiles have corrected.
    """
    band, open_rows = view.band, require(view.status)
    free = open_rows & ~(view.clipped & view.core).any(axis=1)
    if free.sum() < max(LEAST_PROFILES, FREE * open_rows.sum()):
        share = 100 * (1 - free.sum() / open_rows.sum())
        raise Unmeasurable(
            f"the crest of {share:.0f} % of its profiles is saturated, so its shape is unknown", SATURATED
        )
    unsaturated = view.usable & ~view.clipped
    flank = view.usable & ~view.core
    background = (view.light * flank).sum(axis=1) / np.maximum(flank.sum(axis=1), 1)
    flux = ((view.light - background[:, None]) * (view.core & view.usable)).sum(axis=1)
    pool = np.ones(15)
    flux = np.convolve(flux * open_rows, pool, "same") / np.maximum(np.convolve(open_rows, pool, "same"), 1)
    flank &= ~view.clipped & open_rows[:, None]
    slope, slope_factor = np.zeros(len(band.t)), None
    if not view.dark:
        slope, slope_factor = slope_across(band, view.light, flank, flux, core, span)
    light = view.light - slope[:, None] * band.n
    variance = _first_variance(view, light, background, flank)
    rows = open_rows & (flux > 0)
    use, drift, zoom = unsaturated, np.zeros(len(band.t)), np.ones(len(band.t))
    profiles: Profiles | None = None
    for turn in range(3):
        x = (band.n - drift[:, None]) / zoom[:, None]
        near = use & (np.abs(x) <= half_width)
        pick = near & rows[:, None]
        row = np.nonzero(pick)[0]
        scale = (flux / zoom)[row]
        y = (light - background[:, None])[pick] / scale
        order = MAX_ORDER if turn else 0
        shape = fit_shape(x[pick], band.t[row], y, scale**2 / variance[pick], span, core, half_width, order)
        weight = np.where(near, 1 / variance, 0.0)
        profiles = fit_profiles(x, light, weight, band.t, shape, profiles if turn == 2 else None)
        strong = open_rows & (profiles.flux > FAINT_SIGMA * profiles.flux_sigma)
        rows = strong & (profiles.shift_sigma < core / 3) & (np.abs(profiles.shift) < core / 2)
        rows &= ~_misshapen(profiles, rows)
        if rows.sum() < LEAST_PROFILES:
            raise Unmeasurable(f"{rows.sum()} profiles stand above the noise and {LEAST_PROFILES} are needed", FAINT)
        pick = near & rows[:, None]
        near_by = calm(profiles, rows)
        line = light_of(x, band.t, shape, near_by)
        level = view.pedestal + line + near_by.background[:, None]
        noise = fit_pixel_noise((light - profiles.model)[pick], level[pick], line[pick], profiles.leverage[pick])
        variance = noise.variance(level, line)
        background, flux = near_by.background, np.maximum(near_by.flux * zoom, 1e-30)
        if turn == 0:
            weight = profiles.shift_sigma[rows] ** -2
            drift = smooth_curve(band.t[rows], profiles.shift[rows], weight, span)(band.t)
            zoom = _zoom(shape, profiles, band.t, rows, span)
        if view.clipped.any():
            shot, grain = np.sqrt(noise.variance(level, np.zeros(1))), np.sqrt(noise.speckle) * line
            use = _below_the_ceiling(view, view.under + line + background[:, None], shot, grain)
    assert profiles is not None
    stretch = stretches(x, light, np.where(near, 1 / variance, 0.0), band.t, shape, near_by)
    left = np.where(near, light - profiles.model, 0.0) / np.maximum(profiles.flux * zoom, 1e-30)[:, None]
    moved = shape.moved(x - profiles.shift[:, None], left)
    return _Fitted(shape, replace(profiles, stretch=stretch), drift, zoom, strong, moved, slope_factor)


def _below_the_ceiling(view: _View, level: Array, shot: Array, grain: Array) -> Mask:
    """Pixels that noise does not clip: of those that it may, only the ones that it lowered would stay.

    They are told by their neighbourhood's ``level``, not by their own light; ``shot`` is 1 sigma of the pixels' noise,
    ``grain`` that of speckle. Four sigma off of the first; of speckle, which is large, two, or as many as leave `FREE`
    of the profiles their crest: pixels clipped at 2 sigma lower a mean by 0.05.
    """
    open_rows, use = require(view.status), view.usable & ~view.clipped
    for margin in (2.0, 1.0, 0.0):
        below = use & (level + 4 * shot + margin * grain < view.ceiling)
        cut = np.any(view.core & view.usable & ~below, axis=1)
        if np.mean(cut[open_rows]) <= 1 - FREE:
            break
    return below


def _first_variance(view: _View, light: Array, background: Array, flank: Mask) -> Array:
    """A first guess of the noise: all of the flank's variance is shot noise."""
    floor = float(np.mean((light - background[:, None])[flank] ** 2)) + 1e-30
    level = view.pedestal + np.maximum(light, 0)
    base = max(float(np.median(level[flank])), 1e-30)
    return np.maximum(floor * level / base, 0.3 * floor)


def _zoom(shape: Shape, profiles: Profiles, t: Array, rows: Mask, span: tuple[float, float]) -> Array:
    """Width of the line along it over its mean, a quadratic in t: what then changes is the shape alone."""
    terms, width = legendre(t, span, 2), shape.width(t)
    # Beyond the profiles that shaped it a shape may have no width.
    known = rows & (width > 0)
    log_width = profiles.stretch[known] + np.log(width[known])
    weight = profiles.flux[known] / np.maximum(profiles.flux_sigma[known], 1e-30)
    coefficients = np.linalg.lstsq(terms[known] * weight[:, None], log_width * weight, rcond=None)[0]
    # Within a factor of two: beyond, the profiles are too poor to say.
    return np.exp(np.clip(terms[:, 1:] @ coefficients[1:], -0.7, 0.7))


def _judged(view: _View, fitted: _Fitted, curve: BSpline, span: tuple[float, float]) -> Line:
    """Discard what is not a clean profile, calibrate the sigmas, put the parts together."""
    band, shape, profiles, zoom = view.band, fitted.shape, fitted.profiles, fitted.zoom
    t, status = band.t, view.status.copy()
    saturated = (view.clipped & view.core).sum(axis=1) / np.maximum(view.core.sum(axis=1), 1)
    loose = (profiles.shift_sigma > 0.5 * shape.width(t)) | (np.abs(profiles.shift) > shape.core / 2)
    lost = (status == KEPT) & (~fitted.strong | loose)
    status[lost] = np.where(saturated[lost] > 0, SATURATED, FAINT)
    kept = require(status)
    status[kept & _misshapen(profiles, kept)] = MISSHAPEN
    kept = require(status)
    free = np.flatnonzero(kept & (saturated == 0))
    left_out, factor = _of_the_shape(t, shape.span, fitted.moved, profiles.shift_sigma, free)
    offset = fitted.drift + (profiles.shift + shape.centre(t) + left_out) * zoom
    sigma = profiles.shift_sigma * zoom
    threshold = stats.norm.isf(FALSE_ALARM / (2 * kept.sum()))
    for _ in range(3):
        smooth = smooth_curve(t[kept], offset[kept], sigma[kept] ** -2, span)
        pull = np.abs(offset - smooth(t)) / sigma
        stray = kept & (pull > threshold * 1.4826 * np.median(pull[kept]))
        if not stray.any():
            break
        status[stray] = STRAY
        kept = require(status)
    k = np.flatnonzero(kept)
    sigma = sigma * _flank_scale(saturated > 0, kept, pull)
    noise = centre_noise(t[k], offset[k], sigma[k], spline_basis(t[k], span, 40.0))
    sigma = sigma[k] * noise.scale
    factors = [factor[k] * zoom[k, None]]
    if fitted.slope_factor is not None:
        response = shape.slope_response * zoom[k] ** 2 / profiles.flux[k]
        factors.append(fitted.slope_factor[k] * response[:, None])
    normal = band.normal[k]
    gone = np.flatnonzero(status != KEPT)
    return Line(
        t=t[k],
        uv=band.point[k] + offset[k, None] * normal,
        tangent=np.stack([normal[:, 1], -normal[:, 0]], axis=1),
        normal=normal,
        sigma=sigma,
        width=(shape.width(t) * np.exp(profiles.stretch) * zoom)[k],
        flux=(profiles.flux * zoom)[k],
        skewness=shape.skewness(t[k]),
        saturated=saturated[k],
        shape_factor=np.concatenate(factors, axis=1),
        noise=noise,
        core=shape.core,
        half_width=shape.half_width,
        dropped_uv=band.point[gone],
        dropped_status=status[gone],
        curve=curve,
        span=span,
    )


def _flank_scale(clipped: Mask, kept: Mask, pull: Array) -> Array:
    """Scatter of profiles with saturated pixels over that of the others, 1 for the others (k,).

    Placed by their flanks, they feel what is wrong with the shape and the noise there more. Needs 30 of either kind.
    """
    out = np.ones(len(kept))
    hit, free = kept & clipped, kept & ~clipped
    if min(hit.sum(), free.sum()) >= 30:
        out[hit] = np.sqrt(np.mean(pull[hit] ** 2) / np.mean(pull[free] ** 2))
    return out


def _misshapen(profiles: Profiles, among: Mask) -> Mask:
    """Profiles whose chi² is out of line with the others'.

    The cube root of chi² is nearly normal (Wilson & Hilferty 1931); its centre and spread are the picture's own.
    """
    if among.sum() < LEAST_PROFILES:
        return np.zeros(len(among), bool)
    freedom = np.maximum(profiles.pixels - 4, 1)
    root = np.cbrt(profiles.chi2 / freedom) * np.sqrt(9 * freedom / 2)
    centre = np.median(root[among])
    spread = max(1.4826 * float(np.median(np.abs(root[among] - centre))), 1.0)
    return root - centre > stats.norm.isf(FALSE_ALARM / among.sum()) * spread


def _of_the_shape(t: Array, span: tuple[float, float], moved: Array, sigma: Array, free: Rows) -> tuple[Array, Array]:
    """What the mean shape leaves out of the centres (k,), and the common error that is left (k, terms), both [px].

    The shape is fitted to all profiles, and its centre is that of their light: each profile's centre is its own shift
    and what the rest of its light moves it by. Of that rest a cubic along the line is common: what of it the shape does
    not follow, for want of significance, is put back, and its error is read from how the rest scatters, correlation of
    neighbours included. ``free`` are the profiles that show it.
    """
    terms = legendre(t, span, MAX_ORDER)
    noise = centre_noise(t[free], moved[free], sigma[free], terms[free])
    weighted = terms[free] / (sigma[free] * noise.scale)[:, None]
    inverse = np.linalg.pinv(weighted.T @ weighted, rcond=1e-9)
    found = inverse @ (weighted.T @ (moved[free] / (sigma[free] * noise.scale)))
    value, vector = np.linalg.eigh(inverse * (1 + noise.correlation_length))
    return terms @ found, terms @ (vector * np.sqrt(np.maximum(value, 0.0)))
