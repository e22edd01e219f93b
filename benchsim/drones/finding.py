"""Images of mirrors → the mirror's corners and its glints, in the concentrator's frame.

A mirror with the sky in it is brighter than the ground around; its corners are the crossings of four straight edges,
each located to a fraction of a pixel. The corners give the homography from the image to the mirror's plane, so the
camera's own position and gimbal do not enter the places of the glints.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from skimage.filters import threshold_otsu
from skimage.measure import label, regionprops

from benchsim.bench.errors import BenchsimError
from benchsim.drones.flight import Sightings
from benchsim.drones.heliostat import Design

Array = NDArray[np.float64]

REACH = 5.0
"""Half length of the profiles across an edge [px]."""

_GAP = 0.012
"""Half width of what is closed, of the mirror's."""

_SHAPE = 0.03
"""How far a corner may lie from where the mirror's known shape has it, of the mirror's width: a camera that rolls by
10 mrad and errs by a percent in distance stays below."""

_INSET = 0.06
"""Of an edge's length at each end that is not used: there the next edge bends the profile."""

CONTRAST = 1.5
"""Median of what is bright over that of what is not, at least; the sky is six times as bright as the ground."""

GLINT = 0.15
"""A glint's peak over its surroundings, of full scale, at least: 40 times the noise of a sky at 0.1."""

FOOT = 0.05
"""Pixels that far above their surroundings, of full scale, belong to a glint."""


def find_mirror(image: Array, near: Array) -> Array:
    """Corners of the mirror nearest to where it is expected.

    Parameters
    ----------
    image : (rows, columns) array
        Linear counts, of full scale.
    near : (4, 2) array
        Expected corners [px]: lower left, lower right, upper right, upper left; off by less than half a mirror.

    Returns
    -------
    (4, 2) ndarray
        In the same order [px].

    Raises
    ------
    BenchsimError
        If there is no such bright quadrangle.
    """
    near = np.asarray(near, float)
    # glints are capped, first by what is usual in the picture, which may be the ground, then by the mirror's own level
    dim = np.minimum(image, 3 * np.median(image) + 1e-6)
    level = threshold_otsu(dim)
    if not (dim > level).any():
        raise BenchsimError(f"no mirror is seen near pixel {near.mean(axis=0).round()}: all is equally bright")
    sky = np.median(image[dim > level])
    lit = sky > CONTRAST * np.median(image[dim <= level])
    bright = (cv2.GaussianBlur(dim, (0, 0), 1.0) > level).astype(np.uint8)
    dim = np.minimum(image, 1.5 * sky)
    size = float(np.ptp(near[:, 0]))
    # the gaps between facets are closed, but not those to the next heliostat; where the drone's dark reflection eats
    # into an edge, the rectangle spans it and the fit mends it
    bright = cv2.morphologyEx(bright, cv2.MORPH_CLOSE, np.ones((2 * round(_GAP * size) + 1,) * 2, np.uint8))
    count, labels, about, middles = cv2.connectedComponentsWithStats(bright)
    big = [i for i in range(1, count) if about[i, cv2.CC_STAT_AREA] > 0.3 * cv2.contourArea(near.astype(np.float32))]
    if not (lit and big):
        raise BenchsimError(f"no mirror is seen near pixel {near.mean(axis=0).round()}: check exposure and pose")
    best = min(big, key=lambda i: float(np.linalg.norm(middles[i] - near.mean(axis=0))))
    outline = max(
        cv2.findContours((labels == best).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0],
        key=cv2.contourArea,
    )
    box = cv2.boxPoints(cv2.minAreaRect(outline)).astype(float)
    box = box[[int(np.linalg.norm(box - box.mean(0) - (c - near.mean(0)), axis=1).argmin()) for c in near]]
    if len(np.unique(box, axis=0)) < 4:
        raise BenchsimError(f"what is seen near pixel {near.mean(axis=0).round()} is no mirror's quadrangle")
    for _ in range(2):
        edges = [_edge(dim, box[i], box[(i + 1) % 4], box.mean(axis=0)) for i in range(4)]
        box = np.array([_crossing(edges[i - 1], edges[i]) for i in range(4)])
    if np.abs((box - box.mean(axis=0)) - (near - near.mean(axis=0))).max() > _SHAPE * size:
        raise BenchsimError(
            f"what is seen near pixel {near.mean(axis=0).round()} has not the mirror's shape: "
            "something stands before it, or shines beside it"
        )
    return box


def _edge(image: Array, start: Array, end: Array, inside: Array) -> tuple[Array, Array]:
    """A point of the edge's line and its direction: where profiles pass half height, fitted robustly."""
    along = end - start
    length = float(np.linalg.norm(along))
    along = along / length
    out = np.array([along[1], -along[0]])
    out = out if (start - inside) @ out > 0 else -out
    s = np.linspace(_INSET * length, (1 - _INSET) * length, max(8, round(2 * length)))
    t = np.arange(-REACH, REACH + 0.125, 0.25)
    points = start + s[:, None, None] * along + t[:, None] * out
    profiles = map_coordinates(image, [points[..., 1], points[..., 0]], order=1, mode="nearest")
    # one level for the whole edge: single profiles are noisy, and some cross a glint, a gap or the drone's reflection
    half = (np.median(profiles[:, t < -2.5]) + np.median(profiles[:, t > 2.5])) / 2
    above = profiles > half
    crossed = above[:, :-1] & ~above[:, 1:]
    usable = (crossed.sum(axis=1) == 1) & above[:, 0]
    if usable.sum() < 8:
        raise BenchsimError(f"an edge of the mirror near pixel {((start + end) / 2).round()} cannot be located")
    i = crossed[usable].argmax(axis=1)
    high, low = profiles[usable, i], profiles[usable, i + 1]
    place = t[i] + 0.25 * (high - half) / (high - low)
    found = start + s[usable, None] * along + place[:, None] * out
    vx, vy, x, y = cv2.fitLine(found.astype(np.float32), cv2.DIST_HUBER, 0, 1e-3, 1e-3).ravel()
    return np.array([x, y], float), np.array([vx, vy], float)


def _crossing(one: tuple[Array, Array], other: tuple[Array, Array]) -> Array:
    (p, d), (q, e) = one, other
    along = np.linalg.solve(np.column_stack([d, -e]), q - p)
    return np.asarray(p + along[0] * d)


def find_glints(image: Array, corners: Array) -> Array:
    """(n, 2) centroids of the lamp's reflections inside the quadrangle of ``corners`` (4, 2) [px].

    A glint at the mirror's very edge is cut by it, and its centroid lies up to a pixel inside. Two that are nearer than
    some three pixels become one. One fainter than `GLINT` is lost: where the mirror bulges so much that the lamp's
    image is less than about a quarter of a flat mirror's.
    """
    inside = np.zeros(image.shape, np.uint8)
    cv2.fillConvexPoly(inside, np.round(corners).astype(np.int32), 1)
    mirror = inside.astype(bool)
    above = np.where(mirror, image - np.median(image[mirror]), 0.0)
    spots = regionprops(label(above > FOOT, connectivity=2), intensity_image=above)
    found = [s.centroid_weighted[::-1] for s in spots if s.intensity_max > GLINT]
    return np.array(found, float).reshape(-1, 2)


def to_mirror(pixels: Array, corners: Array, design: Design) -> Array:
    """(n, 2) points in the concentrator's frame [mm] of pixels (n, 2), by the homography of the mirror's corners."""
    middle = corners.mean(axis=0)
    m, _ = cv2.findHomography(corners - middle, design.outline)
    if len(pixels) == 0:
        return np.empty((0, 2))
    return np.asarray(cv2.perspectiveTransform((pixels - middle)[:, None], m)[:, 0], float)


def read_images(images: Sequence[Array], near: Sequence[Array], design: Design) -> Sightings:
    """Glints of one heliostat in a flight's images, in the concentrator's frame.

    Parameters
    ----------
    images : sequence of (rows, columns) array
        One per frame, or the window of each that holds the heliostat.
    near : sequence of (4, 2) array
        Expected corners in each [px].
    design : Design

    Returns
    -------
    Sightings
    """
    frames, points = [], []
    for f, (image, expected) in enumerate(zip(images, near, strict=True)):
        corners = find_mirror(image, expected)
        found = to_mirror(find_glints(image, corners), corners, design)
        frames.append(np.full(len(found), f))
        points.append(found)
    return Sightings(np.concatenate(frames), np.concatenate(points))
