"""The loop closed in pixels: photographs less the same exposures rendered again, in units of the photographs' noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, gaussian_filter, maximum_filter
from scipy.optimize import minimize_scalar

from benchsim import rays
from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Camera, Exposure, Recording
from benchsim.bench.place import SettingErrors, place
from benchsim.diagnosis.problem import Problem
from benchsim.instruments.bench import chain
from benchsim.instruments.bench.observed import Observed
from benchsim.instruments.bench.prediction import SHAPES, Predict, errors
from benchsim.instruments.bench.probable import probable
from benchsim.jobs.progress import Progress, silent
from benchsim.trace.band import Band, band_along, smooth_curve
from benchsim.trace.extract import read_photographs
from benchsim.trace.speckle import Grain, Whitener, measure_grain, whitener

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Image = NDArray[np.floating]

WIDTHS = 3.0
"""Pixels within so many rms widths of the trace are compared."""

FLANK = 8.0
"""Pixels beyond on either side that tell the background [px]."""

BLURS = (0.2, 3.0)
"""Range of the lens's blur [px]."""

STEP, STILL = 0.5, 0.02
"""Move of the mirror along its axis by which a picture is first found to change, and one that is not worth it [mm]."""

STRETCH = 16
"""Profiles that a coarse z takes together, the core's two flanks, crest and tails apart."""

RELATIVE_ERROR = 0.01
"""Of the light that is rendered again, per bin; a pixel sees several, and its own noise is a hundredth or more."""


@dataclass(frozen=True)
class State:
    """The simulation of one exposure, with the nuisances that are most probable in it.

    Attributes
    ----------
    recording : Recording
        With the effects and fields of this state, and the beam diameter and divergence that were fitted.
    errors : SettingErrors
    camera : Camera
        With its intrinsics as found.
    rotation, translation : (3, 3), (3,) mm
        Of the board as its marks define it, solved with this state's board, print and lens.
    shape : (c4, e_plus, e_cross)
        Of the beam's profile.
    """

    recording: Recording
    errors: SettingErrors
    camera: Camera
    rotation: Array
    translation: Array
    shape: tuple[float, float, float] = (0.0, 0.0, 0.0)


def state(predict: Predict, block: int, values: Mapping[str, float]) -> State:
    """State of a block of the bench's problem, from values of its nuisances and effects."""
    b = predict.blocks[block]
    truth = predict.truth(values)
    seen, camera = b.observed.view, predict.intrinsics(values, b)
    rotation, translation = seen.rotation, seen.translation
    if chain.active(truth) or camera is not None:
        rotation, translation, _ = chain.true_pose(truth, seen, camera)
    c4, plus, cross = (values.get(name, 0.0) for name in SHAPES)
    return State(truth, errors(values, b.setting), camera or seen.camera, rotation, translation, (c4, plus, cross))


@dataclass(frozen=True)
class PixelFit:
    """A render laid on the photograph.

    Attributes
    ----------
    gain, blur : float
        Counts per unit of the render; rms of the lens's Gaussian [px].
    changes : tuple of float
        What was taken up of each change that was offered; from `compare` the mm of `moved`.
    z_std : float
        rms of the whitened residuals within `WIDTHS` of the trace: 1 where only noise is left.
    coarse_std : float
        The same of averages over `STRETCH` profiles, which noise hides less.
    model, z : (k, m)
        Light, and residual over a pixel's sigma, on the straightened grid; nan where nothing was compared.
    """

    gain: float
    blur: float
    changes: tuple[float, ...]
    z_std: float
    coarse_std: float
    model: Array
    z: Array


@dataclass(frozen=True)
class ExposureComparison:
    """Photograph against render along one trace.

    Attributes
    ----------
    name : str
    pixels : int
        Compared.
    noise_std : float
        rms of the whitened residuals of the photograph less its own smooth light: checks the noise without any model.
    speckle, grain : float
        Relative rms of the speckle in a pixel, and its size [px].
    before, after : PixelFit
    t, n : (k,), (m,) px
        Straightened grid along and across the trace.
    photograph : (k, m)
        Light less dark, or less the background that ``after`` fitted.
    """

    name: str
    pixels: int
    noise_std: float
    speckle: float
    grain: float
    before: PixelFit
    after: PixelFit
    t: Array
    n: Array
    photograph: Array


@dataclass(frozen=True)
class Comparison:
    """All exposures that could be compared, and a sentence for each that could not."""

    exposures: tuple[ExposureComparison, ...]
    lost: tuple[str, ...]

    def pooled(self, which: str) -> float:
        """rms of z over all pixels; ``which``: "before" or "after"."""
        square = sum(x.pixels * getattr(x, which).z_std ** 2 for x in self.exposures)
        return float(np.sqrt(square / max(sum(x.pixels for x in self.exposures), 1)))


def moved(problem: Problem, block: int, values: Mapping[str, float], by: float) -> dict[str, float]:
    """Values with the mirror moved in the beam by so many mm along its axis, the exposure's other errors refitted.

    Where over the mirror's height the beam lies decides how lopsided the line is. The centre line, which other errors
    can always put back, does not say it; pixels do. The way there is bent, so that the refit is needed.
    """
    predict = problem.predict
    assert isinstance(predict, Predict)
    b = predict.blocks[block]
    truth = predict.truth(values)
    at = place(truth.mirror, truth.exposures[b.observed.index], errors(values, b.setting))
    along = at.axis - (at.axis @ at.laser_direction) * at.laser_direction
    along /= np.linalg.norm(along)
    shift = dict(zip(b.setting[:3], (by * along).tolist(), strict=True))
    start = {**values, **{name: values.get(name, 0.0) + d for name, d in shift.items()}}
    own = [p for p in problem.nuisances if p.blocks is not None and block in p.blocks and p.name not in shift]
    return probable(problem, own, start, [block])


def compare(
    recording: Recording,
    problem: Problem,
    before: Sequence[Mapping[str, float]],
    after: Sequence[Mapping[str, float]],
    *,
    blocks: Sequence[int] | None = None,
    seed: int = 0,
    relative_error: float = RELATIVE_ERROR,
    progress: Progress = silent,
) -> Comparison:
    """Render exposures before and after, and hold them against their photographs.

    What is shown is a render each, laid on the photograph with a gain, a blur, and a background where there is no dark
    picture. Of the setting errors the pixels themselves place the mirror in the beam, within three of its sigmas
    (`moved`), before and after alike; nothing else is fitted to them.

    Parameters
    ----------
    recording : Recording
        With its photographs.
    problem : Problem
        Of the bench (`instruments.bench.problem.build`): what was observed, and what its values mean.
    before, after : sequence of mapping
        Values of nuisances and effects, for every block: the same for all, or of settings left out for each (see
        `instruments.bench.probable`).
    blocks : sequence of int, optional
        Which to compare; default all.
    seed : int
        Of the light's rays.
    relative_error : float
        Of the light that is rendered, see `render.irradiance`.
    progress : callable

    Returns
    -------
    Comparison

    Raises
    ------
    BenchsimError
        If no exposure can be compared.
    """
    predict = problem.predict
    assert isinstance(predict, Predict)
    chosen = range(len(predict.blocks)) if blocks is None else blocks
    done, lost = [], []
    limit = 3 * recording.uncertainty.mirror_position / STEP
    for count, i in enumerate(chosen):
        observed = predict.blocks[i].observed
        exposure = recording.exposures[observed.index]
        try:
            show = partial(_render, recording, predict, i, seed=seed, relative_error=relative_error)
            tell = partial(progress, f"rendering {exposure.name} again")
            states = (before[i], after[i])
            tell(count / len(chosen))
            plain = [show(values) for values in states]
            free = plain[1].room > 0.85 * recording.screen.reflectance
            by = [STEP, STEP]
            for turn in (1, 2):
                tell((count + turn / 4) / len(chosen))
                offered = [
                    [p.laser, show(moved(problem, i, v, d)).laser] for p, v, d in zip(plain, states, by, strict=True)
                ]
                tried = compare_exposure(recording, observed, offered[0], offered[1], free, limit)
                taken = [d * fit.changes[0] for fit, d in zip((tried.before, tried.after), by, strict=True)]
                # The second turn offers about as much as is needed, so that what is not linear in it counts right.
                by = [float(np.clip(d, -limit * STEP, limit * STEP)) for d in taken]
                if max(map(abs, by)) < STILL:
                    break
            tell((count + 3 / 4) / len(chosen))
            last = [[show(moved(problem, i, v, d)).laser] for v, d in zip(states, by, strict=True)]
            found = compare_exposure(recording, observed, last[0], last[1], free)
            fits = [replace(fit, changes=(d,)) for fit, d in zip((found.before, found.after), by, strict=True)]
            done.append(replace(found, before=fits[0], after=fits[1]))
        except BenchsimError as error:
            lost.append(f"{exposure.name}: not compared in pixels: {error}")
    if not done:
        raise BenchsimError(f"{recording.path.name}: no exposure can be compared in pixels: {'; '.join(lost)}")
    return Comparison(tuple(done), tuple(lost))


def draw(comparison: Comparison, path: Path, title: str) -> None:
    """Photograph, render and residuals of every exposure compared, as one picture."""
    from benchsim.report.pixels import Strip, strips

    shown = [
        Strip(
            x.name,
            x.t,
            x.n,
            x.photograph,
            x.after.model,
            x.before.z,
            x.after.z,
            f"std of whitened z {x.before.z_std:.2f} before, {x.after.z_std:.2f} after (noise alone {x.noise_std:.2f})",
        )
        for x in comparison.exposures
    ]
    strips(path, shown, title)


def _render(
    recording: Recording,
    predict: Predict,
    block: int,
    values: Mapping[str, float],
    *,
    seed: int,
    relative_error: float,
) -> Any:
    from benchsim.render.again import expected

    s = state(predict, block, values)
    return expected(
        s.recording,
        recording.exposures[predict.blocks[block].observed.index],
        s.camera,
        s.rotation,
        s.translation,
        s.errors,
        shape=s.shape,
        seed=seed,
        relative_error=relative_error,
    )


@dataclass(frozen=True)
class _View:
    """Pixels of the band in the order of the trace (p,), and their noise."""

    band: Band
    u: NDArray[np.intp]
    v: NDArray[np.intp]
    t: Array
    n: Array
    light: Array
    background: Array | None
    grain: Grain
    inner: Mask
    half: float


def compare_exposure(
    recording: Recording,
    observed: Observed,
    before: Sequence[Image],
    after: Sequence[Image],
    free: Mask,
    limit: float = 1.0,
) -> ExposureComparison:
    """Hold two renders of one exposure against its photograph.

    Parameters
    ----------
    recording : Recording
    observed : Observed
        Where the trace is in the picture; not what is expected there.
    before, after : sequence of (rows, columns)
        Laser light of each state's render, any scale, without blur; then renders in which something has changed, which
        is fitted as so many times that change.
    free : (rows, columns) bool
        Pixels that see free board; those within four pixels of others are left out.

    Raises
    ------
    BenchsimError
        If too few pixels are free.
    """
    exposure = recording.exposures[observed.index]
    view = _view(recording, exposure, observed, free)
    white = whitener(view.u, view.v, view.t, view.grain, view.inner)
    own = white(view.grain.residual / np.sqrt(1 - view.grain.leverage))
    blocks = white(_blocks(view))
    blocks /= np.maximum(np.linalg.norm(blocks, axis=0), 1e-30)
    (first, _), (second, background) = (_fit(view, renders, white, blocks, limit) for renders in (before, after))
    return ExposureComparison(
        name=exposure.name,
        pixels=int(view.inner.sum()),
        noise_std=float(np.sqrt(np.mean(own**2))),
        speckle=float(np.sqrt(view.grain.noise.speckle)),
        grain=view.grain.size,
        before=first,
        after=second,
        t=view.band.t,
        n=_columns(view),
        photograph=_straight(view, view.light - background),
    )


def _view(recording: Recording, exposure: Exposure, observed: Observed, free: Mask) -> _View:
    photograph, dark = read_photographs(recording, exposure)
    if not photograph.linear or not len(observed.width2):
        raise BenchsimError("its gamma is unknown, so light cannot be compared; calibrate the camera's gamma")
    light = photograph.light.astype(float)
    pedestal = np.zeros_like(light)
    if dark is not None:
        light = light - dark.light
        pedestal = 2 * gaussian_filter(np.maximum(dark.light, 0).astype(float), 3.0)
    seen = observed.view
    on_board = np.column_stack([np.zeros(len(observed.points)), observed.points])
    uv = rays.project(seen.camera, seen.rotation, seen.translation, on_board)
    t = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(uv, axis=0), axis=1))])
    span = (0.0, float(t[-1]))
    curve = smooth_curve(t, uv, np.ones(len(t)), span)
    half = WIDTHS * float(np.median(np.sqrt(observed.width2) / observed.mm_per_px))
    band = band_along(curve, span, half + FLANK, light.shape)
    if band is None:
        raise BenchsimError("its trace lies outside of the picture; mend the camera")
    good = binary_erosion(free, np.ones((9, 9), bool), border_value=0)
    good &= ~maximum_filter(photograph.saturated, 3)
    use = band.inside & band.take(good)
    row = np.nonzero(use)[0]
    u, v, n = band.u[use], band.v[use], band.n[use]
    inner = np.abs(n) <= half
    if inner.sum() < 500:
        raise BenchsimError(f"only {inner.sum()} of its pixels show the trace on free board; show more of it")
    along, value = band.t[row], light[v, u]
    background = None
    if dark is None:
        terms = _background_terms(along, n, span)
        flank = ~inner
        background = terms @ np.linalg.lstsq(terms[flank], value[flank], rcond=None)[0]
    grain = measure_grain(u, v, along, n, value, pedestal[v, u], np.zeros(len(u)) if background is None else background)
    return _View(band, u, v, along, n, value, background, grain, inner, half)


def _background_terms(t: Array, n: Array, span: tuple[float, float]) -> Array:
    """Cubic along the trace, linear across it."""
    along = np.polynomial.legendre.legvander(2 * (t - span[0]) / (span[1] - span[0]) - 1, 3)
    return np.concatenate([along, along[:, :2] * (n / np.abs(n).max())[:, None]], axis=1)


def _blocks(view: _View) -> Array:
    """Sums over stretches of the trace and fifths of the window, as columns (p, blocks)."""
    part = np.clip(np.floor((view.n / view.half + 1) * 2.5), 0, 4).astype(int)
    number = (view.t // STRETCH).astype(int) * 5 + part
    chosen, number = np.unique(np.where(view.inner, number, -1), return_inverse=True)
    out = np.zeros((len(view.t), len(chosen)))
    out[np.arange(len(view.t)), number] = np.sqrt(view.grain.variance)
    return out[:, chosen >= 0]


def _fit(view: _View, renders: Sequence[Image], white: Whitener, blocks: Array, limit: float) -> tuple[PixelFit, Array]:
    """Gain, changes and background by least squares for every blur, the blur by the residuals' sum of squares."""
    low_u, low_v = max(int(view.u.min()) - 20, 0), max(int(view.v.min()) - 20, 0)
    cuts = [np.asarray(r[low_v : view.v.max() + 21, low_u : view.u.max() + 21], float) for r in renders]
    top = float(cuts[0].max())
    if not top > 0:
        raise BenchsimError("no rendered light falls on its trace; the simulation is too far off")
    cuts = [cuts[0] / top, *((c - cuts[0]) / top for c in cuts[1:])]
    weight = 1 / np.sqrt(view.grain.variance)
    terms = np.zeros((len(view.t), 0))
    if view.background is not None:
        terms = _background_terms(view.t, view.n, (0.0, float(view.t.max())))
    lines, gain = len(cuts), float(view.light.max())

    def solve(blur: float) -> tuple[Array, Array]:
        seen = [gaussian_filter(c, blur, truncate=6.0)[view.v - low_v, view.u - low_u] for c in cuts]
        design = np.column_stack([*seen, terms])
        # The prior of a change is in units of the change, whatever the gain.
        prior = np.eye(lines - 1, design.shape[1], 1) / (gain * limit)
        rows, right = np.vstack([design * weight[:, None], prior]), np.append(view.light * weight, np.zeros(lines - 1))
        return np.asarray(np.linalg.lstsq(rows, right, rcond=None)[0]), design

    def misfit(blur: float) -> float:
        c, design = solve(blur)
        return float((((view.light - design @ c) * weight)[view.inner] ** 2).sum())

    blur = float(minimize_scalar(misfit, bounds=BLURS, method="bounded", options={"xatol": 5e-3}).x)
    c, design = solve(blur)
    background = design[:, lines:] @ c[lines:]
    residual = view.light - design @ c
    z = white(residual)
    return (
        PixelFit(
            gain=float(c[0]),
            blur=blur,
            changes=tuple(float(x / c[0]) for x in c[1:lines]),
            z_std=float(np.sqrt(np.mean(z**2))),
            coarse_std=float(np.sqrt(np.mean((blocks.T @ z) ** 2))),
            model=_straight(view, design[:, :lines] @ c[:lines]),
            z=_straight(view, residual * weight),
        ),
        background,
    )


def _columns(view: _View) -> Array:
    """Columns of the straightened grid [px]."""
    return np.arange(-np.floor(view.half), np.floor(view.half) + 1)


def _straight(view: _View, values: Array) -> Array:
    """Pixels on the straightened grid: mean of those that fall into each cell, nan where there are none."""
    n = _columns(view)
    row = np.round(view.t - view.band.t[0]).astype(int)
    column = np.round(view.n - n[0]).astype(int)
    inside = (column >= 0) & (column < len(n))
    cell = row[inside] * len(n) + column[inside]
    size = len(view.band.t) * len(n)
    count = np.bincount(cell, minlength=size)
    total = np.bincount(cell, values[inside], minlength=size)
    with np.errstate(invalid="ignore", divide="ignore"):
        return (total / count).reshape(len(view.band.t), len(n))
