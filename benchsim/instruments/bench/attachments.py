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
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.fields import field
from benchsim.diagnosis.problem import Attachment
from benchsim.instruments.bench.amended_file import summed
from benchsim.instruments.bench.blocks import size
from benchsim.instruments.bench.local_response import Local, along, both, grid, local, push, tents
from benchsim.instruments.bench.prediction import Predict

Array = NDArray[np.float64]

SPACING_PX = 90.0
SPACING_MM = 58.0
SPACING_AIR = 60.0
"""Between knots in the picture, on the board and half way: a Gaussian defect of 60 mm or 70 px is drawn to 5 %."""


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
