"""Find the board's marks in a photograph and measure their corners.

OpenCV finds and reads the AprilTags 36h11; the corners come from lines fitted to the four edges of the black square
(`edges`), because a detector's own corners are ten times coarser.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Camera, Marks
from benchsim.trace.edge_pixels import CELLS, OUTLIER_SIGMA, Edges, intersections
from benchsim.trace.edges import EdgeFit, fit_edges
from benchsim.trace.image import Photograph
from benchsim.trace.lens import distort, distortion_jacobian, undistort

Array = NDArray[np.float64]

FEWEST_MARKS = 3
"""One mark determines a pose (8 numbers, 6 unknowns) but says nothing of its errors; of two that contradict each other
none can be told to be the wrong one; of three, two outvote the third."""

SMALLEST_SIDE = 10
"""Marks smaller than this are not looked for [px]: a cell would be 1.25 px."""

SMALL_SIDE = 24
"""Where marks are smaller than this [px], or none is found, they are looked for again in a picture enlarged twice: the
detector wants three pixels for a cell."""

BRACKET = 4.0
"""Ratio of successive white levels under which marks are looked for, from the brightest pixel down to the noise."""

COARSE_SIGMA = 1.5
"""Error of the detector's own corners, each coordinate [px]: 0.5 to 1 px rms on photographs of other code."""

RASTER, RUN = 0.027, 0.1
"""1 sigma of the place of an edge that runs along the pixels, and the run across them that halves its variance [px].

All of such an edge lies at one place within its pixels, and what the print's dots or a renderer's rays make of it does
not average out: on 3900 edges of other code the error is 0.025 px where an edge crosses less than 0.1 px from end to
end, 0.014 to 0.25 px, 0.006 to 0.5 px, and the noise's own 0.004 px beyond. Without it the worst marks are ten sigma
off, and they stay so from picture to picture; with it a mark that stands square in a perfect picture counts for less.
"""

GAMMA_RANGE = (0.4, 3.0)
"""Where an unknown gamma is looked for, over what the picture was read with: 1 is that, 2.2 a display's."""

CURVED_RANGE = (0.7, 1.4)
"""The same where a curve was taken back already: sharpening makes edges lopsided too, and no power may stand for it."""

GUESS_MARKS = 8
"""Marks by which an unknown gamma is judged."""

_DICTIONARY = cv2.aruco.DICT_APRILTAG_36h11


@dataclass(frozen=True)
class MarkObservations:
    """Marks as they stand in one photograph.

    Attributes
    ----------
    name : str
        The image, for messages.
    ids : (n,) int
    corners : (n, 4, 2) px
        Of the black square: top left as seen upright from the mirror's side (y small, z large), then clockwise.
        Pixels of the photograph, distortion included.
    covariance : (n, 4, 2, 2) px²
        Of each corner. Corners of one mark share edges: use ``joint`` where they are used together.
    joint : (n, 8, 8) px²
        Of the eight coordinates of each mark, in the order of ``corners.reshape(n, 8)``.
    board : (n, 4, 2) mm
        Nominal (y, z) of the corners.
    measured : (n, 4) bool
        False for a corner next to an edge that is covered or saturated: it stands where the detector saw it, and its
        covariance says so.
    blur : (n,) px
        Standard deviation of the picture's blur at each mark, the pixel's own width included.
    unknown : tuple of int
        Ids that were read but are not in the board's list.
    dropped : tuple of (int, str)
        Ids that were found but are not used, and why.
    gamma : float, or None
        Guess of what an unknown gamma leaves in the light as it was read: 1 where that reading was right.
    shared : (n, 8, 8) px², or None
        Part of ``joint`` that another picture of the same pose has too: where edges run along the pixels.
    motion : (3, 3), or None
        Homography to the pixels of the dark picture, where the camera moved in between; see `motion.motion`.
    """

    name: str
    ids: NDArray[np.intp]
    corners: Array
    covariance: Array
    joint: Array
    board: Array
    measured: NDArray[np.bool_]
    blur: Array
    unknown: tuple[int, ...] = ()
    dropped: tuple[tuple[int, str], ...] = ()
    gamma: float | None = None
    motion: Array | None = None
    shared: Array | None = None


def board_corners(marks: Marks) -> Array:
    """Nominal corners (y, z) of every mark, (n, 4, 2) mm: top left, then clockwise, seen from the mirror's side."""
    centres = np.asarray(marks.centres, float).reshape(-1, 1, 2)
    half = np.asarray(marks.sides, float)[:, None, None] / 2
    return centres + half * np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])


def find_marks(photograph: Photograph, marks: Marks | None, camera: Camera) -> MarkObservations:
    """Find all marks of the board and measure their corners.

    Parameters
    ----------
    photograph : Photograph
    marks : Marks
        The board's list; other ids are reported, not used.
    camera : Camera
        Its distortion is used: edges are straight only where it is undone.

    Returns
    -------
    MarkObservations

    Raises
    ------
    BenchsimError
        No marks, or fewer than three that can be used; names the image and the mend.

    Notes
    -----
    Corners are unbiased under any symmetric blur. A line of light across a mark is left out; an edge that is more
    than half covered is not measured, and a mark with fewer than two measured edges is dropped. Where the
    camera's gamma is not known, what `read_image` left of it is guessed from the shape of the edges, which a wrong
    gamma makes lopsided and moves: sRGB read as linear puts them 0.4 px off, with the guess 0.02 px. Marks of less than
    20 px come out up to 0.03 px too large, of less than 14 px they are often missed; blur beyond a third of a cell has
    the same effect.
    """
    if marks is None or not marks.ids:
        raise BenchsimError(f"{photograph.name}: the recording lists no marks to look for; add screen.marks")
    found, twice = _detect(photograph, set(marks.ids))
    known = [i for i in found if i in marks.ids]
    unknown = tuple(sorted(set(found) - set(marks.ids)))
    dropped = [(i, "two marks carry this id") for i in sorted(twice)]
    if not known:
        other = f"; the ids {', '.join(map(str, unknown))} in it are not the board's" if unknown else ""
        raise BenchsimError(
            f"{photograph.name}: none of the board's marks found{other}; check that it shows the board, in focus, "
            f"not mirrored and not overexposed, and that screen.marks lists its marks"
        )
    coarse = np.array([found[i] for i in known])
    _check_lens(photograph.name, camera, coarse)
    measured = _measure(photograph, camera, np.array(known), coarse)
    good = np.array([reason == "" for reason in measured.reasons])
    dropped += [(i, reason) for i, reason in zip(known, measured.reasons, strict=True) if reason]
    if good.sum() < FEWEST_MARKS:
        why = "; ".join(f"{i}: {reason}" for i, reason in dropped)
        raise BenchsimError(
            f"{photograph.name}: {good.sum()} of the board's {len(marks.ids)} marks can be used and {FEWEST_MARKS} are "
            f"needed{f' ({why})' if why else ''}; show more of the board, sharper or larger"
        )
    ids = np.array(known)[good]
    joint = measured.joint[good]
    blocks = joint.reshape(-1, 4, 2, 4, 2)
    index = [marks.ids.index(i) for i in ids]
    return MarkObservations(
        name=photograph.name,
        ids=ids,
        corners=measured.corners[good],
        covariance=np.stack([blocks[:, k, :, k] for k in range(4)], axis=1),
        joint=joint,
        board=board_corners(marks)[index],
        measured=measured.measured[good],
        blur=measured.blur[good],
        unknown=unknown,
        dropped=tuple(dropped),
        gamma=measured.gamma,
        shared=measured.shared[good],
    )


def _check_lens(name: str, camera: Camera, corners: Array) -> None:
    """Raise BenchsimError where the stated distortion folds the picture over at a mark, or nearly so."""
    ideal = undistort(camera, corners)
    if np.isfinite(ideal).all():
        stretch = np.linalg.det(distortion_jacobian(camera, ideal))
        if ((stretch > 0.1) & (stretch < 10)).all():
            return
    raise BenchsimError(
        f"{name}: the lens of camera {camera.name} cannot be undone at the marks; mend its distortion, focal_px or "
        "principal_point_px"
    )


def _detect(photograph: Photograph, wanted: set[int]) -> tuple[dict[int, Array], set[int]]:
    """Coarse corners by id, and ids seen twice; several exposures of the 8-bit picture that the detector needs."""
    light = photograph.marks_light
    parameters = cv2.aruco.DetectorParameters()
    parameters.minMarkerPerimeterRate = 4 * SMALLEST_SIDE / max(light.shape)
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(_DICTIONARY), parameters)
    noise = 1.4826 * float(np.median(np.abs(np.diff(light[::8], axis=1))))
    darkest = max(4 * noise, 1.0)
    found: dict[int, Array] = {}
    twice: set[int] = set()
    for enlarged in (1, 2):
        white = float(light.max())
        last, aimed = darkest, False
        while white > last and not wanted <= found.keys():
            grey = cv2.convertScaleAbs(np.maximum(light, 0), alpha=255 / white)
            if enlarged > 1:
                grey = cv2.resize(grey, None, fx=enlarged, fy=enlarged, interpolation=cv2.INTER_CUBIC)
            corners, ids, _ = detector.detectMarkers(grey)
            seen = [] if ids is None else [int(i) for i in ids.ravel()]
            twice |= {i for i in seen if seen.count(i) > 1}
            for i, quad in zip(seen, corners, strict=True):
                # Pixel centres are whole numbers: (0, 0) of the picture is (0.5, 0.5) of one enlarged twice.
                found.setdefault(i, (np.asarray(quad, float).reshape(4, 2) + 0.5) / enlarged - 0.5)
            white /= BRACKET
            if found and not aimed:
                aimed = True
                # Just below the white of the marks found: there a line of light across a mark spoils fewest cells.
                white = _white_of(light, np.array(list(found.values())))
                last = max(white / (1.1 * BRACKET), darkest)
        sides = [np.linalg.norm(quad[1] - quad[0]) for quad in found.values()]
        if sides and np.median(sides) > SMALL_SIDE:
            break
    return {i: quad for i, quad in sorted(found.items()) if i not in twice}, twice & wanted


def _white_of(light: NDArray[np.float32], quads: Array) -> float:
    """Median light of the white margins of marks, half a cell outside their corners."""
    centre = quads.mean(axis=1, keepdims=True)
    margin = np.rint(centre + (quads - centre) * (1 + 1 / CELLS)).astype(int).reshape(-1, 2)
    h, w = light.shape
    return float(np.median(light[np.clip(margin[:, 1], 0, h - 1), np.clip(margin[:, 0], 0, w - 1)]))


@dataclass(frozen=True)
class _Measured:
    """Corners (n, 4, 2), their joint covariance (n, 8, 8) and what of it pictures share, which are measured (n, 4),
    blur (n,), why a mark cannot be used ("" if it can), and the gamma if it was guessed."""

    corners: Array
    joint: Array
    shared: Array
    measured: NDArray[np.bool_]
    blur: Array
    reasons: list[str]
    gamma: float | None


def _measure(photograph: Photograph, camera: Camera, ids: NDArray[np.intp], coarse: Array) -> _Measured:
    n = len(ids)
    quad = undistort(camera, coarse)
    dictionary = cv2.aruco.getPredefinedDictionary(_DICTIONARY)
    white = [cv2.aruco.generateImageMarker(dictionary, int(i), CELLS, borderBits=1) > 0 for i in ids]
    inner = np.array([np.rot90(cells, k)[1] for cells in white for k in range(4)])
    quantum = float(np.max(photograph.light_per_count)) ** 2 / 12
    edges = Edges(quad, inner)
    light, gamma = photograph.marks_light, None
    if not photograph.linear:
        gamma = _guess_gamma(photograph, camera, edges, coarse, quantum)
        light, quantum = _raised(light, gamma), gamma**2 * quantum
    fit = fit_edges(light, photograph.marks_saturated, camera, edges, quantum)
    good = _good_edges(fit)
    fit = _with_coarse(fit, edges, good)
    ideal, joint = _intersect(fit, n)
    raster = np.zeros_like(fit.covariance)
    raster[:, 0, 0] = RASTER**2 / (1 + (_run_across(camera, fit, edges) / RUN) ** 2)
    _, shared = _intersect(replace(fit, covariance=raster), n)
    jacobian = np.zeros((n, 8, 8))
    local = distortion_jacobian(camera, ideal)
    for k in range(4):
        jacobian[:, 2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = local[:, k]
    joint, shared = (jacobian @ c @ jacobian.transpose(0, 2, 1) for c in (joint, shared))
    joint = joint + shared
    corners = distort(camera, ideal)
    by_mark = good.reshape(n, 4)
    measured = by_mark & np.roll(by_mark, 1, axis=1)
    reasons = _reasons(by_mark, corners, coarse, photograph)
    return _Measured(corners, joint, shared, measured, np.median(fit.blur.reshape(n, 4), axis=1), reasons, gamma)


def _run_across(camera: Camera, fit: EdgeFit, edges: Edges) -> Array:
    """How far each edge runs across the rows or columns that it follows, from end to end (e,) [px]."""
    half = 0.5 * np.linalg.norm(edges.end - edges.start, axis=1)[:, None] * fit.along
    run = np.abs(np.diff(distort(camera, np.stack([fit.point - half, fit.point + half], axis=1)), axis=1)[:, 0])
    return np.asarray(run.min(axis=1))


def _raised(light: NDArray[np.float32], gamma: float) -> NDArray[np.float32]:
    """Light to a power, odd about zero, of the same size at its brightest."""
    top = max(float(light.max()), 1e-6)
    return (np.sign(light) * np.abs(light / top) ** np.float32(gamma) * top).astype(np.float32)


def _guess_gamma(photograph: Photograph, camera: Camera, edges: Edges, coarse: Array, quantum: float) -> float:
    """The gamma left in the light: it makes edges of `GUESS_MARKS` marks look most like symmetrically blurred steps."""
    some = np.unique(np.linspace(0, len(coarse) - 1, GUESS_MARKS).astype(int))
    part = Edges(edges.corners[some], edges.inner.reshape(-1, 4, CELLS)[some].reshape(-1, CELLS))
    h, w = photograph.shape
    low = np.clip(np.floor(coarse[some].min(axis=(0, 1)) - 20), 0, [w, h]).astype(int)
    high = np.clip(np.ceil(coarse[some].max(axis=(0, 1)) + 20), 0, [w, h]).astype(int)
    window = (slice(low[1], high[1]), slice(low[0], high[0]))
    (cu, cv) = camera.principal_point
    moved = replace(camera, principal_point=(cu - low[0], cv - low[1]))
    part = replace(part, corners=part.corners - low)

    def roughness(gamma: float) -> float:
        light = _raised(photograph.marks_light[window], gamma)
        fit = fit_edges(light, photograph.marks_saturated[window], moved, part, gamma**2 * quantum)
        return float(np.median(np.where(fit.used >= 0.5, fit.scatter, 1.0)))

    bounds = CURVED_RANGE if photograph.light_per_count.ndim else GAMMA_RANGE
    return float(minimize_scalar(roughness, bounds=bounds, method="bounded", options={"xatol": 0.03}).x)


def _good_edges(fit: EdgeFit) -> NDArray[np.bool_]:
    """Edges that were seen over half their length, dark inside, and no rougher than the picture's others."""
    rough = fit.scatter > OUTLIER_SIGMA * np.median(fit.scatter)
    found = np.isfinite(fit.covariance).all(axis=(1, 2)) & np.isfinite(fit.point).all(axis=1)
    return found & (fit.used >= 0.5) & (fit.contrast > 0) & ~rough


def _with_coarse(fit: EdgeFit, edges: Edges, good: NDArray[np.bool_]) -> EdgeFit:
    """Edges that could not be measured lie where the detector saw them, with its own coarse error."""
    run = edges.end - edges.start
    length = np.linalg.norm(run, axis=1)
    along = np.where(good[:, None], fit.along, run / length[:, None])
    coarse = np.zeros_like(fit.covariance)
    coarse[:, 0, 0] = COARSE_SIGMA**2 / 2
    coarse[:, 1, 1] = 2 * (COARSE_SIGMA / length) ** 2
    return replace(
        fit,
        point=np.where(good[:, None], fit.point, (edges.start + edges.end) / 2),
        along=along,
        normal=np.stack([along[:, 1], -along[:, 0]], axis=1),
        covariance=np.where(good[:, None, None], fit.covariance, coarse),
    )


def _intersect(fit: EdgeFit, n: int) -> tuple[Array, Array]:
    """Corners from lines, undistorted pixels, with the covariance of all eight coordinates."""
    along, point = (x.reshape(n, 4, 2) for x in (fit.along, fit.point))
    corners, by_place = intersections(point, along)
    jacobian = np.zeros((n, 8, 8))
    for k in range(4):
        for column, e in enumerate(((k - 1) % 4, k)):
            s = ((corners[:, k] - point[:, e]) * along[:, e]).sum(axis=-1)
            jacobian[:, 2 * k : 2 * k + 2, 2 * e] = by_place[:, k, :, column]
            jacobian[:, 2 * k : 2 * k + 2, 2 * e + 1] = by_place[:, k, :, column] * s[:, None]
    edges = np.zeros((n, 8, 8))
    for e in range(4):
        edges[:, 2 * e : 2 * e + 2, 2 * e : 2 * e + 2] = fit.covariance.reshape(n, 4, 2, 2)[:, e]
    return corners, jacobian @ edges @ jacobian.transpose(0, 2, 1)


def _reasons(good: NDArray[np.bool_], corners: Array, coarse: Array, photograph: Photograph) -> list[str]:
    side = np.linalg.norm(np.roll(coarse, -1, axis=1) - coarse, axis=-1).min(axis=1)
    moved = np.linalg.norm(corners - coarse, axis=-1).max(axis=1)
    h, w = photograph.shape
    outside = np.any((corners < 1) | (corners > np.array([w - 2, h - 2])), axis=(1, 2))
    reasons = []
    for i in range(len(corners)):
        if outside[i]:
            reasons.append("at the picture's border")
        elif good[i].sum() < 2:
            reasons.append("covered or saturated")
        elif moved[i] > max(2 * COARSE_SIGMA, side[i] / CELLS):
            reasons.append("its edges cannot be followed")
        else:
            reasons.append("")
    return reasons
