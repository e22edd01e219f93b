"""Functions without a name as the data see them: Gaussian processes in their kernels' own directions, whitened."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpstrf
from scipy.spatial.distance import cdist

from benchsim.diagnosis.linear import whiten
from benchsim.diagnosis.problem import Attachment, Problem

Array = NDArray[np.float64]

VISIBLE = 1e-6
"""Directions whose signal at the largest plausible rms has a variance below this, in that of the noise, are dropped."""


@dataclass(frozen=True)
class Prepared:
    """An attachment in what its kernels let the data see, for each length: standard normal amplitudes times the rms.

    Attributes
    ----------
    attachment : Attachment
    roots : tuple of (K, r)
        Coefficients per unit of the amplitudes; L of the module, without directions that no data show.
    columns : tuple of (n, r)
        Data per unit of the amplitudes.
    white, squares : tuple of (n, r), tuple of (K, r, r)
        The columns whitened by one noise, 0 where data are left out, and their products with each other (`products`).
    """

    attachment: Attachment
    roots: tuple[Array, ...]
    columns: tuple[Array, ...]
    white: tuple[Array, ...]
    squares: tuple[Array, ...]


def prepare(problem: Problem, covariance: tuple[Array, ...]) -> tuple[Prepared, ...]:
    """All attachments of a problem, prepared once and whitened by the blocks' ``covariance``."""
    return tuple(_prepare(problem, a, whiten(problem, covariance, a.basis)[0]) for a in problem.attachments)


def _prepare(problem: Problem, attachment: Attachment, white: Array) -> Prepared:
    roots, columns, squares = [], [], []
    for length in attachment.lengths:
        root = kernel_root(attachment, length)
        seen = white @ root
        variance, turn = np.linalg.eigh(seen.T @ seen)
        shown = variance * attachment.sigma**2 > VISIBLE
        roots.append(root @ turn[:, shown])
        columns.append(seen @ turn[:, shown])
        squares.append(products(problem, columns[-1], columns[-1]))
    raw = tuple(attachment.basis @ r for r in roots)
    return Prepared(attachment, tuple(roots), raw, tuple(columns), tuple(squares))


def whitened(
    problem: Problem,
    prepared: tuple[Prepared, ...],
    covariance: tuple[Array, ...],
    keep: NDArray[np.bool_],
) -> tuple[Prepared, ...]:
    """The same under another noise, for the data in ``keep`` (whole blocks)."""
    if not prepared:
        return ()
    columns = [c for p in prepared for c in p.columns]
    white, _ = whiten(problem, covariance, np.column_stack(columns))
    white[~keep] = 0.0
    parts = iter(np.split(white, np.cumsum([c.shape[1] for c in columns])[:-1], axis=1))
    out = []
    for p in prepared:
        own = tuple(np.ascontiguousarray(next(parts)) for _ in p.columns)
        out.append(replace(p, white=own, squares=tuple(products(problem, w, w) for w in own)))
    return tuple(out)


def kernel_root(attachment: Attachment, length: float, tolerance: float = 1e-7) -> Array:
    """L with L Lᵀ = R(ℓ), (K, m), columns from the smallest up; directions of variance below ``tolerance`` of the
    largest are dropped."""
    same = attachment.component[:, None] == attachment.component
    kernel = np.exp(-0.5 * cdist(attachment.knots, attachment.knots, "sqeuclidean") / length**2) * same
    # A smooth function of a thousand records has some dozens of directions, and this finds no others.
    packed, pivot, rank, _ = dpstrf(kernel, tol=1e-3 * tolerance, lower=1)
    factor = np.zeros((len(kernel), rank))
    factor[pivot - 1] = np.tril(packed)[:, :rank]
    values, turn = np.linalg.eigh(factor.T @ factor)
    return np.asarray(factor @ turn[:, values > tolerance * values[-1]])


def smooth_functions(problem: Problem) -> list[Array]:
    """What every attachment's smoothest modes do to the data at its largest plausible rms, (n, 8) each or fewer."""
    return [a.basis @ kernel_root(a, float(np.median(a.lengths)))[:, -8:] * a.sigma for a in problem.attachments]


def products(problem: Problem, one: Array, other: Array) -> Array:
    """oneᵀ other, of each of `Problem.error_kinds` by itself, (K, …)."""
    return np.stack([one[own].T @ other[own] for own in problem.error_kinds])
