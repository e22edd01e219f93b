"""Every attachment's basis against the bench with that function as a free field of its own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchsim.bench.fields import FORMS, field
from benchsim.bench.files import read
from benchsim.instruments.bench import observables
from benchsim.instruments.bench.problem import build

ROOT = Path(__file__).parents[2]
NAMES = """camera.pixel camera.row.pixel camera.brightness screen.height screen.shift mirror.lean mirror.facet.lean
air.kick source.angle source.stage source.elevation.stage time.time""".split()


@pytest.fixture(scope="module")
def made():
    recording = read(ROOT / "scenes/campaign12.toml")
    first, second, third = recording.exposures[:3]
    changed = (
        replace(first, facet=2),
        replace(second, facet=5, screen_roll=0.6, time=3600.0),
        replace(third, facet=5, time=7200.0, laser_elevation=third.laser_elevation + 0.05),
    )
    recording = replace(recording, exposures=changed)
    problem = build(recording, observables.simulate(recording, seed=2))
    return recording, problem, {a.name: a for a in problem.attachments}


def test_every_element_has_its_functions(made):
    _, problem, found = made
    assert sorted(found) == sorted([*NAMES, "time.exposure"])
    assert {a.element for a in found.values()} == {"camera", "screen", "mirror", "air", "source", "time"}
    for a in found.values():
        assert a.basis.shape == (len(problem.data), len(a.knots)) and np.isfinite(a.basis).all()
        assert a.position.shape == (len(problem.data), a.knots.shape[1])
        assert len(a.component) == len(a.knots) and a.sigma > 0 and all(x > 0 for x in a.lengths)
        assert np.abs(a.basis).max() > 0


def test_what_light_does_anew_in_every_exposure_moves_no_mark_and_no_other_exposure(made):
    """A displacement across the trace by 1 mm everywhere in one exposure is 1 in all of its centre line, else 0."""
    _, problem, found = made
    a = found["time.exposure"]
    for b in range(len(problem.names)):
        moved = a.basis @ (a.component == b)
        assert moved == pytest.approx(1.0 * ((problem.kind == "c") & (problem.block == b)))


@pytest.mark.parametrize("name", NAMES)
def test_basis_is_the_bench_with_that_field(made, name):
    recording, problem, found = made
    a = found[name]
    form = FORMS[name.split(".")[-1]]
    # A smooth function of the coordinates, a twentieth of the largest plausible: there the bench answers linearly.
    span = np.maximum(np.ptp(a.knots, axis=0), 1e-9)
    u = (a.knots - a.knots.min(axis=0)) / span
    value = 0.05 * a.sigma * (np.sin(2.0 * u.sum(axis=1) + 1 + a.component) + 0.4 * np.cos(4.0 * u[:, 0]))
    if name == "mirror.facet.lean":
        value -= value.mean()
    axes = [np.unique(a.knots[:, k]) for k in range(a.knots.shape[1])]
    table = value.reshape(len(form.components), *(len(x) for x in axes))
    for k, x in enumerate(axes):
        if len(x) == 1:
            axes[k], table = np.array([x[0] - 1, x[0] + 1]), np.repeat(table, 2, axis=k + 1)
    knots = [x * factor for x, (_, factor) in zip(axes, form.coordinates, strict=True)]
    factors = np.array([f for _, f in form.components]).reshape(-1, *[1] * len(knots))
    true = replace(
        problem.predict, recording=replace(recording, fields={form_name(name): field(knots, table * factors)})
    )
    true = replace(true, cache={})
    want = np.concatenate([true({}, b) - problem.predict({}, b) for b in range(3)])
    got = a.basis @ value
    for kind in "cm":
        mine = problem.kind == kind
        size = np.sqrt(np.mean(want[mine] ** 2))
        if kind == "c" or name.startswith(("camera.pixel", "camera.row", "screen")):
            assert size > 1e-4, "the function is seen"
        # Light that is turned across the beam's section lies otherwise in the line, and its centre hardly elsewhere.
        part = 0.1 if name == "source.angle" else 0.04
        assert np.sqrt(np.mean((got - want)[mine] ** 2)) < part * size + 1e-5


def form_name(name: str) -> str:
    return name.split(".")[-1]
