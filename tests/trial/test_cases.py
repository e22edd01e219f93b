"""What is drawn can be rendered and judged; what is of zero size goes the same way; sizes are those aimed at."""

from dataclasses import replace

import numpy as np
import pytest

from benchsim.bench.errors import BenchsimError
from benchsim.instruments.bench import effects as catalogue
from benchsim.instruments.bench import observables
from benchsim.instruments.bench import problem as bench_problem
from benchsim.renderer import effects as rendered
from benchsim.trial import cases, draws
from benchsim.trial.hashing import rng_of


@pytest.fixture(scope="module")
def bench():
    return draws.bench("fig7", np.random.default_rng(0), 4)


@pytest.fixture(scope="module")
def sight(bench):
    return draws.Sight.of(bench_problem.build(bench, observables.simulate(bench), attached=False))


def accepted(recording):
    rendered.check(recording)
    catalogue.check(recording)


def test_no_offset_is_drawn_that_puts_the_facets_behind_the_axis(bench):
    r = bench.mirror.radius
    assert draws.possible({"dr": -1.01 * r, "pyr": -2.0}, bench) == {"dr": 1.01 * r, "pyr": -2.0}
    assert draws.possible({"dr": -0.7 * r}, bench) == {"dr": -0.7 * r}
    assert draws.possible({"sx": -3.0}, bench) == {"sx": -3.0}


def test_every_effect_is_drawn_as_generator_and_judge_take_it(bench, sight):
    for k, effect in enumerate(sight.problem.catalogue):
        values = draws.draw_effect(sight, effect, np.random.default_rng(k), (5.0, 9.0))
        concealed = cases.Concealed(draws.as_effects(values, effect), {})
        accepted(replace(bench, effects=concealed.effects))
        flat = cases.zeroed(concealed, bench)
        accepted(replace(bench, effects=flat.effects))
        own = {p.name for p in draws.amplitudes(effect)}
        assert {v for k, v in flat.values.items() if k in own} == {0.0}
        assert {k: v for k, v in flat.values.items() if k not in own} == {
            k: v for k, v in concealed.values.items() if k not in own
        }


def test_what_has_no_name_is_as_far_from_names_as_what_they_leave_of_it(sight):
    """Expectation: nothing is left of a pair's own change, all of what is at right angles to the catalogue, and of both
    together that."""
    both = sight.columns[:, [sight.catalogue.nodes[n][0].columns[0] for n in ("screen-rotation", "canting")]].sum(
        axis=1
    )
    other = np.random.default_rng(5).standard_normal(len(both))
    other -= sight.columns @ np.linalg.lstsq(sight.columns, other)[0]
    both, other = 9 * both / np.linalg.norm(both), 7 * other / np.linalg.norm(other)
    assert sight.imitation(both)[1] < 1e-6 * 9
    assert sight.imitation(other)[1] == pytest.approx(7.0, rel=1e-6)
    assert sight.imitation(both + other)[1] == pytest.approx(7.0, rel=1e-6)


@pytest.mark.parametrize("name", draws.STRANGERS)
def test_every_stranger_is_drawn_as_the_generator_takes_it(bench, name):
    concealed = cases.Concealed({}, draws.draw_stranger(name, bench, np.random.default_rng(1)), name)
    accepted(replace(bench, fields=concealed.fields))
    for field in cases.zeroed(concealed, bench).fields.values():
        assert not np.any(field.table())


def test_sizes_are_those_aimed_at(sight):
    """An effect that its caps do not hold back has the SNR that was drawn, within what second order makes of it."""
    effect = next(e for e in sight.problem.catalogue if e.name == "canting")
    for k in range(5):
        values = draws.draw_effect(sight, effect, np.random.default_rng(k), (1.0, 1.0001))
        assert np.linalg.norm(sight.change(values)) == pytest.approx(1.0, rel=0.05)


def test_an_effect_below_the_settings_moves_less_than_they_do(sight):
    scaled = np.array([p.scaled for p in sight.problem.nuisances])
    errors = np.linalg.norm(sight.linear.nuisance[:, scaled])
    assert errors > 0
    for k, effect in enumerate(sight.problem.catalogue):
        if any(p.grid for p in effect.parameters):
            continue
        values = draws.draw_effect(sight, effect, np.random.default_rng(k), (200.0, 300.0))
        small = draws.below_the_settings(sight, effect, values, np.random.default_rng(k))
        problem = sight.problem
        moved = draws.whiten(
            problem, problem.covariance, draws.predict_all(problem, small) - draws.predict_all(problem, {})
        )[0]
        assert np.linalg.norm(moved) < 0.6 * errors


@pytest.mark.parametrize("kind", [*cases.KINDS])
def test_a_kind_conceals_what_it_says(bench, kind):
    withheld = ("canting", "coma", "plume")
    found = cases.drawn(bench, kind, withheld, np.random.default_rng(3))
    wanted = {"pair": 2, "below-another": 2, "clean": 0, "clean-speckle": 0, "clean-settings": 0, "stranger": 0}
    assert len(found.effects) == wanted.get(kind, 1)
    assert bool(found.fields) == bool(found.stranger) == (kind == "stranger")
    assert all((name in withheld) == (kind == "removed") for name in found.effects)


def test_what_cannot_be_photographed_is_drawn_anew(tmp_path):
    def attempt(k):
        (tmp_path / f"{k}.png").touch()
        if k < 2:
            raise BenchsimError("misses the board")
        return {"case": "001"}

    assert cases.first_that_goes(attempt, tmp_path) == {"case": "001", "attempt": 2}
    assert [p.name for p in tmp_path.iterdir()] == ["2.png"]

    def never(k):
        raise BenchsimError(f"draw {k}")

    with pytest.raises(BenchsimError, match=f"draw {cases.TRIES - 1}"):
        cases.first_that_goes(never, tmp_path)


def test_noise_and_ray_counts_differ_from_case_to_case(bench):
    drawn = [cases.noise(bench.render, "single", rng_of("00", k, "noise")) for k in range(40)]
    for key in ("full_well_e", "read_noise_e", "blur_px", "relative_error"):
        assert len({getattr(o, key) for o in drawn}) == 40
    assert {o.speckle_px > 0 for o in drawn} == {True, False}


def test_speckle_tells_nothing_of_what_is_concealed(bench):
    """Its share is the same with and without: 1 in 5; of 400 draws 80 ± 8, so that 5 sigma are 40."""

    def share(kinds):
        rng = np.random.default_rng(8)
        chosen = rng.choice(
            kinds, 400, p=np.array([cases.KINDS[k] for k in kinds]) / sum(cases.KINDS[k] for k in kinds)
        )
        return sum(cases.noise(bench.render, str(k), rng).speckle_px > 0 for k in chosen)

    nothing = [k for k in cases.KINDS if k.startswith("clean")]
    assert abs(share(nothing) - 80) < 40
    assert abs(share([k for k in cases.KINDS if k not in nothing]) - 80) < 40
    assert cases.noise(bench.render, "clean", np.random.default_rng(1)).speckle_px == 0
