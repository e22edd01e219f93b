"""Where along its axis the mirror stands, read from how unevenly light lies on the two sides of the trace.

A mirror that stands off along its axis is lit by a flank of the beam: the density falls over the facet's height, and
one tail of the line gets more light. Centre line, width and flux hardly tell this from the laser's and the axis'
angles. The pixels do, though in the tails, which the weight of an adaptive moment leaves out: of the third adaptive
moment a millimetre moves some 0.003, of the light at three widths some percent.

What is read is therefore the amplitude of a template, by least squares weighted with the pixels' own noise: with p(v)
the profiles that the ray model predicts at values v, blurred like the picture,

    light = gain · (p(v₀) + a T₋) + [flux, place, width along the trace, blur, T₊, background],

T = T₊ + T₋ = ∂p/∂(mirror along its axis) at constant flux, of which only the uneven T₋ is believed: what is even
(the level of both tails) a lens, a pixel and a beam's profile change as well. The one number a [mm] is linear in the
light over the gain, and is predicted at other v by the same functional of p(v), so that all else that makes a line
uneven (a beam beside its axis, coma) counts as well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, overload

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.linalg import block_diag
from scipy.ndimage import map_coordinates

from benchsim.bench.curve import Curve, signed_distance
from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Exposure, Recording
from benchsim.bench.place import SettingErrors, place
from benchsim.diagnosis.problem import Problem
from benchsim.instruments.bench import board_coordinates
from benchsim.instruments.bench.effects import PHYSICS_OF
from benchsim.instruments.bench.fitted_simulation import probable
from benchsim.instruments.bench.observed import Observed
from benchsim.instruments.bench.pixels import Pixels
from benchsim.instruments.bench.prediction import FAR, Predict, beam_shape, errors
from benchsim.rays.cross_section import cross_sections
from benchsim.trace.band import smooth_curve

Array = NDArray[np.float64]
Values = Mapping[str, float]

STEP = 0.5
"""Of the mirror along its axis, to either side, for the template [mm]."""

ACROSS = 0.2
"""Of the predicted profiles' grid [mm]."""

ROWS = 24
"""Predicted profiles along the trace, interpolated between those that are worked out."""

PATH_STEP = 60.0
"""Knots of the measured trace's smooth path, from which pixels are measured [mm]."""

PLACE_ORDER, FLUX_ORDER = 7, 3
"""Legendre orders along the trace of what its place, and its flux and width, may be beside the prediction."""

ROUNDS = 2
"""Of measuring and fitting: what is measured about a place millimetres off is less certain than it can be."""

MIXED = 0.5
"""Share above which a switch of the physics counts as on."""


@dataclass(frozen=True)
class Seen:
    """Where the pixels about a trace look on the board.

    Attributes
    ----------
    path : Curve
        The measured trace, smooth.
    s, q : (p,) mm
        Along and across it.
    blur : (n, 2) mm
        Place along it, growing, and rms of the camera's blur across it there.
    """

    path: Curve
    s: Array
    q: Array
    blur: Array

    def light(self, bench: Stands, order: int = 0) -> Array:
        """Predicted light of the pixels, or its derivative of an order by q [1/mm^order], (p,); any scale.

        Raises
        ------
        BenchsimError
            Where the bench has no trace.
        """
        reach = np.abs(self.q).max() + 4 * self.blur[:, 1].max()
        count = int(np.ceil(reach / ACROSS))
        q: Array = ACROSS * np.arange(-count, count + 1.0)
        curve, table = cross_sections(bench.recording, bench.exposure, q, bench.off, bench.shape)
        length = curve.arc_length()
        # Both run along the same trace, which may be millimetres off at trial values; pixels keep their distance.
        here, there = self.path.arc_length(), signed_distance(curve, self.path.points)[1]
        hand = 1 if there[-1] > there[0] else -1
        rows = np.linspace(0.0, length[-1], ROWS)
        blur = np.interp(rows, there[::hand], np.interp(here, *self.blur.T)[::hand])
        k = 2 * np.pi * np.fft.rfftfreq(len(q), ACROSS)
        seen = np.fft.rfft(CubicSpline(length, table)(rows), axis=1) * np.exp(-0.5 * (blur[:, None] * k) ** 2)
        if order:
            seen = seen * (hand * 1j * k) ** order
        at = np.clip(np.interp(self.s, here, there) / length[-1], 0, 1) * (ROWS - 1)
        where = np.stack([at, hand * self.q / ACROSS + count])
        picture = np.fft.irfft(seen, len(q), axis=1)
        return np.asarray(map_coordinates(picture, where, order=3, mode="nearest"), float)


class Stands(NamedTuple):
    """A bench as `rays.cross_section` takes it."""

    recording: Recording
    exposure: Exposure
    off: SettingErrors
    shape: tuple[float, float, float]

    def along_axis(self, by: float) -> Stands:
        """The mirror moved along its axis [mm]."""
        axis = place(self.recording.mirror, self.exposure, self.off).axis
        return self._replace(off=replace(self.off, mirror_position=self.off.mirror_position + by * axis))


@dataclass(frozen=True)
class Asymmetry:
    """Uneven light of one exposure.

    Attributes
    ----------
    value, sigma : float
        How far along its axis the mirror stands beyond where it does at the values that it was measured about, and 1
        sigma by the pixels' noise [mm].
    seen : Seen
    functional : (2, p)
        From the pixels' light to the gain, and to the gain times ``value``.
    """

    value: float
    sigma: float
    seen: Seen
    functional: Array

    def predicted(self, bench: Stands) -> float:
        """What ``value`` would be of another bench [mm]."""
        gain, moved = self.functional @ self.seen.light(bench)
        return float(moved / gain)


def measure(predict: Predict, block: int, values: Values, pixels: Pixels) -> Asymmetry | None:
    """Asymmetry of a block's photograph about the prediction at some values.

    Parameters
    ----------
    predict : Predict
    block : int
    values : mapping
        At which the block's trace is predicted well: nuisances and effects that were fitted to it.
    pixels : Pixels
        About the block's trace.

    Returns
    -------
    Asymmetry or None
        None where the simulation has no profile (a single ray), or a second light beside the first (a second surface).
    """
    b = predict.blocks[block]
    bench = stands(predict, block, values)
    if bench is None:
        return None
    seen = _seen(b.observed, pixels, 1 + values.get(f"{b.camera}.blur", 0.0))
    try:
        light, slope, bend = (seen.light(bench, order) for order in range(3))
        other = replace(seen, q=-seen.q)
        here, there = (
            (side.light(bench.along_axis(STEP)) - side.light(bench.along_axis(-STEP))) / (2 * STEP)
            for side in (seen, other)
        )
        brighter = float(light @ here) / float(light @ light)
        here, there = here - brighter * light, there - brighter * other.light(bench)
    except BenchsimError:
        return None
    even, uneven = (here + there) / 2, (here - there) / 2
    return _fitted(pixels, seen, (light, slope, bend, even), uneven)


def stands(predict: Predict, block: int, values: Values) -> Stands | None:
    """The bench of a block at some values; None where its trace has no profile, or a ghost beside it."""
    b = predict.blocks[block]
    truth = predict.truth(values)
    mixed = {owner for p, owner in predict.owners.items() if owner in PHYSICS_OF and values.get(p, 0.0) > MIXED}
    physics = replace(truth.physics, **{PHYSICS_OF[owner]: True for owner in mixed})
    if not physics.beam or truth.effects.get("second-surface", {}).get("glass", 0.0):
        return None
    truth = replace(truth, physics=physics)
    return Stands(truth, truth.exposures[b.observed.index], errors(values, b.setting), beam_shape(values))


def _seen(o: Observed, pixels: Pixels, scale: float) -> Seen:
    span = (float(o.s[0]), float(o.s[-1]))
    smooth = smooth_curve(o.s, o.points, 1 / np.diag(o.covariance), span, PATH_STEP)
    path = Curve(np.asarray(smooth(np.linspace(*span, ROWS)), float))
    distance, s = signed_distance(path, board_coordinates.read_back(o.view, np.column_stack([pixels.u, pixels.v])))
    at = signed_distance(path, o.profile_points)[1]
    blur = np.column_stack([at, scale * o.blur * o.mm_per_px])[np.argsort(at)]
    return Seen(path, s, distance, blur)


def _fitted(pixels: Pixels, seen: Seen, parts: tuple[Array, Array, Array, Array], uneven: Array) -> Asymmetry:
    """Weighted least squares of the module's head; ``parts`` are p, its derivatives by q, and T₊."""
    light, slope, bend, even = (p[:, None] for p in parts)
    # Beyond three widths too: that light has the least noise for its unevenness, with a dark picture and without.
    ground = pixels.background_terms(always=True)
    x = 2 * (seen.s - seen.s.min()) / np.ptp(seen.s) - 1
    along = np.polynomial.legendre.legvander(x, PLACE_ORDER)
    few = along[:, : FLUX_ORDER + 1]
    wider = (light + seen.q[:, None] * slope) * few
    # The gain comes first, the mirror last.
    columns = (light * few, slope * along, wider, bend, even, ground, uneven[:, None])
    design = np.concatenate(columns, axis=1)
    weight = 1 / pixels.grain.variance
    scaled = design / np.sqrt(weight @ design**2)
    weighted = scaled * weight[:, None]
    every = np.linalg.solve(scaled.T @ weighted, weighted.T) / np.sqrt(weight @ design**2)[:, None]
    c = every @ pixels.light
    white = pixels.white(np.inf)
    z = white(pixels.light - design @ c)
    excess = max(1.0, float(z @ z) / (len(z) - len(c)))
    gain, moved = float(c[0]), float(c[-1])
    # f C f of f's own row, by C = L Lᵀ.
    row = every[-1, white.index]
    part = np.zeros_like(row)
    for d, diagonal in enumerate(white.factor):
        part[: len(row) - d] += diagonal[: len(row) - d] * row[d:]
    sigma = float(np.sqrt(excess * (part @ part))) / abs(gain)
    return Asymmetry(moved / gain, sigma, seen, every[[0, -1]])


@dataclass(frozen=True)
class Predictions:
    """The bench's predictions with the asymmetries of some blocks after their other data; as `Predict`.

    Attributes
    ----------
    bare : Predict
    asymmetries : mapping of int to Asymmetry
        By block.
    """

    bare: Predict
    asymmetries: Mapping[int, Asymmetry]
    known: dict[Any, float] = field(default_factory=dict, compare=False, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "known": {}}

    @overload
    def __call__(self, values: Values, block: int) -> Array: ...
    @overload
    def __call__(self, values: Sequence[Values], block: Sequence[int]) -> list[Array]: ...
    def __call__(self, values: Values | Sequence[Values], block: int | Sequence[int]) -> Array | list[Array]:
        """Prediction of a block; of lists: `many`."""
        return self.many([values], block)[0] if isinstance(values, Mapping) else self.many(values, block)

    def many(self, values: Sequence[Values], block: int | Sequence[int]) -> list[Array]:
        """Predictions for many values, all of one block or each of its own."""
        blocks = [block] * len(values) if isinstance(block, int) else list(block)
        found = self.bare.many(list(values), blocks)
        return [np.concatenate([f, self._uneven(v, b)]) for f, v, b in zip(found, values, blocks, strict=True)]

    def _uneven(self, values: Values, block: int) -> Array:
        asymmetry = self.asymmetries.get(block)
        if asymmetry is None:
            return np.zeros(0)
        key = block, frozenset((k, v) for k, v in values.items() if v and k not in self.bare.aside)
        if key not in self.known:
            while len(self.known) > 2 * len(self.asymmetries):
                self.known.pop(next(iter(self.known)))
            bench = stands(self.bare, block, values)
            try:
                self.known[key] = asymmetry.predicted(bench) if bench is not None else FAR
            except BenchsimError:
                self.known[key] = FAR
        return np.array([self.known[key]])


def joined(problem: Problem, asymmetries: Mapping[int, Asymmetry]) -> Problem:
    """The problem with asymmetries as data of kind ``a`` after the other data of their blocks."""
    assert isinstance(problem.predict, Predict)
    data, block, kind, position, stretch, covariance = [], [], [], [], [], []
    for b, c in enumerate(problem.covariance):
        rows = problem.rows(b)
        more = [asymmetries[b]] if b in asymmetries else []
        data += [problem.data[rows], np.array([a.value for a in more])]
        block.append(np.full(len(c) + len(more), b))
        kind += [problem.kind[rows], np.full(len(more), "a")]
        position += [problem.position[rows], np.zeros(len(more))]
        stretch += [problem.stretch[rows], np.full(len(more), -1)]
        covariance.append(block_diag(c, *(a.sigma**2 for a in more)))
    return replace(
        problem,
        data=np.concatenate(data),
        block=np.concatenate(block),
        kind=np.concatenate(kind),
        position=np.concatenate(position),
        stretch=np.concatenate(stretch),
        covariance=tuple(covariance),
        predict=Predictions(problem.predict, asymmetries),
        attachments=(),
        next_recordings=None,
    )


def settled(
    problem: Problem, pixels: Sequence[Pixels | None], values: Sequence[Values], setting_scale: float = 1.0
) -> list[dict[str, float]]:
    """Values in which each setting's own errors are fitted to its pictures' asymmetries as well.

    What settings share (beam, blur, effects) is held.

    Parameters
    ----------
    problem : Problem
        Of the bench.
    pixels : sequence of Pixels or None
        About each block's trace.
    values : sequence of mapping
        One for each block, the same within a setting: where it was fitted to all else.
    setting_scale : float
        As in `fitted_simulation.probable`.

    Returns
    -------
    list of dict
        One for each block.
    """
    predict = problem.predict
    assert isinstance(predict, Predict)
    out = [dict(v) for v in values]
    for group in dict.fromkeys(problem.groups):
        own = [b for b, g in enumerate(problem.groups) if g == group]
        free = [p for p in problem.nuisances if p.blocks is not None and set(p.blocks) <= set(own)]
        seen = [(b, p) for b in own if (p := pixels[b]) is not None]
        for _ in range(ROUNDS):
            found = {b: measure(predict, b, out[b], p) for b, p in seen}
            known = {b: a for b, a in found.items() if a is not None}
            if not known:
                break
            fitted = probable(joined(problem, known), free, out[own[0]], own, setting_scale)
            for b in own:
                out[b] = fitted
    return out
