"""Which hypotheses merge: the distance against a dense fit, caps, and the shapes that a claim can take."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import lsq_linear
from toy import toy

from benchsim.diagnosis import degeneracy
from benchsim.diagnosis.degeneracy import Space, Weighed, claim, likely, separation
from benchsim.diagnosis.linear import linearise
from benchsim.diagnosis.next_experiment import gram_with
from benchsim.diagnosis.problem import NextRecording, Parameter


def whole(problem):
    return linearise(problem, {}, tuple(p for e in problem.catalogue for p in e.parameters))


def vector(linear, **values):
    return np.array([values.get(n, 0.0) for n in linear.names])


@pytest.mark.parametrize("rival", [("lens-a",), ("lean", "swell"), ("bow", "creep"), ("blur",)])
def test_distance_is_what_a_bounded_fit_leaves(rival):
    problem = toy()
    linear = whole(problem)
    within = degeneracy.space(problem, linear, 1.0)
    signal = vector(linear, bow=0.2, lens_b=0.7)
    # Dense: amplitudes within caps and nuisances with their priors as further data.
    places = within.places(rival)
    p = linear.nuisance.shape[1]
    a = np.block([
        [linear.effect[:, places], linear.nuisance],
        [np.zeros((p, len(places))), np.eye(p)],
    ])  # fmt: skip
    b = np.concatenate([linear.effect @ signal, np.zeros(p)])
    low = np.concatenate([within.low[places], np.full(p, -np.inf)])
    high = np.concatenate([within.high[places], np.full(p, np.inf)])
    dense = np.sqrt(2 * lsq_linear(a, b, (low, high), tol=1e-14).cost)
    assert separation(within, signal, rival) == pytest.approx(dense, rel=1e-4, abs=1e-3)


def test_a_cap_keeps_a_rival_away():
    # Two columns that differ only in strength: the weak one imitates the strong one up to its cap.
    gram = np.array([[100.0, 10.0], [10.0, 1.0]])
    index = {"strong": np.array([0]), "weak": np.array([1])}
    within = Space(gram, np.zeros(2), np.ones(2), np.array([-2.0, -2.0]), np.array([2.0, 2.0]), index)
    assert separation(within, np.array([0.15, 0]), ("weak",)) == pytest.approx(0, abs=1e-6)
    assert separation(within, np.array([1.0, 0]), ("weak",)) == pytest.approx(8)
    one_sided = Space(gram, np.zeros(2), np.ones(2), np.zeros(2), np.array([2.0, 2.0]), index)
    assert separation(one_sided, np.array([-0.15, 0]), ("weak",)) == pytest.approx(1.5)


def made(columns, **log_z):
    """A space of unit-sigma amplitudes with given columns; sets are written a_b."""
    names = list(columns)
    matrix = np.column_stack([columns[n] for n in names])
    n = len(names)
    within = Space(
        matrix.T @ matrix,
        np.zeros(n),
        np.ones(n),
        np.full(n, -2.0),
        np.full(n, 2.0),
        {k: np.array([i]) for i, k in enumerate(names)},
    )
    sets = {tuple(k.split("_")) if k != "null" else (): v for k, v in log_z.items()}
    return within, Weighed(sets)


E1, E2, E3, E4 = 20 * np.eye(4)


def test_far_from_everything_is_a_lone_name():
    within, z = made({"a": E1, "b": E2}, null=0.0, a=50.0, b=10.0)
    got = claim(z, ("a",), np.array([1.0, 0]), within)
    assert got.lone == ("a",) and got.classes == ()


def test_a_rival_within_three_sigma_is_never_left_out_however_improbable():
    within, z = made({"a": E1, "b": E1 + 0.14 * E2, "c": E2}, null=0.0, a=50.0, b=30.0, c=1.0)
    got = claim(z, ("a",), np.array([1.0, 0, 0]), within)
    assert got.lone == () and got.classes == ((("a",), ("b",)),)
    within, z = made({"a": E1, "b": E1 + 0.16 * E2, "c": E2}, null=0.0, a=50.0, b=30.0, c=1.0)
    assert claim(z, ("a",), np.array([1.0, 0, 0]), within).lone == ("a",)


def test_what_keeps_the_best_from_being_likely_is_an_alternative():
    within, z = made({"a": E1, "b": E1 + 0.2 * E2}, null=0.0, a=50.0, b=49.0)
    assert claim(z, ("a",), np.array([1.0, 0]), within).classes == ((("a",), ("b",)),)


def test_a_pair_that_outdoes_the_member_that_it_holds_is_a_member_too():
    """Scenario: two effects are there; one that stands in for both is a little more probable, and either of the two by
    itself less than both. Where both are less probable than one of them, that one is enough."""
    columns = {"a": E1, "b": E1 + 0.1 * E2, "c": 0.2 * E3}
    within, z = made(columns, null=0.0, a=20.0, b=17.0, c=1.0, b_c=19.0)
    assert claim(z, ("a",), np.array([1.0, 0, 0]), within).classes == ((("a",), ("b", "c"), ("b",)),)
    within, z = made(columns, null=0.0, a=20.0, b=17.0, c=1.0, b_c=16.0)
    assert claim(z, ("a",), np.array([1.0, 0, 0]), within).classes == ((("a",), ("b",)),)


def test_members_of_a_pair_are_told_apart_one_by_one():
    columns = {"a": E1, "b": E2, "c": E2 + 0.1 * E3}
    within, z = made(columns, null=0.0, a=20.0, b=20.0, c=19.0, a_b=80.0, a_c=79.0, b_c=20.0)
    got = claim(z, ("a", "b"), np.array([1.0, 1, 0]), within)
    assert got.lone == ("a",)
    assert got.classes == ((("b",), ("c",)),)


def test_two_open_alternatives_are_two_classes():
    columns = {"a": E1, "b": E2, "c": E2 + 0.1 * E3, "d": E1 + 0.1 * E4}
    pairs = {"a_b": 80.0, "a_c": 79.0, "b_d": 78.0, "c_d": 77.0, "a_d": 20.0, "b_c": 20.0}
    within, z = made(columns, null=0.0, a=20.0, b=20.0, c=19.0, d=20.0, **pairs)
    got = claim(z, ("a", "b"), np.array([1.0, 1, 0, 0]), within)
    assert got.lone == ()
    assert got.classes == ((("a",), ("d",)), (("b",), ("c",)))


def test_one_effect_that_imitates_two_makes_one_class_of_sets():
    columns = {"a": E1, "b": E2, "c": E1 + E2 + 0.1 * E3}
    within, z = made(columns, null=0.0, a=20.0, b=20.0, c=82.0, a_b=80.0, a_c=79.0, b_c=79.0)
    got = claim(z, ("a", "b"), np.array([1.0, 1, 0]), within)
    assert got.classes == ((("a", "b"), ("c",)),)


def test_at_most_four_members_the_most_probable_first():
    columns = {"a": E1, **{f"b{k}": E1 + 0.01 * (k + 1) * E2 for k in range(6)}}
    within, z = made(columns, null=0.0, a=50.0, **{f"b{k}": 40.0 + k for k in range(6)})
    (members,) = claim(z, ("a",), np.eye(7)[0], within).classes
    assert members == (("a",), ("b5",), ("b4",), ("b3",))


def test_an_effect_that_is_not_likely_is_dropped():
    within, z = made({"a": E1, "b": 0.1 * E2}, null=0.0, a=50.0, b=-2.0, a_b=51.0)
    assert likely(z, ("a", "b"), np.array([1.0, 1]), within) == ("a",)
    within, z = made({"a": E1, "b": E2}, null=0.0, a=50.0, b=40.0, a_b=90.0)
    assert likely(z, ("a", "b"), np.array([1.0, 1]), within) == ("a", "b")
    # Two that share what would make either likely: the slot is filled, by one of them.
    within, z = made({"a": E1, "b": E1 + 0.01 * E2}, null=0.0, a=1.9, b=1.9)
    assert likely(z, ("a",), np.array([1.0, 0]), within) == ("a",)


def test_probability_counts_every_set_that_holds_a_member():
    _, z = made({"a": E1, "b": E2}, null=0.0, a=np.log(3), b=np.log(2), a_b=np.log(4))
    assert z.probability([("a",)]) == pytest.approx(0.7)
    assert z.probability([("a",), ("b",)]) == pytest.approx(0.9)


def test_a_further_recording_counts_as_if_it_were_there():
    # The Gram matrix with seven lines and the eighth as a further recording is that with eight.
    eight = toy(blocks=8)
    full = whole(eight)
    now = eight.block < 7
    part = type(full)(
        full.residual[now],
        full.nuisance[now][:, [*range(21), 24]],
        full.scaled[[*range(21), 24]],
        full.effect[now],
        full.names,
        full.block[now],
        0.0,
    )
    seven = replace(eight, nuisances=(*eight.nuisances[:21], eight.nuisances[24]))
    last = ~now
    new = {f"g7.{k}": i for k, i in (("offset", 21), ("slope", 22), ("shift", 23))}
    priors = {n: Parameter(n, "mm", 0.5, scaled=True) for n in new}
    more = NextRecording(
        "recording",
        "the eighth line",
        np.eye(int(last.sum())),
        {"focus": full.nuisance[last, 24] / 0.05, **{n: full.nuisance[last, i] / 0.5 for n, i in new.items()}},
        priors,
        {n: full.effect[last, i] for i, n in enumerate(full.names)},
    )
    expected = degeneracy.space(eight, full, 2.0).gram
    assert gram_with(seven, part, 2.0, more) == pytest.approx(expected, rel=1e-8, abs=1e-6)
