"""Is anything left? Amplitudes of a dozen smooth modes per kind of datum, and the pulls that settings share.

Under a hypothesis the whitened residual is r ~ N(0, M), with nuisances and amplitudes integrated (see `linear`). For
columns E the numbers y = Eᵀ M⁻¹ r are N(0, Eᵀ M⁻¹ E), so their norm in that metric is χ² with the rank of E, exactly,
whatever E is. Choosing few and smooth columns is what gives the test its power: χ² of the data themselves spreads over
thousands of numbers and passes most wrong explanations. A mechanical effect leaves white residuals and shows only in
pulls that are alike in all settings: these are a family of their own.

Not to be used to judge the noise: a wrong noise model is seen in the data's χ², not here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, fdtrc

from benchsim.diagnosis.discrepancy import Attached, absorb, with_columns
from benchsim.diagnosis.functions import smooth_functions
from benchsim.diagnosis.hypothesis import Fit, Naming
from benchsim.diagnosis.levels import ALARM, APART
from benchsim.diagnosis.linear import Linear, factors, marginal, nuisance_posterior, raised, whiten
from benchsim.diagnosis.problem import Problem

Array = NDArray[np.float64]

MODES = 12
"""Of a family that are looked at by themselves; all together are looked at besides, for what is not so smooth."""

_HIDDEN = 1e-6


@dataclass(frozen=True)
class Family:
    """What one family of modes shows.

    Attributes
    ----------
    statistic : float
        χ² of its most visible modes.
    rank : int
        Their number.
    p : float
        Probability of as much by chance, in these or in all of its modes; the number of families not counted.
    rms : float
        Of what they show in the data beside what settings do, less what chance would, in the data's unit; nan for
        pulls.
    """

    statistic: float
    rank: int
    p: float
    rms: float

    @property
    def excess(self) -> float:
        return self.statistic - self.rank


@dataclass(frozen=True)
class Remainder:
    """What the smooth modes and the shared pulls say, by family: one per kind of datum, and ``pulls``."""

    families: Mapping[str, Family]

    def chance(self, name: str) -> float:
        """p of a family, corrected for the number of families."""
        return min(1.0, self.families[name].p * len(self.families))

    @property
    def p(self) -> float:
        return min((self.chance(n) for n in self.families), default=1.0)

    @property
    def acceptable(self) -> bool:
        return self.p >= ALARM

    @property
    def alarming(self) -> tuple[str, ...]:
        """Families that show something."""
        return tuple(n for n in self.families if self.chance(n) < ALARM)

    @property
    def odds(self) -> float:
        """Most that p can be worth in ln of odds, −ln(−e p ln p) (Sellke, Bayarri & Berger 2001,
        https://doi.org/10.1198/000313001300339950): p = 0.01 is at most 8 to 1."""
        p = max(self.p, 1e-300)
        return float(-np.log(-np.e * p * np.log(p))) if p < 1 / np.e else 0.0

    def part_of(self, before: Remainder) -> float:
        """Largest part of what a hypothesis took from a family that it touches, which that family still shows."""
        parts = [0.0]
        for name in self.alarming:
            removed = before.families[name].statistic - self.families[name].statistic
            if removed > APART**2:
                parts.append(max(self.families[name].excess, 0.0) / removed)
        return max(parts)


Modes = Mapping[str, Array]
"""Whitened columns of each family, before they are brought into a hypothesis' marginal space."""


def modes(problem: Problem, linear: Linear, covariance: tuple[Array, ...]) -> Modes:
    """Smooth columns: what the attachments can do to each kind, polynomials along the traces, together and apart.

    Parameters
    ----------
    problem : Problem
    linear : Linear
        For the columns of the nuisances.
    covariance : tuple of (n_b, n_b)
        Of the blocks.
    """
    families = {}
    functions = smooth_functions(problem)
    n_blocks = len(problem.names)
    for kind in np.unique(problem.kind):
        here = problem.kind == kind
        x = problem.position[here]
        span = float(np.ptp(x)) or 1.0
        polynomials = np.zeros((len(problem.data), 4))
        polynomials[here] = np.polynomial.legendre.legvander(2 * (x - x.min()) / span - 1, 3)
        apart = polynomials[:, None, :] * (problem.block[:, None] == np.arange(n_blocks))[:, :, None]
        # Of a block's few data, no more polynomials than data.
        count = np.bincount(problem.block[here], minlength=n_blocks)
        apart = apart[:, np.arange(polynomials.shape[1]) < count[:, None]]
        parts = [*polynomials.T[:, :, None], apart, *(g * here[:, None] for g in functions)]
        white = [whiten(problem, covariance, part)[0] for part in parts if part.any()]
        families[str(kind)] = np.column_stack([w for part in white for w in _levelled(linear, part)])
    shared: dict[str, list[int]] = {}
    for i, p in enumerate(problem.nuisances):
        if p.scaled:
            shared.setdefault(p.name.partition(".")[2], []).append(i)
    columns = [linear.nuisance[:, many].sum(axis=1) for many in shared.values() if len(many) > 1]
    if columns:
        families["pulls"] = np.column_stack(columns)
    return families


def _levelled(linear: Linear, part: Array) -> list[Array]:
    """Columns scaled so that together they show as much as any other part's: what settings nearly hide counts too."""
    visible = float(np.trace(marginal(linear, part).gram))
    return [part / np.sqrt(visible)] if visible > _HIDDEN * float((part**2).sum()) else []


def remainder(
    linear: Linear,
    families: Modes,
    scale: float,
    freedom: Mapping[str, float] | None = None,
    lower: tuple[Array, ...] = (),
    kind: NDArray[np.str_] | None = None,
) -> Remainder:
    """What is left under a hypothesis.

    Parameters
    ----------
    linear : Linear
        Of the hypothesis, its own amplitudes and functions among the nuisances (`discrepancy.absorb`).
    families : Modes
    scale : float
        Setting scale.
    freedom : mapping of str to float, optional
        By kind: numbers from which its noise was estimated (`hypothesis.Noise`), so that χ² over its rank is F; default
        known.
    lower : tuple of (n_b, n_b), optional
        Cholesky factors of the blocks' covariance, and the kind of every datum: without them ``rms`` is nan.
    """
    found = {}
    for name, columns in families.items():
        m = marginal(linear, columns, scale)
        values, vectors = np.linalg.eigh(m.gram)
        keep = values > 1e-8 * values[-1]
        values, vectors = values[keep][::-1], vectors[:, keep][:, ::-1]
        y = vectors.T @ m.projection
        known = (freedom or {}).get(name, np.inf)
        # The most visible modes, and all: what is rough spreads over many of them.
        sums = [(float((y[:k] ** 2 / values[:k]).sum()), k) for k in sorted({min(MODES, len(y)), len(y)})]
        chances = [
            chdtrc(k, total) if np.isinf(known) else fdtrc(max(k, 1), known, total / max(k, 1)) for total, k in sums
        ]
        statistic, rank = sums[0]
        rms = float("nan")
        if lower and kind is not None and (kind == name).any() and statistic > rank:
            best = int(np.argmin(chances))
            total, k = sums[best]
            mode = columns @ (vectors[:, :k] @ (y[:k] / values[:k]))
            # Most of a mode that settings nearly hide is theirs: what of it they cannot do is what the data show.
            shown = mode - linear.nuisance @ nuisance_posterior(linear, mode, scale)[0]
            raw = raised(lower, shown)
            rms = float(np.sqrt(np.mean(raw[kind == name] ** 2) * max(0.0, 1 - k / total)))
        found[name] = Family(statistic, rank, float(min(1.0, len(sums) * min(chances))), rms)
    return Remainder(found)


def left(problem: Problem, naming: Naming, fit: Fit, families: Modes) -> Remainder:
    """What the smooth modes show beside a fit."""
    free = naming.noise.freedom
    lower = tuple(factors(naming.noise.covariance))
    base = absorb(problem, fit.linear)
    return remainder(base, families, fit.setting_scale, free, lower, problem.kind)


def beside(problem: Problem, naming: Naming, laid: Attached, families: Modes) -> tuple[Linear, Remainder]:
    """The problem with a function on it, and what the smooth modes leave then."""
    white, _ = whiten(problem, naming.noise.covariance, laid.attachment.basis)
    with_it = with_columns(absorb(problem, laid.linear), white @ laid.root)
    return with_it, remainder(with_it, families, laid.scale, naming.noise.freedom)
