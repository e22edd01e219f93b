"""Unknown functions that compete with the names: one Gaussian process per attachment, weighed by its evidence.

An attachment adds B c to the prediction, c ~ N(0, a² R(ℓ)), R_ij = exp(−½ |k_i − k_j|²/ℓ²) for knots of one
component. In the marginal space of `linear` (nuisances integrated, products through M⁻¹) with R = L Lᵀ, W = Lᵀ Bᵀ M⁻¹
B L = V diag(w) Vᵀ and u = Vᵀ Lᵀ Bᵀ M⁻¹ r, its gain in ln Z over the hypothesis it is laid on is

    −½ Σ ln(1 + a² w) + ½ Σ a² u² / (1 + a² w) ,

one eigen-decomposition for all amplitudes. The rms a is integrated with a uniform prior up to the attachment's
``sigma``: a prior uniform in ln a would spare the function the price that a named amplitude pays for its cap, and
every true name would lose to its own element's function. The length is integrated over the attachment's list. An
attachment is present with the prior probability of one catalogue effect, shared among all attachments.

Not to be used where the prediction bends over the size of what is sought: the basis is taken at one point.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.special import logsumexp

from benchsim.diagnosis.fits import Fit, Naming
from benchsim.diagnosis.linear import Linear, whiten
from benchsim.diagnosis.problem import Attachment, Parameter, Problem

Array = NDArray[np.float64]

PRESENCE = 0.02
"""Prior probability that any attachment at all is there: that of one effect of the catalogue."""

_STEPS = 21
_SMALLEST = 1e-4


@dataclass(frozen=True)
class Attached:
    """An attachment laid on a hypothesis.

    Attributes
    ----------
    attachment : Attachment
    log_evidence : float
        ln Z of the hypothesis with it, on the scale of ``Fit.log_evidence``; -inf where the data do not see it.
    amplitude, length, scale : float
        Most probable rms, length and setting scale.
    coefficients : (K,)
        Posterior mean there, in the attachment's unit.
    root : (K, m)
        L a: coefficients per unit of independent standard normal amplitudes, there.
    """

    attachment: Attachment
    log_evidence: float
    amplitude: float
    length: float
    scale: float
    coefficients: Array
    root: Array


def kernel_root(attachment: Attachment, length: float, tolerance: float = 1e-7) -> Array:
    """L with L Lᵀ = R(ℓ), (K, m); directions of variance below ``tolerance`` of the largest are dropped."""
    distance2 = ((attachment.knots[:, None, :] - attachment.knots[None, :, :]) ** 2).sum(axis=2)
    same = attachment.component[:, None] == attachment.component[None, :]
    values, vectors = np.linalg.eigh(np.exp(-0.5 * distance2 / length**2) * same)
    keep = values > tolerance * values[-1]
    root: Array = vectors[:, keep] * np.sqrt(values[keep])
    return root


def amplitudes(problem: Problem, names: tuple[str, ...]) -> tuple[Parameter, ...]:
    """The catalogue's parameters of these names."""
    known = {p.name: p for e in problem.catalogue for p in e.parameters}
    return tuple(known[n] for n in names)


def absorb(problem: Problem, linear: Linear) -> Linear:
    """The same with its amplitudes, in units of their prior sigma**power, among the unscaled nuisances."""
    sigma = np.array([p.sigma**p.power for p in amplitudes(problem, linear.names)])
    return with_columns(replace(linear, effect=linear.effect[:, :0], names=()), linear.effect * sigma)


def with_columns(linear: Linear, columns: Array) -> Linear:
    """Whitened columns of unit prior variance added to the unscaled nuisances."""
    scaled = np.concatenate([linear.scaled, np.zeros(columns.shape[1], bool)])
    return replace(linear, nuisance=np.column_stack([linear.nuisance, columns]), scaled=scaled)


def weigh(
    problem: Problem,
    naming: Naming,
    on: Fit | None = None,
    keep: NDArray[np.bool_] | None = None,
    linear: Linear | None = None,
    log_evidence: float | None = None,
) -> tuple[Attached, ...]:
    """Lay every attachment on one hypothesis.

    Parameters
    ----------
    problem : Problem
    naming : Naming
    on : Fit, optional
        The hypothesis; default the null.
    keep : (n,) bool, optional
        Data to use, whole blocks.
    linear, log_evidence : optional
        In place of the fit's own, where one is fitted to part of the data.

    Returns
    -------
    tuple of Attached
        Most probable first; empty where the problem has no attachments.
    """
    on = on or naming.null
    base = absorb(problem, on.linear if linear is None else linear)
    found = []
    for attachment in problem.attachments:
        white, _ = whiten(problem, naming.noise.covariance, attachment.basis)
        found.append(
            _one(
                attachment,
                white,
                base,
                naming,
                keep,
                on.log_evidence if log_evidence is None else log_evidence,
                np.log(PRESENCE / (1 - PRESENCE) / len(problem.attachments)),
            )
        )
    return tuple(sorted(found, key=lambda a: -a.log_evidence))


def _one(
    attachment: Attachment,
    white: Array,
    base: Linear,
    naming: Naming,
    keep: NDArray[np.bool_] | None,
    log_evidence: float,
    log_prior: float,
) -> Attached:
    use = slice(None) if keep is None else keep
    n_cols, r, b_cols = base.nuisance[use], base.residual[use], white[use]
    nn, nb, bb = n_cols.T @ n_cols, n_cols.T @ np.column_stack([r, b_cols]), b_cols.T @ np.column_stack([r, b_cols])
    roots = [kernel_root(attachment, length) for length in attachment.lengths]
    best: tuple[float, float, float, float, Array, Array] | None = None
    terms: list[float] = []
    plain: list[float] = []
    # As `linear.marginal`, with the products of the data taken once for all scales and lengths.
    for scale, weight in zip(naming.setting_scales, naming.scale_weights, strict=True):
        s = np.where(base.scaled, float(scale), 1.0)
        factor = cho_factor(np.diag(s**-2.0) + nn, lower=True)
        gram = bb - nb[:, 1:].T @ cho_solve(factor, nb)
        chi2 = float(r @ r - nb[:, 0] @ cho_solve(factor, nb[:, 0]))
        logdet = 2 * float(np.log(np.diag(factor[0])).sum() + np.log(s).sum())
        known = float(np.log(weight)) - 0.5 * (chi2 + logdet)
        plain.append(known)
        for length, root in zip(attachment.lengths, roots, strict=True):
            values, vectors = np.linalg.eigh(root.T @ gram[:, 1:] @ root)
            values = np.clip(values, 0, None)
            u = vectors.T @ (root.T @ gram[:, 0])
            for a, w in _rms(attachment.sigma):
                shrink = a**2 / (1 + a**2 * values)
                gain = 0.5 * float((shrink * u**2).sum() - np.log1p(a**2 * values).sum())
                term = known + gain + float(np.log(w / len(roots)))
                terms.append(term)
                if best is None or term > best[0]:
                    best = (term, a, length, float(scale), root @ (vectors @ (shrink * u)), root * a)
    assert best is not None
    total = float(logsumexp(terms) - logsumexp(plain)) + log_evidence + log_prior
    seen = bool(np.any(white))
    return Attached(attachment, total if seen else -np.inf, best[1], best[2], best[3], best[4], best[5])


def _rms(largest: float) -> Iterator[tuple[float, float]]:
    """Grid of the rms, uniform in its logarithm, with the weights of a uniform prior on (0, largest)."""
    grid = np.geomspace(largest * _SMALLEST, largest, _STEPS)
    weights = grid / grid.sum()
    yield from zip(grid.tolist(), weights.tolist(), strict=True)
