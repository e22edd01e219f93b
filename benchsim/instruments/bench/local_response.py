"""How the data of a block answer to displacements: of the light on the board or in the picture, or of the marks.

Displacements of the marks turn the solved pose, and with it all light; see `board_coordinates`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from benchsim.bench.curve import Curve, signed_distance
from benchsim.bench.place import Placement
from benchsim.instruments.bench import board_coordinates
from benchsim.instruments.bench.blocks import Block, size
from benchsim.instruments.bench.prediction import Predict
from benchsim.rays.prediction import bench_of
from benchsim.trace.pose import pose_derivatives

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Local:
    """One exposure linearised about the simulation in doubt.

    Attributes
    ----------
    block : Block
    board : (n, 2) mm
        True places of the light at the reference points.
    phase : (n,) rad
    level : (n,)
    across : (n, 2) 1/mm or 1/px
        Change of ``c`` per mm of the light's measured displacement on the board.
    pixel : (n, 2) px
    by_board : (n, 2, 2), by_height : (n, 2), by_pose : (n, 2, 6)
        Of the light's pixels.
    slope : (n, 2)
        d(y, z)/dx of the light that arrives.
    path : (n,) mm
        From the plane half way.
    crossing : (n, 2) mm
        World y, z there.
    corners_board, corners_pixel, corners_by_board, corners_by_height : (4 m, …)
        The same of the marks' corners.
    placement : Placement
        With what the simulation in doubt has moved and turned.
    """

    block: Block
    board: Array
    phase: Array
    level: Array
    across: Array
    pixel: Array
    by_board: Array
    by_height: Array
    by_pose: Array
    slope: Array
    path: Array
    crossing: Array
    corners_pixel: Array
    corners_by_board: Array
    corners_by_height: Array
    placement: Placement

    @property
    def corners_board(self) -> Array:
        return self.block.observed.view.corners


def local(predict: Predict, index: int) -> Local:
    """One exposure linearised; see `Local`."""
    b = predict.blocks[index]
    o, seen, truth = b.observed, b.observed.view, predict.recording
    exposure = truth.exposures[o.index]
    curve = predict.light({}, index, truth)
    assert curve.phase is not None
    level = np.interp(np.linspace(0, 1, len(curve.points)), np.linspace(0, 1, len(b.level)), b.level)
    measured = (
        board_coordinates.measured(truth, seen, curve.points, level)[0]
        if board_coordinates.active(truth)
        else curve.points
    )
    arc = Curve(measured).arc_length()
    s = np.clip(signed_distance(Curve(measured), o.points)[1], 0.0, arc[-1])
    tangent = CubicSpline(arc, measured)(s, 1)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    board = CubicSpline(arc, curve.points)(s)
    pose = board_coordinates.pose_of(seen)
    pixel, by_pose = pose_derivatives(pose, board)
    by_x = by_pose[..., 3:] @ seen.rotation
    placement = bench_of(truth, exposure).placement
    world = placement.screen_origin + board @ placement.screen_rotation[:, 1:].T
    way = world - placement.centre
    inside = way @ placement.screen_rotation
    share = 0.5 * (world[:, 0] - placement.centre[0]) / way[:, 0]
    corners_by_x = seen.by_pose[..., 3:] @ seen.rotation
    return Local(
        block=b,
        board=board,
        phase=CubicSpline(arc, curve.phase)(s),
        level=np.interp(s, arc, level),
        across=np.stack([-tangent[:, 1], tangent[:, 0]], axis=1),
        pixel=pixel,
        by_board=by_x[..., 1:],
        by_height=by_x[..., 0],
        by_pose=by_pose,
        slope=inside[:, 1:] / inside[:, :1],
        path=0.5 * np.linalg.norm(way, axis=1),
        crossing=(placement.centre + share[:, None] * way)[:, 1:],
        corners_pixel=seen.flat,
        corners_by_board=corners_by_x[..., 1:],
        corners_by_height=corners_by_x[..., 0],
        placement=placement,
    )


def push(at: Local, board: Array | None = None, light: Array | None = None, corners: Array | None = None) -> Array:
    """Data of one block per unit of K functions.

    Parameters
    ----------
    at : Local
    board : (n, K, 2) array [mm], optional
        Displacement of the light on the true board.
    light : (n, K, 2) array [px], optional
        Of the light in the picture.
    corners : (4 m, K, 2) array [px], optional
        Of the marks' corners in the picture.

    Returns
    -------
    (n_b, K) ndarray
        Rows of ``w`` and ``f`` are 0: their response is of second order.
    """
    given = next(x for x in (board, light, corners) if x is not None)
    k = given.shape[1]
    n = len(at.board)
    moved = np.zeros((n, k, 2))
    if board is not None:
        moved += np.einsum("nij,nkj->nki", at.by_board, board)
    if light is not None:
        moved += light
    out = np.zeros((size(at.block), k))
    if corners is not None:
        seen = at.block.observed.view
        delta = -seen.gain @ corners.transpose(0, 2, 1).reshape(-1, k)
        moved += np.einsum("nip,pk->nki", at.by_pose, delta)
        left = corners + np.einsum("nip,pk->nki", seen.by_pose, delta)
        centres = left.reshape(-1, 4, k, 2).mean(axis=1)[at.block.kept]
        rows = 2 * len(centres)
        if rows:
            out[-rows:] = centres.transpose(0, 2, 1).reshape(rows, k)
    out[:n] = np.einsum("nj,njk->nk", at.across, np.linalg.solve(at.by_board, moved.transpose(0, 2, 1)))
    return out


def tents(axes: Sequence[Array], *coordinates: Array) -> Array:
    """Multilinear weights (n, K) of points on a grid of knots, held beyond the outermost; as `fields.evaluate`.

    Parameters
    ----------
    axes : one growing array per coordinate; a single knot is a constant
    *coordinates : (n,) arrays
    """
    out = np.ones((len(coordinates[0]), 1))
    for knots, x in zip(axes, coordinates, strict=True):
        weight = np.ones((len(x), 1))
        if len(knots) > 1:
            place = np.interp(x, knots, np.arange(len(knots)))
            weight = np.maximum(0.0, 1.0 - np.abs(place[:, None] - np.arange(len(knots))[None, :]))
        out = (out[:, :, None] * weight[:, None, :]).reshape(len(x), -1)
    return out


def grid(axes: Sequence[Array], components: int) -> tuple[Array, NDArray[np.intp]]:
    """Knots (K, d), component after component, and the component of each."""
    mesh = np.stack([m.ravel() for m in np.meshgrid(*axes, indexing="ij")], axis=1)
    return np.tile(mesh, (components, 1)), np.repeat(np.arange(components), len(mesh))


def both(weights: Array) -> Array:
    """Displacements (n, 2 K, 2) of weights (n, K) that act along the first component, then along the second."""
    n, k = weights.shape
    out = np.zeros((n, 2 * k, 2))
    out[:, :k, 0] = out[:, k:, 1] = weights
    return out


def along(at: Local, light: Array, marks: Array | None = None) -> Array:
    """Coordinates (n_b, d) of every datum of a block: of the light for c, of a mark's centre for m, else nan."""
    out = np.full((size(at.block), light.shape[1]), np.nan)
    out[: len(light)] = light
    if marks is not None and at.block.kept.any():
        centres = marks.reshape(-1, 4, marks.shape[1]).mean(axis=1)[at.block.kept]
        out[-2 * len(centres) :] = np.repeat(centres, 2, axis=0)
    return out
