"""Exposures whose facets draw lines of their own: the mean of all light, and how far it parts.

What a ridge's centre, width and flux mean is lost where lines of several facets lie beside or half over each other.
The light of all of them has a mean, which is what `rays.predict` predicts, and a mean square offset about it, which is
the facets' mean square lean times the square of a lever, whatever their pattern. Both are read from the comb of lines
that each stretch of the trace shows (`trace.parting`), the line's shape being the stated bench's.

An exposure counts as parted only where no single line explains what lies across its trace: not the stated one, nor one
of any curvature of the wavefront, shaking or coma. A reflection beside the trace is taken for a facet's line if it
holds as much light as one; its offset then has to follow the lever, or no facet explains it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from benchsim import rays
from benchsim.bench.curve import signed_distance
from benchsim.bench.model import Exposure, Physics, Recording
from benchsim.instruments.bench.observed import Observed, mm_per_px, no_shape, nominal, smooth_floor
from benchsim.rays.cross_section import cross_sections
from benchsim.trace.pose import Pose
from benchsim.trace.side_lines import CELLS, REACH, Across, Comb, comb, one_line
from benchsim.trace.table import Trace

Array = NDArray[np.float64]
SINGLE = 1.5
"""χ² per bin beyond which a single line does not explain a stretch; lines of every kind of bench stay below 0.7, for
the error that its shape is granted is generous."""

BETTER = 3.0
"""How many times better a comb must explain it."""

BENT = (-8.0, -6.0, -4.0, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0)
"""Divergences beyond the stated one of single lines [mrad]; wavefront and facets may bend it by 4."""

SHAKEN = (0.0, 0.5, 1.0, 2.0, 4.0)
"""1 sigma of their shaking [mm]."""

COMA, COMA_WAYS = (0.02, 0.035, 0.05, 0.07, 0.1), 12
"""Coma of single lines, and directions in which each is tried."""

SHARE = 0.3
"""Of one facet's light: less is no line."""

APART = 1.5
"""In a line's widths: leans at which there is enough light within a width lie over one width already for one line."""

FEWEST = 6
"""Stretches on which all light is seen; with fewer the exposure stays as it is."""

FLOOR = (0.03, 0.1)
"""Smooth error of the parting: a share of it (shares and lever), and of the line's own mean square (its shape)."""

CHANGE = 150.0
"""Length over which the floors here change along the trace [mm]."""

MEAN_FLOOR = 0.01
"""Smooth error of the mean, in widths of the line."""


SAME_LEAN = 1.25
"""Ratio up to which the mean leans that exposures show may differ."""

PLAINER, PLAIN = 1.3, 2.5
"""How much further apart than where lines were seen, or how far in 1 sigma of a line, they would have to lie in an
exposure that shows one line for no facet to draw them."""


@dataclass(frozen=True)
class Parted:
    """Light of all facets of one exposure in n stretches.

    ``points`` (n, 2) mm: its mean; ``s`` (n,) mm; ``covariance`` (n, n) mm² across the trace, the pose's included;
    ``parting`` (n,) mm²: its mean square offset about the mean, one line's own not included; ``parting_covariance``.
    """

    points: Array
    s: Array
    covariance: Array
    parting: Array
    parting_covariance: Array


def parted(
    recording: Recording, exposure: Exposure, across: Across, pose: Pose, blur: float, line: Trace
) -> Parted | None:
    """The light of all facets, where it draws more than one line; None where one line explains it.

    Parameters
    ----------
    recording, exposure
        The stated bench.
    across : Across
    pose : Pose
    blur : float
        1 sigma of the camera's blur [px].
    line : Trace
        The main ridge, for the pose's share in its error.
    """
    if exposure.facet is not None or recording.mirror.shape != "polygon":
        return None
    known = np.isfinite(across.sigma)
    usable = np.flatnonzero(known.mean(axis=1) > 0.5).tolist()
    blurred = blur * mm_per_px(pose, across.points, across.normal)
    full, bare = Physics(True, True, True), nominal(recording)
    # A simulation without beam has no profile; and whatever it leaves out is no facet's line.
    stated = replace(bare, physics=bare.physics if bare.physics.beam else full)
    q, plain = _shapes(stated, exposure, across, blurred, 0.0, (0.0,))
    wide = np.array([(q[1] - q[0]) * (shape > 0.5 * shape.max()).sum() for shape in plain[0]])
    reach = REACH - wide.max()
    combs = {k: _comb(across, k, q, plain[0][k], wide[k], (-reach, reach)) for k in usable}
    # Where the stated line does, nothing else is tried.
    sample = [k for k in usable if _seen(across, k, 2 * wide[k])]
    if len(sample) < FEWEST or not _misfit(across, sample, q, plain[0], combs):
        return None
    sample = sample[:: max(1, len(sample) // 6)]

    def misfit(bench: Recording, bent: float, shaken: tuple[float, ...] = SHAKEN) -> float:
        """Of the best of a bench's single lines."""
        singles = _shapes(bench, exposure, across, blurred, 1e-3 * bent, shaken)[1]
        return min(_misfit(across, sample, q, single, combs) for single in singles)

    benches = (stated, replace(bare, physics=full))[: 1 + (stated.physics != full)]
    if not all(misfit(bench, bent) for bench, bent in product(benches, BENT)):
        return None
    comatic = _comatic(stated)
    # A beam may have coma and be bent, too; all of both would take a minute, and the likest coma alone is near enough.
    alone = [misfit(bench, 0.0, SHAKEN[:1]) for bench in comatic]
    likest = comatic[int(np.argmin(alone))]
    if not min(alone) or not all(misfit(likest, bent) for bent in BENT):
        return None
    lever = _lever(recording, exposure, across.points)
    return _measured(recording, across, q, plain[0], wide, combs, lever, line)


def follow_facets(recording: Recording, parted: Sequence[Observed], single: Sequence[Observed]) -> bool:
    """Whether the lines that some exposures show can be those of facets: all exposures see the same leans.

    A beam with strong coma or a caustic is no comb either, but how far its light parts follows no lever.

    Parameters
    ----------
    recording : Recording
        The stated bench.
    parted, single : sequences of Observed
        With lines apart, and with one line though all facets are seen.
    """

    def levers(seen: Observed) -> tuple[Array, float]:
        exposure = recording.exposures[seen.index]
        width = float(np.median(np.asarray(rays.predict(nominal(recording), exposure).width)))
        return _lever(recording, exposure, seen.points), width

    both = [levers(seen) for seen in parted]
    leans = np.sqrt([np.median(seen.parting / lever**2) for seen, (lever, _) in zip(parted, both, strict=True)])
    apart = min(lean * np.median(np.abs(lever)) / width for lean, (lever, width) in zip(leans, both, strict=True))
    if leans.max() > SAME_LEAN * leans.min():
        return False
    others = [np.median(np.abs(lever)) / width for lever, width in map(levers, single)]
    return bool(all(np.median(leans) * ratio < min(PLAINER * apart, PLAIN) for ratio in others))


def as_parted(seen: Observed, like: Sequence[Observed]) -> Observed:
    """Data of an exposure as they would be where lines part as in others, with noise like theirs; parting 0."""

    def usual(of: Callable[[Observed], Array]) -> float:
        return float(np.sqrt(np.median(np.concatenate([np.diag(of(o)) for o in like]))))

    centre, parting = usual(lambda o: o.covariance), usual(lambda o: o.parting_covariance)
    one = np.ones(len(seen.s))
    white = np.diag(one) / FEWEST**2
    return replace(
        seen,
        covariance=seen.covariance + centre**2 * (smooth_floor(seen.s, one, length=CHANGE) + white),
        parting=np.zeros(len(one)),
        parting_covariance=parting**2 * (smooth_floor(seen.s, one, length=CHANGE) + white),
        **no_shape(),
    )


def _measured(
    recording: Recording,
    across: Across,
    q: Array,
    shapes: Array,
    wide: Array,
    combs: dict[int, Comb],
    lever: Array,
    line: Trace,
) -> Parted | None:
    """Mean and parting of the light within the range of leans where all stretches together show lines."""
    least = SHARE / recording.mirror.facets
    low, high = _leans(combs, wide, lever, least)
    if high - low < APART * float(np.median(wide / np.abs(lever))):
        # What lies about the one line, a halo for instance, is none.
        return None
    rows, means, squares, errors = [], [], [], []
    for k in combs:
        reach = np.sort([low * lever[k], high * lever[k]]) + np.array([-0.5, 0.5]) * wide[k]
        inside = (across.q[k] > reach[0] - 0.5 * wide[k]) & (across.q[k] < reach[1] + 0.5 * wide[k])
        if not np.isfinite(across.sigma[k][inside]).all():
            continue
        found = _comb(across, k, q, shapes[k], wide[k], (float(reach[0]), float(reach[1])), least)
        rows.append(k)
        means.append(found.mean)
        squares.append(found.parting)
        errors.append(found.errors)
    if len(rows) < FEWEST:
        return None
    s, error = across.s[rows], np.array(errors)
    order = np.argsort(line.s_mm)
    shift = np.stack([np.interp(s, line.s_mm[order], column[order]) for column in line.pose_mm.T], axis=1)
    own = (wide[rows] / 2.355) ** 2
    parting = np.array(squares)
    return Parted(
        across.points[rows] + np.array(means)[:, None] * across.normal[rows],
        s,
        np.diag(error[:, 0] ** 2) + smooth_floor(s, MEAN_FLOOR * wide[rows], length=CHANGE) + shift @ shift.T,
        parting,
        np.diag(error[:, 1] ** 2) + smooth_floor(s, FLOOR[0] * parting + FLOOR[1] * own, length=CHANGE),
    )


def _leans(combs: dict[int, Comb], wide: Array, lever: Array, least: float) -> tuple[float, float]:
    """Least and largest lean [mrad] at which most stretches show that share of the light within a line's width."""
    step = 0.25 * float(np.median(wide / np.abs(lever)))
    leans = step * np.arange(
        -np.ceil(REACH / np.abs(lever).min() / step), np.ceil(REACH / np.abs(lever).min() / step) + 1
    )
    light = []
    for k, found in combs.items():
        near = np.abs(lever[k] * leans[:, None] - found.places) < 0.5 * wide[k]
        light.append(np.where(near.any(axis=1), near @ found.shares, np.nan))
    seen = np.isfinite(light).any(axis=0)
    lit = leans[seen][np.nanmedian(np.array(light)[:, seen], axis=0) > least]
    return float(lit.min()), float(lit.max())


def _seen(across: Across, k: int, reach: float) -> bool:
    """Whether a stretch shows all of what lies near the main ridge."""
    return bool(np.isfinite(across.sigma[k][np.abs(across.q[k]) < reach]).all())


def _bins(across: Across, k: int) -> tuple[Array, Array, Array]:
    known = np.isfinite(across.sigma[k])
    return across.q[k][known], across.light[k][known], across.error(k)[known]


def _comb(
    across: Across, k: int, q: Array, shape: Array, wide: float, reach: tuple[float, float], least: float = 0.0
) -> Comb:
    """The comb of a stretch, with cells where it has pixels."""
    step = CELLS * wide
    cells = step * np.arange(np.ceil(reach[0] / step), np.floor(reach[1] / step) + 1)
    dark = across.q[k][~np.isfinite(across.sigma[k])]
    if len(dark):
        cells = cells[np.abs(cells[:, None] - dark).min(axis=1) > 0.7 * wide]
    return comb(*_bins(across, k), (q, shape), cells, least)


def _misfit(across: Across, rows: list[int], q: Array, shapes: Array, combs: dict[int, Comb]) -> float:
    """χ² per bin of single lines where they fail on most stretches and combs do not; else 0."""
    alone = np.array([one_line(*_bins(across, k), (q, shapes[k])) for k in rows])
    bins = np.array([len(_bins(across, k)[0]) for k in rows])
    together = np.array([combs[k].chi2 for k in rows])
    left = float(np.median(alone / bins))
    return left if left > SINGLE and np.median(alone / together) > BETTER else 0.0


def _shapes(
    recording: Recording, exposure: Exposure, across: Across, blur: Array, bent: float, shaken: tuple[float, ...]
) -> tuple[Array, list[Array]]:
    """The stated bench's line behind the blur: places (n,) [mm], and for each shaking its light (stretch, n)."""
    q: Array = 0.05 * np.arange(-1200.0, 1201.0)
    laser = replace(recording.laser, divergence=recording.laser.divergence + bent)
    curve, light = cross_sections(replace(recording, laser=laser), exposure, q)
    at = np.interp(signed_distance(curve, across.points)[1], curve.arc_length(), np.arange(len(light)))
    first = np.minimum(at.astype(int), len(light) - 2)
    part = (at - first)[:, None]
    spectrum = np.fft.rfft((1 - part) * light[first] + part * light[first + 1], axis=1)
    k = 2 * np.pi * np.fft.rfftfreq(len(q), q[1] - q[0])
    out = []
    for sigma in shaken:
        blurred = np.fft.irfft(spectrum * np.exp(-0.5 * k**2 * (blur**2 + sigma**2)[:, None]), len(q), axis=1)
        out.append(np.maximum(blurred, 0.0) / blurred.max(axis=1, keepdims=True))
    return q, out


def _comatic(recording: Recording) -> list[Recording]:
    """The stated bench with a beam that has coma, whose light lies to one side with a tail, as two lines' may."""
    angles = np.arange(COMA_WAYS) * 2 * np.pi / COMA_WAYS
    sizes = [{"coma_u": c * float(np.cos(a)), "coma_v": c * float(np.sin(a))} for c in COMA for a in angles]
    return [replace(recording, effects={"coma": size}) for size in sizes]


def _lever(recording: Recording, exposure: Exposure, points: Array) -> Array:
    """How far a facet's line lies off for its lean [mm/mrad], (k,), at the stated setting."""
    bare = nominal(recording)

    def leaning(lean: float) -> Array:
        leant = replace(bare, effects={"canting": {"pyr": lean}})
        return signed_distance(rays.predict(leant, exposure, width=False), points)[0]

    return leaning(-0.5) - leaning(0.5)
