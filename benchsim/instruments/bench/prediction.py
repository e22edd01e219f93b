"""What the bench would give for stated errors and effects: the prediction that the diagnosis calls some thousand times.

A frozen object of plain data, so that worker processes can be handed it. The light's part (`rays.predict`) is kept
for the last values of what bears on the light: parameters of camera, print and detector are then nearly free.
Lists of values (`Predict.many`) are worked out together, whatever their blocks.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from benchsim import rays
from benchsim.bench.curve import Curve
from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Camera, Recording
from benchsim.bench.place import SettingErrors
from benchsim.bench.settings import NAMES, from_vector
from benchsim.instruments.bench import board_coordinates
from benchsim.instruments.bench.blocks import Block, Seen, data, size
from benchsim.rays.curve import tangents
from benchsim.rays.interpolated_trace import left_of

Array = NDArray[np.float64]

SAMPLES = 48
"""Points of the curve: between them its spline is good to 0.1 µm (traces bend with radii of metres)."""

FAR = 1e3
"""Centre line [mm] of a bench whose light misses the board: no fit stays there."""

TOGETHER = 64
"""Curves that are held against the data at once, which bounds the memory."""

KEPT = 16
"""Predictions whose light is kept: of as many points as a descent follows at once."""

ASIDE = 0.5
"""To either side of a line [mm] for how it is stretched: lines are so wide, lenses and boards bend over decimetres."""

SHAPES = ("beam_c4", "beam_plus", "beam_cross")
QUARTIC = 0.08
"""Largest quartic term, four sigma of its prior, which is approached as a tanh: with larger ones the light grows again
two radii off the axis, as no beam does, and a fit that misses something would sit there."""

LEAST = 0.05
"""Smallest diameter and divergence over the stated ones."""

BEAM = ("beam_diameter", "divergence", *SHAPES)
INTRINSICS = ("focal", "principal_u", "principal_v", "k1")
UNITS = tuple("mm" if "position" in name else "mrad" for name in NAMES)
_TO_RAD = np.array([1.0 if unit == "mm" else 1e-3 for unit in UNITS])


class Asked(NamedTuple):
    """A prediction that is wanted: values, the number of the block, and the bench that they make."""

    values: Mapping[str, float]
    block: int
    truth: Recording


class Measured(NamedTuple):
    """Coordinates (samples, 2) mm in which a trace is measured, the marks' residuals (m, 2) px, and by what its width
    is stretched there, (samples,) or 1."""

    points: Array
    residual: Array
    stretch: Array | float


@dataclass(frozen=True)
class Predict:
    """predict(values, block) of the bench; see `problem.build`.

    Attributes
    ----------
    recording : Recording
        The simulation in doubt: its physics, effects and fields.
    blocks : tuple of Block
    owners : mapping of str to str
        Parameter of the catalogue → its effect.
    shapes : frozenset of str
        Parameters that have no effect on their own.
    aside : frozenset of str
        Parameters that do not bear on the light before the board.
    """

    recording: Recording
    blocks: tuple[Block, ...]
    owners: Mapping[str, str]
    shapes: frozenset[str]
    aside: frozenset[str]
    cache: dict[Any, Curve] = field(default_factory=dict, compare=False, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "cache": {}}

    @overload
    def __call__(self, values: Mapping[str, float], block: int) -> Array: ...
    @overload
    def __call__(self, values: Sequence[Mapping[str, float]], block: int | Sequence[int]) -> list[Array]: ...
    def __call__(
        self, values: Mapping[str, float] | Sequence[Mapping[str, float]], block: int | Sequence[int]
    ) -> Array | list[Array]:
        """Prediction (n_b,) of a block: c, w, f, g, m; ``FAR`` away where light misses the board. Of lists: `many`."""
        if isinstance(values, Mapping):
            assert not isinstance(block, Sequence)
            return self.many([values], block)[0]
        return self.many(values, block)

    def many(self, values: Sequence[Mapping[str, float]], block: int | Sequence[int]) -> list[Array]:
        """Predictions for many values, all of one block or each of its own: several times cheaper each than alone."""
        blocks = block if isinstance(block, Sequence) else [block] * len(values)
        # Values that bear on the same physics share one recording, and all that is worked out of it.
        truths: dict[Any, Recording] = {}
        # The same values are often asked of several blocks.
        known: dict[int, Recording] = {}
        for v in values:
            if id(v) in known:
                continue
            key = tuple((k, x) for k, x in v.items() if x and (k in self.owners or k in BEAM[:2]))
            if key not in truths:
                truths[key] = self.truth(v)
            known[id(v)] = truths[key]
        asked = [Asked(v, int(b), known[id(v)]) for v, b in zip(values, blocks, strict=True)]
        return self._beyond(asked, self._lights(asked))

    def light(self, values: Mapping[str, float], block: int, truth: Recording) -> Curve:
        """The trace on the true board, kept for the last values.

        Raises
        ------
        BenchsimError
            If the light misses the board.
        """
        key = self._key(values, block)
        if key not in self.cache:
            recording, exposure, off, shape, blur = self._case(Asked(values, block, truth))
            width = self.blocks[block].response is not None
            self._keep(key, rays.predict(recording, exposure, off, SAMPLES, width=width, shape=shape, blur=blur))
        return self.cache[key]

    def _lights(self, asked: Sequence[Asked]) -> list[Curve | None]:
        """`light` of many; None where it misses the board."""
        known = {id(a.values): self._bearing(a.values) for a in asked}
        keys = [(a.block, known[id(a.values)]) for a in asked]
        found: dict[Any, Curve | None] = {key: self.cache[key] for key in keys if key in self.cache}
        wanted = {key: a for key, a in zip(keys, asked, strict=True) if key not in found}
        for width in (False, True):
            some = {key: a for key, a in wanted.items() if (self.blocks[a.block].response is not None) == width}
            if len(some) < 2:
                continue
            try:
                curves = rays.predict_many([self._case(a) for a in some.values()], SAMPLES, width=width)
            except BenchsimError:
                # One of them holds a value that an element cannot take.
                continue
            found.update(zip(some, curves, strict=True))
            if len(some) <= KEPT * len(self.blocks):
                for key, curve in zip(some, curves, strict=True):
                    if curve is not None:
                        self._keep(key, curve)
        for key, a in wanted.items():
            if key in found:
                continue
            try:
                found[key] = self.light(a.values, a.block, a.truth)
            except BenchsimError:
                found[key] = None
        return [found[key] for key in keys]

    def _key(self, values: Mapping[str, float], block: int) -> Any:
        return block, self._bearing(values)

    def _bearing(self, values: Mapping[str, float]) -> frozenset[tuple[str, float]]:
        """What of the values bears on the light."""
        return frozenset((k, v) for k, v in values.items() if v and k not in self.aside)

    def _keep(self, key: Any, curve: Curve) -> None:
        while len(self.cache) >= KEPT * len(self.blocks):
            self.cache.pop(next(iter(self.cache)))
        self.cache[key] = curve

    def _case(self, a: Asked) -> rays.Case:
        b = self.blocks[a.block]
        blur = 0.0 if b.response is None else b.response.blur
        exposure = a.truth.exposures[b.observed.index]
        return rays.Case(a.truth, exposure, errors(a.values, b.setting), beam_shape(a.values), blur)

    def beyond(
        self, values: Mapping[str, float], block: int, truth: Recording, curve: Curve, shift: Array | None = None
    ) -> Array:
        """From the trace on the true board to the block's data.

        Parameters
        ----------
        values, block
            As `__call__`.
        truth : Recording
            With the effects and fields that lie beyond the board.
        curve : Curve
            On the true board.
        shift : (samples, 2) array, optional
            Added to the trace on the board [mm].
        """
        return self._beyond([Asked(values, block, truth)], [curve], shift)[0]

    def _beyond(
        self, asked: Sequence[Asked], curves: Sequence[Curve | None], shift: Array | None = None
    ) -> list[Array]:
        """`beyond` of many; `FAR` where there is no curve."""
        lit = [(i, curve) for i, curve in enumerate(curves) if curve is not None]
        lights = [curve.points if shift is None else curve.points + shift for _, curve in lit]
        out: dict[int, Array] = {}
        seen: dict[Any, list[tuple[int, Seen]]] = {}
        measured = self._measured([asked[i] for i, _ in lit], lights)
        for (i, curve), (points, residual, stretch) in zip(lit, measured, strict=True):
            if np.isfinite(points).all():
                b = self.blocks[asked[i].block]
                o = b.observed
                alike = len(points), len(o.points), len(o.profile_points), len(o.parting)
                seen.setdefault(alike, []).append((i, Seen(asked[i].values, b, points, residual, curve, stretch)))
        for members in seen.values():
            for first in range(0, len(members), TOGETHER):
                some = members[first : first + TOGETHER]
                out.update(zip((i for i, _ in some), data([s for _, s in some]), strict=True))
        return [out[i] if i in out else np.full(size(self.blocks[a.block]), FAR) for i, a in enumerate(asked)]

    def _measured(self, asked: Sequence[Asked], lights: Sequence[Array]) -> list[Measured]:
        """Coordinates in which light at true places of the board is measured, and what the marks show of it.

        Light that the same camera sees on the same board is seen at once: what the marks make of the pose is theirs.
        """
        out = [
            Measured(light, np.zeros((len(self.blocks[a.block].kept), 2)), 1.0)
            for a, light in zip(asked, lights, strict=True)
        ]
        alike: dict[Any, list[int]] = {}
        for i, a in enumerate(asked):
            camera = self.intrinsics(a.values, self.blocks[a.block])
            if camera is not None or board_coordinates.active(a.truth):
                alike.setdefault((id(a.truth), a.block, camera), []).append(i)
        for (_, block, camera), members in alike.items():
            b, truth = self.blocks[block], asked[members[0]].truth
            # Where width or flux are data, to either side of the line too: what is stretched there is as wide, and as
            # bright in sum, as it is stretched.
            aside = (0.0, ASIDE, -ASIDE) if b.shaped else (0.0,)
            beside = [lights[i] + h * left_of(tangents(lights[i])) if h else lights[i] for i in members for h in aside]
            level = np.concatenate([self._level(b, len(light)) for light in beside])
            points, residual = board_coordinates.measured(truth, b.observed.view, np.concatenate(beside), level, camera)
            parts = np.split(points, np.cumsum([len(light) for light in beside])[:-1])
            for i, k in zip(members, range(0, len(parts), len(aside)), strict=True):
                stretch: Array | float = 1.0
                # A line of sight that misses the board reads nothing, and has no tangent.
                if len(aside) > 1 and np.isfinite(parts[k]).all():
                    across = left_of(tangents(parts[k]))
                    stretch = ((parts[k + 1] - parts[k + 2]) * across).sum(axis=1) / (2 * ASIDE)
                out[i] = Measured(parts[k], residual, stretch)
        return out

    def _level(self, b: Block, n: int) -> Array:
        return np.asarray(np.interp(np.linspace(0, 1, n), np.linspace(0, 1, len(b.level)), b.level))

    def truth(self, values: Mapping[str, float]) -> Recording:
        """The bench with the hypothesis' effects added to the file's, and the laser's nuisances."""
        added: dict[str, dict[str, float]] = {}
        for name, owner in self.owners.items():
            if name in values and name not in self.shapes and values[name] != 0:
                added.setdefault(owner, {})[name] = values[name]
        for name in self.shapes:
            if name in values and self.owners[name] in added:
                added[self.owners[name]][name] = values[name]
        laser = self.recording.laser
        # What a fit that is far off asks for may be no beam at all.
        wide, angle = (max(values.get(name, 0.0), LEAST - 1) for name in BEAM[:2])
        if wide or angle:
            laser = replace(
                laser, beam_diameter=laser.beam_diameter * (1 + wide), divergence=laser.divergence * (1 + angle)
            )
        if not added and laser is self.recording.laser:
            return self.recording
        effects = {name: dict(table) for name, table in self.recording.effects.items()}
        for owner, table in added.items():
            mine = effects.setdefault(owner, {})
            for name, value in table.items():
                mine[name] = value if name in self.shapes else mine.get(name, 0.0) + value
        return replace(self.recording, laser=laser, effects=effects)

    def intrinsics(self, values: Mapping[str, float], b: Block) -> Camera | None:
        """The true intrinsics where they are not the stated ones."""
        focal, cu, cv, k1 = (values.get(f"{b.camera}.{name}", 0.0) for name in INTRINSICS)
        if not (focal or cu or cv or k1):
            return None
        camera = b.observed.view.camera
        u, v = camera.principal_point
        return replace(
            camera,
            focal=camera.focal * (1 + 1e-3 * focal),
            principal_point=(u + cu, v + cv),
            distortion=(camera.distortion[0] + k1, *camera.distortion[1:]),
        )


def beam_shape(values: Mapping[str, float]) -> tuple[float, float, float]:
    """The beam's profile as `rays.predict` takes it, from the nuisances."""
    c4, plus, cross = (values.get(name, 0.0) for name in SHAPES)
    return QUARTIC * math.tanh(c4 / QUARTIC), plus, cross


def errors(values: Mapping[str, float], setting: tuple[str, ...]) -> SettingErrors:
    """Setting errors of a block from values in mm and mrad; ``setting`` are the 13 names, "" where there is none."""
    return from_vector(np.array([values.get(name, 0.0) if name else 0.0 for name in setting]) * _TO_RAD)
