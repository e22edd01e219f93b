"""What the bench would give for stated errors and effects: the prediction that the diagnosis calls some thousand times.

A frozen object of plain data, so that worker processes can be handed it. The light's part (`rays.predict`) is kept
for the last values of what bears on the light: parameters of camera, print and detector are then nearly free.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from benchsim import rays
from benchsim.bench.curve import Curve, signed_distance
from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Camera, Recording
from benchsim.bench.place import SettingErrors
from benchsim.bench.settings import NAMES, from_vector
from benchsim.instruments.bench import chain
from benchsim.instruments.bench.observed import Observed

Array = NDArray[np.float64]

SAMPLES = 48
"""Points of the curve: between them its spline is good to 0.1 µm (traces bend with radii of metres)."""

FAR = 1e3
"""Centre line [mm] of a bench whose light misses the board: no fit stays there."""

SHAPES = ("beam_c4", "beam_plus", "beam_cross")
BEAM = ("beam_diameter", "divergence", *SHAPES)
INTRINSICS = ("focal", "principal_u", "principal_v", "k1")
UNITS = tuple("mm" if "position" in name else "mrad" for name in NAMES)
_TO_RAD = np.array([1.0 if unit == "mm" else 1e-3 for unit in UNITS])


@dataclass(frozen=True)
class Response:
    """How an adaptive width behind the camera's blur follows the light's.

    w² = at + slope (w_light² − light) + by_blur (b² − b₀²); (k,) each, mm² or 1.
    """

    at: Array
    light: Array
    slope: Array
    by_blur: Array


@dataclass(frozen=True)
class Block:
    """One exposure as the prediction needs it.

    Attributes
    ----------
    observed : Observed
    setting : 13 str
        Names of its setting errors among the nuisances, in the order of `settings.NAMES`; "": free of error.
    response : Response or None
        None where neither width nor flux is used.
    level : (samples,)
        Peak brightness along the stated trace, 1 at the brightest measured.
    kept : (m,) bool
        Marks whose residuals are data.
    offset : (n,) mm
        c₀: signed distance of the reference points from the stated bench's curve.
    """

    observed: Observed
    setting: tuple[str, ...]
    response: Response | None
    level: Array
    kept: NDArray[np.bool_]
    offset: Array

    @property
    def camera(self) -> str:
        return self.observed.view.camera.name


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
    samples : int
        Points of the curve.
    """

    recording: Recording
    blocks: tuple[Block, ...]
    owners: Mapping[str, str]
    shapes: frozenset[str]
    aside: frozenset[str]
    samples: int = SAMPLES
    cache: dict[Any, Curve] = field(default_factory=dict, compare=False, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "cache": {}}

    def __call__(self, values: Mapping[str, float], block: int) -> Array:
        """Prediction (n_b,) of a block: c, w, f, m; ``FAR`` away where the light misses the board."""
        b = self.blocks[block]
        truth = self.truth(values)
        try:
            curve = self.light(values, block, truth)
        except BenchsimError:
            return np.full(size(b), FAR)
        return self.beyond(values, block, truth, curve)

    def light(self, values: Mapping[str, float], block: int, truth: Recording) -> Curve:
        """The trace on the true board, kept for the last values.

        Raises
        ------
        BenchsimError
            If the light misses the board.
        """
        b = self.blocks[block]
        key = (block, tuple(sorted((k, v) for k, v in values.items() if v and k not in self.aside)))
        if key not in self.cache:
            exposure = truth.exposures[b.observed.index]
            c4, plus, cross = (values.get(name, 0.0) for name in SHAPES)
            curve = rays.predict(
                truth,
                exposure,
                errors(values, b.setting),
                SAMPLES,
                width=b.response is not None,
                shape=(c4, plus, cross),
            )
            while len(self.cache) >= 2 * len(self.blocks):
                self.cache.pop(next(iter(self.cache)))
            self.cache[key] = curve
        return self.cache[key]

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
        b = self.blocks[block]
        o = b.observed
        points = curve.points if shift is None else curve.points + shift
        camera = self.intrinsics(values, b)
        residual = np.zeros((len(b.kept), 2))
        if chain.active(truth) or camera is not None:
            level = np.interp(np.linspace(0, 1, len(points)), np.linspace(0, 1, len(b.level)), b.level)
            points, residual = chain.measured(truth, o.view, points, level, camera)
        if not np.isfinite(points).all():
            return np.full(size(b), FAR)
        seen = Curve(points)
        every = np.concatenate([o.points, o.profile_points]) if b.response is not None else o.points
        distance, s = signed_distance(seen, every)
        n = len(o.points)
        parts = [b.offset - distance[:n]]
        if b.response is not None:
            assert curve.width is not None and curve.flux is not None
            arc, at = seen.arc_length(), s[n:]
            blur = values.get(f"{b.camera}.blur", 0.0)
            more = ((1 + blur) ** 2 - 1) * (o.blur * o.mm_per_px) ** 2
            light = CubicSpline(arc, curve.width**2)(at)
            r = b.response
            parts.append(r.at + r.slope * (light - r.light) + r.by_blur * more)
            gain = values.get(f"{o.name}.gain", 0.0)
            # Its level is the gain's alone: whatever of it geometry could change, quadratically, would only be undone.
            flux = CubicSpline(arc, np.log(np.maximum(curve.flux, 1e-30)))(at)
            parts.append(flux - flux.mean() + gain)
        parts.append(residual[b.kept].ravel())
        return np.concatenate(parts)

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
        wide, angle = values.get("beam_diameter", 0.0), values.get("divergence", 0.0)
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


def errors(values: Mapping[str, float], setting: tuple[str, ...]) -> SettingErrors:
    """Setting errors of a block from values in mm and mrad; ``setting`` are the 13 names, "" where there is none."""
    return from_vector(np.array([values.get(name, 0.0) if name else 0.0 for name in setting]) * _TO_RAD)


def size(b: Block) -> int:
    """Number of data of a block."""
    shape = 0 if b.response is None else len(b.observed.width2) + len(b.observed.log_flux)
    return len(b.observed.points) + shape + 2 * int(b.kept.sum())
