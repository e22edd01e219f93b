"""Products with the nuisances marginalised, and derivatives, against what they stand for."""

import lines
import numpy as np
import pytest

from benchsim.diagnosis import evidence, linear, settings
from benchsim.diagnosis.problem import Parameter

AMPLITUDES = tuple(p for e in lines.CATALOGUE for p in e.parameters if not p.grid)


@pytest.fixture(scope="module")
def about():
    problem, _ = lines.problem({"turn": 0.2}, seed=5)
    at = {"s1.offset": 0.3, "gain": 0.01, "turn": 0.1, "period": 0.7}
    return problem, at, linear.linearise(problem, at, AMPLITUDES)


def test_marginal_products_are_those_of_the_full_covariance(about):
    _, _, lin = about
    for scale in (1.0, 3.0):
        s = np.where(lin.scaled, scale, 1.0)
        full = np.eye(len(lin.residual)) + (lin.nuisance * s**2) @ lin.nuisance.T
        found = linear.marginal(lin, lin.effect, scale)
        np.testing.assert_allclose(found.gram, lin.effect.T @ np.linalg.solve(full, lin.effect), rtol=1e-7, atol=1e-6)
        assert found.chi2 == pytest.approx(lin.residual @ np.linalg.solve(full, lin.residual), rel=1e-8)
        assert found.logdet == pytest.approx(np.linalg.slogdet(full)[1] + lin.logdet, rel=1e-10)


def test_columns_so_long_that_their_square_has_lost_the_prior_are_factored_all_the_same():
    """Far from any fit a bench answers a milliradian with metres. Thirty columns that are sums of ten leave
    NᵀN + S⁻² indefinite by rounding; its factor still is what the columns and the prior make it."""
    rng = np.random.default_rng(3)
    n = rng.normal(size=(60, 10)) @ rng.normal(size=(10, 30)) * 1e7
    s = np.full(30, 1e3)
    inner = np.diag(s**-2.0) + n.T @ n
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.cholesky(inner)
    factor, lower = linear.precision(n, s)
    assert lower and (np.diag(factor) > 0).all()
    np.testing.assert_allclose(factor @ factor.T, inner, rtol=1e-9, atol=1e-9 * np.abs(inner).max())
    near = rng.normal(size=(60, 10))
    np.testing.assert_allclose(linear.precision(near, s[:10])[0], np.linalg.cholesky(1e-6 * np.eye(10) + near.T @ near))


def test_what_long_columns_leave_beside_the_nuisances_is_not_rounding():
    """Scenario: about a null that misses by far, effects and settings alike move the light by 1e9 sigma. Of a column
    that is a nuisance's but for some sigma, a difference of squares keeps nothing (here it is below 0, which made the
    probabilities of all effects no numbers). What is left is known in closed form: M⁻¹ takes 1 part of 1 + L² of the
    nuisance's own direction and all of the others."""
    rng = np.random.default_rng(8)
    n, length = 60, 1e9
    basis = np.linalg.qr(rng.normal(size=(n, 6)))[0]
    nuisance, odd = length * basis[:, :4], basis[:, 4:]
    columns = nuisance[:, :2] + odd * [3.0, 5.0]
    lin = linear.Linear(odd[:, 0] * 7.0, nuisance, np.ones(4, bool), columns, ("a", "b"), np.zeros(n, int), 0.0)
    left = np.diag([9.0 + 1.0, 25.0 + 1.0])
    for found in (linear.marginal(lin, columns), *linear.marginals(lin, columns, np.array([1.0]))):
        np.testing.assert_allclose(found.gram, left, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(found.projection, [21.0, 0.0], rtol=1e-5, atol=1e-5)
        assert found.chi2 == pytest.approx(49.0)


def test_an_amplitude_that_others_take_up_but_for_rounding_is_not_seen_beside_them():
    """Scenario: three columns 1e10 sigma long of which two span the third, rounded as a product of long columns is.
    Whichever of them is one-sided or a square, its factor is that of the other two to within what the prior's own
    volume can be."""
    rng = np.random.default_rng(4)
    two = rng.normal(size=(40, 2)) * 1e10
    columns = np.column_stack([two, two @ [0.6, 0.8]])
    gram = columns.T @ columns * (1 + 2e-16 * rng.normal(size=(3, 3)))
    data = two @ [0.3, 0.2] * 1e-10
    projection = columns.T @ data
    alone = evidence.log_integral(gram[None, :2, :2], projection[None, :2], (2, 0, 0))
    for counts in ((2, 1, 0), (2, 0, 1)):
        found = evidence.log_integral(gram[None], projection[None], counts)
        assert np.isfinite(found).all() and abs(found - alone) < 1.0


def test_two_squares_that_look_alike_are_weighed_however_long_their_columns_are():
    """Scenario: facets' tilts and their wobble widen the line alike; beside a null that misses by far each is 1e5 sigma
    long. Only their sum shows, so that the evidence falls by the ratio of lengths: by ln 10 for each ten."""
    alike = np.ones((2, 2))
    found = [
        evidence.log_integral(a * alike[None], 0.3 * a * alike[:1], (0, 0, 2))[0] - a * 0.3**2 / 2
        for a in (1e4, 1e6, 1e8, 1e10)
    ]
    np.testing.assert_allclose(np.diff(found), -np.log(10), atol=0.3)


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
def test_what_cannot_be_weighed_is_not_believed():
    unknown = np.array([[[np.nan]]])
    one = evidence.Term((0,), (1.0,), (1, 0, 0), 0.0)
    assert evidence.log_factors(unknown, np.zeros((1, 1)), [one])[0, 0] == -np.inf


def test_all_scales_at_once_are_each_scale_alone(about):
    _, _, lin = about
    scales, weights = settings.grid()
    assert weights.sum() == pytest.approx(1.0) and scales[0] == 1.0 and (np.diff(weights) < 0).all()
    for scale, many in zip(scales, linear.marginals(lin, lin.effect, scales), strict=True):
        one = linear.marginal(lin, lin.effect, scale)
        np.testing.assert_allclose(many.gram, one.gram, rtol=1e-8, atol=1e-7)
        np.testing.assert_allclose(many.projection, one.projection, rtol=1e-6, atol=1e-6)
        assert (many.chi2, many.logdet, many.n) == pytest.approx((one.chi2, one.logdet, one.n))


def test_the_residual_of_a_linear_problem_does_not_depend_on_the_point():
    problem, _ = lines.problem({"bow_1": 0.1}, seed=2)
    bow = AMPLITUDES[:2]
    first = linear.linearise(problem, {}, bow)
    second = linear.linearise(problem, {"bow_1": 0.4, "bow_2": -0.3}, bow)
    np.testing.assert_allclose(first.residual, second.residual, atol=1e-9)


def test_a_square_is_differentiated_by_the_square_and_only_to_the_right_of_zero():
    problem, _ = lines.problem()
    blur = next(p for p in AMPLITUDES if p.name == "blur")
    step = 1e-6
    column = linear.columns(problem, {}, (blur,), {"blur": step})[:, 0]
    width = np.concatenate([0.3 + 0.1 * u * lines.Y for u in lines.SETTINGS])
    np.testing.assert_allclose(column[problem.kind == "w"], 1 / (2 * width), rtol=1e-4)
    assert not column[problem.kind == "c"].any()


def test_a_square_is_differentiated_where_it_is_seen():
    """Scenario: a blur of a tenth of its prior sigma, many sigma in the data. The step is a part of the value's
    prior sigma: a twentieth of its square would reach three times as far as the blur is wide."""
    problem, _ = lines.problem()
    blur = next(p for p in AMPLITUDES if p.name == "blur")
    faint = 0.1 * blur.sigma
    column = linear.columns(problem, {"blur": faint}, (blur,))[:, 0]
    plain = np.concatenate([0.3 + 0.1 * u * lines.Y for u in lines.SETTINGS])
    exact = 1 / (2 * np.sqrt(plain**2 + faint**2))
    np.testing.assert_allclose(column[problem.kind == "w"], exact, rtol=0.01)


def test_a_parameter_is_differentiated_on_its_own_blocks_only():
    problem, _ = lines.problem()
    asked = []

    def predict(values, block):
        asked.append(block)
        return lines.predict(values, block)

    watched = lines.problem(predict=predict)[0]
    asked.clear()
    column = linear.columns(watched, {}, (Parameter("s2.slope", "mm", 0.3, blocks=(2,)),))[:, 0]
    assert asked == [2, 2]
    assert set(problem.block[column != 0]) == {2}


def test_tiny_blocks_are_whitened_together_as_they_are_apart():
    rng = np.random.default_rng(8)
    roots = [np.tril(rng.normal(size=(2, 2))) + 2 * np.eye(2) for _ in range(5)]
    columns = rng.normal(size=(10, 3))
    apart = np.concatenate([np.linalg.solve(low, columns[2 * k : 2 * k + 2]) for k, low in enumerate(roots)])
    np.testing.assert_allclose(linear.lowered(roots, columns), apart, rtol=1e-12)
    np.testing.assert_allclose(linear.lowered(roots, columns[:, 0]), apart[:, 0], rtol=1e-12)
    for low, again in zip(roots, linear.factors([r @ r.T for r in roots]), strict=True):
        np.testing.assert_allclose(np.abs(again), np.abs(low), rtol=1e-9)
