"""What the ray model predicts of a recording: the trace of an exposure with every effect of light, and its ghost."""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.curve import Curve, signed_distances
from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Exposure, Recording
from benchsim.bench.place import Placement, SettingErrors, place, places
from benchsim.rays import batch
from benchsim.rays.bench import Bench
from benchsim.rays.curve import tangents, trace, traces
from benchsim.rays.effects import Elements, elements
from benchsim.rays.ghost import ghost_of, ghosts, pulled
from benchsim.rays.interpolated_trace import left_of
from benchsim.rays.phases import check

Array = NDArray[np.float64]
Shape = tuple[float, float, float]

TOGETHER = 64
"""Most cases worked out together: beyond, little is gained for the memory."""


class Case(NamedTuple):
    """What `predict` takes of one case."""

    recording: Recording
    exposure: Exposure
    errors: SettingErrors | None = None
    shape: Shape = (0.0, 0.0, 0.0)
    blur: float = 0.0


def bench_of(
    recording: Recording,
    exposure: Exposure,
    errors: SettingErrors | None = None,
    shape: Shape = (0.0, 0.0, 0.0),
    blur: float = 0.0,
) -> Bench:
    """The bench of one exposure with the recording's effects and fields; see `predict`."""
    stands = place(recording.mirror, exposure, errors)
    return _bench(recording, exposure, stands, elements(recording, exposure, shape), blur)


def _bench(recording: Recording, exposure: Exposure, stands: Placement, parts: Elements, blur: float = 0.0) -> Bench:
    placement = parts.turned(stands)
    if blur:
        # A camera spreads what it sees as shaking spreads the light: widths behind both are those of one Gaussian.
        parts = replace(parts, timing=replace(parts.timing, shake=math.hypot(parts.timing.shake, blur)))
    return Bench(
        recording.laser, recording.mirror, recording.physics, recording.screen, placement, exposure.facet, parts
    )


def predict(
    recording: Recording,
    exposure: Exposure,
    errors: SettingErrors | None = None,
    samples: int = 96,
    *,
    width: bool = True,
    shape: Shape = (0.0, 0.0, 0.0),
    blur: float = 0.0,
) -> Curve:
    """Time-averaged trace of one exposure on the board, with the recording's effects and fields of light.

    Effects and fields between board and pixel do not act here; see `camera.see`. Where ``[physics]`` leaves facets,
    beam or diffraction out and an effect gives their amplitude a, the trace is (1 − a) of the one without and a of the
    one with (multilinear in several): of the positions across, the squared widths, and the flux along the trace.

    Parameters
    ----------
    recording : Recording
    exposure : Exposure
    errors : SettingErrors, optional
        True minus stated setting; default none.
    samples : int
        Points along the curve.
    width : bool
        False leaves the width out (None), which saves about half the time.
    shape : (c4, e_plus, e_cross)
        True beam profile over the Gaussian: its density is multiplied with exp(c4 (s² − 2 s) + (e_plus (u² − v²) +
        e_cross 2 u v)/w²), s = 2 (u² + v²)/w². Not normalised: the flux is to be compared along one trace only.
    blur : float
        rms [mm] on the board of a camera's Gaussian blur: the width is then that behind it, and so is ``parting``.

    Returns
    -------
    Curve
        See `curve.trace_curve`; true board coordinates.

    Raises
    ------
    BenchsimError
        For an effect or parameter that does not exist, and as `curve.trace_curve`.
    """
    mixture = _mixture(bench_of(recording, exposure, errors, shape, blur))
    try:
        curves = [_with_ghost(bench, samples, width=width) for bench in mixture.benches]
    except BenchsimError as error:
        raise BenchsimError(f"{exposure.name}: {error}") from None
    return _mixed([(mixture.shares, curves)], width=width)[0]


def predict_many(cases: Sequence[Case], samples: int = 96, *, width: bool = True) -> list[Curve | None]:
    """`predict` of many cases, worked out together where their benches differ in numbers alone: several times cheaper.

    Parameters
    ----------
    cases : sequence of Case
        Of any exposures. Cases of equal or no effects gain most; free fields and single rays gain nothing.
    samples, width
        As `predict`.

    Returns
    -------
    list of Curve or None
        Equal to `predict`'s to rounding, widths to 1e-7 mm; None where the light misses mirror or board.

    Raises
    ------
    BenchsimError
        For an effect, a parameter or a value that an element cannot take.
    """
    known: dict[Hashable, Elements] = {}
    shared: dict[Hashable, Any] = {}
    mixtures = []
    for (recording, exposure, _, shape, blur), stands in zip(cases, _stand(cases), strict=True):
        # By identity: recordings hold tables, which are compared slowly. The cases keep them alive.
        key = id(recording), id(exposure), shape
        if key not in known:
            known[key] = elements(recording, exposure, shape, shared)
        mixtures.append(_mixture(_bench(recording, exposure, stands, known[key], blur)))
    benches = [bench for mixture in mixtures for bench in mixture.benches]
    curves: list[Curve | None] = [None] * len(benches)
    for group in batch.groups(benches, TOGETHER):
        if len(group) > 1:
            found = _alike([benches[i] for i in group], samples, width=width)
        else:
            found = [_or_none(benches[i], samples, width=width) for i in group]
        for i, curve in zip(group, found, strict=True):
            curves[i] = curve
    out: list[Curve | None] = [None] * len(cases)
    lit: dict[int, tuple[tuple[float, ...], list[Curve]]] = {}
    first = 0
    for i, mixture in enumerate(mixtures):
        own = [c for c in curves[first : first + len(mixture.benches)] if c is not None]
        first += len(mixture.benches)
        if len(own) == len(mixture.benches):
            lit[i] = mixture.shares, own
    for i, curve in zip(lit, _mixed(list(lit.values()), width=width), strict=True):
        out[i] = curve
    return out


def _stand(cases: Sequence[Case]) -> list[Placement]:
    """Placements of cases."""
    by_mirror: dict[int, list[int]] = {}
    for i, case in enumerate(cases):
        by_mirror.setdefault(id(case[0].mirror), []).append(i)
    out: dict[int, Placement] = {}
    for members in by_mirror.values():
        out.update(zip(members, places(cases[members[0]][0].mirror, [cases[i][1:3] for i in members]), strict=True))
    return [out[i] for i in range(len(cases))]


def _or_none(bench: Bench, samples: int, *, width: bool) -> Curve | None:
    try:
        return _with_ghost(bench, samples, width=width)
    except BenchsimError:
        return None


def _alike(benches: Sequence[Bench], samples: int, *, width: bool) -> list[Curve | None]:
    """Traces of benches that are `batch.alike`; behind glass as the ghost pulls them."""
    if not benches[0].parts.polygon.glass:
        return traces(benches, samples, width=width)
    out = [
        None if curve is None else pulled(curve, ghost)
        for curve, ghost in zip(traces(benches, samples), ghosts(benches, samples), strict=True)
    ]
    return out if width else [None if curve is None else replace(curve, width=None, aside=None) for curve in out]


class _Mixture(NamedTuple):
    """Benches without and with what the physics leaves out, whose light an effect mixes, and the share of each.

    From the first one's trace the others' are measured, whatever its share.
    """

    benches: tuple[Bench, ...]
    shares: tuple[float, ...]


def _mixture(bench: Bench) -> _Mixture:
    """The one bench where nothing is mixed."""
    has, parts = bench.physics, bench.parts
    amounts = {
        name: amount
        for name, amount in (
            ("facets", parts.polygon.facets),
            ("beam", parts.source.beam),
            ("diffraction", parts.diffraction),
        )
        if amount and not getattr(has, name)
    }
    if not amounts:
        return _Mixture((bench,), (1.0,))
    plain = replace(
        parts, polygon=replace(parts.polygon, facets=0.0), source=replace(parts.source, beam=0.0), diffraction=0.0
    )
    benches: list[Bench] = []
    shares: list[float] = []
    for choice in product((False, True), repeat=len(amounts)):
        share = float(np.prod([a if on else 1 - a for a, on in zip(amounts.values(), choice, strict=True)]))
        if share or not benches:
            physics = replace(has, **dict(zip(amounts, choice, strict=True)))
            benches.append(replace(bench, physics=physics, parts=plain))
            shares.append(share)
    return _Mixture(tuple(benches), tuple(shares))


def _mixed(mixtures: Sequence[tuple[Sequence[float], Sequence[Curve]]], *, width: bool) -> list[Curve]:
    """Of every mixture its trace, from the shares and traces of its benches."""
    # Where the mirror misses a part of the beam a trace has fewer points.
    alike: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for m, (_, curves) in enumerate(mixtures):
        for k, curve in enumerate(curves[1:], 1):
            alike.setdefault((len(curve.points), len(curves[0].points)), []).append((m, k))
    feet: dict[tuple[int, int], tuple[Array, Array, Array]] = {}
    for members in alike.values():
        some = [mixtures[m][1][k] for m, k in members]
        traced, phases = np.stack([c.points for c in some]), np.stack([_given(c.phase) for c in some])
        at = np.stack([mixtures[m][1][0].points for m, _ in members])
        distance, s, phase = signed_distances(traced, at, phases[..., None])
        assert phase is not None
        feet.update(zip(members, zip(distance, s, phase[..., 0], strict=True), strict=True))
    return [
        _sum(shares, curves, [feet[m, k] for k in range(1, len(curves))], width=width) if len(curves) > 1 else curves[0]
        for m, (shares, curves) in enumerate(mixtures)
    ]


def _sum(
    shares: Sequence[float], curves: Sequence[Curve], feet: Sequence[tuple[Array, Array, Array]], *, width: bool
) -> Curve:
    """One mixture's trace. ``feet``: of every curve but the first, distances of the first's points, the arc lengths of
    their feet, and the phases there."""
    base = curves[0]
    none = np.zeros(len(base.points)), base.arc_length(), _given(base.phase)
    offset, wide, relative, phase, parting, aside = np.zeros((6, len(base.points)))
    level = 0.0
    for share, curve, (d, s, turned) in zip(shares, curves, (none, *feet), strict=True):
        at, flux = curve.arc_length(), _given(curve.flux)
        offset -= share * d
        relative += share * np.interp(s, at, flux) / flux.mean()
        level += share * float(flux.mean())
        phase += share * turned
        if curve.parting is not None:
            parting += share * np.interp(s, at, curve.parting)
        if curve.width is not None:
            wide += share * np.interp(s, at, curve.width) ** 2
        if curve.aside is not None:
            aside += share * np.interp(s, at, curve.aside)
    # Of a mixture of lights it is the second moment that mixes; shares beyond 0 … 1 can make it negative.
    spread = np.sqrt(np.maximum(wide, 0.0)) if width else None
    normal = left_of(tangents(base.points))
    return Curve(base.points + offset[:, None] * normal, spread, relative * level, phase, parting, aside)


def _given(values: Array | None) -> Array:
    assert values is not None
    return values


def _with_ghost(bench: Bench, samples: int, *, width: bool) -> Curve:
    """The trace; behind glass as the front face's ghost pulls it."""
    if not bench.parts.polygon.glass:
        return trace(bench, samples, width=width)
    curve = pulled(trace(bench, samples), ghosts([bench], samples)[0])
    return curve if width else replace(curve, width=None, aside=None)


def ghost(
    recording: Recording, exposure: Exposure, errors: SettingErrors | None = None, samples: int = 96
) -> Curve | None:
    """The faint ridge that the front face of a second-surface mirror draws; None without glass.

    Parameters as in `predict`.

    Returns
    -------
    Curve or None
        ``flux`` in the units of `predict`'s, so that their ratio is the ghost's relative brightness. None too where it
        does not meet the board.

    Raises
    ------
    BenchsimError
        Laser below the horizon or behind the mirror.
    """
    bench = bench_of(recording, exposure, errors)
    if not bench.parts.polygon.glass:
        return None
    check(bench)
    return ghost_of(bench, samples)
