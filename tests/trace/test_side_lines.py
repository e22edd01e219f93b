"""Scenario: a stretch of a trace on which several lines of one known shape lie beside and half over each other, on a
background that slopes, with the noise of pixels. The comb has to give the mean and the mean square offset of the light
with errors that are true, however the lines lie; a single line has to be told from several."""

import numpy as np
import pytest

from benchsim.trace.side_lines import comb, one_line

Q = np.arange(-30.0, 30.0, 0.6)
PLACES = np.arange(-40.0, 40.0, 0.05)
WIDTH = 1.3
LINE = (PLACES, np.exp(-0.5 * (PLACES / WIDTH) ** 2))


def stretch(lines, shares, rng, noise=0.003):
    light = sum(s * np.exp(-0.5 * ((Q - x) / WIDTH) ** 2) for x, s in zip(lines, shares, strict=True))
    sigma = np.full(len(Q), noise)
    return Q, light + 0.002 + 1e-4 * Q + sigma * rng.standard_normal(len(Q)), sigma


@pytest.mark.parametrize(
    ("lines", "shares"),
    [
        ((-11.0, 0.0, 11.0), (1 / 12, 10 / 12, 1 / 12)),
        ((0.0, 3.3), (0.9, 0.1)),
        (tuple(np.random.default_rng(4).normal(0, 4, 12)), (1 / 12,) * 12),
    ],
)
def test_mean_and_parting_lie_where_their_errors_say(lines, shares):
    rng, places, light = np.random.default_rng(7), np.array(lines), np.array(shares)
    mean = light @ places
    parting = light @ (places - mean) ** 2
    cells = np.arange(-14.0, 14.0, 0.6)
    found = [comb(*stretch(lines, shares, rng), LINE, cells, 0.025) for _ in range(60)]
    for values, errors, truth, bias in (
        ([f.mean for f in found], [f.errors[0] for f in found], mean, 0.0),
        # Two cells share a line between them, and noise that cannot be negative adds a little.
        ([f.parting for f in found], [f.errors[1] for f in found], parting, 0.6**2 / 4 + 0.02 * parting),
    ):
        off, usual = np.array(values) - truth, float(np.mean(errors))
        assert abs(off.mean()) < bias + 4 * usual / np.sqrt(60)
        # The scatter of 60 is known to 9 %; four of it.
        assert 0.64 < off.std() / usual < 1.36


def test_one_line_does_where_there_is_one_and_not_where_two_are():
    rng = np.random.default_rng(8)
    free = len(Q) - 4
    alone = [one_line(*stretch((0.7,), (1.0,), rng), LINE) for _ in range(40)]
    # χ² of 40 · 96 degrees of freedom at five sigma.
    assert abs(np.mean(alone) / free - 1) < 5 * np.sqrt(2 / (40 * free))
    # A tenth of the light 2.5 widths off is 33 sigma of a pixel's noise high.
    assert one_line(*stretch((0.0, 3.3), (0.9, 0.1), rng), LINE) > 3 * free


def test_a_comb_has_no_light_where_there_are_no_cells():
    rng = np.random.default_rng(9)
    found = comb(*stretch((0.0,), (1.0,), rng), LINE, np.array([-2.0, 0.0, 2.0]))
    assert found.shares[1] > 0.98 and found.shares.sum() == pytest.approx(1.0) and found.parting < 0.1
