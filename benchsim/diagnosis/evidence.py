"""Integrals over amplitudes: how much better the data are explained with some columns than without.

With the nuisances marginalised (`linear.Marginal`) the likelihood of amplitudes q in fit space (q = value**power), over
that of q = 0, is exp(bᵀ q − ½ qᵀ G q). Its integral over the amplitudes' priors is the Bayes factor:

* ordinary amplitude: value ~ N(0, sigma²), integrated in closed form;
* one-sided: half-normal. One alone is closed (log Φ): Laplace's method fails where the peak lies at the boundary;
* power 2: the value is half-normal, the data respond to its square: Gauss-Legendre quadrature over the value.

Several of the last two kinds are integrated one inside the other, so the cost grows as nodes**(number − 1); more than
three of them in one hypothesis is not what this is for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, logsumexp

from benchsim.diagnosis.problem import Effect, Parameter

Array = NDArray[np.float64]
PRESENCE = 0.02
"""Prior probability of each effect to be present."""

NODES = (64, 40, 24)
"""Of the quadrature, innermost first; further out all have the last: 1e-2 in ln Z or better (held by a test)."""

ROUNDING = 1e-12
"""Part of an amplitude's square that is left beside others, below which it is rounding."""

FIELD_SIGMAS = np.geomspace(1 / 64, 1.0, 8)
"""Population sigma of a random field over its largest, uniform prior: weights proportional to the spacing."""


@dataclass(frozen=True)
class Term:
    """One integral: amplitudes at one value of everything that is integrated over a grid.

    Attributes
    ----------
    columns : tuple of int
        Ordinary amplitudes, then one-sided ones, then those of power 2.
    sigma : tuple of float
        Prior sigma of the values, same order.
    counts : tuple of three int
        How many of each.
    log_weight : float
        ln of the prior weight on the grid.
    field_sigma : tuple of float
        Of the random fields it holds, in the order of the hypothesis.
    """

    columns: tuple[int, ...]
    sigma: tuple[float, ...]
    counts: tuple[int, int, int]
    log_weight: float
    field_sigma: tuple[float, ...] = ()


def log_prior(effects: Sequence[str], catalogue: Sequence[str]) -> float:
    """ln of the prior probability that just these are present."""
    return len(effects) * float(np.log(PRESENCE)) + (len(catalogue) - len(effects)) * float(np.log1p(-PRESENCE))


def amplitudes(effect: Effect) -> tuple[Parameter, ...]:
    """The parameters that the data respond to in proportion."""
    return tuple(p for p in effect.parameters if not p.grid)


def shapes(effect: Effect) -> tuple[Parameter, ...]:
    """A place, a width, a period: they have no effect on their own."""
    return tuple(p for p in effect.parameters if len(p.grid) > 1)


def fixed(effect: Effect) -> dict[str, float]:
    """Shape parameters whose grid leaves them no choice."""
    return {p.name: float(p.grid[0]) for p in effect.parameters if len(p.grid) == 1}


def kind(parameter: Parameter) -> int:
    """0 ordinary, 1 one-sided, 2 squared."""
    if parameter.power not in (1, 2):
        raise ValueError(f"parameter {parameter.name}: power {parameter.power} is not 1 or 2; write another power")
    return 2 if parameter.power == 2 else int(parameter.one_sided)


def term(entries: Sequence[tuple[int, float, int]], log_weight: float, field_sigma: tuple[float, ...] = ()) -> Term:
    """Sort (column, sigma, kind) into a term."""
    ordered = sorted(entries, key=lambda e: e[2])
    counts = [sum(e[2] == k for e in entries) for k in range(3)]
    return Term(
        tuple(e[0] for e in ordered),
        tuple(e[1] for e in ordered),
        (counts[0], counts[1], counts[2]),
        log_weight,
        field_sigma,
    )


def field_grid(effect: Effect) -> list[tuple[float | None, float]]:
    """(population sigma or None, ln weight): a random field's sigma is uniform below its largest."""
    if not effect.random_field:
        return [(None, 0.0)]
    weights = np.gradient(FIELD_SIGMAS)
    largest = max(p.sigma for p in amplitudes(effect))
    return [(float(t * largest), float(w)) for t, w in zip(FIELD_SIGMAS, np.log(weights / weights.sum()), strict=True)]


def entries(effect: Effect, columns: Sequence[int], field_sigma: float | None) -> list[tuple[int, float, int]]:
    """An effect's amplitudes as `term` wants them."""
    return [
        (c, p.sigma if field_sigma is None else field_sigma, kind(p))
        for c, p in zip(columns, amplitudes(effect), strict=True)
    ]


def log_factors(gram: Array, projection: Array, terms: Sequence[Term]) -> Array:
    """ln Bayes factor of every term against no amplitudes, its weight not included.

    Parameters
    ----------
    gram : (S, K, K) array
    projection : (S, K) array
        For each of S setting scales.
    terms : sequence of T terms

    Returns
    -------
    (S, T) array
    """
    out = np.zeros((len(gram), len(terms)))
    groups: dict[tuple[int, int, int], list[int]] = {}
    for i, t in enumerate(terms):
        groups.setdefault(t.counts, []).append(i)
    for counts, members in groups.items():
        index = np.array([terms[i].columns for i in members], int).reshape(len(members), -1)
        if not index.shape[1]:
            continue
        power = np.array([1] * (counts[0] + counts[1]) + [2] * counts[2])
        unit = np.array([terms[i].sigma for i in members]) ** power
        g = gram[:, index[:, :, None], index[:, None, :]] * unit[:, :, None] * unit[:, None, :]
        b = projection[:, index] * unit
        flat = log_integral(g.reshape(-1, *g.shape[2:]), b.reshape(-1, b.shape[2]), counts)
        out[:, members] = flat.reshape(len(gram), -1)
    # A single one that is no number would make every probability one: what cannot be weighed is not believed.
    return np.where(np.isnan(out), -np.inf, out)


def log_integral(gram: Array, projection: Array, counts: tuple[int, int, int]) -> Array:
    """ln of the integrals with priors of unit sigma, (B, k, k) and (B, k) → (B,)."""
    free, lines, squares = counts
    out = np.zeros(len(gram))
    b, g = projection[:, free:], gram[:, free:, free:]
    if free:
        precision = gram[:, :free, :free] + np.eye(free)
        sides = np.concatenate([projection[:, :free, None], gram[:, :free, free:]], axis=2)
        solved = np.linalg.solve(precision, sides)
        out += 0.5 * np.einsum("bi,bi->b", sides[:, :, 0], solved[:, :, 0]) - 0.5 * np.linalg.slogdet(precision)[1]
        b = b - np.einsum("bij,bi->bj", sides[:, :, 1:], solved[:, :, 0])
        whole = np.einsum("bii->bi", g)
        g = g - np.swapaxes(sides[:, :, 1:], 1, 2) @ solved[:, :, 1:]
        # What the free amplitudes take up but for rounding is not seen beside them; a square below 0 has no root.
        seen = np.einsum("bii->bi", g) > ROUNDING * whole
        b, g = np.where(seen, b, 0.0), np.where(seen[:, :, None] & seen[:, None, :], g, 0.0)
    return out + _halves(g, b, lines, squares)


def _halves(gram: Array, b: Array, lines: int, squares: int) -> Array:
    """ln ∫ over half-normal values: the first ``lines`` act as they are, the rest by their squares."""
    count = lines + squares
    if count == 0:
        return np.zeros(len(b))
    if count == 1 and lines == 1:
        precision = 1 + gram[:, 0, 0]
        mean = b[:, 0] / np.sqrt(precision)
        return np.asarray(np.log(2) - 0.5 * np.log(precision) + 0.5 * mean**2 + log_ndtr(mean))
    # The last is integrated by quadrature about the constrained peak, the others inside it.
    slope = b - 0.5 * (np.arange(count) >= lines)
    curvature = gram + np.diag((np.arange(count) < lines) + 1e-9)
    # Of two that look alike the priors' own curvature may be less than the rounding of their squares.
    curvature = curvature + ROUNDING * gram * np.eye(count)
    peak, sd = _constrained_peak(curvature, slope)
    above = peak + 8 * sd
    if count == 1:
        at_wall = (peak == 0) & (slope[:, 0] < 0)
        above = np.where(at_wall, np.minimum(above, 40 / np.maximum(-slope[:, 0], 1e-300)), above)
    root = np.sqrt if squares else np.positive
    middle = root(peak)
    low, high = (
        np.maximum(root(np.maximum(peak - 8 * sd, 0)), middle - 9),
        np.minimum(root(above), middle + 9),
    )
    node, weight = np.polynomial.legendre.leggauss(NODES[min(count, len(NODES)) - 1])
    v = low[:, None] + (high - low)[:, None] * (node + 1) / 2
    q = v**2 if squares else v
    log_f = np.log(weight) + np.log((high - low) / 2)[:, None] + 0.5 * np.log(2 / np.pi) - v**2 / 2
    log_f = log_f + b[:, -1:] * q - 0.5 * gram[:, -1, -1][:, None] * q**2
    if count > 1:
        rest = b[:, None, :-1] - gram[:, None, -1, :-1] * q[:, :, None]
        inner = np.broadcast_to(gram[:, None, :-1, :-1], (*q.shape, count - 1, count - 1))
        less = (lines, squares - 1) if squares else (lines - 1, 0)
        flat = _halves(inner.reshape(-1, count - 1, count - 1), rest.reshape(-1, count - 1), *less)
        log_f = log_f + flat.reshape(q.shape)
    return np.asarray(logsumexp(log_f, axis=1))


def _constrained_peak(curvature: Array, slope: Array) -> tuple[Array, Array]:
    """Last coordinate of argmax bᵀq − ½ qᵀ A q over q ≥ 0, and its sigma with nothing constrained, (B,) each."""
    count = slope.shape[1]
    best = np.zeros(len(slope))
    where = np.zeros(len(slope))
    for free in product([False, True], repeat=count):
        use = np.flatnonzero(free)
        if not len(use):
            continue
        q = np.linalg.solve(curvature[:, use[:, None], use], slope[:, use, None])[:, :, 0]
        gain = 0.5 * np.einsum("bi,bi->b", q, slope[:, use])
        better = (q >= 0).all(axis=1) & (gain > best)
        best[better] = gain[better]
        where[better] = q[better, -1] if free[-1] else 0.0
    return where, np.sqrt(np.linalg.inv(curvature)[:, -1, -1])
