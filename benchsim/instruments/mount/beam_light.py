"""A beam's light on a rectified target: background, contour, centroid, and the noise of the centroid.

Works on a map of light on the target's plane, in the map's own pixels (column, row); knows no target and no file.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchsim.bench.errors import BenchsimError

Array = NDArray[np.float64]
Image = NDArray[Any]
"""float32; OpenCV's type stubs know no dtype."""
Mask = NDArray[np.bool_]

CONTOUR = 0.05
"""The beam is what exceeds this fraction of its peak: it holds 95 % of a Gaussian beam's light, and a background that
is wrong by a hundredth of the peak cannot add patches to it."""
ORDER = 2
"""Total degree of the background's polynomial."""
LEAST_PEAK = (6.0, 0.02)
"""What counts as a beam: sigmas of the smoothed background, and fraction of the background's level."""
COARSER = 3
"""Pixels of the map to one of those that the background is fitted on."""
SMOOTH = 0.008
"""Standard deviation of the smoothing for the contour, in widths of the map."""


@dataclass(frozen=True)
class Beam:
    """A beam on a map of light.

    Attributes
    ----------
    centroid : (2,)
        Of the light inside the contour (column, row).
    noise : (2, 2)
        Its covariance from the background's pixel noise and texture.
    inside : (h, w) bool
        The contour's inside.
    net : (h, w) float32
        Light less background.
    background : (h, w) float32
    peak, flux : float
        Of the smoothed net light; of the light inside.
    clipped : float
        Brightest net light on the map's edge within the contour, as a fraction of the peak; 0: the contour is closed.
    second : float
        Flux of the brightest other patch above the contour, as a fraction of ``flux``.
    hidden : float
        Fraction of the inside that is no target (marks) and was filled from its surroundings.
    """

    centroid: Array
    noise: Array
    inside: Mask
    net: Image
    background: Image
    peak: float
    flux: float
    clipped: float
    second: float
    hidden: float


def linear(counts: NDArray[np.uint8]) -> Image:
    """Light, 0 to 1, of 8-bit counts written with the curve of sRGB (IEC 61966-2-1)."""
    x = np.arange(256) / 255
    table = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4).astype(np.float32)
    return table[counts]


def beam_on(image: Image, valid: Mask, order: int = ORDER, contour: float = CONTOUR) -> Beam:
    """Background, contour and centroid of the brightest beam on a map.

    Parameters
    ----------
    image : (h, w) float32
        Light, linear.
    valid : (h, w) bool
        Pixels that show the target: no marks, nothing off the picture.
    order, contour
        See `ORDER`, `CONTOUR`.

    Raises
    ------
    BenchsimError
        There is no beam (`LEAST_PEAK`), or too little background around it; without the picture's name.

    Notes
    -----
    Not for a beam that fills the target: background and beam are told apart by place. A patch of light that the
    background's polynomial can follow (wider than about half the map) is taken for background.
    """
    filled = _fill(image, valid)
    background, free = _background(filled, valid, order)
    net = filled - background
    width = max(SMOOTH * max(image.shape), 1.0)
    smooth = cv2.GaussianBlur(net, (0, 0), width)
    sigma = 1.4826 * float(np.median(np.abs(smooth[free])))
    # A ridge of a few pixels is no beam: judged after smoothing three times as wide.
    wide = cv2.GaussianBlur(net, (0, 0), 3 * width)
    wide_sigma = 1.4826 * float(np.median(np.abs(wide[free])))
    level = float(np.median(background[valid]))
    if wide[valid].max() < max(LEAST_PEAK[0] * wide_sigma, LEAST_PEAK[1] * level):
        raise BenchsimError(
            f"there is no beam on the target: nothing is brighter than the background by {LEAST_PEAK[1]:.0%} and "
            f"{LEAST_PEAK[0]:g} σ; take the photograph with the heliostat on the target"
        )
    peak = float(smooth[valid].max())
    inside, second = _patch(net, smooth > max(contour * peak, 3 * sigma))
    rows, columns = np.nonzero(inside)
    weight = net[inside].astype(float)
    flux = float(weight.sum())
    place = np.stack([columns, rows]).astype(float)
    centroid = place @ weight / flux
    off = place - centroid[:, None]
    noise = _pixel_variance(net, free) * (off @ off.T) / flux**2
    edge = np.zeros_like(inside)
    edge[[0, -1], :] = edge[:, [0, -1]] = True
    rim = edge & inside
    clipped = float(smooth[rim].max() / peak) if rim.any() else 0.0
    hidden = float((inside & ~valid).sum() / inside.sum())
    return Beam(centroid, noise, inside, net, background, peak, flux, clipped, second, hidden)


def _fill(image: Image, valid: Mask) -> Image:
    """Pixels that show no target take the mean of the nearest that do, weighted by a Gaussian that grows until it
    reaches some."""
    filled = np.where(valid, image, 0).astype(np.float32)
    known = valid.astype(np.float32)
    sum_, weight, width = filled.copy(), known.copy(), 2.0
    while (weight <= 1e-3).any() and width < max(image.shape):
        open_ = weight <= 1e-3
        s, w = cv2.GaussianBlur(filled, (0, 0), width), cv2.GaussianBlur(known, (0, 0), width)
        sum_[open_], weight[open_] = s[open_], w[open_]
        width *= 2
    return sum_ / np.maximum(weight, 1e-6)


def _terms(shape: tuple[int, ...], order: int) -> Array:
    """Legendre products of total degree up to ``order``, (terms, h · w)."""
    y, x = (np.polynomial.legendre.legvander(np.linspace(-1, 1, n), order) for n in shape)
    pairs = [(i, j) for i in range(order + 1) for j in range(order + 1 - i)]
    return np.stack([np.outer(y[:, i], x[:, j]).ravel() for i, j in pairs])


def _background(image: Image, valid: Mask, order: int) -> tuple[Image, Mask]:
    """Polynomial through the pixels without beam, and those pixels.

    Light only adds: what exceeds the fit by twice the scatter *below* it is beam, fit and mask by turns; then the mask
    is grown, since a beam's tail passes below any limit. All on means over `COARSER` pixels: the background is smooth.
    """
    whole = (image.shape[1], image.shape[0])
    size = tuple(max(n // COARSER, 4) for n in whole)
    coarse = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    shows = cv2.resize(valid.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.99
    terms = _terms(coarse.shape, order)
    free = shows
    for _ in range(40):
        off = coarse - (_fit(coarse, free, terms) @ terms).reshape(coarse.shape)
        below = off[free & (off < 0)]
        new = shows & (off < 2 * 1.4826 * float(np.median(np.abs(below))))
        if (new ^ free).sum() < 1e-3 * shows.sum():
            break
        free = new
    reach = int(0.03 * max(coarse.shape)) * 2 + 1
    grow = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))
    for _ in range(4):
        off = coarse - (_fit(coarse, free, terms) @ terms).reshape(coarse.shape)
        smooth = np.asarray(cv2.GaussianBlur(off, (0, 0), 1.0), float)
        below = smooth[free & (smooth < 0)]
        above = (smooth > 3 * 1.4826 * float(np.median(np.abs(below)))).astype(np.uint8)
        bright = cv2.morphologyEx(above, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
        new = shows & (cv2.dilate(bright, grow) == 0)
        if new.sum() < 0.1 * shows.sum():
            raise BenchsimError("the beam leaves less than a tenth of the target dark; photograph a smaller beam")
        if (new == free).all():
            break
        free = new
    background = (_fit(coarse, free, terms) @ _terms(image.shape, order)).astype(np.float32).reshape(image.shape)
    return background, valid & (cv2.resize(free.astype(np.uint8), whole, interpolation=cv2.INTER_NEAREST) > 0)


def _fit(image: Image, free: Mask, terms: Array) -> Array:
    weighted = terms * free.ravel()
    return np.linalg.lstsq(weighted @ terms.T, weighted @ image.ravel().astype(float), rcond=None)[0]


def _patch(net: Image, above: Mask) -> tuple[Mask, float]:
    """The connected patch of most light, its holes closed, and the next one's light relative to it."""
    count, label = cv2.connectedComponents(above.astype(np.uint8))
    flux = np.array([net[label == i].sum() for i in range(1, count)], float)
    best = int(np.argmax(flux))
    others = np.delete(flux, best)
    outside = cv2.copyMakeBorder((label != best + 1).astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=1)
    cv2.floodFill(outside, None, (0, 0), 2)
    return outside[1:-1, 1:-1] != 2, float(others.max() / flux[best]) if len(others) else 0.0


def _pixel_variance(net: Image, free: Mask) -> float:
    """Variance of a pixel of the background times the number of pixels that vary together.

    From means over blocks, which hold what is correlated over less than a block (noise after rectification, joints of
    panels, dirt); the background's own shape is the business of its order.
    """
    block = 8
    h, w = (n // block * block for n in net.shape)
    cut = (slice(h), slice(w))

    def blocks(a: NDArray) -> NDArray:
        return a[cut].reshape(h // block, block, w // block, block).transpose(0, 2, 1, 3).reshape(-1, block**2)

    whole = blocks(free).all(axis=1)
    if whole.sum() < 8:
        return float(net[free].var()) * block**2
    return float(blocks(net)[whole].mean(axis=1).astype(float).var()) * block**2
