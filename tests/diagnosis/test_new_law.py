"""Laws: sparse where the truth is, free where it is not, and none where nothing is predicted."""

from dataclasses import replace

import numpy as np
import pytest
from toy import toy

from benchsim.diagnosis import cross_validation, discrepancy, functions, naming, new_law


def law_of(truth, seed, attachment, **options):
    problem = toy(truth, seed, **options)
    found = naming.name(problem)
    prepared = functions.prepare(problem, found.noise.covariance)
    laid = next(a for a in discrepancy.weigh(problem, found, prepared) if a.attachment.name == attachment)
    many = cross_validation.folds(problem, found, found.linear)
    return new_law.law(problem, found, found.null, laid, many)


def test_a_square_is_found_as_a_square():
    law, why = law_of({"bow": 0.5}, 1, "screen.height", without=("bow",))
    assert why == ""
    assert law.coordinate == "screen x"
    assert list(law.terms) == ["x^2"]
    assert law.terms["x^2"] == pytest.approx(0.5, abs=0.04)
    assert law.held_out_gain > 0.9 and law.held_out_gain > 3 * law.gain_sigma
    x = law.knots[:, 0]
    assert law.coefficients == pytest.approx(law.terms["x^2"] * x**2, abs=1e-9)


def test_what_is_no_short_polynomial_is_left_as_a_function():
    law, _ = law_of({"warp": 0.3}, 2, "mirror.lean", blocks=16)
    assert law.terms == {} or len(law.terms) >= 2
    x = law.knots[:, 0]
    seen = law.coefficients - np.polyval(np.polyfit(x, law.coefficients, 1), x)
    true = 0.3 * np.cos(5 * x)
    true = true - np.polyval(np.polyfit(x, true, 1), x)
    assert np.corrcoef(seen, true)[0, 1] > 0.98
    assert law.held_out_gain > 0.8


@pytest.mark.parametrize("seed", range(20, 26))
def test_noise_has_no_law(seed):
    law, why = law_of({}, seed, "screen.height")
    assert law is None
    assert why.startswith("No law is published")


def test_a_function_of_the_wrong_coordinate_has_no_law():
    # The warp changes sign with the angle: no function of x alone predicts a setting that was left out.
    law, _ = law_of({"warp": 0.3}, 3, "screen.height", blocks=16)
    assert law is None


def test_gain_needs_half_and_three_sigma():
    assert new_law.gain(np.array([(100.0, 1.0, 1.0), (120.0, 2.0, 1.0), (90.0, -3.0, 1.0)]).T, 50).holds
    # Half is not reached.
    assert not new_law.gain(np.array([*[(1000.0, 600.0, 1.0)] * 4]).T, 50).holds
    # One fold carries all of it: the jackknife says so.
    assert not new_law.gain(np.array([(1000.0, 10.0, 1.0), (10.0, 300.0, 1.0), (10.0, 50.0, 1.0)]).T, 50).holds
    # Nothing to take away.
    assert not new_law.gain(np.array([*[(-5.0, -6.0, 0.25)] * 3]).T, 50).holds


def test_fewer_than_three_settings_publish_nothing():
    law, why = law_of({"bow": 0.5}, 4, "screen.height", without=("bow",), blocks=4, per_group=2)
    assert law is None and "three settings" in why


def test_terms_carry_the_coordinates_names_and_units():
    a = toy().attachments[0]
    knots = np.array([[y, z] for y in (-200.0, 200.0) for z in (-100.0, 0.0, 100.0)])
    two = type(a)(**{**vars(a), "knots": knots, "component": np.array([0, 0, 0, 1, 1, 1])})
    two = replace(two, axes=("y", "z"), parts=("across", "up"))
    found = new_law.printed(two, [new_law.Monomial(0, (1, 2)), new_law.Monomial(1, (0, 0))], np.array([4.0, 1.0]))
    assert found == {"y z^2 [across]": pytest.approx(4.0 / 200 / 100**2), "1 [up]": 1.0}
