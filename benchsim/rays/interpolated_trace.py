"""Traces of benches without free fields, from few rays: everything about them is smooth along the trace and the facet.

Along the trace, centre, flux and phase are polynomials through Chebyshev nodes in the axis ray's phase: the board is
seen under tens of degrees, so that their coefficients fall about tenfold per degree. On the facet, where light goes and
the logarithm of its power are polynomials in (t, h) of low degree, found at few nodes and carried to the rule that sums
the beam's Gaussian well. What does not fall fast enough is found out by the last coefficients (`Smooth.resolved`) and
is for `curve.beam_profiles`, which assumes nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from benchsim.bench.curve import Curve
from benchsim.rays.bench import MOST, Bench, facet_nodes, nodes_needed
from benchsim.rays.laser import some
from benchsim.rays.phases import axis_points
from benchsim.rays.profile import Profiles, interpolation
from benchsim.rays.sweep import LAST_STEP, cuts, mixed
from benchsim.rays.width import adaptive_widths, between, few_of

Array = NDArray[np.float64]


class Rule(NamedTuple):
    """Chebyshev nodes along the trace, nodes over the facet's width and height at which rays are traced, and the
    largest of the last two coefficients along the trace [mm; of ln flux 1] that counts as resolved."""

    trace: int
    across: int
    along: int
    tail: float = 1e-7


PLAIN = Rule(14, 6, 4)
"""Enough for setting errors and most effects."""

COMA = Rule(14, 9, 5)
"""Enough for beams with coma, up to its cap."""

FINER = (Rule(32, 6, 4), Rule(32, 9, 5), Rule(32, MOST, MOST, 1e-4))
"""Tried in turn; plumes need the first. The last traces the rays at all nodes that the sum over the beam takes, as
`curve.beam_profiles` would; where the beam all but misses the mirror, what Newton's method leaves of the phases is seen
as a jitter of 1e-6 to 1e-5 along the trace."""

NODE_TAIL = 1e-5
"""The same over the facet's width and height [mm]: the mean over the beam hardly feels it."""

FAINT = 1e-9
"""Share of a trace's brightest flux, and of the laser's power on the board, below which the mirror misses the beam."""

WIDTHS = 6
"""Profiles whose widths are worked out, as in `width`."""


@dataclass(frozen=True)
class Smooth:
    """Curves of one bench or, with a leading axis, of several; ``resolved`` () or (bench,) says which are good."""

    points: Array
    width: Array | None
    flux: Array
    phase: Array
    resolved: NDArray[np.bool_]
    parting: Array | None = None
    aside: Array | None = None

    def curve(self, which: Any = ...) -> Curve:
        """One of them."""
        width = None if self.width is None else self.width[which]
        parting = None if self.parting is None else self.parting[which]
        aside = None if self.aside is None else self.aside[which]
        return Curve(self.points[which], width, self.flux[which], self.phase[which], parting, aside)


def rules(bench: Bench) -> tuple[Rule, ...]:
    """What is worth trying; nothing where a part is a table of numbers, whose kinks no polynomial follows."""
    parts = bench.parts
    free = parts.air.kick, parts.board.height, parts.source.angle
    if not bench.physics.beam or any(f is not None for f in free) or parts.polygon.uneven:
        return ()
    narrow, coma = some(parts.air.plume[0]), some(*parts.source.coma)
    if coma:
        return FINER[1:] if narrow else (COMA, *FINER[1:])
    return FINER if narrow else (PLAIN, *FINER)


def left_of(tangent: Array) -> Array:
    """Tangents (..., 2) turned by +90 degrees."""
    return np.stack([-tangent[..., 1], tangent[..., 0]], axis=-1)


def curves(bench: Bench, phase: Array, rule: Rule, *, width: bool = True, front: bool = False) -> Smooth:
    """Curves through the profiles of the axis ray's phases (samples,) or (bench, samples); NaN phases are not resolved.

    ``bench`` may be a stack (`batch.stacked`), the phases then have the leading axis. ``front`` is the light that the
    front of the mirror's glass would reflect, of all facets at their mean lean.
    """
    with np.errstate(all="ignore"):
        return _curves(bench, phase, rule, width, front)


def _curves(bench: Bench, phase: Array, rule: Rule, width: bool, front: bool) -> Smooth:
    x, coefficients, slope = _nodes(rule.trace)
    first, length = phase[..., :1], phase[..., -1:] - phase[..., :1]
    at = first + 0.5 * length * (1 + x)
    # The outermost nodes lie within the samples' range; it is extended by half a percent of it on either side.
    carry = chebyshev.chebvander(2 * (phase - first) / length - 1, rule.trace - 1) @ coefficients
    need = nodes_needed(bench)
    across, along = (min(a, b) for a, b in zip(need, rule[1:3], strict=True))
    points, start = axis_points(bench, at), at[..., None, None]
    resolved = np.ones(phase.shape[:-1], bool)
    for h in (1, along):
        step = slope @ points
        tangent = step / np.sqrt((step**2).sum(axis=-1, keepdims=True))
        # The first round only finds where to cut.
        last = 1e-4 if h == 1 else LAST_STEP
        kicks = width and h > 1
        raw = cuts(bench, points, tangent, start, across, h, front=front, kicks=kicks, last_step=last)

        def finer(nodes: Profiles) -> Profiles:
            return _finer(bench, nodes, need)

        if h > 1:
            fine = finer(raw) if front else mixed(bench, raw, points, tangent, across, finer)
            if (across, along) != need:
                resolved &= _node_tail(raw.q) < NODE_TAIL
        else:
            fine = finer(raw)
        centre = fine.mean(fine.q)
        if fine.shift is not None and fine.share is not None:
            centre = centre + (fine.share * fine.shift).sum(axis=-1)
        points, start = points + centre[..., None] * left_of(tangent), raw.phase
    flux = fine.flux
    brightest = flux.max(axis=-1)
    reach = np.sqrt(((points[..., -1, :] - points[..., 0, :]) ** 2).sum(axis=-1))
    resolved &= (flux.min(axis=-1) > FAINT * brightest) & (brightest * reach > FAINT)
    sought = np.concatenate([points, np.log(flux)[..., None], fine.mean(fine.phase)[..., None]], axis=-1)
    tail = np.abs(coefficients[-2:] @ sought).max(axis=(-2, -1))
    resolved &= tail < rule.tail
    found = carry @ sought
    wide, aside = _widths(bench, raw, fine, centre, carry, need, resolved) if width else (None, None)
    shake = bench.parts.timing.shake
    # Of several benches it is (bench, 1, 1, 1).
    parting = fine.parting(np.reshape(shake, (-1, 1)) if np.ndim(shake) else shake)
    if parting is not None:
        parting = (carry @ parting[..., None])[..., 0]
    return Smooth(found[..., :2], wide, np.exp(found[..., 2]), found[..., 3], resolved, parting, aside)


def _widths(
    bench: Bench,
    raw: Profiles,
    fine: Profiles,
    centre: Array,
    carry: Array,
    need: tuple[int, int],
    resolved: NDArray[np.bool_],
) -> tuple[Array, Array]:
    """Adaptive widths and centres at the samples, (..., samples) each, of what is resolved."""
    samples = carry.shape[-2]
    few = few_of(samples, WIDTHS)
    to = carry[..., few, :]

    def moved(a: Array) -> Array:
        flat = to @ a.reshape(*a.shape[: to.ndim - 1], -1)
        return flat.reshape(*flat.shape[:-1], *a.shape[to.ndim - 1 :])

    area = facet_nodes(bench, *raw.q.shape[-2:])[2]
    profiles = _finer(
        bench,
        Profiles(
            moved(raw.q),
            np.exp(moved(np.log(raw.weight / area))) * area,
            moved(raw.phase),
            moved(raw.lateral),
            moved(raw.chirp),
        ),
        need,
        kicks=True,
    )
    profiles = profiles._replace(q=profiles.q - (to @ centre[..., None])[..., None])
    if fine.shift is not None and fine.share is not None:
        profiles = profiles._replace(shift=moved(fine.shift), share=moved(fine.share))
    found = np.full((*profiles.q.shape[:-2], 2), np.nan)
    if resolved.any():
        found[resolved] = adaptive_widths(bench, profiles, resolved)
    found = between(samples, WIDTHS) @ found
    return found[..., 0], found[..., 1]


def _finer(bench: Bench, nodes: Profiles, need: tuple[int, int], *, kicks: bool = False) -> Profiles:
    """Nodes carried to the rule that sums the beam; one over the height stays one."""
    t, h = nodes.q.shape[-2:]
    rule = (need[0] if bench.facets else 1, need[1] if h > 1 else 1)
    if (t, h) == rule:
        return nodes
    carry = _carry(t, h, *rule)

    def fine(a: Array) -> Array:
        flat = a.reshape(*a.shape[:-2], t * h) @ carry
        return flat.reshape(*a.shape[:-2], *rule)

    area, fine_area = facet_nodes(bench, t, h)[2], facet_nodes(bench, *rule)[2]
    weight = np.exp(fine(np.log(nodes.weight / area))) * fine_area
    lateral, chirp = (fine(nodes.lateral), fine(nodes.chirp)) if kicks else (nodes.lateral, nodes.chirp)
    return Profiles(fine(nodes.q), weight, fine(nodes.phase), lateral, chirp)


@lru_cache(maxsize=64)
def _carry(t: int, h: int, fine_t: int, fine_h: int) -> Array:
    """Matrix (t h, fine_t fine_h) of polynomials on the facet."""

    def along(n: int, fine: int) -> Array:
        rule = np.polynomial.legendre.leggauss
        return interpolation(rule(n)[0], rule(fine)[0])

    return np.ascontiguousarray(np.kron(along(t, fine_t), along(h, fine_h)).T)


def _node_tail(q: Array) -> Array:
    """Largest of the last Legendre coefficients over t and over h, (...)."""
    t, h = q.shape[-2:]
    over_t = np.abs(_last(t) @ q).max(axis=-1) if t > 1 else np.zeros(q.shape[:-2])
    over_h = np.abs(q @ _last(h)).max(axis=-1)
    return np.asarray(np.maximum(over_t, over_h).max(axis=-1))


@lru_cache(maxsize=32)
def _last(n: int) -> Array:
    """Row (n,) that gives the last Legendre coefficient of values at n Gauss–Legendre nodes."""
    x = np.polynomial.legendre.leggauss(n)[0]
    return np.asarray(np.linalg.inv(np.polynomial.legendre.legvander(x, n - 1))[-1])


@lru_cache(maxsize=8)
def _nodes(n: int) -> tuple[Array, Array, Array]:
    """Chebyshev nodes in [-1, 1], and matrices from values there to coefficients, and to derivatives there."""
    x = np.sort(chebyshev.chebpts1(n))
    vander = chebyshev.chebvander(x, n - 1)
    coefficients = np.linalg.inv(vander)
    slope = vander[:, : n - 1] @ chebyshev.chebder(np.eye(n)) @ coefficients
    return np.asarray(x), np.asarray(coefficients), np.asarray(slope)
