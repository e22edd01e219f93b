"""Unknown functions of the bench's own coordinates, as linear bases: one or two per element of the light's path.

A function of an element's coordinate is carried to the data as the bench carries a catalogue effect: a displacement of
the light on the board, of the light in the picture, or of the marks in the picture. Displacements of the marks turn the
solved pose, and with it all light; see `board_coordinates`. Functions are values on a grid of knots with multilinear
interpolation between, exactly the recording's free fields (`bench.fields`), in whose coordinates and units they are:
what is found can be put into the file as it stands. Names are ``element.FIELD``, with a word between where a coordinate
is left out.

Lengths reach from the spacing of the knots to the size of the whole; defects of a board or a lens of 60 mm or 70 px
and stages that err in the third harmonic of azimuth lie between.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from benchsim.bench.curve import Curve, signed_distance
from benchsim.bench.fields import field
from benchsim.bench.place import Placement
from benchsim.diagnosis.problem import Attachment
from benchsim.instruments.bench import board_coordinates
from benchsim.instruments.bench.amended_file import summed
from benchsim.instruments.bench.blocks import Block, size
from benchsim.instruments.bench.prediction import Predict
from benchsim.rays.prediction import bench_of
from benchsim.trace.pose import pose_derivatives

Array = NDArray[np.float64]

SPACING_PX = 90.0
SPACING_MM = 58.0
SPACING_AIR = 60.0
"""Between knots in the picture, on the board and half way: a Gaussian defect of 60 mm or 70 px is drawn to 5 %."""


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


def attachments(predict: Predict) -> tuple[Attachment, ...]:
    """All attachments of a problem, linearised about its simulation in doubt.

    Parameters
    ----------
    predict : Predict

    Returns
    -------
    tuple of Attachment
        Bases in the fields' units per data of the problem, block after block.
    """
    blocks = [local(predict, i) for i in range(len(predict.blocks))]
    out = [_pixel(blocks), _row(blocks), _brightness(blocks), _height(blocks), _shift(blocks), _lean(predict, blocks)]
    out += [_kick(blocks)]
    exposures = [predict.recording.exposures[b.block.observed.index] for b in blocks]
    if len({e.facet for e in exposures if e.facet is not None}) > 1:
        out.append(_facet(predict, blocks))
    if predict.recording.physics.beam:
        out.append(_angle(predict, blocks))
    azimuths, elevations = ({round(np.degrees(x), 9) for x in xs} for xs in zip(
        *((e.laser_azimuth, e.laser_elevation) for e in exposures), strict=True
    ))  # fmt: skip
    if len(azimuths) > 1:
        out.append(_stage(predict, blocks, 0))
    if len(elevations) > 1:
        out.append(_stage(predict, blocks, 1))
    if len({e.time for e in exposures}) > 1:
        out.append(_time(predict, blocks))
    return (*out, _wander(blocks))


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


def _spread(low: float, high: float, spacing: float) -> Array:
    return np.linspace(low, high, max(2, 1 + int(np.ceil((high - low) / spacing))))


def _joined(
    name: str,
    coordinate: str,
    unit: str,
    axes: Sequence[Array],
    components: int,
    sigma: float,
    lengths: tuple[float, ...],
    parts: Sequence[tuple[Array, Array]],
    called: tuple[tuple[str, ...], tuple[str, ...]],
) -> Attachment:
    """``called``: names of the coordinate's directions, and of the components where there are several."""
    knots, component = grid(axes, components)
    basis = np.concatenate([p[0] for p in parts])
    position = np.concatenate([p[1] for p in parts])
    return Attachment(
        name, name.split(".")[0], coordinate, unit, basis, knots, component, sigma, lengths, position, *called
    )


def _resolution(blocks: Sequence[Local]) -> tuple[int, int]:
    each = [b.block.observed.view.camera.resolution for b in blocks]
    return max(r[0] for r in each), max(r[1] for r in each)


def _pixel(blocks: Sequence[Local]) -> Attachment:
    width, height = _resolution(blocks)
    spacing = max(SPACING_PX, width / 16)
    axes = (_spread(0, width - 1, spacing), _spread(0, height - 1, spacing))
    parts = [
        (
            push(b, light=both(tents(axes, *b.pixel.T)), corners=both(tents(axes, *b.corners_pixel.T))),
            along(b, b.pixel, b.corners_pixel),
        )
        for b in blocks
    ]
    lengths = (0.8 * spacing, 2 * spacing, 5 * spacing)
    return _joined("camera.pixel", "place in the picture", "px", axes, 2, 3.0, lengths, parts, (("u", "v"), ("u", "v")))


def _row(blocks: Sequence[Local]) -> Attachment:
    height = _resolution(blocks)[1]
    axes = (np.array([0.0]), _spread(0, height - 1, height / 24))

    def weights(pixel: Array) -> Array:
        return both(tents(axes, pixel[:, 0], pixel[:, 1]))

    parts = [
        (push(b, light=weights(b.pixel), corners=weights(b.corners_pixel)), along(b, b.pixel, b.corners_pixel))
        for b in blocks
    ]
    lengths = (height / 16, height / 8, height / 4)
    return _joined("camera.row.pixel", "image row", "px", axes, 2, 3.0, lengths, parts, (("u", "v"), ("u", "v")))


def _brightness(blocks: Sequence[Local]) -> Attachment:
    axes = (np.linspace(0, 1, 9),)
    parts = [(push(b, light=both(tents(axes, b.level))), along(b, b.level[:, None])) for b in blocks]
    return _joined(
        "camera.brightness", "brightness", "1", axes, 2, 1.0, (0.2, 0.5), parts, (("brightness",), ("u", "v"))
    )


def _board_axes(blocks: Sequence[Local]) -> tuple[Array, Array]:
    reach = np.max([np.abs(np.concatenate([b.board, b.corners_board])).max(axis=0) for b in blocks], axis=0)
    return _spread(-reach[0], reach[0], SPACING_MM), _spread(-reach[1], reach[1], SPACING_MM)


_BOARD_LENGTHS = (45.0, 130.0, 400.0)
"""[mm]; as those in the picture, for what can be either must not be told by the length that one may have."""


def _height(blocks: Sequence[Local]) -> Attachment:
    axes = _board_axes(blocks)
    parts = []
    for b in blocks:
        here, there = tents(axes, *b.board.T), tents(axes, *b.corners_board.T)
        parts.append(
            (
                # A raised surface is met earlier on the light's way.
                push(
                    b,
                    board=here[..., None] * b.slope[:, None, :],
                    light=here[..., None] * b.by_height[:, None, :],
                    corners=there[..., None] * b.corners_by_height[:, None, :],
                ),
                along(b, b.board, b.corners_board),
            )
        )
    return _joined("screen.height", "place on the board", "mm", axes, 1, 4.0, _BOARD_LENGTHS, parts, (("y", "z"), ()))


def _shift(blocks: Sequence[Local]) -> Attachment:
    axes = _board_axes(blocks)
    parts = []
    for b in blocks:
        moved = np.einsum("nij,nkj->nki", b.corners_by_board, both(tents(axes, *b.corners_board.T)))
        parts.append((push(b, corners=moved), along(b, b.board, b.corners_board)))
    return _joined(
        "screen.shift", "place on the board", "mm", axes, 2, 2.0, _BOARD_LENGTHS, parts, (("y", "z"), ("y", "z"))
    )


def _differences(predict: Predict, names: Sequence[tuple[int, str]], step: float) -> list[Array]:
    """Derivatives of blocks, each by one parameter."""
    blocks = [i for i, _ in names]
    ahead = predict([{name: step} for _, name in names], blocks)
    behind = predict([{name: -step} for _, name in names], blocks)
    return [(a - b) / (2 * step) for a, b in zip(ahead, behind, strict=True)]


def _lean(predict: Predict, blocks: Sequence[Local]) -> Attachment:
    degrees = [np.degrees(b.phase) for b in blocks]
    axes = (_spread(min(d.min() for d in degrees), max(d.max() for d in degrees), 0.75), np.array([0.0]))
    parts = []
    turned = _differences(predict, [(i, "pyr") for i in range(len(blocks))], 0.5)
    for b, d, by_lean in zip(blocks, degrees, turned, strict=True):
        rows = np.zeros((size(b.block), len(axes[0])))
        rows[: len(d)] = by_lean[: len(d), None] * tents(axes, d, np.zeros(len(d)))
        parts.append((rows, along(b, np.stack([d, np.zeros(len(d))], axis=1))))
    return _joined(
        "mirror.lean", "phase of the mirror", "mrad", axes, 1, 3.0, (0.75, 2.0, 6.0), parts, (("phase", "height"), ())
    )


def _facet(predict: Predict, blocks: Sequence[Local]) -> Attachment:
    axes = (np.array([0.0]), np.arange(float(predict.recording.mirror.facets)))
    parts = []
    turned = _differences(predict, [(i, "pyr") for i in range(len(blocks))], 0.5)
    for b, by_lean in zip(blocks, turned, strict=True):
        facet = predict.recording.exposures[b.block.observed.index].facet
        rows = np.zeros((size(b.block), len(axes[1])))
        place_ = np.full((len(b.board), 2), np.nan)
        if facet is not None:
            rows[:, facet] = by_lean
            place_[:] = (0.0, facet)
        parts.append((rows, along(b, place_)))
    return _joined(
        "mirror.facet.lean", "number of the facet", "mrad", axes, 1, 2.0, (0.3, 3.0), parts, (("phase", "facet"), ())
    )


def _kick(blocks: Sequence[Local]) -> Attachment:
    low = np.min([b.crossing.min(axis=0) for b in blocks], axis=0)
    high = np.max([b.crossing.max(axis=0) for b in blocks], axis=0)
    axes = (_spread(low[0], high[0], SPACING_AIR), _spread(low[1], high[1], SPACING_AIR))
    parts = []
    for b in blocks:
        # A turn of a unit direction by (0, ky, kz) moves the line by path times it, measured on the plane x = const.
        turn = 1e-3 * b.path[:, None, None] * both(tents(axes, *b.crossing.T))
        world = np.concatenate([np.zeros((*turn.shape[:2], 1)), turn], axis=2)
        inside = world @ b.placement.screen_rotation
        moved = inside[..., 1:] - inside[..., :1] * b.slope[:, None, :]
        parts.append((push(b, board=moved), along(b, b.crossing)))
    return _joined(
        "air.kick",
        "where the light crosses the plane half way",
        "mrad",
        axes,
        2,
        0.5,
        (40.0, 90.0, 200.0),
        parts,
        (("y", "z"), ("y", "z")),
    )


def _angle(predict: Predict, blocks: Sequence[Local]) -> Attachment:
    """By differences of the ray model itself: the beam's section reaches the data through mean, width and flux."""
    waist = predict.recording.laser.waist
    # Along v the mirror cuts out a strip of its height, over which a smooth angle is constant or, linear, a curvature.
    axes = (waist * np.linspace(-1, 1, 5), np.array([0.0]))
    knots = grid(axes, 2)[0]
    step = 0.1
    columns: list[list[Array]] = [[] for _ in blocks]
    every = list(range(len(blocks)))
    base = predict([{}] * len(blocks), every)
    for k in range(len(knots)):
        table = np.zeros((2, len(axes[0]), 1))
        table.reshape(-1)[k] = 1e-3 * step
        new = field((axes[0], (-waist, waist)), np.repeat(table, 2, axis=2))
        fields = dict(predict.recording.fields)
        fields["angle"] = summed(fields["angle"], new) if "angle" in fields else new
        bent = replace(predict, recording=replace(predict.recording, fields=fields), cache={})
        for column, there, here in zip(columns, bent([{}] * len(blocks), every), base, strict=True):
            column.append((there - here) / step)
    parts = [(np.stack(c, axis=1), np.full((size(b.block), 2), np.nan)) for b, c in zip(blocks, columns, strict=True)]
    return _joined(
        "source.angle",
        "place in the beam's section",
        "mrad",
        axes,
        2,
        0.5,
        (waist / 2, 2 * waist),
        parts,
        (("u", "v"), ("u", "v")),
    )


def _stage(predict: Predict, blocks: Sequence[Local], axis: int) -> Attachment:
    exposures = [predict.recording.exposures[b.block.observed.index] for b in blocks]
    dials = np.degrees([[e.laser_azimuth, e.laser_elevation] for e in exposures])
    axes = [np.array([float(dials[:, k].mean())]) for k in (0, 1)]
    axes[axis] = np.unique(dials[:, axis].round(9))
    names = [
        (i, n)
        for i, b in enumerate(blocks)
        for n in b.block.setting
        if n.endswith((".laser_azimuth", ".laser_elevation"))
    ]
    turned = _differences(predict, names, 0.5)
    parts = []
    for i, (b, at) in enumerate(zip(blocks, dials, strict=True)):
        weight = tents(axes, at[:1], at[1:])[0]
        rows = [np.outer(t, weight) for (k, _), t in zip(names, turned, strict=True) if k == i]
        parts.append((np.concatenate(rows, axis=1), along(b, np.tile(at, (len(b.board), 1)))))
    name, words, lengths = (
        ("source.stage", "stated azimuth of the laser", (12.0, 25.0, 60.0)),
        ("source.elevation.stage", "stated elevation of the laser", (5.0, 12.0, 30.0)),
    )[axis]
    return _joined(
        name, words, "mrad", axes, 2, 2.0, lengths, parts, (("azimuth", "elevation"), ("azimuth", "elevation"))
    )


def _time(predict: Predict, blocks: Sequence[Local]) -> Attachment:
    hours = np.array([predict.recording.exposures[b.block.observed.index].time / 3600.0 for b in blocks])
    axes = (np.unique(hours),)
    parts = []
    for b, t in zip(blocks, hours, strict=True):
        shift = both(tents(axes, np.full(len(b.board), t)))
        world = np.concatenate([np.zeros((*shift.shape[:2], 1)), shift], axis=2)
        parts.append(
            (push(b, board=world @ b.placement.screen_rotation[:, 1:]), along(b, np.full((len(b.board), 1), t)))
        )
    span = float(np.ptp(axes[0]))
    return _joined("time.time", "time", "mm", axes, 2, 0.5, (span / 12, span / 4, span), parts, (("hour",), ("y", "z")))


def _wander(blocks: Sequence[Local]) -> Attachment:
    """What light does along a trace, anew in every exposure: no field can state it, and no other exposure knows it."""
    everywhere = np.concatenate([b.block.observed.s for b in blocks])
    axis = _spread(float(everywhere.min()), float(everywhere.max()), SPACING_MM / 2)
    k = len(axis)
    parts = []
    for i, b in enumerate(blocks):
        s = b.block.observed.s
        rows = np.zeros((size(b.block), k * len(blocks)))
        rows[: len(s), i * k : (i + 1) * k] = tents((axis,), s)
        parts.append((rows, along(b, s[:, None])))
    words = "place along the trace, anew in every exposure"
    return _joined(
        "time.exposure",
        words,
        "mm",
        (axis,),
        len(blocks),
        0.5,
        (30.0, 60.0, 150.0),
        parts,
        (("s",), tuple(b.block.observed.name for b in blocks)),
    )
