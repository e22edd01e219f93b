"""Table 1 of Lara-Cerecedo 2016: consistency, what it determines, and how well it is reproduced."""

import math

import numpy as np
import pytest

from benchsim.fluxes import table
from benchsim.fluxes.table import TABLE, Field, Row, analytic, contradictions, fit_table, least_gap


@pytest.fixture(scope="module")
def fit():
    return fit_table()


def test_rounded_rows_are_never_called_faulty():
    """2000 rows of random fluxes, printed as the paper prints them, the difference taken before rounding, relative to
    either flux."""
    rng = np.random.default_rng(1)
    for k in range(2000):
        digit = (1.0, 0.1)[k % 2]
        mc = rng.uniform(200, 7000)
        approximate = mc * (1 + rng.normal(0, 0.03))
        base = (mc, approximate)[k // 2 % 2]
        printed = round(100 * abs(mc - approximate) / base, 2)
        rounded = [round(v / digit) * digit for v in (mc, approximate)]
        assert least_gap(*rounded, printed, digit) < 1e-9


def test_the_faulty_row_is_found_by_its_own_numbers():
    """(14.2, 66.7): 2701 against 2616 is 3.1 %, not 0.77. One average is off by more than rounding too, by a hundredth
    of a percentage point."""
    found = contradictions()
    grave = [(row.x, row.y, what) for row, what, gap in found if gap > 0.1]
    assert grave == [(14.2, 66.7, "peak")]
    assert [(row.y, what) for row, what, gap in found if gap <= 0.1] == [(88.5, "average")]


def test_the_table_is_reproduced(fit):
    """The bars: peaks within 4 %, averages within 2 %."""
    assert np.abs(fit.peak).max() < 0.04
    assert np.abs(fit.average).max() < 0.02


def test_no_length_follows_from_the_table(fit):
    """Mirror, target and total error grown together change nothing."""
    for row in TABLE[::4]:
        np.testing.assert_allclose(analytic(fit.field, row, 1e-3), analytic(fit.field, row, 9e-3), rtol=1e-12)


def test_what_is_determined_and_what_is_not(fit):
    """T/σ and irradiance × (L/σ)² to a per cent; irradiance and L/σ apart only by the images' astigmatism."""
    mirror, target, irradiance, _ = fit.sigma
    assert target < 0.01
    assert irradiance > 0.05 and mirror > 0.03
    assert fit.correlation[0, 2] < -0.99
    both = 4 * mirror**2 + irradiance**2 + 4 * fit.correlation[0, 2] * mirror * irradiance
    assert math.sqrt(both) < 0.02


def test_the_hour_is_known_up_to_the_sign_of_x(fit, monkeypatch):
    """The table mirrored east to west is fitted by the sun mirrored about noon."""
    west = tuple(Row(-r.x, *[getattr(r, n) for n in list(r.__dataclass_fields__)[1:]]) for r in TABLE)
    monkeypatch.setattr(table, "TABLE", west)
    mirrored = fit_table(Field(fit.field.mirror, fit.field.target, fit.field.irradiance, 24 - fit.field.hour))
    assert mirrored.field.hour == pytest.approx(24 - fit.field.hour, abs=1e-3)


def test_a_made_table_gives_back_what_it_was_made_of(monkeypatch):
    """Rounded as printed, begun elsewhere: each within four of its own sigmas (0.03 % by chance)."""
    truth = Field(520e3, 600e3, 500.0, 10.4)
    made = []
    for r in TABLE:
        peak, average = analytic(truth, r)
        made.append(Row(r.x, r.y, 0, round(peak), 0, 0, round(average, 1), 0))
    monkeypatch.setattr(table, "TABLE", tuple(made))
    found = fit_table()
    pulls = [
        math.log(found.field.mirror / truth.mirror) / found.sigma[0],
        math.log(found.field.target / truth.target) / found.sigma[1],
        math.log(found.field.irradiance / truth.irradiance) / found.sigma[2],
        (found.field.hour - truth.hour) / found.sigma[3],
    ]
    assert np.abs(pulls).max() < 4
    assert found.sigma.max() < 0.02
