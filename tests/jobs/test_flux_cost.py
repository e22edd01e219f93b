"""What errors cost and what mending them brings back, against plants in which one thing was changed."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import benchsim as bs
from benchsim.jobs import flux_cost
from benchsim.jobs.flux_engines import Pool, done, over_cells
from benchsim.plant import files
from benchsim.plant.moment import moment, over_limit, over_limit_changes, shifted

PLANTS = Path(__file__).resolve().parents[2] / "scenes" / "plants"
DAY = {"day": "2026-03-21", "step": 4.0, "cells": 30}


def five(limit=None, **changes):
    p = files.read(PLANTS / "five")
    receiver = replace(p.receivers[0], peak_limit=limit)
    return replace(p, receivers=(receiver,), field=replace(p.field, sigmas={}, **changes))


def test_one_that_changes_alone_changes_what_is_above_the_limit():
    """Against the plant with that one heliostat exchanged; nothing shades here."""
    p = five(20e3)
    sun = np.array([0.1, -0.5, 0.86])
    sun /= np.linalg.norm(sun)
    rng = np.random.default_rng(3)
    before, after = ({n: rng.normal(0, 2e-3, 5) for n in ("IA", "IE")} for _ in range(2))
    grids = (p.receivers[0].mesh(1.0, 30, 30),)
    base, other = (moment(p, sun, 900.0, e, grids) for e in (before, after))
    found = over_limit_changes((p, p), (base, other), (before, after))
    for k in range(5):
        mixed = {n: np.where(np.arange(5) == k, after[n], before[n]) for n in before}
        alone = moment(p, sun, 900.0, mixed, grids)
        assert found[k] == pytest.approx(float(over_limit(p, alone)[0] - over_limit(p, base)[0]), rel=1e-6)
    assert np.abs(found).max() > 100


def test_light_on_anothers_spot_is_ranked_by_what_it_puts_above_the_limit():
    """Two images beside one another, each below the limit; the error of one lays them over each other. Nothing is
    lost: all of its cost is above the limit."""
    p = five()
    aim = p.field.aim + np.array([[-1.0], [0.0], [1.0], [0.0], [0.0]]) * [1500.0, 0.0, 0.0]
    f = p.field
    some = [0, 2]
    field = replace(
        f, ids=("A", "B"), position=f.position[some], width=f.width[some], height=f.height[some], facets=f.facets[some],
        focal=f.focal[some], canting=f.canting[some], receiver=f.receiver[some], aim=aim[some],
    )  # fmt: skip
    p = replace(p, field=field)
    alone = bs.flux(p, at="2026-03-21T12:00", cells=30)
    p = replace(p, receivers=(replace(p.receivers[0], peak_limit=1.02e3 * float(alone.maps()[0].max())),))
    p = replace(p, field=replace(field, errors={"IA": np.array([0.0, 12e-3])}))
    result = bs.flux(p, day="2026-03-21", step=2.0, cells=30, rank=True)
    r = result.rank
    assert r.over[1] > 5 * abs(r.lost[1]) and r.over[1] > 1 and result.as_dict()["rank"][0]["id"] == "B"
    assert r.recalibrated[1] == pytest.approx(r.total[1]) and 0.5 * r.total[1] < r.reaimed[1] <= 1.1 * r.total[1]
    assert "above a limit" in result.summary() and "largest peak" in result.summary()


@pytest.mark.slow
def test_mended_to_within_their_sigmas_is_the_mean_of_many_such_plants():
    """Draws of what is left after a calibration, 24 of them: within four standard errors and a tenth."""
    p = five(errors={"IA": np.array([4e-3, -5e-3, 3e-3, 6e-3, -4e-3])})
    sigmas = {n: np.full(5, 1.2e-3) for n in ("IA", "IE", "AN")}
    result = bs.flux(replace(p, field=replace(p.field, sigmas=sigmas)), rank=True, **DAY)
    rng = np.random.default_rng(5)
    now, brought = result.total("power"), []
    for _ in range(24):
        left = {n: s * rng.standard_normal(5) for n, s in sigmas.items()}
        mended = replace(p, field=replace(p.field, errors=left))
        brought.append(bs.flux(mended, **DAY).total("power") - now)
    mean, error = np.mean(brought, axis=0), np.std(brought, axis=0, ddof=1) / np.sqrt(24)
    np.testing.assert_allclose(result.rank.recalibrated, mean, atol=float((4 * error + 0.1 * np.abs(mean)).max()))
    assert (result.rank.recalibrated < result.rank.total).all()


def test_a_shift_of_the_aim_answers_an_error_that_does_not_drift_and_less_of_one_that_does():
    """A collimation error on a day of one time; and offsets, whose images wander through a day."""
    errors = {"CA": np.full(5, 6e-3)}
    once = bs.flux(five(errors=errors), day="2026-03-21", step=6.0, cells=30, rank=True)
    assert len(once.moments) == 2
    noon = flux_cost.aligned(once.plant, once.moments[0].sun, errors)
    assert np.abs(flux_cost.misses(noon, once.moments[0].sun, errors)).max() > 500
    back = moment(noon, once.moments[0].sun, 1.0, errors).landing
    assert np.abs(back).max() < 1.0
    through = bs.flux(five(errors={"AN": np.full(5, 6e-3), "AW": np.full(5, 3e-3)}), rank=True, **DAY).rank
    assert (through.reaimed < through.recalibrated + 1e-9).all() and through.reaimed.sum() > 0


def test_aims_on_a_cylinder_are_shifted_around_it():
    p = files.read(PLANTS / "five")
    receiver = replace(p.receivers[0], kind="cylinder", width=8e3, height=9e3)
    places = p.field.position
    p = replace(p, receivers=(receiver,), field=replace(p.field, aim=receiver.aim(places)))
    moved = shifted(p, np.full((5, 2), [700.0, -300.0]))
    sun = np.array([0.0, -0.6, 0.8])
    a, b = (moment(x, sun, 1.0).landing for x in (p, moved))
    np.testing.assert_allclose(b - a, np.full((5, 2), [700.0, -300.0]), atol=1e-6)


def test_means_over_cells_are_those_of_finer_ones():
    x = (np.arange(20) + 0.5) / 20 - 0.5
    fine = (np.arange(20 * 25) + 0.5) / (20 * 25) - 0.5

    def bump(u):
        return np.exp(-(u[:, None] ** 2) / 0.02 - (u[None, :] - 0.1) ** 2 / 0.03)

    means = bump(fine).reshape(20, 25, 20, 25).mean(axis=(1, 3))
    assert np.abs(over_cells(bump(x), False) - means).max() < 0.1 * np.abs(bump(x) - means).max()


def test_images_are_put_on_their_aims_at_the_time_that_is_said():
    result = bs.flux(
        PLANTS / "five", at="2026-06-21T07:00", aligned="2026-06-21T07:00", errors="drawn", seed=3, cells=30
    )
    later = bs.flux(
        PLANTS / "five", at="2026-06-21T15:00", aligned="2026-06-21T07:00", errors="drawn", seed=3, cells=30
    )
    assert np.abs(result.moments[0].landing).max() < 2 and np.abs(later.moments[0].landing).max() > 100


@pytest.mark.slow
def test_other_processes_give_what_this_one_does():
    """Of the sums the order of terms may differ."""
    here, there = (bs.flux(PLANTS / "five", rank=True, workers=w, errors="drawn", **DAY) for w in (0, 2))
    np.testing.assert_allclose(here.total("power"), there.total("power"), rtol=1e-12)
    np.testing.assert_allclose(here.rank.reaimed, there.rank.reaimed, rtol=1e-9)


def test_results_come_in_the_order_of_the_tasks_and_errors_come_out():
    heard = []
    assert done(pow, [(2, k) for k in range(4)], Pool(workers=0), heard.append) == [1, 2, 4, 8]
    assert heard[-1] == 1.0
    with pytest.raises(ZeroDivisionError):
        done(divmod, [(1, 1), (1, 0)], Pool(), heard.append)
