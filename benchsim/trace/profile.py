"""Every profile's flux, centre, width and background by weighted maximum likelihood, all profiles at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchsim.trace.shape import Shape

Array = NDArray[np.float64]

ITERATIONS = 4


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
    centroid = shape.centroid(t)
    flux, shift, stretch, background = (
        (start.flux.copy(), start.shift.copy(), start.stretch.copy(), start.background.copy())
        if start is not None
        else (np.ones(k), np.zeros(k), np.zeros(k), np.zeros(k))
    )
    solved = start is not None
    for _ in range(ITERATIONS):
        light, gradient = _model(x, t, shape, centroid, shift, stretch)
        if not solved:
            flux, background = _linear(light, y, weight)
            solved = True
        residual = y - background[:, None] - flux[:, None] * light
        jacobian = np.stack([light, flux[:, None] * gradient[0], flux[:, None] * gradient[1], np.ones_like(light)], 1)
        weighted = jacobian * weight[:, None, :]
        normal = np.einsum("kam,kbm->kab", weighted, jacobian)
        right = np.einsum("kam,km->ka", weighted, residual)
        # A stretch of 1 and a shift of the core are beyond any profile: as priors they keep undetermined ones finite.
        diagonal = np.einsum("kaa->ka", normal)
        diagonal += np.array([0.0, 1.0 / shape.core**2, 1.0, 0.0]) + 1e-9 * diagonal + 1e-30
        step = np.linalg.solve(normal, right[..., None])[..., 0]
        flux = flux + step[:, 0]
        shift = np.clip(shift + np.clip(step[:, 1], -1.0, 1.0), -shape.core, shape.core)
        stretch = np.clip(stretch + np.clip(step[:, 2], -0.3, 0.3), -1.0, 1.0)
        background = background + step[:, 3]
        if np.max(np.abs(step[:, 1]), initial=0.0, where=flux > 0) < 1e-4:
            break
    light, _ = _model(x, t, shape, centroid, shift, stretch)
    line = flux[:, None] * light
    model = line + background[:, None]
    covariance = np.linalg.inv(normal)
    return Profiles(
        flux,
        shift,
        stretch,
        background,
        np.sqrt(np.maximum(covariance[:, 0, 0], 0)),
        np.sqrt(np.maximum(covariance[:, 1, 1], 0)),
        (weight * (y - model) ** 2).sum(axis=1),
        (weight > 0).sum(axis=1),
        model,
        line,
        np.einsum("kam,kab,kbm->km", weighted, covariance, jacobian, optimize=True),
    )


def _model(
    x: Array, t: Array, shape: Shape, centroid: Array, shift: Array, stretch: Array
) -> tuple[Array, tuple[Array, Array]]:
    """Unit-flux light and its derivatives by shift and stretch; the stretch is about the centroid."""
    narrow = np.exp(-stretch)[:, None]
    q = (x - centroid[:, None] - shift[:, None]) * narrow
    value, slope = shape.evaluate(q + centroid[:, None], t)
    return value * narrow, (-slope * narrow**2, -narrow * (value + q * slope))


def _linear(light: Array, y: Array, weight: Array) -> tuple[Array, Array]:
    """Flux and background for a fixed shape."""
    w = np.maximum(weight.sum(axis=1), 1e-300)
    mean_l, mean_y = (weight * light).sum(axis=1) / w, (weight * y).sum(axis=1) / w
    variance = (weight * light**2).sum(axis=1) / w - mean_l**2
    flux = ((weight * light * y).sum(axis=1) / w - mean_l * mean_y) / np.maximum(variance, 1e-12)
    return flux, mean_y - flux * mean_l
