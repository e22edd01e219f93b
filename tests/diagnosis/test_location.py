"""Where: the rule for elements, and the scan along the lines with its rate of false alarms."""

from dataclasses import replace

import numpy as np
import pytest
from test_remainder import draws
from toy import toy

from benchsim.diagnosis.levels import ALARM
from benchsim.diagnosis.linear import linearise
from benchsim.diagnosis.location import Explanation, by_kind, locate, scan


def explained(element, coordinate, log_evidence, left=0.0):
    return Explanation(element, coordinate, log_evidence, lambda: left)


def test_an_element_is_claimed_over_every_other_one():
    a, b = explained("screen", "z", -10.0), explained("mirror", "phase", -17.9)
    assert not locate([a, b]).claimed
    far = explained("mirror", "phase", -18.1)
    found = locate([a, far, explained("screen", "y", -10.5)])
    assert found.claimed and found.element == "screen" and found.coordinate == "z"
    assert not locate([explained("screen", "z", -10.0, float("inf")), far]).claimed
    assert not locate([explained("screen", "z", -10.0, 0.2), far]).claimed
    assert locate([explained("screen", "z", -9.0, 0.9), far]).claimed
    assert not locate([a]).claimed
    assert locate([]) is None


def test_clean_lines_show_a_stretch_no_more_often_than_stated():
    problem = toy()
    linear = linearise(problem, {}, ())
    hits = sum(
        bool(scan(problem, replace(linear, residual=r), problem.covariance, 1.0))
        for r in draws(problem, linear, 300, 3)
    )
    # At the stated 1 %, 9 or more of 300 happen once in 250 times.
    assert ALARM == pytest.approx(0.01)
    assert hits < 9


def test_a_stretch_is_found_where_it_is():
    problem = toy()
    linear = linearise(problem, {}, ())
    residual = next(draws(problem, linear, 1, 4))
    rows = np.flatnonzero((problem.block == 5) & (problem.kind == "c") & (np.abs(problem.position - 0.4) < 0.22))
    residual[rows] += 4.0
    found = scan(problem, replace(linear, residual=residual), problem.covariance, 1.0)
    assert found[0].exposure == "line5"
    assert 0.1 < found[0].from_mm < found[0].to_mm < 0.7
    assert found[0].z > 3 and found[0].kind == "c"


def test_what_bends_within_a_line_shows_by_its_own_form_only():
    """A wave of 12 sigma on one line: a window of constant sign averages it away."""
    problem = toy()
    linear = linearise(problem, {}, ())
    residual = next(draws(problem, linear, 1, 4))
    rows = (problem.block == 2) & (problem.kind == "c")
    wave = np.where(rows, np.sin(4 * np.pi * problem.position), 0.0)
    residual = residual + 12 * wave / np.linalg.norm(wave)
    lain = replace(linear, residual=residual)
    found = scan(problem, lain, problem.covariance, 1.0, wave)
    assert found[0].exposure == "line2" and found[0].z > 8
    assert all(s.z < found[0].z - 2 for s in scan(problem, lain, problem.covariance, 1.0))


def test_each_kind_of_datum_tells_how_far_it_follows_what_was_found():
    """The bow of 10 sigma in the lines and nothing in the widths; alone, a kind of noise is N(0, 1)."""
    problem = toy()
    linear = linearise(problem, {}, ())
    bow = np.where(problem.kind == "c", problem.position**2, 0.0)
    both = bow + np.where(problem.kind == "w", 1.0, 0.0)
    white = bow / np.sqrt(np.concatenate([np.diag(c) for c in problem.covariance]))
    noise = list(draws(problem, linear, 200, 5))
    clean = np.array(
        [list(by_kind(problem, replace(linear, residual=r), problem.covariance, 1.0, both).values()) for r in noise]
    )
    # Means of 200 are within 0.25, standard deviations within 0.17: 3.5 sigma.
    assert (np.abs(clean.mean(axis=0)) < 0.25).all() and (np.abs(clean.std(axis=0) - 1) < 0.17).all()
    lain = replace(linear, residual=noise[0] + 10 * white / np.linalg.norm(white))
    seen = by_kind(problem, lain, problem.covariance, 1.0, both)
    assert seen["c"] > 4 and abs(seen["w"]) < 3.5
