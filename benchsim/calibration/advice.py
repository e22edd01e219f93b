"""How well a calibration fixes the lens, and which further views would fix what it leaves open.

Views are weighed before they are taken: their derivatives need no photograph.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchsim.bench.model import Marks
from benchsim.calibration.model import LENS, OWN, SHARED, project, spreading
from benchsim.calibration.solve import Bundle
from benchsim.trace.lens import distort, distortion_jacobian
from benchsim.trace.marks import FEWEST_MARKS, board_corners

Array = NDArray[np.float64]

TARGETS = {"focal length": 1e-3, "principal point": 1e-3, "lines of sight": 3e-4}
"""1 σ above which a quantity is called poorly fixed: of the focal length as a fraction, the others in units of the
picture's longer side. A tenth of a percent of focal length is a third of what the bench's own settings leave open."""

MOST_VIEWS = 6
"""Views that are suggested at most."""

TILT = 40.0
"""Of suggested views to the board's normal [deg]: the focal length shows in the square of its sine, and marks are still
read."""

STEPS = (25, 19)
"""Points of the map of the lines of sight, across and down."""

HEAD_ON = "head on, the board's image in the picture's {} corner, half as large"


@dataclass(frozen=True)
class Advice:
    """What is poorly fixed and what would mend it.

    Attributes
    ----------
    sigma : mapping of str to float
        By the names of `TARGETS`, in their units.
    poor : tuple of str
        Those above their target.
    views : tuple of str
        Views to add, the most useful first; empty where nothing is poor.
    then : mapping of str to float
        ``sigma`` with them.
    """

    sigma: dict[str, float]
    poor: tuple[str, ...]
    views: tuple[str, ...]
    then: dict[str, float]


def sight(bundle: Bundle, covariance: Array | None = None) -> tuple[Array, Array, Array]:
    """1 σ of where the picture shows a given line of sight, all over the picture.

    A turn of the whole camera is taken out: every picture's pose is solved from its own marks and absorbs it (as in
    mrcal's projection uncertainty).

    Returns
    -------
    u, v : (n,) px
        Columns and rows of the map.
    sigma : (len(v), len(u)) px
        Root of the larger eigenvalue of the pixel's covariance.
    """
    covariance = bundle.covariance if covariance is None else covariance
    w, h = bundle.camera.resolution
    u, v = np.linspace(0, w - 1, STEPS[0]), np.linspace(0, h - 1, STEPS[1])
    # Undistorted points spread over the picture; where the lens puts them is where the map holds.
    ideal = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    camera = bundle.camera
    normal = (ideal - np.asarray(camera.principal_point)) / camera.focal
    by_lens = _by_lens(bundle, normal, ideal)
    x, y = normal.T
    turn = np.stack(
        [np.stack([-x * y, 1 + x * x, -y], axis=-1), np.stack([-1 - y * y, x * y, x], axis=-1)], axis=1
    ) * camera.focal  # fmt: skip
    turn = distortion_jacobian(camera, ideal) @ turn
    flat = turn.reshape(-1, 3)
    absorbed = flat @ np.linalg.lstsq(flat, by_lens.reshape(-1, len(LENS)), rcond=None)[0]
    left = (by_lens.reshape(-1, len(LENS)) - absorbed).reshape(-1, 2, len(LENS))
    blocks = left @ covariance[: len(LENS), : len(LENS)] @ left.transpose(0, 2, 1)
    return u, v, np.sqrt(np.linalg.eigvalsh(blocks)[:, -1]).reshape(len(v), len(u))


def _by_lens(bundle: Bundle, normal: Array, ideal: Array) -> Array:
    """d(pixel)/d(lens), (n, 2, 8), at fixed slopes of the line of sight."""
    x, y = normal.T
    r2, f = x * x + y * y, bundle.camera.focal
    out = np.zeros((len(x), 2, len(LENS)))
    out[..., 0] = (distort(bundle.camera, ideal) - np.asarray(bundle.camera.principal_point)) / f
    out[:, 0, 1] = out[:, 1, 2] = 1.0
    for column, power in ((3, r2), (4, r2**2), (7, r2**3)):
        out[..., column] = f * normal * power[:, None]
    out[:, 0, 5], out[:, 1, 5] = f * 2 * x * y, f * (r2 + 2 * y * y)
    out[:, 0, 6], out[:, 1, 6] = f * (r2 + 2 * x * x), f * 2 * x * y
    return out


def advise(bundle: Bundle, marks: Marks) -> Advice:
    """Judge a calibration by `TARGETS`, and look for views that would meet them."""
    sigma = _sigma(bundle, bundle.covariance)
    poor = tuple(name for name, limit in TARGETS.items() if sigma[name] > limit)
    views: list[str] = []
    covariance, then = bundle.covariance, sigma
    if poor:
        candidates = _candidates(bundle, marks)
        while len(views) < MOST_VIEWS and candidates and any(then[name] > TARGETS[name] for name in TARGETS):
            added = {name: _with(covariance, information) for name, information in candidates.items()}
            best = min(added, key=lambda name: _worst(_sigma(bundle, added[name])))
            views.append(best)
            covariance = added[best]
            then = _sigma(bundle, covariance)
            del candidates[best]
    return Advice(sigma, poor, tuple(views), then)


def _sigma(bundle: Bundle, covariance: Array) -> dict[str, float]:
    longer = max(bundle.camera.resolution)
    sigma = np.sqrt(np.diag(covariance))
    return {
        "focal length": float(sigma[0] / bundle.lens[0]),
        "principal point": float(max(sigma[1:3]) / longer),
        "lines of sight": float(sight(bundle, covariance)[2].max() / longer),
    }


def _worst(sigma: dict[str, float]) -> float:
    return max(sigma[name] / limit for name, limit in TARGETS.items())


def _with(covariance: Array, information: Array) -> Array:
    """(C⁻¹ + I)⁻¹ without inverting a C that may hold parameters known exactly in practice."""
    size = np.sqrt(np.diag(covariance))
    scaled = covariance / np.outer(size, size)
    return (scaled @ np.linalg.inv(np.eye(len(size)) + information * np.outer(size, size) @ scaled)) * np.outer(
        size, size
    )


def _candidates(bundle: Bundle, marks: Marks) -> dict[str, Array]:
    """What views would tell of lens and board, (13, 13) each, by what a person is to do."""
    corners = board_corners(marks)
    extent = np.abs(corners).reshape(-1, 2).max(axis=0)
    w, h = bundle.camera.resolution
    f = bundle.lens[0]
    fill = f * max(2 * extent[0] / (0.9 * w), 2 * extent[1] / (0.9 * h))
    poses = {
        "from the left": (_from(0, -TILT), 1.25, (0, 0)),
        "from the right": (_from(0, TILT), 1.25, (0, 0)),
        "from above": (_from(TILT, 0), 1.25, (0, 0)),
        "from below": (_from(-TILT, 0), 1.25, (0, 0)),
    }
    poses = {f"{k}, {TILT:.0f}° off the board's normal, the board filling the picture": p for k, p in poses.items()}
    poses |= {
        f"{k}, {TILT:.0f}° off the board's normal, the camera turned upright": (
            Rotation.from_euler("z", 90, degrees=True) * p, 1.5, (0, 0)
        )
        for k, p in {"from the left": _from(0, -TILT), "from above": _from(TILT, 0)}.items()
    }  # fmt: skip
    poses |= {
        HEAD_ON.format(f"{a} {b}"): (_from(0, 0), 2.0, (i, j))
        for a, j in (("upper", -1), ("lower", 1))
        for b, i in (("left", -1), ("right", 1))
    }
    poses["head on, so close that the outermost marks are just inside the picture"] = (_from(0, 0), 1.0, (0, 0))
    out = {}
    for name, (turn, far, corner) in poses.items():
        # Turned toward the picture's corner: half of what is left beside the board's image.
        aside = np.array(corner) * 0.25 * np.array([w, h]) / f
        pose = np.concatenate([turn.as_rotvec(), fill * far * np.array([*aside, 1.0])])
        information = _information(bundle, corners, pose)
        if information is not None:
            out[name] = information
    return out


def _from(up: float, right: float) -> Rotation:
    """Of the points (y, −z, −x) into the frame of a camera that stands above or to the right of the board [deg]."""
    return Rotation.from_euler("yx", [right, up], degrees=True)


def _information(bundle: Bundle, corners: Array, pose: Array) -> Array | None:
    """Information of a view on lens and board, pose and spread marginalised; its noise is the median of the views'."""
    size = float(np.abs(corners).max())
    board = bundle.board / np.array([1, 1, size, size, size])
    pixels, by = project(bundle.lens, board, pose, corners, size)
    inside = ((pixels > 3) & (pixels < np.array(bundle.camera.resolution) - 4)).all(axis=(1, 2))
    if inside.sum() < FEWEST_MARKS:
        return None
    noise = float(np.median(bundle.rms))
    by = np.concatenate([by, spreading(pixels)], axis=-1)[inside].reshape(-1, SHARED + 2 + OWN) / noise
    by[:, 10:13] /= size  # bow and twist in mm, as in the bundle's covariance
    shared, own = by[:, :SHARED], by[:, SHARED + 2 :]
    return shared.T @ (shared - own @ np.linalg.lstsq(own, shared, rcond=None)[0])
