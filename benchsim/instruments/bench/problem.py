"""The bench as the diagnosis sees it: data of a recording, what was set by hand, and what might be missing.

Data of a block are, in this order, ``c`` (mm), ``w`` (mm²), ``f`` (1) and ``m`` (px); where the facets' lines part,
``g`` (mm²) stands in the place of ``w`` and ``f``. The centre line's datum is the
signed distance c₀ of a fixed point of the measured trace from the stated bench's curve; its prediction is c₀ less the
point's distance from the predicted curve, so that they differ by exactly that distance. The logarithm of the flux is
taken from its mean over the exposure, to which a free gain is added.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from benchsim import rays
from benchsim.bench.curve import Curve, signed_distance
from benchsim.bench.model import Physics, Recording
from benchsim.bench.place import place
from benchsim.bench.settings import NAMES, OF_THE_SEAT, prior_sigma, screen_seats, uncertainty_of
from benchsim.diagnosis.problem import Effect, Parameter, Problem, Values
from benchsim.instruments.bench.attachments import attachments
from benchsim.instruments.bench.blocks import Block, Response
from benchsim.instruments.bench.board_coordinates import pose_of
from benchsim.instruments.bench.candidates import candidates, simulated
from benchsim.instruments.bench.effects import BY_NAME, terms
from benchsim.instruments.bench.next_recordings import Next
from benchsim.instruments.bench.observed import Observed, beside, mm_per_px
from benchsim.instruments.bench.prediction import SAMPLES, SHAPES, UNITS, Predict
from benchsim.instruments.bench.simulation import simulate_one
from benchsim.rays.camera import EFFECTS as BEYOND_THE_BOARD
from benchsim.rays.width import placed

Array = NDArray[np.float64]

BLUR_SIGMA = 0.15
"""Of the blur as a fraction: marks at the board's edge and the trace in its middle are not equally sharp."""

SHAPE_SIGMA = {"beam_c4": 0.02, "beam_plus": 0.05, "beam_cross": 0.05}
"""Of the beam's log-density perturbations: a TEM00 beam behind an expander is round to some 2.5 % in diameter, which is
a perturbation of 0.05, and Gaussian to 2 to 6 % of its density out to its 1/e² radius. Larger quartic terms would also
make the fits treacherous: with a sigma of 0.1 they have a second minimum far away."""

GAIN_SIGMA = 1.0
"""Of the logarithm of the light in an exposure, which is free; data are centred, so that it is nearly 0."""


def build(
    recording: Recording, observed: tuple[Observed, ...], *, against: str = "bench", attached: bool = True
) -> Problem:
    """The problem of a recording.

    Parameters
    ----------
    recording : Recording
    observed : tuple of Observed
        Of its exposures, those that were lost left out.
    against : {"bench", "vector"}
        The simulation in doubt: exactly the file's ``[physics]`` and ``[effects]``, or ``[physics]`` all false.

    attached : bool
        Whether to compute the attachments (seconds for a dozen exposures); limits and isolability do without.

    Returns
    -------
    Problem
        Settings in mm and mrad, effects in the file's units. Kinds ``c w f g m``; groups are settings.

    Raises
    ------
    BenchsimError
        If a trace of the simulation in doubt misses the board at the stated setting, or ``against`` is unknown.

    Notes
    -----
    The marks' residuals are those of a pose fitted to them: six of an exposure's 2 m numbers are spent, and χ² of
    kind ``m`` is on average 2 m − 6.
    """
    doubted = replace(recording, physics=simulated(recording, against))
    catalogue = candidates(recording, against)
    predict = _predict(doubted, recording, observed, catalogue)
    for number in range(len(predict.blocks)):
        # Later a trace beside the board only makes a hypothesis impossible; here it is the file that is wrong.
        predict.light({}, number, doubted)
    data, covariance, kind, position, stretch, block = [], [], [], [], [], []
    for number, b in enumerate(predict.blocks):
        o = b.observed
        kept = b.kept
        marks = block_diag(*o.marks_covariance[kept]) if kept.any() else np.zeros((0, 0))
        parts = [("c", b.offset, o.covariance, o.s)]
        if b.shaped:
            parts.append(("w", o.width2, o.width2_covariance, o.profile_s))
            parts.append(("f", o.log_flux, o.log_flux_covariance, o.profile_s))
        if len(o.parting):
            parts.append(("g", o.parting, o.parting_covariance, o.s))
        parts.append(("m", o.marks[kept].ravel(), marks, np.arange(2.0 * kept.sum())))
        for line, (name, values, _, at) in enumerate(parts):
            data.append(values)
            kind.append(np.full(len(values), name))
            position.append(at)
            stretch.append(np.full(len(values), -1 if name == "m" else line))
            block.append(np.full(len(values), number))
        covariance.append(block_diag(*(p[2] for p in parts)))
    return Problem(
        data=np.concatenate(data),
        block=np.concatenate(block),
        kind=np.concatenate(kind),
        position=np.concatenate(position),
        stretch=np.concatenate(stretch),
        covariance=tuple(covariance),
        names=tuple(o.name for o in observed),
        groups=tuple(recording.exposures[o.index].setting for o in observed),
        nuisances=nuisances(recording, predict),
        catalogue=catalogue,
        predict=predict,
        attachments=attachments(predict) if attached else (),
        next_recordings=Next(
            recording, against, catalogue, build, simulate_one, tuple(o for o in observed if len(o.parting))
        ),
    )


def nuisances(recording: Recording, predict: Predict) -> tuple[Parameter, ...]:
    """What may differ from the file without being an effect, with its prior."""
    u = recording.uncertainty
    sigma = prior_sigma(uncertainty_of(recording), reseated=True) * np.array(
        [1.0 if unit == "mm" else 1e3 for unit in UNITS]
    )
    out: dict[str, Parameter] = {}
    blocks = predict.blocks

    def share(name: str, of: int) -> tuple[int, ...]:
        return tuple(i for i, b in enumerate(blocks) if b.setting[of] == name)

    for b in blocks:
        for k, name in enumerate(b.setting):
            if name and name not in out and sigma[k] > 0:
                out[name] = Parameter(name, UNITS[k], float(sigma[k]), scaled=True, blocks=share(name, k))
    for name, fraction in (("beam_diameter", u.beam_diameter_fraction), ("divergence", u.divergence_fraction)):
        if fraction > 0:
            out[name] = Parameter(name, "1", fraction)
    for name in SHAPES:
        out[name] = Parameter(name, "1", SHAPE_SIGMA[name])
    for b in blocks:
        same = tuple(i for i, other in enumerate(blocks) if other.camera == b.camera)
        if b.shaped:
            wide = tuple(i for i in same if blocks[i].shaped)
            out[f"{b.camera}.blur"] = Parameter(f"{b.camera}.blur", "1", BLUR_SIGMA, blocks=wide)
        focal, centre, k1 = u.intrinsics_sigma
        for name, unit, s in (
            ("focal", "1e-3", 1e3 * focal),
            ("principal_u", "px", centre),
            ("principal_v", "px", centre),
            ("k1", "1", k1),
        ):
            if s > 0:
                out[f"{b.camera}.{name}"] = Parameter(f"{b.camera}.{name}", unit, s, blocks=same)
    for i, b in enumerate(blocks):
        if b.shaped:
            name = f"{b.observed.name}.gain"
            out[name] = Parameter(name, "1", GAIN_SIGMA, blocks=(i,))
    return tuple(out.values())


def draw(problem: Problem, values: Values, rng: np.random.Generator) -> Problem:
    """The same problem with data of another truth, and noise by its covariance.

    Parameters
    ----------
    problem : Problem
    values : mapping
        The truth: nuisances and effects.
    rng : numpy Generator
    """
    data = np.empty_like(problem.data)
    for b, covariance in enumerate(problem.covariance):
        rows = problem.rows(b)
        noise = np.linalg.cholesky(covariance) @ rng.standard_normal(len(covariance))
        data[rows] = problem.predict(values, b) + noise
    return replace(problem, data=data)


def _predict(
    doubted: Recording, recording: Recording, observed: tuple[Observed, ...], catalogue: tuple[Effect, ...]
) -> Predict:
    owners = {p.name: e.name for e in catalogue for p in e.parameters}
    # Files may state what no candidate fits: it is in the recording's own effects and stays there.
    shapes = frozenset(p.name for e in catalogue for p in e.parameters if p.grid)
    aside = {t.name for name in BEYOND_THE_BOARD if name in BY_NAME for t in terms(name, 0)}
    seats = screen_seats(recording.exposures)
    blocks = []
    for o in observed:
        exposure = recording.exposures[o.index]
        seat = seats[o.index]
        names = [f"{exposure.setting}.{n}" for n in NAMES]
        names[OF_THE_SEAT] = [f"seat{seat}.{n}" if seat else "" for n in NAMES[OF_THE_SEAT]]
        stated = rays.predict(replace(doubted, effects={}, fields={}), exposure, samples=SAMPLES)
        response = None if len(o.parting) else _response(doubted, recording, o)
        kept = np.asarray(np.isfinite(o.marks).all(axis=1))
        offset = signed_distance(stated, o.points)[0]
        o = replace(o, log_flux=o.log_flux - o.log_flux.mean()) if len(o.log_flux) else o
        blocks.append(Block(o, tuple(names), response, _level(o, stated), kept, offset))
        camera = o.view.camera.name
        aside |= {f"{camera}.{k}" for k in ("blur", "focal", "principal_u", "principal_v", "k1")} | {f"{o.name}.gain"}
    return Predict(doubted, tuple(blocks), owners, shapes, frozenset(aside))


def _level(o: Observed, stated: Curve) -> Array:
    """Peak brightness along the stated trace, 1 at the brightest that the camera saw.

    The light is as bright as it was measured, where it was: settings that are off by their errors make a tenth of it,
    and blooming goes by its square.
    """
    assert stated.flux is not None
    arc, scale, flux = stated.arc_length(), np.array(0.7), stated.flux
    if len(o.log_flux):
        s = signed_distance(stated, o.profile_points)[1]
        order = np.argsort(s)
        scale = np.interp(arc, s[order], o.mm_per_px[order])
        # A parabola: the noise of single profiles is not the trace's brightness, nor is there any beyond the ends.
        at = np.polynomial.Polynomial.fit(s, o.log_flux - np.interp(s, arc, np.log(flux)), min(2, len(s) - 1))
        flux = flux * np.exp(at(np.clip(arc, s.min(), s.max())))
    width = np.hypot(stated.width if stated.width is not None else 0.0, o.blur * scale)
    level = flux / width
    ends = signed_distance(stated, np.concatenate([o.points, o.ends]))[1]
    near = (arc > ends.min() - 20.0) & (arc < ends.max() + 20.0)
    return np.asarray(level / level[near].max() if near.any() else level / level.max())


def _response(doubted: Recording, recording: Recording, o: Observed) -> Response:
    """Centre and width behind the blur, at the stated bench: exact there, and their slopes by light and blur."""
    exposure = recording.exposures[o.index]
    p = doubted.physics
    # A simulation without beam has no profile; what it lacks is then judged by the full one's.
    physics = p if p.beam else Physics(recording.mirror.shape == "polygon", True, True)
    q: Array = 0.05 * np.arange(-400.0, 401.0)
    curve, light = rays.irradiance_profiles(
        recording.laser,
        recording.mirror,
        physics,
        recording.screen,
        place(recording.mirror, exposure),
        q,
        facet=exposure.facet,
        samples=20,
    )
    points = np.concatenate([o.points, o.profile_points])
    s = np.clip(signed_distance(curve, points)[1], 0, curve.arc_length()[-1])
    index = np.interp(s, curve.arc_length(), np.arange(len(curve.points)))
    low = np.minimum(index.astype(int), len(curve.points) - 2)
    part = (index - low)[:, None]
    profile = np.maximum((1 - part) * light[low] + part * light[low + 1], 0.0)
    normal = beside(curve, s, np.full(len(s), 0.5)) - beside(curve, s, np.full(len(s), -0.5))
    blur = o.blur * mm_per_px(pose_of(o.view), points, normal)
    n = len(o.points)
    mean = float(blur[n:].mean()) if len(blur) > n else float(blur.mean())

    def seen(b: Array, stretch: float = 1.0) -> tuple[Array, Array]:
        """Squares of the widths, and the centres."""
        f = np.fft.rfft(profile, axis=1)
        k = 2 * np.pi * np.fft.rfftfreq(len(q), q[1] - q[0])
        blurred = np.fft.irfft(f * np.exp(-0.5 * (k * b[:, None] / stretch) ** 2), len(q), axis=1)
        width, centre = placed(np.broadcast_to(stretch * q, blurred.shape), np.maximum(blurred, 0.0))
        return width**2, centre

    step, same = 0.01, np.full(len(blur), mean)
    (at, there), (near, alike) = seen(blur), seen(same)
    slope = (seen(blur, 1 + step)[0] - seen(blur, 1 - step)[0]) / (seen(same, 1 + step)[0] - seen(same, 1 - step)[0])
    by_blur, moved = (
        (more - less) / ((1.02**2 - 0.98**2) * blur**2)
        for more, less in zip(seen(1.02 * blur), seen(0.98 * blur), strict=True)
    )
    if not p.beam:
        there, alike, moved = np.zeros((3, len(s)))
    return Response(mean, at[n:], near[n:], slope[n:], by_blur[n:], (there - alike)[:n], moved[:n], blur[:n] ** 2)
