"""The loop closed in pixels: photographs less the same exposures rendered again, in units of the photographs' noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.optimize import minimize_scalar
from scipy.spatial import cKDTree

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Exposure, Recording
from benchsim.instruments.bench.fitted_simulation import State
from benchsim.instruments.bench.observed import Observed
from benchsim.instruments.bench.pixels import WIDTHS, Pixels, about_trace
from benchsim.jobs.progress import Progress, silent
from benchsim.trace.speckle import Whitener

Array = NDArray[np.float64]
Image = NDArray[np.floating]

BLURS = (0.2, 3.0)
"""Range of the lens's blur [px]."""

NEAR = 1.0
"""Farthest pixel that a cell of the straightened grid shows [px]."""

RAYS = 1 << 24
"""Of a render, 1 s of CPU. A bin of 0.25 mm is then good to some 0.007, a pixel that sees sixteen to 0.003, where a
photograph has 0.01 and more (8-bit pictures and speckle; 0.005 at best, where z becomes 1.15 instead of 1). A fixed
number, since what adds dimensions to the light (shaking, facets that differ) makes a wanted error cost minutes."""


@dataclass(frozen=True)
class Render:
    """What is laid on a photograph.

    Attributes
    ----------
    laser : (rows, columns)
        Laser light of a state's render, any scale, without blur.
    arrived : callable
        From that light, blurred by the lens, to where its charge is read: what bright pixels do on the sensor.
    """

    laser: Image
    arrived: Callable[[Image], Image] = lambda light: light


@dataclass(frozen=True)
class PixelFit:
    """A render laid on the photograph.

    Attributes
    ----------
    gain, blur : float
        Counts per unit of the render; rms of the lens's Gaussian [px].
    z_std : float
        rms of the whitened residuals within `WIDTHS` of the trace: 1 where only noise is left.
    core_std : float
        The same within one width.
    model, z : (k, m)
        Light, and residual over a pixel's sigma, on the straightened grid; nan where nothing was compared.
    """

    gain: float
    blur: float
    z_std: float
    core_std: float
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

    def pooled(self, which: str, core: bool = False) -> float:
        """rms of z over all pixels, or over those within one width; ``which``: "before" or "after"."""
        fits = [getattr(x, which) for x in self.exposures]
        std = np.array([f.core_std if core else f.z_std for f in fits])
        # Every exposure's share of pixels within one width is about the same.
        return float(np.sqrt(np.average(std**2, weights=[x.pixels for x in self.exposures])))


def compare(
    recording: Recording,
    observed: Sequence[Observed],
    before: Sequence[State],
    after: Sequence[State],
    *,
    pixels: Sequence[Pixels | None] | None = None,
    seed: int = 0,
    rays: int = RAYS,
    progress: Progress = silent,
) -> Comparison:
    """Render exposures before and after, and hold them against their photographs.

    Gain, blur and, where there is no dark picture, a background are fitted to each photograph; nothing else is.

    Parameters
    ----------
    recording : Recording
        With its photographs.
    observed : sequence of Observed
        The exposures to compare.
    before, after : sequence of State
        One for each; where both are the same object there is one render.
    pixels : sequence of Pixels or None, optional
        Of each, as `pixels_of` gave them; where they are not there the photograph is read.
    seed : int
        Of the light's rays.
    rays : int
        For each render, see `render.irradiance`.
    progress : callable

    Returns
    -------
    Comparison

    Raises
    ------
    BenchsimError
        If no exposure can be compared.
    """
    from benchsim.renderer.charge import arrived
    from benchsim.renderer.rerendered import expected

    def show(s: State, exposure: Exposure) -> Render:
        picture = expected(
            s.recording, exposure, s.camera, s.rotation, s.translation, s.errors,
            shape=s.shape, seed=seed, rays=rays, lit_only=True,
        )  # fmt: skip
        return Render(picture.laser, partial(arrived, effects=s.recording.effects, fields=s.recording.fields))

    unknown = {name for name, camera in recording.cameras.items() if camera.gamma == "unknown"}
    if unknown and all(recording.exposures[o.index].camera in unknown for o in observed):
        raise BenchsimError(
            f"{recording.path.name}: cameras.{min(unknown)}.gamma: unknown, so that photographs are not compared pixel "
            "by pixel with renders, only their traces; state the gamma if the camera's maker does"
        )
    done, lost = [], []
    known = pixels or [None] * len(observed)
    for count, (o, old, new, view) in enumerate(zip(observed, before, after, known, strict=True)):
        exposure = recording.exposures[o.index]
        try:
            progress(f"rendering {exposure.name} again", count / len(observed))
            last = show(new, exposure)
            progress(f"rendering {exposure.name} again", (count + 0.5) / len(observed))
            first = last if old is new else show(old, exposure)
            done.append(compare_exposure(exposure.name, view or about_trace(recording, o), first, last))
        except BenchsimError as error:
            lost.append(f"{exposure.name}: not compared in pixels: {error}")
    if not done:
        raise BenchsimError(f"{recording.path.name}: no exposure can be compared in pixels: {'; '.join(lost)}")
    return Comparison(tuple(done), tuple(lost))


def draw(comparison: Comparison, path: Path, title: str) -> list[Path]:
    """Photograph, render and residuals of every exposure compared; see `report.pixels.strips`."""
    from benchsim.reports.pixels import Strip, strips

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
    return strips(path, shown, title)


def compare_exposure(name: str, view: Pixels, before: Render, after: Render) -> ExposureComparison:
    """Hold two renders of one exposure against the pixels about its trace.

    Raises
    ------
    BenchsimError
        If no rendered light falls on the trace.
    """
    whole, core = view.white(WIDTHS), view.white(1.0)
    own = whole(view.grain.residual / np.sqrt(1 - view.grain.leverage))
    second, background = _fit(view, after, whole, core)
    first = second if before is after else _fit(view, before, whole, core)[0]
    return ExposureComparison(
        name=name,
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


def _fit(view: Pixels, render: Render, whole: Whitener, core: Whitener) -> tuple[PixelFit, Array]:
    """Gain and background by least squares for every blur, the blur by the residuals' sum of squares."""
    low_u, low_v = max(int(view.u.min()) - 20, 0), max(int(view.v.min()) - 20, 0)
    cut = np.asarray(render.laser[low_v : view.v.max() + 21, low_u : view.u.max() + 21], float)
    top = float(cut.max())
    if not top > 0:
        raise BenchsimError("no rendered light falls on its trace; the simulation is too far off")
    weight = 1 / np.sqrt(view.grain.variance)
    # What lies beyond the window is needed for the background alone.
    part = view.inner
    terms = view.background_terms()
    if terms.shape[1]:
        part = np.ones_like(part)

    def solve(blur: float) -> tuple[Array, Array]:
        seen = render.arrived(gaussian_filter(cut / top, blur, truncate=6.0))[view.v - low_v, view.u - low_u]
        design = np.column_stack([seen, terms])
        c = np.linalg.lstsq((design * weight[:, None])[part], (view.light * weight)[part], rcond=None)[0]
        return np.asarray(c), design

    def misfit(blur: float) -> float:
        c, design = solve(blur)
        return float((((view.light - design @ c) * weight)[part] ** 2).sum())

    blur = float(minimize_scalar(misfit, bounds=BLURS, method="bounded", options={"xatol": 5e-3}).x)
    c, design = solve(blur)
    residual = view.light - design @ c
    return (
        PixelFit(
            gain=float(c[0]) / top,
            blur=blur,
            z_std=float(np.sqrt(np.mean(whole(residual) ** 2))),
            core_std=float(np.sqrt(np.mean(core(residual) ** 2))),
            model=_straight(view, design[:, 0] * c[0]),
            z=_straight(view, residual * weight),
        ),
        design[:, 1:] @ c[1:],
    )


def _columns(view: Pixels) -> Array:
    """Columns of the straightened grid [px]."""
    return np.arange(-np.floor(view.half), np.floor(view.half) + 1)


def _straight(view: Pixels, values: Array) -> Array:
    """Pixels on the straightened grid: the nearest one's value, nan where there is none within `NEAR`."""
    t, n = np.meshgrid(view.band.t, _columns(view), indexing="ij")
    tree = cKDTree(np.stack([view.t, view.n], axis=1))
    _, nearest = tree.query(np.stack([t.ravel(), n.ravel()], axis=1), distance_upper_bound=NEAR)
    return np.append(values, np.nan)[nearest].reshape(t.shape)
