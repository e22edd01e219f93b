"""The camera and the board's print from the contract's words: OpenCV's pinhole, marks, and a pose solved from them."""

from __future__ import annotations

import numpy as np
from first_principles import turn, unit
from scipy.optimize import least_squares


def look(camera):
    """Nominal pose: "looks at `look_at_mm` without roll: rows run downward, right = forward × z"."""
    position = np.array(camera.position)
    forward = unit(np.array(camera.look_at) - position)
    right = unit(np.cross(forward, [0.0, 0.0, 1.0]))
    rotation = np.array([right, np.cross(forward, right), forward])
    return rotation, -rotation @ position


def project(camera, rotation, translation, x, extra=(0.0, 0.0, 0.0, 0.0)):
    """Pixels of board-frame points (..., 3); ``extra`` is added to OpenCV's k1 k2 p1 p2."""
    c = x @ np.transpose(rotation) + translation
    a, b = c[..., 0] / c[..., 2], c[..., 1] / c[..., 2]
    k1, k2, p1, p2 = np.array(camera.distortion[:4]) + extra
    k3 = camera.distortion[4]
    s = a * a + b * b
    radial = 1.0 + s * (k1 + s * (k2 + s * k3))
    u = a * radial + 2.0 * p1 * a * b + p2 * (s + 2.0 * a * a)
    v = b * radial + p1 * (s + 2.0 * b * b) + 2.0 * p2 * a * b
    return np.stack([u, v], -1) * camera.focal + np.array(camera.principal_point)


def printed(places, gs=0.0, ga=0.0, gsh=0.0):
    """Where marks printed at nominal places lie on the board, in 1e-3."""
    y, z = places[..., 0], places[..., 1]
    gs, ga, gsh = 1e-3 * gs, 1e-3 * ga, 1e-3 * gsh
    return np.stack([(1.0 + gs + ga) * y + gsh * z, (1.0 + gs - ga) * z + gsh * y], -1)


def raised(board, bow_y=0.0, bow_z=0.0):
    """Board-frame points (..., 3) of board coordinates on the bowed board."""
    height = 0.5e-3 * (bow_y * board[..., 0] ** 2 + bow_z * board[..., 1] ** 2)
    return np.concatenate([height[..., None], board], -1)


def corners(marks):
    """Nominal corners (marks, 4, 2) of the black squares."""
    square = 0.5 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return np.array(marks.centres)[:, None] + np.array(marks.sides)[:, None, None] * square


def solve(camera, pixels, places, start):
    """Pose (R, t) of the flat stated board in the stated camera by least squares of all corners; and what is left."""
    rotation, translation = start
    flat = raised(places.reshape(-1, 2))

    def miss(p):
        return (project(camera, turn(p[:3]) @ rotation, translation + p[3:], flat) - pixels.reshape(-1, 2)).ravel()

    scale = np.array([1e-3] * 3 + [1.0] * 3)
    found = least_squares(miss, np.zeros(6), x_scale=scale, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return (turn(found.x[:3]) @ rotation, translation + found.x[3:]), found.fun.reshape(-1, 2)


def read(camera, pose, pixels):
    """Coordinates on the flat board that the stated camera reads from pixels, by Newton's method."""
    board = np.zeros_like(pixels)
    for _ in range(30):
        step = 1e-3
        at = project(camera, *pose, raised(board))
        jac = np.stack([(project(camera, *pose, raised(board + step * e)) - at) / step for e in np.eye(2)], -1)
        board = board + np.linalg.solve(jac, (pixels - at)[..., None])[..., 0]
    return board
