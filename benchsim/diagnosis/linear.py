"""The linear algebra that screening, attachments, limits and held-out predictions share.

At a point of the parameters the data are  d = f + N x + A a + noise, with x the nuisances in units of their prior
sigma. In whitened space (noise of unit variance) and with the nuisances marginalised, x ~ N(0, S²), S the setting scale
for scaled nuisances and 1 for the others, the data's covariance is M = 1 + N S² Nᵀ, and all that is needed of data and
hypotheses are products through M⁻¹ (Woodbury):

    ⟨a, b⟩ = aᵀ b − (aᵀ N) (S⁻² + Nᵀ N)⁻¹ (Nᵀ b),      ln |M| = ln |S⁻² + Nᵀ N| + ln |S²| .
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dpotrf, dpotrs

from benchsim.diagnosis.problem import Parameter, Problem, Values, fit_value

Array = NDArray[np.float64]

TOGETHER = 25_000
"""Data predicted in one task: few enough that cores share the work evenly, enough that more would gain little."""

CANCELLED = 1e-9
"""Part of a column's square that is left of it beside the others, below which rounding speaks in the factor."""

TINY = 8
"""Data of a block up to which all blocks of that size are worked on together."""


@dataclass(frozen=True)
class Linear:
    """A problem linearised at a point, whitened by the blocks' covariances.

    Attributes
    ----------
    residual : (n,)
        Data less prediction at the point, plus the nuisances' and amplitudes' columns times their values there: the
        residual that x = 0, a = 0 would leave if the problem were as linear there as at the point.
    nuisance : (n, p)
        Columns of the nuisances, in units of their prior sigma, in the problem's order.
    scaled : (p,) bool
    effect : (n, k)
        Columns of amplitudes, per unit of value**power, in the order of ``names``.
    names : tuple of str
        Of the amplitudes.
    block : (n,) int
    logdet : float
        ln of the determinant of the blocks' covariances.
    """

    residual: Array
    nuisance: Array
    scaled: NDArray[np.bool_]
    effect: Array
    names: tuple[str, ...]
    block: NDArray[np.intp]
    logdet: float


@dataclass(frozen=True)
class Marginal:
    """Products through M⁻¹ of the residual r and columns A: all that Gaussian hypotheses need.

    Attributes
    ----------
    gram : (k, k)
        Aᵀ M⁻¹ A.
    projection : (k,)
        Aᵀ M⁻¹ r.
    chi2 : float
        rᵀ M⁻¹ r.
    logdet : float
        ln |M|, and of the whitening.
    n : int
        Number of data.
    """

    gram: Array
    projection: Array
    chi2: float
    logdet: float
    n: int


def factors(covariance: Sequence[Array]) -> tuple[Array, ...]:
    """Cholesky factors L of the blocks' covariances."""
    if _alike(covariance):
        return tuple(np.linalg.cholesky(np.array(covariance)))
    return tuple(np.asarray(np.linalg.cholesky(c), float) for c in covariance)


def lowered(lower: Sequence[Array], columns: Array) -> Array:
    """L⁻¹ columns, block after block; ``columns`` is (n,) or (n, k)."""
    if _alike(lower):
        # Row by row for all at once: a triangular solution of two rows costs hundreds of times its arithmetic.
        low, flat = np.array(lower), columns.reshape(len(lower), len(lower[0]), -1).astype(float)
        for i in range(flat.shape[1]):
            flat[:, i] -= np.einsum("bj,bjk->bk", low[:, i, :i], flat[:, :i])
            flat[:, i] /= low[:, i, i, None]
        return flat.reshape(columns.shape)
    out: Array = np.zeros(columns.shape)
    whole, solved = (a if a.ndim == 2 else a[:, None] for a in (columns, out))
    first = 0
    for low in lower:
        rows = slice(first, first + len(low))
        # Most columns are 0 in most blocks: an exposure's settings do nothing in all others.
        some = np.flatnonzero(whole[rows].any(axis=0))
        solved[rows, some] = solve_triangular(low, whole[rows, some], lower=True, check_finite=False)
        first += len(low)
    return out


def raised(lower: Sequence[Array], white: Array) -> Array:
    """L white, block after block: what was whitened, in the data's units; ``white`` is (n,) or (n, k)."""
    if _alike(lower):
        return np.asarray(np.array(lower) @ white.reshape(len(lower), len(lower[0]), -1)).reshape(white.shape)
    parts = np.split(white, np.cumsum([len(low) for low in lower])[:-1])
    return np.concatenate([low @ part for low, part in zip(lower, parts, strict=True)])


def _alike(blocks: Sequence[Array]) -> bool:
    return len(blocks) > 1 and len(blocks[0]) <= TINY and len(set(map(len, blocks))) == 1


def whiten(problem: Problem, covariance: tuple[Array, ...], columns: Array) -> tuple[Array, float]:
    """L⁻¹ columns, C = L Lᵀ per block, and ln |C|; ``columns`` is (n,) or (n, k)."""
    lower = factors(covariance)
    return lowered(lower, columns), log_determinant(lower)


def log_determinant(lower: Sequence[Array]) -> float:
    """ln |C|, C = L Lᵀ per block."""
    return 2 * float(np.log(np.concatenate([low.diagonal() for low in lower])).sum())


def precision(nuisance: Array, sigma: Array, own: Array | None = None) -> tuple[Array, bool]:
    """Factor of NᵀN + S⁻² for `scipy.linalg.cho_solve`, of whitened columns (n, p) and prior sigmas (p,).

    ``own`` is NᵀN, where it is there already.

    Far from any fit columns can be so long that their square has lost the prior; its factor is then found without it.
    """
    inner = nuisance.T @ nuisance if own is None else own.copy()
    inner.flat[:: len(sigma) + 1] += sigma**-2.0
    lower, failed = dpotrf(inner, lower=1)
    if not failed and (lower.diagonal() ** 2 > CANCELLED * inner.diagonal()).all():
        return lower, True
    upper = np.linalg.qr(np.concatenate([nuisance, np.diag(1 / sigma)]), mode="r")
    return (upper * np.sign(np.diag(upper))[:, None]).T, True


def through(
    nuisance: Array, sigma: Array, columns: Array, factor: tuple[Array, bool], cross: Array, square: Array
) -> Array:
    """Products of columns through M⁻¹, made anew where too little is left of a square for a difference to tell.

    Far from any fit columns can be some 1e8 sigma long and lie almost wholly among the nuisances': what is left of
    their products by subtraction is rounding, and need not even be positive.

    Parameters
    ----------
    nuisance : (n, p) array
        Whitened.
    sigma : (p,) array
        Prior sigmas.
    columns : (n, k) array
    factor
        `precision` of the nuisances.
    cross : (p, k) array
        The nuisances' products with the columns.
    square : (k, k) array
        The columns' own products.
    """
    if not nuisance.shape[1]:
        return square
    product = square - cross.T @ dpotrs(factor[0], cross, lower=factor[1])[0]
    if (product.diagonal() >= CANCELLED * square.diagonal()).all():
        return np.asarray(product)
    basis = np.linalg.qr(np.concatenate([nuisance, np.diag(1 / sigma)]))[0]
    rest = np.concatenate([columns, np.zeros((len(sigma), columns.shape[1]))])
    for _ in range(2):
        # Once more, since what the first leaves in the basis is rounding of the whole column.
        rest = rest - basis @ (basis.T @ rest)
    return np.asarray(rest.T @ rest)


def posterior(columns: Array, sigma: Array, own: Array | None = None) -> Array:
    """(NᵀN + S⁻²)⁻¹, arguments as in `precision`; never a negative variance."""
    lower, _ = precision(columns, sigma, own)
    root = solve_triangular(lower, np.eye(len(lower)), lower=True)
    return np.asarray(root.T @ root)


def marginal(linear: Linear, columns: Array, scale: float = 1.0, keep: NDArray[np.bool_] | None = None) -> Marginal:
    """Marginalise the nuisances.

    Parameters
    ----------
    linear : Linear
    columns : (n, k) array
        Whitened.
    scale : float
        S of the scaled nuisances.
    keep : (n,) bool, optional
        Data to use, whole blocks only (a block's whitening mixes its data); default all.
    """
    if keep is not None:
        linear, columns = only(linear, keep), columns[keep]
    return marginals(linear, columns, [scale])[0]


def marginals(linear: Linear, columns: Array, scales: Sequence[float] | Array) -> tuple[Marginal, ...]:
    """`marginal` at several setting scales, the products of long arrays taken once."""
    both = np.column_stack([linear.residual, columns])
    own, cross, square = linear.nuisance.T @ linear.nuisance, linear.nuisance.T @ both, both.T @ both
    out = []
    for scale in scales:
        s = np.where(linear.scaled, scale, 1.0)
        factor = precision(linear.nuisance, s, own)
        product = through(linear.nuisance, s, both, factor, cross, square)
        logdet = 2 * float(np.log(factor[0].diagonal()).sum()) + 2 * float(np.log(s).sum()) + linear.logdet
        out.append(Marginal(product[1:, 1:], product[1:, 0], float(product[0, 0]), logdet, len(both)))
    return tuple(out)


def only(linear: Linear, keep: NDArray[np.bool_]) -> Linear:
    """The rows of whole blocks; the determinant of the noise, which all hypotheses share, is left out."""
    return replace(
        linear,
        residual=linear.residual[keep],
        nuisance=linear.nuisance[keep],
        effect=linear.effect[keep],
        block=linear.block[keep],
        logdet=0.0,
    )


def nuisance_posterior(linear: Linear, residual: Array, scale: float = 1.0) -> tuple[Array, Array]:
    """Mean and covariance of the nuisances, in units of their prior sigma, given a whitened residual."""
    s = np.where(linear.scaled, scale, 1.0)
    covariance = posterior(linear.nuisance, s)
    return covariance @ (linear.nuisance.T @ residual), covariance


CENTRAL, FORWARD = 0.05, 0.01
"""Steps of differences, in prior sigmas: far below the scale on which the prediction bends, far above its rounding. At
the fit of a recording by other code the two differ by 2e-5 of a column in the median, by 0.04 for a second surface."""


def columns(
    problem: Problem, at: Values, parameters: tuple[Parameter, ...], steps: Mapping[str, float] | None = None
) -> Array:
    """Derivatives of the prediction by value**power, by differences, (n, k).

    Parameters
    ----------
    problem : Problem
    at : mapping
        The point.
    parameters : tuple of Parameter
        Each is differentiated on its own blocks only.
    steps : mapping, optional
        Half the step of a central difference by name; default `CENTRAL` at a value of 0, and one step of `FORWARD`
        elsewhere. What has a power is stepped in its value too: widths that add in quadrature are seen at a tenth of a
        prior sigma, and a step of 5 % of sigma**power would reach to a third of one.
    """
    return columns_at(problem, [(at, parameters)], steps)[0]


def columns_at(
    problem: Problem,
    points: Sequence[tuple[Values, Sequence[Parameter]]],
    steps: Mapping[str, float] | None = None,
) -> list[Array]:
    """`columns` at several points, each with parameters of its own; all predictions are asked for at once."""
    every, number = range(len(problem.names)), np.arange(len(problem.data))
    values: list[Values] = []
    asked: list[int] = []
    ends = [0]

    def ask(at: Values, blocks: Sequence[int], rows: NDArray[np.intp]) -> slice:
        # One mapping for all blocks: a thousand records would fill the memory with copies.
        values.extend([at] * len(blocks))
        asked.extend(blocks)
        ends.append(ends[-1] + len(rows))
        return slice(*ends[-2:])

    here: dict[int, slice] = {}
    tasks: list[tuple[int, int, NDArray[np.intp], slice | None, slice, float]] = []
    known: Mapping[str, Array] = getattr(problem.predict, "slopes", {})
    out = [np.zeros((len(problem.data), len(parameters))) for _, parameters in points]
    for i, (at, parameters) in enumerate(points):
        for k, p in enumerate(parameters):
            if p.name in known:
                out[i][:, k] = known[p.name]
                continue
            middle, half = at.get(p.name, 0.0), (steps or {}).get(p.name)
            # Away from 0 one step suffices; at 0 things may appear, a tilted window where there was none.
            once = half is None and middle != 0.0
            step = (FORWARD if once else CENTRAL) * p.sigma if half is None else half
            low, high = (middle if once else middle - step), middle + step
            # A quantity that exists only where it is ≥ 0 is differentiated to the right of 0.
            if (p.one_sided or p.power > 1) and low < 0:
                low, high, once = 0.0, 2 * step, False
            if once and i not in here:
                here[i] = ask(at, every, number)
            own: Sequence[int] = every if p.blocks is None else p.blocks
            rows = number if p.blocks is None else np.concatenate([number[problem.rows(b)] for b in own])
            below = None if once else ask({**at, p.name: low}, own, rows)
            width = fit_value(p, high) - fit_value(p, low)
            tasks.append((i, k, rows, below, ask({**at, p.name: high}, own, rows), width))
    found = predictions(problem, values, asked)
    for i, k, rows, below, above, width in tasks:
        first = found[here[i]][rows] if below is None else found[below]
        out[i][rows, k] = (found[above] - first) / width
    # Where a step finds no light no derivative is better than one that is not finite: fits step on exact predictions.
    return [np.where(np.isfinite(j), j, 0.0) for j in out]


def predictions(problem: Problem, values: Sequence[Values], blocks: Sequence[int]) -> Array:
    """Predictions for values and the block of each, one after the other, through `Problem.spread`.

    Where the prediction takes lists (it has ``many``), it is given lists of values and of their blocks, which is
    several times cheaper.
    """
    if not values:
        return np.zeros(0)
    if not hasattr(problem.predict, "many"):
        return np.concatenate(list(problem.spread(problem.predict, values, blocks)))
    size = np.bincount(problem.block, minlength=len(problem.names))
    count = max(1, -(-int(size[np.asarray(blocks, np.intp)].sum()) // TOGETHER))
    ends = [len(values) * k // count for k in range(count + 1)]
    parts = [slice(*pair) for pair in pairwise(ends)]
    lists, numbers = [list(values[p]) for p in parts], [[int(b) for b in blocks[p]] for p in parts]
    found = problem.spread(problem.predict, lists, numbers)
    return np.concatenate([f for many in found for f in ([many.ravel()] if isinstance(many, np.ndarray) else many)])


def predict_all(problem: Problem, at: Values) -> Array:
    """The prediction of all blocks, (n,)."""
    return predict_each(problem, [at])[0]


def predict_each(problem: Problem, points: Sequence[Values]) -> list[Array]:
    """`predict_all` at several points, which are asked for at once."""
    blocks = range(len(problem.names))
    found = predictions(problem, [at for at in points for _ in blocks], [*blocks] * len(points))
    return list(found.reshape(len(points), len(problem.data)))


def linearise(
    problem: Problem,
    at: Values,
    amplitudes: tuple[Parameter, ...],
    covariance: tuple[Array, ...] | None = None,
    known: Array | None = None,
) -> Linear:
    """Linearise at a point.

    Parameters
    ----------
    problem : Problem
    at : mapping
        Values of nuisances and amplitudes (and shapes) there.
    amplitudes : tuple of Parameter
        Whose columns are wanted besides the nuisances'.
    covariance : tuple of array, optional
        Of the blocks, where the noise was re-estimated; default the problem's.
    known : (n, p + k) array, optional
        Columns already computed (nuisances per sigma, then amplitudes), for instance at a point nearby; default they
        are differentiated here.
    """
    nuisances = problem.nuisances
    sigma = np.array([p.sigma for p in nuisances])
    if known is None:
        j = columns(problem, at, (*nuisances, *amplitudes))
        j[:, : len(nuisances)] *= sigma
    else:
        j = known
    here = np.array(
        [at.get(p.name, 0.0) / p.sigma for p in nuisances] + [fit_value(p, at.get(p.name, 0.0)) for p in amplitudes]
    )
    residual = problem.data - predict_all(problem, at) + j @ here
    white, logdet = whiten(problem, covariance or problem.covariance, np.column_stack([residual, j]))
    p = len(nuisances)
    return Linear(
        white[:, 0],
        white[:, 1 : 1 + p],
        np.array([n.scaled for n in nuisances], bool),
        white[:, 1 + p :],
        tuple(a.name for a in amplitudes),
        problem.block,
        logdet,
    )
