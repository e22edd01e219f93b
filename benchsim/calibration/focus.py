"""Did the lens change between the pictures? Autofocus and zoom change its focal length, stabilisation its axis.

The lens that fits all views is the null hypothesis. The alternative gives every view its own focal length (or principal
point), all else free as before, the board's shape included, so that a bent board is not taken for a lens that moves.
Everything is linear about the common solution: a change that is small enough for this is found, one that is not is
found all the more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.stats import chi2

from benchsim.calibration.solve import Bundle

Array = NDArray[np.float64]

FALSE_ALARM = 1e-6
"""Probability with which a lens that stands still is said to have moved."""

MATTERS_FOCAL = 5e-4
"""Changes of the focal length below this fraction are not refused but added to its uncertainty: refocusing from 0.7 m
to 1.2 m changes that of a phone's main camera by 0.3 %."""

MATTERS_POINT = 5e-4
"""Nor is stabilisation spoken of where the principal point moves by less than this, in units of the picture's longer
side: sharpening and uneven light do as much."""

NEARLY = 0.8
"""Share of the χ² explained by principal points that focal lengths must explain to be believed: of principal points
that wander at random they explain about a half."""

REWEIGHTED = 3


@dataclass(frozen=True)
class Change:
    """What every view says when it may have its own.

    Attributes
    ----------
    value, sigma : (v, k)
        Deviation from the common one and its 1 σ: of the focal length as a fraction (k = 1), of the principal point in
        pixels (k = 2).
    probability : float
        Of a χ² as large as this by chance.
    amount : float
        Root mean square of the deviations beyond their errors; of the focal length this, or what the trend with
        distance amounts to between the nearest and the farthest view, whichever is larger.
    gained : float
        χ² that the common lens has more.
    trend, trend_sigma : float
        Of the focal length: its change from the farthest view to the nearest, as refocusing has it (∝ 1/distance).
    follows : bool
        Whether that alone explains more than half of what single values explain.
    """

    value: Array
    sigma: Array
    probability: float
    amount: float
    gained: float
    trend: float = 0.0
    trend_sigma: float = np.inf
    follows: bool = False

    @property
    def seen(self) -> bool:
        """Whether it is more than chance."""
        return self.probability < FALSE_ALARM


def focal(bundle: Bundle) -> Change:
    """One focal length for every view, and one that follows 1/distance as a lens that refocuses does.

    The probability is the smaller of both, doubled for having looked twice.
    """
    own = [bundle.slope[r, :1] * bundle.lens[0] for r in bundle.rows]
    value, sigma, p, gained = _own(bundle, own)
    near = 1 / bundle.distance
    pull = (near - near.mean()) / np.ptp(near) if np.ptp(near) > 1e-9 * near.mean() else np.zeros_like(near)
    columns = np.concatenate([np.outer(_column(o), x).reshape(-1, 1) for o, x in zip(own, pull, strict=True)])
    trend, trend_sigma, p_trend, by_trend = _gain(bundle, columns)
    amount = max(_beyond(value, sigma), abs(float(trend[0])) if p_trend < FALSE_ALARM else 0.0)
    return Change(
        value,
        sigma,
        min(1.0, 2 * min(p, p_trend)),
        amount,
        gained,
        float(trend[0]),
        float(trend_sigma[0]),
        by_trend > 0.5 * gained,
    )


def principal_point(bundle: Bundle) -> Change:
    """One principal point for every view."""
    value, sigma, p, gained = _own(bundle, [bundle.slope[r, 1:3] for r in bundle.rows])
    return Change(value, sigma, p, _beyond(value, sigma), gained)


def refocused(focal: Change, principal_point: Change) -> bool:
    """Whether it was the focal length that changed, and by so much that it matters.

    One picture of a plane tells two numbers of a lens, so that a principal point of its own explains in each what a
    focal length of its own does: it is believed where the focal lengths, half as many, do not explain nearly as much.
    """
    return focal.seen and focal.amount > MATTERS_FOCAL and focal.gained > NEARLY * principal_point.gained


def _column(x: Array) -> Array:
    return x[:, 0]


def _own(bundle: Bundle, columns: list[Array]) -> tuple[Array, Array, float, float]:
    k = columns[0].shape[1]
    value, sigma, p, gained = _gain(bundle, block_diag(*columns))
    return value.reshape(-1, k), sigma.reshape(-1, k), p, gained


def _beyond(value: Array, sigma: Array) -> float:
    """Weighted root mean square beyond the errors."""
    weight = 1 / np.maximum(sigma, 1e-12) ** 2
    return float(np.sqrt(max(0.0, float((weight * (value**2 - sigma**2)).sum() / weight.sum()))))


def _gain(bundle: Bundle, columns: Array) -> tuple[Array, Array, float, float]:
    """Size and 1 σ of further parameters, the probability of the χ² they gain, and that χ².

    ``columns`` are their derivatives without the priors' rows. The scale of every view's noise is what is left of its
    residuals after them: before, it may be inflated by the very change that is looked for.
    """
    further = np.concatenate([columns, np.zeros((len(bundle.misfit) - len(columns), columns.shape[1]))])
    slope = bundle.slope / np.linalg.norm(bundle.slope, axis=0)
    weight = np.ones(len(bundle.misfit))
    for _ in range(REWEIGHTED):
        base = np.linalg.qr(slope * weight[:, None])[0]
        f = further * weight[:, None]
        r = bundle.misfit * weight
        f, r = f - base @ (base.T @ f), r - base @ (base.T @ r)
        size = np.linalg.norm(f, axis=0)
        # One direction, the same change in all views, is the common lens itself.
        values, vectors = np.linalg.eigh((f / size).T @ (f / size))
        good = values > 1e-7 * values[-1]
        inverse = (vectors[:, good] / values[good]) @ vectors[:, good].T / np.outer(size, size)
        step = -inverse @ (f.T @ r)
        gained = float(step @ (f.T @ f) @ step)
        left = (r + f @ step) / weight
        lever = (base**2).sum(axis=1) + np.einsum("ij,jk,ik->i", f, inverse, f)
        for rows in bundle.rows:
            freedom = max(float((1 - lever[rows]).sum()), 1.0)
            weight[rows] = 1 / np.sqrt(max(float((left[rows] ** 2).sum()) / freedom, 1e-12))
    return step, np.sqrt(np.diag(inverse)), float(chi2.sf(gained, int(good.sum()))), gained
