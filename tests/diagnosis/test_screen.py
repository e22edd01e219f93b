"""Evidence by linear algebra against brute-force integration, and how long all of it takes."""

from itertools import product

import lines
import numpy as np
import pytest
from scipy.special import logsumexp

from benchsim.diagnosis import evidence, linear, screen, settings
from benchsim.diagnosis.problem import Effect, Parameter


def brute(gram, projection, sigma, kinds, points=241, reach=8.0):
    """ln ∫ prior(v) exp(bᵀq − ½ qᵀGq) dv on a plain grid over the values."""
    axes = []
    for s, kind in zip(sigma, kinds, strict=True):
        v = np.linspace(0 if kind else -reach * s, reach * s, points)
        w = np.full(points, v[1] - v[0])
        w[[0, -1]] /= 2
        density = np.log(w) - 0.5 * (v / s) ** 2 - 0.5 * np.log(2 * np.pi * s**2) + np.log(2 if kind else 1)
        axes.append((v**2 if kind == 2 else v, density))
    q = np.stack(np.meshgrid(*(a[0] for a in axes), indexing="ij"), -1).reshape(-1, len(sigma))
    prior = sum(np.meshgrid(*(a[1] for a in axes), indexing="ij")).ravel()
    return logsumexp(prior + q @ projection - 0.5 * np.einsum("ij,jk,ik->i", q, gram, q))


CASES = [c for n in (1, 2, 3) for c in product(range(3), repeat=n) if n < 3 or c in ((0, 1, 2), (1, 1, 2), (2, 2, 1))]


@pytest.mark.parametrize("kinds", CASES, ids=str)
def test_integrals_against_brute_force(kinds):
    """Ordinary, one-sided and squared amplitudes, alone and together, at and away from the boundary, to 1e-2."""
    rng = np.random.default_rng(len(kinds))
    points = {1: 4001, 2: 401, 3: 81}[len(kinds)]
    for middle in (-1.5, 0.0, 1.0, 2.0) if len(kinds) < 3 else (-0.5, 1.0):
        root = rng.normal(size=(len(kinds), len(kinds) + 1))
        gram = root @ root.T + 0.5 * np.eye(len(kinds))
        sigma = rng.uniform(0.7, 1.5, len(kinds))
        projection = gram @ np.full(len(kinds), middle) + rng.normal(size=len(kinds))
        term = evidence.term([(i, sigma[i], k) for i, k in enumerate(kinds)], 0.0)
        found = evidence.log_factors(gram[None], projection[None], [term])[0, 0]
        assert found == pytest.approx(brute(gram, projection, sigma, kinds, points, 6.0), abs=1e-2)


@pytest.mark.parametrize("kind", [1, 2])
@pytest.mark.parametrize("pull", [-300.0, -20.0, 5.0, 300.0])
def test_strong_pulls_at_and_away_from_the_boundary(kind, pull):
    """Peaks a thousand times narrower than the prior, and ones that the boundary cuts to an exponential."""
    gram, projection = np.array([[1e4]]), np.array([100.0 * pull])
    found = evidence.log_factors(gram[None], projection[None], [evidence.term([(0, 1.0, kind)], 0.0)])[0, 0]
    assert found == pytest.approx(brute(gram, projection, [1.0], [kind], 400_001, 8.0 if pull > 0 else 0.5), abs=1e-2)


def test_screened_evidence_against_integration_over_everything():
    """Nuisances, amplitude, setting scale and field sigma by brute force, on a problem small enough for it."""
    rng = np.random.default_rng(1)
    n = 7
    nuisance, effect = rng.normal(size=(n, 1)) * 2, rng.normal(size=(n, 1)) * 3
    residual = rng.normal(size=n) + effect[:, 0] * 0.7
    about = linear.Linear(residual, nuisance, np.array([True]), effect, ("a",), np.zeros(n, int), 0.0)
    made = Effect("a", "x", (Parameter("a", "1", 0.8, one_sided=True),))
    catalogue = screen.Catalogue({"a": made}, {"a": (screen.Node({}, (0,), 0.0),)}, effect, 0 * effect)
    scales, weights = settings.grid()
    sets = [(h, screen.hypothesis_terms(catalogue, h, {})) for h in ((), ("a",))]
    found = {h: z + evidence.log_prior(h, ["a"]) for h, z in screen.weigh(about, effect, scales, weights, sets).items()}
    x, a = np.linspace(-40, 40, 1001), np.linspace(0, 6.4, 201)
    for hypothesis, grid in ((), np.zeros(1)), (("a",), a):
        total = []
        for v in grid:
            fit = residual[:, None] - nuisance * x - effect * v
            loglike = -0.5 * (fit**2).sum(axis=0) - n / 2 * np.log(2 * np.pi)
            prior = logsumexp(
                [
                    np.log(w) - 0.5 * (x / s) ** 2 - 0.5 * np.log(2 * np.pi * s**2)
                    for s, w in zip(scales, weights, strict=True)
                ],
                axis=0,
            )
            total.append(logsumexp(loglike + prior) + np.log(x[1] - x[0]))
        if hypothesis:
            edge = np.where((a == 0) | (a == a[-1]), 0.5, 1.0)
            log_prior = np.log(2 * edge) - 0.5 * (a / 0.8) ** 2 - 0.5 * np.log(2 * np.pi * 0.8**2)
            total = np.array(total) + log_prior + np.log(a[1] - a[0])
        presence = np.log(evidence.PRESENCE) if hypothesis else np.log1p(-evidence.PRESENCE)
        assert found[hypothesis] == pytest.approx(logsumexp(total) + presence, abs=1e-2)


def test_a_shape_is_summed_over_its_grid_and_a_field_over_its_sigma():
    problem, _ = lines.problem({"ripple": 0.05, "period": 0.7}, seed=2)
    catalogue = screen.expand(problem, {})
    assert [n.shape["period"] for n in catalogue.nodes["ripple"]] == [0.5, 0.7, 0.9]
    # A uniform prior over the range: the ends stand for half a step each.
    np.testing.assert_allclose(np.exp([n.log_weight for n in catalogue.nodes["ripple"]]), [0.25, 0.5, 0.25])
    terms = screen.effect_terms(catalogue, "tilts")
    assert np.exp([t.log_weight for t in terms]).sum() == pytest.approx(1.0)
    assert max(t.field_sigma[0] for t in terms) == pytest.approx(0.3)


def test_a_hypothesis_is_the_join_of_its_effects_in_any_kind():
    a = evidence.term([(0, 1.0, 2), (1, 2.0, 0)], -1.0)
    b = evidence.term([(2, 3.0, 1), (3, 4.0, 0)], -2.0)
    joined = screen.join(a, b)
    assert (joined.columns, joined.sigma, joined.counts) == ((1, 3, 2, 0), (2.0, 4.0, 3.0, 1.0), (2, 1, 1))
    assert joined.log_weight == -3.0
