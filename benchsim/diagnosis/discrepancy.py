"""Unknown functions that compete with the names: one Gaussian process per attachment, weighed by its evidence.

An attachment adds B c to the prediction, c ~ N(0, a² R(ℓ)), R_ij = exp(−½ |k_i − k_j|²/ℓ²) for knots of one
component. In the marginal space of `linear` (nuisances integrated, products through M⁻¹) with R = L Lᵀ, G = Lᵀ Bᵀ M⁻¹
B L and u = Lᵀ Bᵀ M⁻¹ r, its gain in ln Z over the hypothesis it is laid on is

    −½ ln |1 + a² G| + ½ a² uᵀ (1 + a² G)⁻¹ u ,

one tridiagonal form for all amplitudes. The rms a is integrated with a uniform prior up to the attachment's
``sigma``: a prior uniform in ln a would spare the function the price that a named amplitude pays for its cap, and
every true name would lose to its own element's function. The length is integrated over the attachment's list. An
attachment is present with the prior probability of one catalogue effect, shared among all attachments.

Not to be used where the prediction bends over the size of what is sought: the basis is taken at one point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dsytrd

from benchsim.diagnosis.evidence import PRESENCE
from benchsim.diagnosis.functions import Prepared, products
from benchsim.diagnosis.hypothesis import Fit, Naming
from benchsim.diagnosis.linear import Linear, linearise, nuisance_posterior, precision, predict_all, whiten
from benchsim.diagnosis.problem import Attachment, Parameter, Problem, value_of

Array = NDArray[np.float64]

_STEPS = 21
_ROUNDS = 3
_STRAIGHT = 0.3
_SMALLEST = 1e-4

UNSTATED = (0.6, 0.36, 0.22)
"""Parts of the noise that was estimated without a function to which the errors of one kind of datum, or of all, may
fall beside it where nobody states them: a wave of a bearing four times as large as errors passes for errors."""


@dataclass(frozen=True)
class Attached:
    """An attachment laid on a hypothesis.

    Attributes
    ----------
    attachment : Attachment
    log_evidence : float
        ln Z of the hypothesis with it, on the scale of ``Fit.log_evidence``; -inf where the data do not see it.
    log_scales : (m,)
        The same at every setting scale of the grid, up to a constant.
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
    log_scales: Array
    amplitude: float
    length: float
    scale: float
    coefficients: Array
    root: Array
    linear: Linear


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


def _parts(problem: Problem) -> Array:
    """Parts of the noise that the errors of every kind may be, (c, K); those of the first row are all of it."""
    kinds = len(problem.error_kinds)
    if problem.stated:
        return np.ones((1, kinds))
    which = np.unique(np.vstack([np.eye(kinds, dtype=bool), np.ones(kinds, bool)]), axis=0)
    return np.vstack([np.ones(kinds), *(np.where(which, part, 1.0) for part in UNSTATED)])


@dataclass(frozen=True)
class _Ground:
    """A hypothesis that functions are laid on, with products that all of them share.

    Attributes
    ----------
    plain : Linear
    nuisance, residual : (n, p), (n,)
        Amplitudes among the nuisances; 0 where data are left out.
    scale, weight, known : (m,), (m, K), (m,)
        Every setting scale with every noise (`_parts`, as the inverse square), and ln of their prior weight times the
        likelihood without a function.
    root, half : (m, p, p), (m, p)
        W with Wᵀ W = (S⁻² + Nᵀ N)⁻¹ there, and W Nᵀ r.
    offset : float
        Turns ln Z of this scale into that of the fits.
    """

    plain: Linear
    nuisance: Array
    residual: Array
    scale: Array
    weight: Array
    known: Array
    root: Array
    half: Array
    offset: float = 0.0

    @property
    def log_evidence(self) -> float:
        """With the noise as it was estimated."""
        whole = (self.weight == 1.0).all(axis=1)
        return float(np.logaddexp.reduce(self.known[whole]) + np.log(len(whole) / whole.sum())) + self.offset


def _ground(
    problem: Problem, naming: Naming, plain: Linear, keep: NDArray[np.bool_] | None = None, offset: float = 0.0
) -> _Ground:
    base, parts, scales = absorb(problem, plain), _parts(problem), naming.setting_scales
    use = np.ones(len(base.residual), bool) if keep is None else keep
    n_cols, r = base.nuisance * use[:, None], base.residual * use
    scale, weight = np.repeat(scales, len(parts)), np.tile(parts**-2.0, (len(scales), 1))
    s = np.where(base.scaled, scale[:, None], 1.0)
    own, along, power = (
        np.tensordot(weight, products(problem, *two), 1) for two in ((n_cols, n_cols), (n_cols, r), (r, r))
    )
    lower: Array = np.stack([precision(n_cols, row, square)[0] for row, square in zip(s, own, strict=True)])
    root: Array = np.asarray(np.linalg.inv(lower), float)
    logdet = 2 * (np.log(np.diagonal(lower, axis1=1, axis2=2)) + np.log(s)).sum(axis=1)
    half = (root @ along[:, :, None])[:, :, 0]
    number = products(problem, use.astype(float), use.astype(float))
    prior = np.log(np.repeat(naming.scale_weights, len(parts)) / len(parts))
    known = prior - 0.5 * (power - (half**2).sum(axis=1) + logdet) + 0.5 * np.log(weight) @ number
    return _Ground(plain, n_cols, r, scale, weight, known, root, half, offset)


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
        Whitened by the naming's noise, for the data in ``keep``.
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
    ground = _ground(problem, naming, on.linear if linear is None else linear, keep)
    known = on.log_evidence if log_evidence is None else log_evidence
    ground = replace(ground, offset=known - ground.log_evidence + _prior(problem))
    return tuple(sorted((_one(problem, p, ground) for p in prepared), key=lambda a: -a.log_evidence))


def refine(
    problem: Problem,
    naming: Naming,
    prepared: tuple[Prepared, ...],
    laid: Attached,
    on: Fit,
    worth: float = -np.inf,
) -> Attached:
    """Weigh an attachment again about the nuisances that it leaves, until the prediction there is what was expected.

    Nuisances fitted without the function stand where they imitate it, and the prediction's bending between there and
    where they belong can be larger than the difference of two explanations. The function itself stays linear, and so
    do the nuisances' columns until the place is found; they matter to a fraction of what bending does.

    Parameters
    ----------
    problem : Problem
    naming : Naming
    prepared : tuple of Prepared
    laid : Attached
    on : Fit
        What it is laid on.
    worth : float
        ln Z that it must reach for its columns to be differentiated there.
    """
    own = next(p for p in prepared if p.attachment.name == laid.attachment.name)
    offset = _offset(problem, naming, on) + _prior(problem)
    white, _ = whiten(problem, naming.noise.covariance, own.attachment.basis)
    at = on.values
    for _ in range(_ROUNDS):
        there, seen, promised = _exactly(problem, naming, laid, white @ laid.coefficients, on)
        bent = promised - seen
        if not np.isfinite(bent).all() or np.linalg.norm(bent) < _STRAIGHT:
            break
        at = there
        plain = replace(laid.linear, residual=laid.linear.residual - bent)
        laid = _one(problem, own, _ground(problem, naming, plain, offset=offset))
    if at is not on.values and laid.log_evidence >= worth:
        known = amplitudes(problem, laid.linear.names)
        plain = linearise(problem, at, known, naming.noise.covariance)
        laid = _one(problem, own, _ground(problem, naming, plain, offset=offset))
    return checked(problem, naming, laid, white @ laid.coefficients, on)


def _exactly(
    problem: Problem, naming: Naming, laid: Attached, function: Array, on: Fit
) -> tuple[dict[str, float], Array, Array]:
    """The nuisances that a function leaves, with the hypothesis' amplitudes; the whitened misfit there, the function
    not taken off, as predicted exactly and as linearised."""
    base, p = absorb(problem, laid.linear), len(problem.nuisances)
    pull = nuisance_posterior(base, base.residual - function, laid.scale)[0][:p]
    there = {**on.values, **{q.name: float(x * q.sigma) for q, x in zip(problem.nuisances, pull, strict=True)}}
    seen, _ = whiten(problem, naming.noise.covariance, problem.data - predict_all(problem, there))
    size = np.array([on.values.get(q.name, 0.0) ** q.power for q in amplitudes(problem, laid.linear.names)])
    return there, seen, laid.linear.residual - laid.linear.nuisance @ pull - laid.linear.effect @ size


def checked(problem: Problem, naming: Naming, laid: Attached, function: Array, on: Fit) -> Attached:
    """The same, its ln Z less by what the exact prediction misses of the misfit that it was to leave.

    About a null that is far off, nuisances that follow a function can be led to where no linearisation holds: it then
    promises hundreds that it does not have, and would take the place of a name that fits.
    """
    _, seen, promised = _exactly(problem, naming, laid, function, on)
    loss = 0.5 * float(np.sum((seen - function) ** 2) - np.sum((promised - function) ** 2))
    loss = loss if np.isfinite(loss) else np.inf
    return replace(laid, log_evidence=laid.log_evidence - max(loss, 0.0))


def weighed_with(fit: Fit, laid: Attached) -> Fit:
    """A hypothesis with the evidence, at every setting scale too, that it has with a function on it."""
    scales = laid.log_scales - np.logaddexp.reduce(laid.log_scales) + laid.log_evidence
    return replace(fit, log_evidence=laid.log_evidence, log_scales=scales, setting_scale=laid.scale)


def fitted_with(problem: Problem, naming: Naming, fit: Fit, laid: Attached) -> Fit:
    """A hypothesis with the nuisances and amplitudes that it has with a function on it; places and other shapes stand.

    The function's rms and length stand too; the prediction is linearised anew where the last step ended."""
    white, _ = whiten(problem, naming.noise.covariance, laid.attachment.basis)
    own = amplitudes(problem, laid.linear.names)
    values, sigma, linear = dict(fit.values), dict(fit.sigma), laid.linear
    for again in range(_ROUNDS):
        if again:
            linear = linearise(problem, values, own, naming.noise.covariance)
        both = with_columns(absorb(problem, linear), white @ laid.root)
        mean, covariance = nuisance_posterior(both, both.residual, laid.scale)
        deviation = np.sqrt(np.diag(covariance))
        for p, x, s in zip(problem.nuisances, mean, deviation, strict=False):
            values[p.name], sigma[p.name] = float(x * p.sigma), float(s * p.sigma)
        for k, p in enumerate(own, len(problem.nuisances)):
            unit = p.sigma**p.power
            values[p.name] = value_of(p, max(mean[k] * unit, 0.0) if p.one_sided else float(mean[k] * unit))
            slope = p.power * abs(values[p.name]) ** (p.power - 1)
            sigma[p.name] = float(deviation[k]) * unit / slope if slope else sigma[p.name]
    return replace(weighed_with(fit, laid), values=values, sigma=sigma, log_evidence=fit.log_evidence)


def _offset(problem: Problem, naming: Naming, on: Fit) -> float:
    """Turns ln Z of a linearised hypothesis into that of the fits."""
    return on.log_evidence - _ground(problem, naming, on.linear).log_evidence


def _prior(problem: Problem) -> float:
    """ln of the odds of any one attachment to be there."""
    return float(np.log(PRESENCE / (1 - PRESENCE) / max(1, len(problem.attachments))))


def _one(problem: Problem, prepared: Prepared, ground: _Ground) -> Attached:
    """One attachment on one hypothesis."""
    attachment = prepared.attachment
    rms = np.geomspace(attachment.sigma * _SMALLEST, attachment.sigma, _STEPS)
    # Uniform in the rms itself, on a grid that is even in its logarithm.
    log_prior = np.log(rms / rms.sum() / len(prepared.roots))
    grams: list[Array] = []
    projections: list[Array] = []
    both = np.column_stack([ground.nuisance, ground.residual])
    for white, square in zip(prepared.white, prepared.squares, strict=True):
        seen = np.tensordot(ground.weight, products(problem, both, white), 1)
        taken = ground.root @ seen[:, :-1]
        turned = np.swapaxes(taken, 1, 2)
        grams.extend(np.tensordot(ground.weight, square, 1) - turned @ taken)
        projections.extend(seen[:, -1] - (turned @ ground.half[:, :, None])[:, :, 0])
    known = np.tile(ground.known, len(prepared.roots))
    cells = known[:, None] + _gains(grams, projections, rms) + log_prior
    each = np.logaddexp.reduce(cells.reshape(len(prepared.roots), len(np.unique(ground.scale)), -1), axis=(0, 2))
    total = float(np.logaddexp.reduce(each)) + ground.offset if any(r.shape[1] for r in prepared.roots) else -np.inf
    i, k = np.unravel_index(np.argmax(cells), cells.shape)
    of, j = divmod(int(i), len(ground.scale))
    root = prepared.roots[of]
    mean = np.linalg.solve(np.eye(root.shape[1]) / rms[k] ** 2 + grams[i], projections[i])
    length, scale = attachment.lengths[of], float(ground.scale[j])
    return Attached(attachment, total, each, float(rms[k]), length, scale, root @ mean, root * rms[k], ground.plain)


def _gains(grams: Sequence[Array], projections: Sequence[Array], rms: Array) -> Array:
    """−½ ln |1 + a² G| + ½ a² uᵀ (1 + a² G)⁻¹ u of every G (r, r) with its u (r,), and every rms a; (c, m).

    The reflections that make [[0, uᵀ], [u, G]] tridiagonal leave its first place alone, so both are read off a
    recurrence for any a, at a quarter of the cost of an eigen-decomposition.
    """
    size, count = max(len(u) for u in projections), len(grams)
    diagonal, beside = np.zeros((size + 1, count, 1)), np.zeros((size + 1, count, 1))
    for i, (gram, u) in enumerate(zip(grams, projections, strict=True)):
        bordered = np.zeros((len(u) + 1, len(u) + 1), order="F")
        bordered[1:, 0], bordered[1:, 1:] = u, gram
        _, d, e, _, _ = dsytrd(bordered, lower=1, lwork=32 * len(bordered), overwrite_a=True)
        diagonal[: len(d), i, 0], beside[: len(e), i, 0] = d, e
    power = rms**2
    pivot = np.ones((size + 1, count, len(rms)))
    for j in range(size, 0, -1):
        below = pivot[j + 1] if j < size else 1.0
        pivot[j] = 1 + power * diagonal[j] - (power * beside[j]) ** 2 / below
    first = pivot[1] if size else 1.0
    gains: Array = 0.5 * power * beside[0] ** 2 / first - 0.5 * np.log(pivot[1:]).sum(axis=0)
    return gains
