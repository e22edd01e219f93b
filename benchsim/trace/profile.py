"""Every profile's flux, centre, width and background by weighted maximum likelihood, all profiles at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from benchsim.trace.shape import Shape

Array = NDArray[np.float64]

ITERATIONS = 4

NEIGHBOURS = 31
"""Profiles over which the light of a pixel's noise is pooled: long against grains of speckle, short against the
changes of a line."""


class Values(NamedTuple):
    """Flux, shift, stretch and background of profiles, (k,) each; see `Profiles`."""

    flux: Array
    shift: Array
    stretch: Array
    background: Array


@dataclass(frozen=True)
class Profiles:
    """Fitted profiles, (k,) each, pixels.

    ``flux`` (light · px across the line), ``shift`` (px, of the line's shape from where it was estimated), ``stretch``
    (log of the width over the shape's), ``background``; ``flux_sigma`` and ``shift_sigma`` 1 sigma of the pixels' noise
    with all four free; ``chi2`` and ``pixels`` (used). ``model`` and ``line`` (k, m): fitted light with and without the
    background; ``leverage`` (k, m): share of each pixel's own noise that the fit follows.
    """

    flux: Array
    shift: Array
    stretch: Array
    background: Array
    flux_sigma: Array
    shift_sigma: Array
    chi2: Array
    pixels: Array
    model: Array
    line: Array
    leverage: Array


def fit_profiles(x: Array, y: Array, weight: Array, t: Array, shape: Shape, start: Profiles | None = None) -> Profiles:
    """Gauss–Newton on flux, shift, stretch and background of every profile.

    Fails softly: where the pixels do not determine a profile its sigmas are large, never missing.

    Parameters
    ----------
    x : (k, m) array
        Place of the pixels across the line [px].
    y, weight : (k, m) array
        Light and 1/variance; weight 0 leaves a pixel out.
    t : (k,) array
        Along the line [px].
    shape : Shape
    start : Profiles, optional
        Where to begin; default the shape where it is, flux and background by linear least squares.
    """
    k = len(x)
    if start is None:
        light, _ = _model(x, t, shape, np.zeros(k), np.zeros(k))
        flux, background = _linear(light, y, weight)
        at = Values(flux, np.zeros(k), np.zeros(k), background)
    else:
        at = Values(start.flux, start.shift, start.stretch, start.background)
    for _ in range(ITERATIONS):
        step, normal, jacobian, weighted = _step(x, y, weight, t, shape, at)
        at = Values(
            at.flux + step[:, 0],
            np.clip(at.shift + np.clip(step[:, 1], -1.0, 1.0), -shape.core, shape.core),
            np.clip(at.stretch + np.clip(step[:, 2], -0.3, 0.3), -1.0, 1.0),
            at.background + step[:, 3],
        )
        if np.max(np.abs(step[:, 1]), initial=0.0, where=at.flux > 0) < 1e-4:
            break
    light, _ = _model(x, t, shape, at.shift, at.stretch)
    line = at.flux[:, None] * light
    model = line + at.background[:, None]
    covariance = np.linalg.inv(normal)
    return Profiles(
        *at,
        np.sqrt(np.maximum(covariance[:, 0, 0], 0)),
        np.sqrt(np.maximum(covariance[:, 1, 1], 0)),
        (weight * (y - model) ** 2).sum(axis=1),
        (weight > 0).sum(axis=1),
        model,
        line,
        np.einsum("kam,kab,kbm->km", weighted, covariance, jacobian, optimize=True),
    )


def calm(profiles: Profiles, good: NDArray[np.bool_]) -> Values:
    """The profiles' values pooled over their neighbours, of which ``good`` (k,) count; their own where there are few.

    A profile follows its own noise. With weights from itself, pixels that happen to be bright count for less: where
    noise grows with the light (speckle) lines come out a few per cent too narrow. A median, since of a profile whose
    crest is saturated the flux may be anything: one of four times the flux made a mean a tenth too large, and the shape
    that was fitted about it 5 % narrower at one end.
    """
    side = NEIGHBOURS // 2
    enough = sliding_window_view(np.pad(good, side), NEIGHBOURS).mean(axis=1) > 0.5

    def pooled(own: Array) -> Array:
        near = sliding_window_view(np.pad(np.where(good, own, np.nan), side, constant_values=np.nan), NEIGHBOURS)
        out = own.copy()
        out[enough] = np.nanmedian(near[enough], axis=1)
        return out

    return Values(*(pooled(v) for v in (profiles.flux, profiles.shift, profiles.stretch, profiles.background)))


def light_of(x: Array, t: Array, shape: Shape, at: Values) -> Array:
    """Light of the line at pixels (k, m), without the background."""
    return at.flux[:, None] * _model(x, t, shape, at.shift, at.stretch)[0]


def stretches(x: Array, y: Array, weight: Array, t: Array, shape: Shape, near: Values) -> Array:
    """Stretch (k,) by one linear step from the neighbours' values: free of the bias, of second order in the noise, that
    a profile of few pixels has where its own fit has converged. Arguments as of `fit_profiles`; weights must not follow
    the profile's own noise either.
    """
    step, *_ = _step(x, y, weight, t, shape, near)
    return np.clip(near.stretch + step[:, 2], -1.0, 1.0)


def _step(x: Array, y: Array, weight: Array, t: Array, shape: Shape, at: Values) -> tuple[Array, Array, Array, Array]:
    """One step (k, 4) of Gauss and Newton, its normal matrices (k, 4, 4), its derivatives (k, 4, m), and weighted."""
    light, gradient = _model(x, t, shape, at.shift, at.stretch)
    flux = at.flux[:, None]
    residual = y - at.background[:, None] - flux * light
    jacobian = np.stack([light, flux * gradient[0], flux * gradient[1], np.ones_like(light)], 1)
    weighted = jacobian * weight[:, None, :]
    normal = np.einsum("kam,kbm->kab", weighted, jacobian)
    right = np.einsum("kam,km->ka", weighted, residual)
    # A stretch of 1 and a shift of the core are beyond any profile: as priors they keep undetermined ones finite.
    diagonal = np.einsum("kaa->ka", normal)
    diagonal += np.array([0.0, 1.0 / shape.core**2, 1.0, 0.0]) + 1e-9 * diagonal + 1e-30
    return np.linalg.solve(normal, right[..., None])[..., 0], normal, jacobian, weighted


def _model(x: Array, t: Array, shape: Shape, shift: Array, stretch: Array) -> tuple[Array, tuple[Array, Array]]:
    """Unit-flux light and its derivatives by shift and stretch; the stretch is about the centre."""
    centre = shape.centre(t)
    narrow = np.exp(-stretch)[:, None]
    q = (x - centre[:, None] - shift[:, None]) * narrow
    value, slope = shape.evaluate(q + centre[:, None], t)
    return value * narrow, (-slope * narrow**2, -narrow * (value + q * slope))


def _linear(light: Array, y: Array, weight: Array) -> tuple[Array, Array]:
    """Flux and background for a fixed shape."""
    w = np.maximum(weight.sum(axis=1), 1e-300)
    mean_l, mean_y = (weight * light).sum(axis=1) / w, (weight * y).sum(axis=1) / w
    variance = (weight * light**2).sum(axis=1) / w - mean_l**2
    flux = ((weight * light * y).sum(axis=1) / w - mean_l * mean_y) / np.maximum(variance, 1e-12)
    return flux, mean_y - flux * mean_l
