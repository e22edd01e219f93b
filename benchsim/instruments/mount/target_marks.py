"""A target's printed marks in a photograph, and the homography from its pixels to the target's plane.

Frames: pixel (u, v), OpenCV's; plane (east, up) in mm from the target's centre, east along the target.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchsim.bench.errors import BenchsimError
from benchsim.instruments.mount.mark_templates import Template

Array = NDArray[np.float64]
Image = NDArray[Any]
"""float32; OpenCV's type stubs know no dtype."""

SCORE = 0.8
"""Least correlation of a mark with its aligned template: panel joints and edges stay below 0.7."""
PRIOR_SIGMA = 15.0
"""1 σ of a mark's place on the plane [mm], of survey and reading together: a pixel of PAINT's pictures and templates is
4 to 7 mm, its own readings of the templates scatter by two. Refined by the marks' residuals where there are more than
four, as `PRIOR_DOF` observations would be."""
PRIOR_DOF = 4
OUTLYING = 5.0
"""A mark farther than this many sigma from where the others put it is set aside."""
COARSE = 700
"""Long side of the picture in which marks are first looked for [px]."""
SCALES = np.geomspace(0.3, 2.4, 16)
"""Of the photograph's marks, as multiples of the templates': in steps of 15 % a mark's end is never off by more than a
quarter of its bar."""


@dataclass(frozen=True)
class Marks:
    """The marks found in a photograph and the homography through them.

    Attributes
    ----------
    names : tuple of str
        n marks.
    pixel : (n, 2) px
    plane : (n, 2) mm
        Surveyed, (east, up).
    score : (n,)
        Correlation with the aligned template.
    used : (n,) bool
        The others contradict the rest.
    homography : (3, 3)
        Pixel to plane.
    residual : (n, 2) mm
        Surveyed minus mapped; of a mark set aside too.
    sigma : float
        1 σ of a mark's place per coordinate [mm].
    inset : (n, 2) mm
        From the surveyed point to where it would lie if bars had been surveyed along their centre lines.
    missing : tuple of str
        Marks of the target that were not found.
    ink : (h, w) bool
        Pixels of the photograph that show a mark.
    """

    names: tuple[str, ...]
    pixel: Array
    plane: Array
    score: Array
    used: NDArray[np.bool_]
    homography: Array
    residual: Array
    sigma: float
    inset: Array
    missing: tuple[str, ...]
    ink: NDArray[np.bool_]

    @property
    def rms(self) -> float:
        """Of the used marks' residuals per coordinate [mm]; 0 where only four marks are used."""
        return float(np.sqrt(np.mean(self.residual[self.used] ** 2)))

    @property
    def set_aside(self) -> tuple[str, ...]:
        """Names of the marks found but not used."""
        return tuple(n for n, u in zip(self.names, self.used, strict=True) if not u)


def find_marks(grey: Image, templates: tuple[Template, ...], survey: dict[str, Array]) -> Marks:
    """Find the marks, each on its own, and the homography on which most of them agree.

    The marks' common scale is searched first (normalised cross-correlation in a small picture). Marks that do not
    stand as on the target are looked for again where the others put them. Each is then aligned with its template by
    an affine map (enhanced correlation coefficient; Evangelidis & Psarakis, IEEE PAMI 30, 1858, 2008), which takes
    brightness, contrast, tilt and turns of a few degrees. Not for marks turned by more than about 15°.

    Parameters
    ----------
    grey : (h, w) float32
    templates : tuple of Template
    survey : dict
        Name of the mark → (2,) (east, up) [mm].

    Returns
    -------
    Marks

    Raises
    ------
    BenchsimError
        Fewer than four marks are found that stand as on the target; without the picture's name.
    """
    templates = tuple(t for t in templates if t.name in survey)
    factor = min(1.0, COARSE / max(grey.shape))
    small = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    scale, coarse, scores = _search(small, templates, factor)
    plane = np.array([survey[t.name] for t in templates])
    points = np.array([_point(t, c, scale, factor) for t, c in zip(templates, coarse, strict=True)])
    affine, agree = _consensus(points, plane, scores)
    if affine is None:
        raise BenchsimError("the target's marks are not found; photograph the whole target, upright, marks included")
    found = []
    for i, t in enumerate(templates):
        expected = points[i] if agree[i] else cv2.transform(plane[i][None, None], affine)[0, 0]
        start = expected if agree[i] else _again(small, t, expected, scale, factor)
        if start is not None:
            aligned = _align(grey, t, start, scale)
            if aligned is not None:
                found.append((t, *aligned))
    if len(found) < 4:
        names = ", ".join(t.name for t, _, _ in found) or "none"
        raise BenchsimError(
            f"only {len(found)} of the target's marks are found ({names}) and four are needed; photograph all of them"
        )
    pixel = np.array([warp[:, :2] @ t.point + warp[:, 2] for t, warp, _ in found])
    plane = np.array([survey[t.name] for t, _, _ in found])
    used, homography, sigma = agreed_homography(pixel, plane)
    return Marks(
        tuple(t.name for t, _, _ in found),
        pixel,
        plane,
        np.array([s for _, _, s in found]),
        used,
        homography,
        plane - to_plane(homography, pixel),
        sigma,
        np.array([_inset(t, warp, homography) for t, warp, _ in found]),
        tuple(n for n in survey if n not in {t.name for t, _, _ in found}),
        _ink(grey.shape, found),
    )


def _search(small: Image, templates: tuple[Template, ...], factor: float) -> tuple[float, Array, Array]:
    """The scale at which all marks together correlate best, each mark's top left corner there, and its score."""
    best: tuple[float, float, Array, Array] = (-1.0, 1.0, np.empty(0), np.empty(0))
    for scale in SCALES:
        patches = [_resized(t.image, scale * factor) for t in templates]
        if any(min(p.shape) < 12 or p.shape[0] >= small.shape[0] or p.shape[1] >= small.shape[1] for p in patches):
            continue
        hits = [cv2.minMaxLoc(cv2.matchTemplate(small, p, cv2.TM_CCOEFF_NORMED)) for p in patches]
        scores = np.array([h[1] for h in hits])
        if scores.mean() > best[0]:
            best = (float(scores.mean()), float(scale), np.array([h[3] for h in hits], float), scores)
    if best[0] < 0:
        raise BenchsimError("the picture is too small for the marks; photograph the target with more pixels")
    return best[1:]


def _resized(image: Image, scale: float) -> Image:
    return cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)


def _point(t: Template, corner: Array, scale: float, factor: float) -> Array:
    """The mark's surveyed point in the full picture, from its template's corner in the small one."""
    return (corner + 0.5) / factor - 0.5 + t.point * scale


def _consensus(points: Array, plane: Array, scores: Array) -> tuple[Image | None, NDArray[np.bool_]]:
    """Affine map from plane to pixel through three marks that most others agree with, near enough upright."""
    size = float(np.ptp(plane, axis=0).max())
    best: tuple[float, Image | None, NDArray[np.bool_]] = (0.0, None, np.zeros(len(points), bool))
    for three in combinations(range(len(points)), 3):
        i = list(three)
        if abs(np.linalg.det(np.c_[plane[i], np.ones(3)])) < 0.1 * size**2:
            continue
        affine = cv2.getAffineTransform(plane[i].astype(np.float32), points[i].astype(np.float32))
        linear = affine[:, :2]
        stretch = np.linalg.svd(linear, compute_uv=False)
        mirrored = np.linalg.det(linear) < 0
        # East is at the left of who looks at a target that faces north, and rows run downward: no mirror.
        turn = np.arctan2(linear[0, 1] - linear[1, 0], -linear[0, 0] - linear[1, 1])
        if mirrored or stretch[1] < 0.7 * stretch[0] or abs(turn) > np.radians(20):
            continue
        off = np.linalg.norm(cv2.transform(plane[:, None], affine)[:, 0] - points, axis=1)
        agree = off < 0.05 * size * stretch[0]
        total = float(scores[agree].sum())
        if total > best[0]:
            best = (total, affine, agree)
    return best[1], best[2]


def _again(small: Image, t: Template, expected: Array, scale: float, factor: float) -> Array | None:
    """The mark within half its size of where it is expected, or None if that is off the picture."""
    patch = _resized(t.image, scale * factor)
    corner = (expected - t.point * scale + 0.5) * factor - 0.5
    reach = max(patch.shape) / 2
    low = np.maximum(np.floor(corner - reach), 0).astype(int)
    high = np.minimum(np.ceil(corner + reach) + patch.shape[::-1], small.shape[::-1]).astype(int)
    window = small[low[1] : high[1], low[0] : high[0]]
    if window.shape[0] < patch.shape[0] or window.shape[1] < patch.shape[1]:
        return None
    place = cv2.minMaxLoc(cv2.matchTemplate(window, patch, cv2.TM_CCOEFF_NORMED))[3]
    return _point(t, low + np.array(place, float), scale, factor)


def _align(grey: Image, t: Template, start: Array, scale: float) -> tuple[Array, float] | None:
    """Affine map from the template's pixels to the photograph's, and the correlation; None below `SCORE`."""
    corner = start - t.point * scale
    first = np.array([[scale, 0, corner[0]], [0, scale, corner[1]]], np.float32)
    everywhere = np.full(grey.shape, 255, np.uint8)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-5)
    # A smaller photograph is smoothed less than the template that it is sampled at.
    blur = 2 * int(np.ceil(1.5 * max(1 / scale, 1.0))) + 1
    try:
        score, found = cv2.findTransformECC(t.image, grey, first, cv2.MOTION_AFFINE, criteria, everywhere, blur)
    except cv2.error:  # it does not converge: there is no such mark here
        return None
    warp = np.asarray(found, float)
    moved = np.linalg.norm(warp[:, :2] @ t.point + warp[:, 2] - start)
    stretch = np.linalg.svd(warp[:, :2], compute_uv=False)
    if score < SCORE or moved > 0.5 * scale * max(t.image.shape) or not 0.7 < stretch[1] / stretch[0]:
        return None
    return warp, float(score)


def agreed_homography(pixel: Array, plane: Array) -> tuple[NDArray[np.bool_], Array, float]:
    """Homography by least squares on the plane, without marks that the others contradict; σ of a mark [mm].

    Four marks fit any homography: then none can be set aside and σ is `PRIOR_SIGMA`.
    """
    used = np.ones(len(pixel), bool)
    while True:
        homography = _fit(pixel[used], plane[used])
        sigma = _sigma(plane[used] - to_plane(homography, pixel[used]))
        if used.sum() < 6:
            break
        # What a mark alone adds: how far the others would put it from its place, in its own sigma.
        worst, index = 0.0, -1
        for i in np.flatnonzero(used):
            others = used.copy()
            others[i] = False
            h = _fit(pixel[others], plane[others])
            s = _sigma(plane[others] - to_plane(h, pixel[others]))
            jacobian = homography_jacobian(pixel[others], plane[others], pixel[i])
            spread = s * np.sqrt(1 + np.einsum("ij,ij->i", jacobian, jacobian).max())
            off = float(np.linalg.norm(plane[i] - to_plane(h, pixel[i])) / spread)
            if off > worst:
                worst, index = off, int(i)
        if worst < OUTLYING:
            break
        used[index] = False
    return used, homography, sigma


def _sigma(residual: Array) -> float:
    """σ of a mark per coordinate, the prior counted as `PRIOR_DOF` observations."""
    dof = max(residual.size - 8, 0)
    return float(np.sqrt((PRIOR_DOF * PRIOR_SIGMA**2 + (residual**2).sum() * (dof > 0)) / (PRIOR_DOF + dof)))


def _fit(pixel: Array, plane: Array) -> Array:
    homography, _ = cv2.findHomography(pixel[:, None], plane[:, None], 0)
    if homography is None:
        raise BenchsimError("the marks found lie on one line; photograph all of the target's marks")
    return np.asarray(homography, float)


def to_plane(homography: Array, pixel: Array) -> Array:
    """Pixels (..., 2) on the plane, (..., 2) mm."""
    flat = np.asarray(pixel, float).reshape(-1, 1, 2)
    return np.asarray(cv2.perspectiveTransform(flat, homography), float).reshape(np.shape(pixel))


def inverse(homography: Array) -> Array:
    """From plane to pixel."""
    return np.asarray(np.linalg.inv(homography), float)


def homography_jacobian(pixel: Array, plane: Array, at: Array) -> Array:
    """Derivative of a pixel's place on the plane by the marks' places there, (2, 2 n), by differences."""
    step = 1.0
    columns = []
    for i in range(plane.size):
        shift = step * (np.arange(plane.size) == i).reshape(plane.shape)
        columns.append((to_plane(_fit(pixel, plane + shift), at) - to_plane(_fit(pixel, plane - shift), at)) / 2 / step)
    return np.stack(columns, axis=-1)


def _inset(t: Template, warp: Array, homography: Array) -> Array:
    """Half a bar inward from the surveyed point, on the plane [mm]; along a bar that ends there alone."""
    inward = {"left": (1, 0), "right": (-1, 0), "top": (0, 1), "bottom": (0, -1), "middle": (0, 0)}
    step = t.bar / 2 * np.sum([inward[w] for w in t.name.split("_")], axis=0)
    ends = [warp[:, :2] @ p + warp[:, 2] for p in (t.point, t.point + step)]
    a, b = to_plane(homography, np.array(ends))
    return b - a


def _ink(shape: tuple[int, ...], found: list[tuple[Template, Array, float]]) -> NDArray[np.bool_]:
    """The marks' own pixels, grown by half a bar: their soft edges and the halo that a camera's sharpening leaves."""
    ink = np.zeros(shape, np.uint8)
    for t, warp, _ in found:
        grown = cv2.dilate(t.ink.astype(np.uint8), np.ones((int(t.bar) | 1, int(t.bar) | 1), np.uint8))
        ink |= np.asarray(cv2.warpAffine(grown, warp, shape[::-1], flags=cv2.INTER_NEAREST), np.uint8)
    return ink.astype(bool)
