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
from scipy.stats import chi2, f

from benchsim.diagnosis.attachments import smooth_functions
from benchsim.diagnosis.linear import Linear, marginal, whiten
from benchsim.diagnosis.problem import Problem

Array = NDArray[np.float64]

ALARM = 0.01
"""Rate of false alarms of `remainder` at which something is said to be left."""

MODES = 12

_HIDDEN = 1e-6


@dataclass(frozen=True)
class Remainder:
    """What the smooth modes and the shared pulls say.

    ``p`` is the probability of as much by chance, corrected for the number of families; ``families`` holds χ² and the
    number of modes of each: one per kind of datum, and ``pulls``.
    """

    p: float
    families: dict[str, tuple[float, int]]

    @property
    def acceptable(self) -> bool:
        return self.p >= ALARM

    def part_of(self, before: Remainder) -> float:
        """Of the family that shows the most: its excess χ² as a part of what that family showed before."""
        excess = {name: statistic - rank for name, (statistic, rank) in self.families.items()}
        worst = max(excess, key=lambda name: excess[name], default="")
        if not worst or excess[worst] <= 0:
            return 0.0
        statistic, rank = before.families.get(worst, (0.0, 0))
        return excess[worst] / max(statistic - rank, 1e-300)


@dataclass(frozen=True)
class Modes:
    """Whitened columns of each family, before they are brought into a hypothesis' marginal space."""

    families: dict[str, Array]


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
        parts = [*polynomials.T[:, :, None], apart.reshape(len(here), -1), *(g * here[:, None] for g in functions)]
        white = [whiten(problem, covariance, part)[0] for part in parts if part.any()]
        families[str(kind)] = np.column_stack([w for part in white for w in _levelled(linear, part)])
    shared: dict[str, list[int]] = {}
    for i, p in enumerate(problem.nuisances):
        if p.scaled:
            shared.setdefault(p.name.partition(".")[2], []).append(i)
    columns = [linear.nuisance[:, many].sum(axis=1) for many in shared.values() if len(many) > 1]
    if columns:
        families["pulls"] = np.column_stack(columns)
    return Modes(families)


def _levelled(linear: Linear, part: Array) -> list[Array]:
    """Columns scaled so that together they show as much as any other part's: what settings nearly hide counts too."""
    visible = float(np.trace(marginal(linear, part).gram))
    return [part / np.sqrt(visible)] if visible > _HIDDEN * float((part**2).sum()) else []


def remainder(linear: Linear, families: Modes, scale: float, freedom: Mapping[str, float] | None = None) -> Remainder:
    """What is left under a hypothesis.

    Parameters
    ----------
    linear : Linear
        Of the hypothesis, its own amplitudes and functions among the nuisances (`attachments.absorb`).
    families : Modes
    scale : float
        Setting scale.
    freedom : mapping of str to float, optional
        By kind: numbers from which its noise was estimated (`fits.Noise`), so that χ² over its rank is F; default
        known.
    """
    found = {}
    worst = 1.0
    for name, columns in families.families.items():
        m = marginal(linear, columns, scale)
        values, vectors = np.linalg.eigh(m.gram)
        keep = (values > 1e-9 * values[-1]) & (np.arange(len(values)) >= len(values) - MODES)
        y = vectors[:, keep].T @ m.projection
        statistic, rank = float((y**2 / values[keep]).sum()), int(keep.sum())
        found[name] = (statistic, rank)
        known = (freedom or {}).get(name, np.inf)
        chance = chi2.sf(statistic, rank) if np.isinf(known) else f.sf(statistic / max(rank, 1), rank, known)
        worst = min(worst, float(chance))
    return Remainder(min(1.0, worst * max(1, len(found))), found)
