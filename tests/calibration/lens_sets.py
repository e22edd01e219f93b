"""Sets of views without photographs: corners as `find_marks` would give them, with noise of a known covariance."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from benchsim.bench.model import Camera, Marks
from benchsim.boards import lay_out
from benchsim.calibration.model import predict, project, spreading
from benchsim.trace.marks import MarkObservations, board_corners

SIZE = (1200, 900)
LENS = np.array([900.0, 607.0, 441.0, 0.09, -0.2, 4e-4, -3e-4, 0.08])
NOISE = 0.02

CAMERA = Camera("A", SIZE, 1200.0, (599.5, 449.5), bit_depth=8, gamma="unknown", saturation_level=255.0)


def board() -> Marks:
    return lay_out((500.0, 400.0), 30.0).marks


def poses(rng, count=8, tilt=(15, 45), distance=(480, 750)):
    out = []
    for k in range(count):
        angle, way = np.radians(rng.uniform(*tilt)), 2 * np.pi * (k + rng.uniform(-0.2, 0.2)) * 3 / count
        turn = Rotation.from_rotvec(angle * np.array([np.cos(way), np.sin(way), 0]))
        turn = Rotation.from_rotvec([0, 0, np.radians(rng.choice([0, 90]) + rng.normal(0, 5))]) * turn
        aside = rng.uniform(-40, 40, 2)
        out.append(np.concatenate([turn.as_rotvec(), aside, [rng.uniform(*distance)]]))
    return np.array(out)


def views(
    rng, poses, *, lens=LENS, shape=(0, 0, 0, 0, 0), places=None, spread=(0, 0, 0), focal=None, point=None, noise=NOISE
):
    """Observations of a set. ``shape``: the board's five, bows in mm; ``focal``, ``point``: of every view its own."""
    marks = board()
    meant = board_corners(marks)
    size = float(np.abs(meant).max())
    shape = np.array(shape, float) / [1, 1, size, size, size]
    moved = meant if places is None else meant + np.asarray(places)[:, None]
    out = []
    for k, pose in enumerate(poses):
        own = np.array(lens, float)
        own[0] *= 1.0 if focal is None else focal[k]
        own[1:3] += 0.0 if point is None else point[k]
        pixels, _ = project(own, shape, pose, moved, size)
        inside = ((pixels > 5) & (pixels < np.array(SIZE) - 6)).all(axis=(1, 2))
        pixels = pixels[inside]
        pixels = pixels + spreading(pixels) @ np.array(spread, float)
        n = int(inside.sum())
        # Corners of a mark share edges: neighbours are correlated.
        joint = noise**2 * (np.eye(8) + 0.3 * (np.roll(np.eye(8), 2, axis=0) + np.roll(np.eye(8), -2, axis=0)))
        error = rng.multivariate_normal(np.zeros(8), joint, n).reshape(n, 4, 2)
        blocks = np.broadcast_to(joint, (n, 8, 8))
        out.append(
            MarkObservations(
                name=f"{k:02d}.jpg",
                ids=np.array(marks.ids)[inside],
                corners=pixels + error,
                covariance=np.stack([blocks[:, 2 * i : 2 * i + 2, 2 * i : 2 * i + 2] for i in range(4)], axis=1),
                joint=blocks,
                board=meant[inside],
                measured=np.ones((n, 4), bool),
                blur=np.ones(n),
            )
        )
    return out


__all__ = ["CAMERA", "LENS", "NOISE", "SIZE", "board", "poses", "predict", "views"]
