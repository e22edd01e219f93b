"""Has the camera moved between a photograph and its dark picture? Seen by the marks, and taken back.

A phone on a clamp turns by some pixels when it is touched. A dark picture subtracted where it no longer fits leaves
bright and black rims on everything printed, and its marks belong to another pose.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as f_distribution

from benchsim.trace.image import Photograph
from benchsim.trace.marks import MarkObservations

Array = NDArray[np.float64]

FALSE_ALARM = 1e-6
"""Probability with which a camera that stands still is said to have moved."""

HARMLESS = 0.05
"""Motion of all marks below this is not taken back [px]: it moves less light than the noise of one pixel does."""

FEWEST_COMMON = 4
"""Marks that both pictures must show: a plane's motion has eight numbers, four marks give thirty-two."""

OUTLYING = 4.0
"""Marks whose corners miss the common motion by this many times the median miss are left out: the laser crosses them
in one picture only."""


def motion(first: MarkObservations, second: MarkObservations) -> Array | None:
    """How the marks moved from one picture of a board to another, or None where they did not.

    Parameters
    ----------
    first, second : MarkObservations
        Of one board and one camera.

    Returns
    -------
    (3, 3) array or None
        Homography from pixels of ``first`` to pixels of ``second``. A board is a plane: exact but for the change of the
        lens's distortion over the motion.

    Notes
    -----
    The eight numbers of the homography are fitted to the corners that both show. They are significant if they lower
    χ² by more than an F-test allows at ``FALSE_ALARM``, with the noise that the corners themselves show. Use it for
    motions up to some tens of pixels, not to join views of a board from different places.
    """
    shared, i, j = np.intersect1d(first.ids, second.ids, return_indices=True)
    if len(shared) < FEWEST_COMMON:
        return None
    a, b = first.corners[i], second.corners[j]
    weight = np.linalg.inv(first.joint[i] + second.joint[j])

    def misses(h: Array) -> Array:
        off = (b - _moved(h, a)).reshape(-1, 8)
        return np.einsum("ni,nij,nj->n", off, weight, off)

    use = (first.measured[i] & second.measured[j]).all(axis=1)
    found = np.eye(3)
    for _ in range(5):
        if use.sum() < FEWEST_COMMON:
            return None
        fitted, _ = cv2.findHomography(a[use].reshape(-1, 2), b[use].reshape(-1, 2), 0)
        if fitted is None:
            return None
        found = np.asarray(fitted, float)
        miss = misses(found)
        previous, use = use, use & (miss <= OUTLYING**2 * max(float(np.median(miss[use])), 8.0))
        if np.array_equal(previous, use):
            break
    left, still = float(misses(found)[use].sum()), float(misses(np.eye(3))[use].sum())
    dof = 8 * int(use.sum()) - 8
    scale = max(left / dof, 1.0)
    shift = float(np.sqrt(np.mean((_moved(found, a[use]) - a[use]) ** 2)))
    if shift < HARMLESS or (still - left) / 8 < scale * f_distribution.isf(FALSE_ALARM, 8, dof):
        return None
    return found


def moved_by(homography: Array | None, corners: Array) -> float:
    """Root-mean-square motion of points (..., 2) [px]; 0 where there is none."""
    if homography is None:
        return 0.0
    return float(np.sqrt(((_moved(homography, corners) - corners) ** 2).sum(axis=-1).mean()))


def taken_back(picture: Photograph, homography: Array) -> Photograph:
    """A picture as it would have been had the camera not moved.

    Parameters
    ----------
    picture : Photograph
        The second of `motion`.
    homography : (3, 3) array
        From pixels of the first picture to this one's.

    Notes
    -----
    Interpolation (cubic) lowers the noise between pixels by up to a third and correlates neighbours.
    """
    h, w = picture.shape

    def warped(light: NDArray, how: int) -> NDArray:
        flags = how | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpPerspective(light, homography, (w, h), flags=flags, borderMode=cv2.BORDER_REPLICATE))

    def clipped(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        return warped(mask.astype(np.float32), cv2.INTER_LINEAR) > 0

    same = picture.marks_light is picture.light
    light, saturated = warped(picture.light, cv2.INTER_CUBIC), clipped(picture.saturated)
    return replace(
        picture,
        light=light,
        saturated=saturated,
        marks_light=light if same else warped(picture.marks_light, cv2.INTER_CUBIC),
        marks_saturated=saturated if same else clipped(picture.marks_saturated),
    )


def _moved(homography: Array, points: Array) -> Array:
    ones = np.ones((*points.shape[:-1], 1))
    x = np.concatenate([points, ones], axis=-1) @ homography.T
    return np.asarray(x[..., :2] / x[..., 2:])
