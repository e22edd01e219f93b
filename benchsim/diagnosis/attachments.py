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

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.special import logsumexp

from benchsim.diagnosis.fits import Fit, Naming
from benchsim.diagnosis.linear import Linear, linearise, nuisance_posterior, predict_all, whiten
from benchsim.diagnosis.problem import Attachment, Parameter, Problem

Array = NDArray[np.float64]

PRESENCE = 0.02
"""Prior probability that any attachment at all is there: that of one effect of the catalogue."""

_STEPS = 21
_ROUNDS = 3
_STRAIGHT = 0.3
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
    linear : Linear
        What it was weighed in: nuisances, and the amplitudes of the hypothesis it is laid on.
    """

    attachment: Attachment
    log_evidence: float
    amplitude: float
    length: float
    scale: float
    coefficients: Array
    root: Array
    linear: Linear


@dataclass(frozen=True)
class Prepared:
    """An attachment in the coefficients that its kernels can tell apart; the same for all hypotheses and folds.

    Attributes
    ----------
    attachment : Attachment
    lift : (K, m)
        Orthonormal columns: the attachment's coefficients of the m that are worked with.
    basis : (n, m)
    roots : tuple of (m, r)
        Of each length.
    """

    attachment: Attachment
    lift: Array
    basis: Array
    roots: tuple[Array, ...]


def prepare(problem: Problem) -> tuple[Prepared, ...]:
    """All attachments of a problem, prepared once."""
    out = []
    for a in problem.attachments:
        roots = [kernel_root(a, length) for length in a.lengths]
        lift, size, _ = np.linalg.svd(np.column_stack(roots), full_matrices=False)
        lift = lift[:, size > 1e-4 * size[0]]
        out.append(Prepared(a, lift, a.basis @ lift, tuple(lift.T @ r for r in roots)))
    return tuple(out)


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
    prepared: tuple[Prepared, ...],
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
    prepared : tuple of Prepared
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
    plain = on.linear if linear is None else linear
    known = on.log_evidence if log_evidence is None else log_evidence
    offset = known - _alone(naming, absorb(problem, plain), keep) + _prior(problem)
    found = [_one(problem, p, plain, naming, keep, offset) for p in prepared]
    return tuple(sorted(found, key=lambda a: -a.log_evidence))


def refine(problem: Problem, naming: Naming, prepared: tuple[Prepared, ...], laid: Attached, on: Fit) -> Attached:
    """Weigh an attachment again about the nuisances that it leaves, until the prediction there is what was expected.

    Nuisances fitted without the function stand where they imitate it, and the prediction's bending between there and
    where they belong can be larger than the difference of two explanations. The function itself stays linear.

    Parameters
    ----------
    problem : Problem
    naming : Naming
    prepared : tuple of Prepared
    laid : Attached
    on : Fit
        What it is laid on.
    """
    own = next(p for p in prepared if p.attachment.name == laid.attachment.name)
    offset = on.log_evidence - _alone(naming, absorb(problem, on.linear), None) + _prior(problem)
    white, _ = whiten(problem, naming.noise.covariance, own.attachment.basis)
    p = len(problem.nuisances)
    here = np.array([on.values.get(q.name, 0.0) / q.sigma for q in problem.nuisances])
    values = dict(on.values)
    predicted = predict_all(problem, values)
    for _ in range(_ROUNDS):
        base = absorb(problem, laid.linear)
        pull, _ = nuisance_posterior(base, base.residual - white @ laid.coefficients, laid.scale)
        step = pull[:p] - here
        at = {**values, **{q.name: float(x * q.sigma) for q, x in zip(problem.nuisances, pull[:p], strict=True)}}
        there = predict_all(problem, at)
        bent = whiten(problem, naming.noise.covariance, there - predicted)[0] - laid.linear.nuisance @ step
        if not np.isfinite(bent).all() or np.linalg.norm(bent) < _STRAIGHT:
            break
        known = amplitudes(problem, laid.linear.names)
        laid = _one(problem, own, linearise(problem, at, known, naming.noise.covariance), naming, None, offset)
        here, predicted, values = pull[:p], there, at
    return laid


def _prior(problem: Problem) -> float:
    """ln of the odds of any one attachment to be there."""
    return float(np.log(PRESENCE / (1 - PRESENCE) / max(1, len(problem.attachments))))


def _cells(naming: Naming, base: Linear, nn: Array, nb: Array, rr: float) -> list[tuple[float, float, Array]]:
    """At every setting scale: the scale, ln of its weight times the likelihood, and the inner matrix solved for nb."""
    out = []
    for scale, weight in zip(naming.setting_scales, naming.scale_weights, strict=True):
        s = np.where(base.scaled, float(scale), 1.0)
        factor = cho_factor(np.diag(s**-2.0) + nn, lower=True)
        solved = cho_solve(factor, nb)
        logdet = 2 * float(np.log(np.diag(factor[0])).sum() + np.log(s).sum())
        chi2 = rr - float(nb[:, 0] @ solved[:, 0])
        out.append((float(scale), float(np.log(weight)) - 0.5 * (chi2 + logdet), solved))
    return out


def _alone(naming: Naming, base: Linear, keep: NDArray[np.bool_] | None) -> float:
    """ln Z of the data without any function, but for a constant of the data and the prior of presence."""
    use = slice(None) if keep is None else keep
    n_cols, r = base.nuisance[use], base.residual[use]
    cells = _cells(naming, base, n_cols.T @ n_cols, (n_cols.T @ r)[:, None], float(r @ r))
    return float(logsumexp([c[1] for c in cells]))


def _one(
    problem: Problem,
    prepared: Prepared,
    plain: Linear,
    naming: Naming,
    keep: NDArray[np.bool_] | None,
    offset: float,
) -> Attached:
    """One attachment; ``offset`` turns ln Z as `_alone` gives it into that of the fits."""
    white, _ = whiten(problem, naming.noise.covariance, prepared.basis)
    base = absorb(problem, plain)
    use = slice(None) if keep is None else keep
    n_cols, r, b_cols = base.nuisance[use], base.residual[use], white[use]
    both = np.column_stack([r, b_cols])
    nb, bb = n_cols.T @ both, b_cols.T @ both
    attachment = prepared.attachment
    rms = np.geomspace(attachment.sigma * _SMALLEST, attachment.sigma, _STEPS)
    # Uniform in the rms itself, on a grid that is even in its logarithm.
    log_prior = np.log(rms / rms.sum() / len(prepared.roots))
    best = (-np.inf, 0.0, 0.0, 0.0, np.zeros(0), np.zeros((0, 0)))
    terms: list[Array] = []
    # As `linear.marginal`, with the products of the data taken once for all scales and lengths.
    for scale, known, solved in _cells(naming, base, n_cols.T @ n_cols, nb, float(r @ r)):
        gram = bb - nb[:, 1:].T @ solved
        for length, root in zip(attachment.lengths, prepared.roots, strict=True):
            values, vectors = np.linalg.eigh(root.T @ gram[:, 1:] @ root)
            values = np.clip(values, 0, None)
            u = vectors.T @ (root.T @ gram[:, 0])
            shrink = rms[:, None] ** 2 / (1 + rms[:, None] ** 2 * values)
            gain = 0.5 * (shrink @ u**2 - np.log1p(rms[:, None] ** 2 * values).sum(axis=1))
            cells = known + gain + log_prior
            terms.append(cells)
            k = int(np.argmax(cells))
            if cells[k] > best[0]:
                mean = root @ (vectors @ (shrink[k] * u))
                best = (float(cells[k]), float(rms[k]), length, scale, mean, root * rms[k])
    total = float(logsumexp(np.concatenate(terms))) + offset if np.any(white) else -np.inf
    lifted, root = prepared.lift @ best[4], prepared.lift @ best[5]
    return Attached(attachment, total, best[1], best[2], best[3], lifted, root, plain)
