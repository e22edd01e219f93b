"""How probable shared causes make a field's records, and what those say of the causes' sizes: L(s) of `shared_causes`.

A heliostat's part is what its sets of own effects say (`Witness`), or with the prior probability `OWN` nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize
from scipy.special import logsumexp, softmax
from scipy.stats import multivariate_t, norm

from benchsim.instruments.mount.records import Array

OWN = 0.05
"""Prior probability that a heliostat says nothing of the field: 3 in ln Z is the most that any one can say."""

HEARD = 0.1
"""Gain in ln Z from which on a heliostat bears a cause out."""

DRAWS, ROUNDS, TAIL = 512, 3, 5.0
"""Points of the importance sampling, times that they are drawn anew about where the last ones found most, and degrees
of freedom of the multivariate t that they are drawn from."""


@dataclass(frozen=True)
class Witness:
    """What one heliostat says of the shared causes.

    Attributes
    ----------
    name : str
    sets : tuple of tuple of str
        Of its own effects.
    log_z, projection, gram : (m,), (m, k), (m, k, k)
        z, b and G of `shared_causes` for each set, by the parameters of its ``causes`` in prior sigmas, in their order.
    own : float
        O there.
    """

    name: str
    sets: tuple[tuple[str, ...], ...]
    log_z: Array
    projection: Array
    gram: Array
    own: float


@dataclass(frozen=True)
class Likelihood:
    """All witnesses' sets in one array each, (H, m, …), those that are none at −inf."""

    log_z: Array
    projection: Array
    gram: Array
    own: Array

    @staticmethod
    def of(witnesses: Sequence[Witness]) -> Likelihood:
        """That of some witnesses."""
        most = max(len(w.log_z) for w in witnesses)

        def together(many: Sequence[Array], nothing: float) -> Array:
            return np.stack(
                [np.pad(x, [(0, most - len(x)), *[(0, 0)] * (x.ndim - 1)], constant_values=nothing) for x in many]
            )

        return Likelihood(
            together([w.log_z for w in witnesses], -np.inf),
            together([w.projection for w in witnesses], 0.0),
            together([w.gram for w in witnesses], 0.0),
            np.array([w.own for w in witnesses]),
        )

    def sets(self, s: Array) -> Array:
        """ln Z_i(s) of every heliostat's sets, (H, m)."""
        return self._sets(s, self.along(s))

    def _sets(self, s: Array, along: Array) -> Array:
        return np.asarray(self.log_z + (self.projection - 0.5 * along) @ s)

    def along(self, s: Array) -> Array:
        """G s of every heliostat's sets, (H, m, k)."""
        return np.asarray((self.gram.reshape(self.log_z.size * len(s), len(s)) @ s).reshape(self.projection.shape))

    def each(self, s: Array) -> Array:
        """ln of every heliostat's factor of L(s), (H,)."""
        return self._each(self.sets(s))

    def _each(self, z: Array) -> Array:
        both = np.concatenate([np.log1p(-OWN) + z, (np.log(OWN) + self.own)[:, None]], axis=1)
        return np.asarray(logsumexp(both, axis=1))

    def bears(self, at: Array, places: Sequence[int]) -> int:
        """How many heliostats are more probable with some parameters than without, the others as they are."""
        without = np.where(np.isin(np.arange(len(at)), places), 0.0, at)
        return int((self.each(at) > self.each(without) + HEARD).sum())

    def total(self, many: Array) -> Array:
        """ln L(s) − ½ |s|² at points (S, k), (S,)."""
        heliostats, sets, k = self.projection.shape
        square = np.einsum("si,sj->sij", many, many).reshape(len(many), -1)
        z = self.projection.reshape(-1, k) @ many.T - 0.5 * self.gram.reshape(-1, k * k) @ square.T
        z = np.log1p(-OWN) + self.log_z[:, :, None] + z.reshape(heliostats, sets, -1)
        own = np.broadcast_to((np.log(OWN) + self.own)[:, None], (heliostats, len(many)))
        return np.logaddexp(logsumexp(z, axis=1), own).sum(axis=0) - 0.5 * (many**2).sum(axis=1)

    def signal(self, at: Array, places: Sequence[int]) -> Array:
        """What every heliostat's records show of some parameters (χ²), (H,)."""
        only = np.where(np.isin(np.arange(len(at)), places), at, 0.0)
        q = (softmax(self.sets(at), axis=1) * np.einsum("hmij,i,j->hm", self.gram, only, only)).sum(axis=1)
        return np.asarray(np.maximum(q, 1e-12))

    def expected(self, at: Array, places: Sequence[int]) -> float:
        """How many `bears` would count if the parameters are as large as that: ln of a heliostat's ratio of likelihoods
        is normal about half of its `signal` with that variance."""
        q = self.signal(at, places)
        return float(norm.cdf((0.5 * q - HEARD) / np.sqrt(q)).sum())

    def peak(self, places: list[int]) -> tuple[float, Array, Array]:
        """ln of the evidence with some parameters free, and their posterior mean and 1 sigma."""
        b, g = (np.ascontiguousarray(x) for x in (self.projection[:, :, places], self.gram[:, :, places][..., places]))
        some = replace(self, projection=b, gram=g)
        if not places:
            return float(some.each(np.zeros(0)).sum()), np.zeros(0), np.zeros(0)

        def shares(s: Array) -> tuple[Array, Array, Array]:
            """ln of every heliostat's factor, its sets' weights, and their slopes."""
            along = some.along(s)
            z = some._sets(s, along)
            each = some._each(z)
            return each, np.exp(np.log1p(-OWN) + z - each[:, None]), b - along

        def fallen(s: Array) -> tuple[float, Array]:
            each, weight, slope = shares(s)
            return -float(each.sum() - 0.5 * s @ s), s - np.tensordot(weight, slope, 2)

        def curvature(s: Array) -> Array:
            _, weight, slope = shares(s)
            mean = np.einsum("hm,hmi->hi", weight, slope)
            heavy = (weight[:, :, None] * slope).reshape(-1, len(s))
            return np.asarray(
                np.tensordot(weight, g, 2) - heavy.T @ slope.reshape(-1, len(s)) + mean.T @ mean + np.eye(len(s))
            )

        lone = np.linalg.solve(g + np.eye(len(places)), b[..., None])[..., 0]
        first = lone[np.arange(len(lone)), np.argmax(self.log_z + 0.5 * (b * lone).sum(axis=2), axis=1)]
        starts = (np.zeros(len(places)), np.median(first, axis=0))
        ends = [minimize(fallen, start, jac=True, method="BFGS") for start in starts]
        middle = min(ends, key=lambda e: e.fun).x
        values, turn = np.linalg.eigh(curvature(middle))
        shape = (turn / np.maximum(values, 1e-9)) @ turn.T
        total = 0.0
        for again in range(ROUNDS):
            # Tails are heavier than the peak's curvature says where one more heliostat would be left out.
            about = multivariate_t(middle, shape, TAIL)
            drawn = about.rvs(DRAWS, random_state=again).reshape(DRAWS, -1)
            log = some.total(drawn) - about.logpdf(drawn) - 0.5 * len(places) * np.log(2 * np.pi)
            total, share = float(logsumexp(log) - np.log(DRAWS)), softmax(log)
            middle = share @ drawn
            shape = np.cov(drawn.T, aweights=share, bias=True).reshape(len(places), -1) + 1e-12 * np.eye(len(places))
        return total, middle, np.sqrt(np.diag(shape))
