"""How near the next other explanation comes, where one of two concealed effects bends.

Two exposures of a line. A tilt turns it and bends it by its square, a² x²; a shear bends it alike, with a little x³.
About the stated bench the tilt's column is x alone, so that a large tilt would be far from itself, and a shear beside
it far from the tilt; where the tilt is, its column holds 2 a x² as well.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchsim.diagnosis.fitting import STILL
from benchsim.diagnosis.linear import predict_all
from benchsim.diagnosis.problem import Effect, Parameter, Problem
from benchsim.trial.visibility import Sight, refitted, rival_refitted

X, NOISE, CUBIC = np.linspace(-1, 1, 40), 0.01, 0.02


def predict(values, block):
    a, b, c, o = (values.get(n, 0.0) for n in ("a", "b", "c", f"o{block}"))
    return 0.3 * X**2 + o + 0.02 * a * X + a**2 * X**2 + b * (X**2 + CUBIC * X**3) + c * np.cos(14 * X)


CATALOGUE = (
    Effect("tilt", "screen", (Parameter("a", "1", 1.0),)),
    Effect("shear", "screen", (Parameter("b", "1", 1.0),)),
    Effect("ripple", "camera", (Parameter("c", "1", 1.0),)),
)


def sight(catalogue=CATALOGUE):
    n = len(X)
    made = Problem(
        data=np.zeros(2 * n),
        block=np.repeat([0, 1], n),
        kind=np.full(2 * n, "c"),
        position=np.tile(X, 2),
        stretch=np.repeat([0, 1], n),
        covariance=(NOISE**2 * np.eye(n),) * 2,
        names=("one", "two"),
        groups=("one", "two"),
        nuisances=tuple(Parameter(f"o{b}", "1", 1.0, scaled=True, blocks=(b,)) for b in range(2)),
        catalogue=catalogue,
        predict=predict,
    )
    return Sight.of(made)


def nearest_by_search(s, values, names):
    """Least squares over a fine grid of amplitudes, settings marginalised: no linearisation at all."""
    grid = np.linspace(-2, 2, 4001)
    target = predict_all(s.problem, values)
    left = [s.through((target - predict_all(s.problem, {names: float(x)})) / NOISE) for x in grid]
    return min(float(np.linalg.norm(v)) for v in left)


def test_one_of_two_that_imitates_both_is_their_rival():
    s, values = sight(), {"a": 0.5, "b": 0.04}
    assert float(np.linalg.norm(s.change({"b": 0.04}))) > 8
    name, distance = s.rival(values, ("tilt", "shear"))
    true = nearest_by_search(s, values, "a")
    assert true < 1.0
    assert "tilt" in name and distance < 1.5
    assert s.alone(values, ("tilt", "shear")) == pytest.approx(true, abs=0.5)


def test_what_nothing_imitates_has_no_near_rival():
    s, values = sight(CATALOGUE[::2]), {"a": 0.5, "c": 0.04}
    snr = float(np.linalg.norm(s.change({"c": 0.04})))
    _, distance = s.rival(values, ("tilt", "ripple"))
    assert distance == pytest.approx(snr, rel=0.1)
    assert s.alone(values, ("tilt", "ripple")) == pytest.approx(snr, rel=0.1)
    assert s.alone({"c": 0.04}, ("ripple",)) == float("inf")


def test_settings_that_bend_take_up_more_than_to_first_order():
    """One setting moves the line by 0.1 s + 0.1 s². About 0 it would have to move by six sigma to hide a shift of 0.6;
    it moves by two."""
    n = len(X)
    problem = Problem(
        data=np.zeros(n),
        block=np.zeros(n, int),
        kind=np.full(n, "c"),
        position=X,
        stretch=np.zeros(n, int),
        covariance=(NOISE**2 * np.eye(n),),
        names=("one",),
        groups=("one",),
        nuisances=(Parameter("s", "1", 1.0, scaled=True),),
        catalogue=(Effect("shift", "screen", (Parameter("b", "1", 1.0),)),),
        predict=lambda values, block: np.full(
            n, values.get("b", 0.0) + 0.1 * values.get("s", 0.0) + 0.1 * values.get("s", 0.0) ** 2
        ),
    )
    shifted = predict_all(problem, {"b": 0.6})
    cost = [s**2 + n * ((0.6 - 0.1 * s - 0.1 * s**2) / NOISE) ** 2 for s in np.linspace(0, 6, 60001)]
    assert refitted(problem, shifted) ** 2 == pytest.approx(min(cost), abs=2 * STILL)
    assert np.linalg.norm(Sight.of(problem).change({"b": 0.6})) > 5.5


def test_a_rival_that_bends_comes_nearer_when_it_is_fitted():
    """A swell changes the line by 0.4 d + d², a twist by 0.2 t + t². A swell of 0.5 makes 0.45: to first order twice
    what a twist can at its cap, 1, and what one of 0.58 does."""

    def bending(values, block):
        d, t, o = (values.get(n, 0.0) for n in ("d", "t", f"o{block}"))
        return 0.3 * X**2 + o + (0.4 * d + d**2 + 0.2 * t + t**2) * np.cos(5 * X)

    catalogue = (
        Effect("swell", "screen", (Parameter("d", "1", 0.5),)),
        Effect("twist", "mirror", (Parameter("t", "1", 0.5),)),
    )
    s = sight(catalogue)
    bent = Sight.of(replace(s.problem, predict=bending))
    values = {"d": 0.5}
    first, far = bent.rival(values, ("swell",))
    name, distance = rival_refitted(bent, values, ("swell",))
    assert first == name == "twist"
    assert far > 20
    assert distance < 0.1


def test_a_rival_that_would_need_more_than_its_cap_stays_as_far_as_it_is():
    s = sight(CATALOGUE[:2])
    values = {"b": 4.5}
    first = s.rival(values, ("shear",))
    assert rival_refitted(s, values, ("shear",)) == pytest.approx(first)
