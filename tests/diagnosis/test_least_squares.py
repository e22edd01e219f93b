"""The solver by itself: against certified values, at bounds, without rank, and many tasks at once."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchsim.diagnosis.least_squares import Task, bounded, minimise

MODELS = {
    "Misra1a": lambda b, x: b[0] * (1 - np.exp(-b[1] * x)),
    "Misra1b": lambda b, x: b[0] * (1 - (1 + b[1] * x / 2) ** -2),
    "Misra1c": lambda b, x: b[0] * (1 - (1 + 2 * b[1] * x) ** -0.5),
    "Misra1d": lambda b, x: b[0] * b[1] * x / (1 + b[1] * x),
    "Chwirut2": lambda b, x: np.exp(-b[0] * x) / (b[1] + b[2] * x),
    "Lanczos3": lambda b, x: sum(b[i] * np.exp(-b[i + 1] * x) for i in (0, 2, 4)),
    "DanWood": lambda b, x: b[0] * x ** b[1],
    "Kirby2": lambda b, x: (b[0] + b[1] * x + b[2] * x**2) / (1 + b[3] * x + b[4] * x**2),
    "MGH17": lambda b, x: b[0] + b[1] * np.exp(-x * b[3]) + b[2] * np.exp(-x * b[4]),
    "Roszman1": lambda b, x: b[0] - b[1] * x - _arctan(b[2] / (x - b[3])) / np.pi,
    "MGH09": lambda b, x: b[0] * (x**2 + x * b[1]) / (x**2 + x * b[2] + b[3]),
    "Thurber": lambda b, x: (b[0] + b[1] * x + b[2] * x**2 + b[3] * x**3) / (1 + b[4] * x + b[5] * x**2 + b[6] * x**3),
    "BoxBOD": lambda b, x: b[0] * (1 - np.exp(-b[1] * x)),
    "Rat42": lambda b, x: b[0] / (1 + np.exp(b[1] - b[2] * x)),
    "MGH10": lambda b, x: b[0] * np.exp(b[1] / (x + b[2])),
    "Eckerle4": lambda b, x: b[0] / b[1] * np.exp(-0.5 * ((x - b[2]) / b[1]) ** 2),
    "Rat43": lambda b, x: b[0] / (1 + np.exp(b[1] - b[2] * x)) ** (1 / b[3]),
    "Bennett5": lambda b, x: b[0] * (b[1] + x) ** (-1 / b[2]),
}


def _arctan(z):
    """Of complex numbers whose imaginary part is a step's."""
    return np.arctan(z.real) + 1j * z.imag / (1 + z.real**2)


def sets():
    """Name, start 2, certified values, y and x of every data set."""
    lines = [r for r in Path(__file__).with_name("nist_strd.txt").read_text().splitlines() if not r.startswith("#")]
    for i in range(0, len(lines), 5):
        yield (lines[i].split()[0], *(np.array(r.split(), float) for r in lines[i + 1 : i + 5]))


def task(start, unit=None, low=-np.inf, high=np.inf, precision=0.0, rows=1):
    k = len(start)
    full = [np.broadcast_to(np.asarray(v, float), k).copy() for v in (low, high, precision)]
    return Task(
        np.array(start, float),
        full[0],
        full[1],
        np.ones(k) if unit is None else unit,
        full[2],
        np.zeros(k),
        np.ones((rows, k), bool),
    )


def solved(model, tasks, still=lambda r: 1e-13 * float(r @ r), steps=3000):
    """Fits of residuals model(θ), their derivatives by complex steps."""

    def jacobian(theta):
        return np.column_stack(
            [
                model(theta + 1e-20j * np.abs(t) * unit).imag / (1e-20 * np.abs(t))
                for t, unit in zip(np.where(theta == 0, 1.0, theta), np.eye(len(theta)), strict=True)
            ]
        )

    return minimise(
        lambda points: [model(t.astype(complex)).real for _, t in points],
        lambda points: [jacobian(t) for _, t in points],
        tasks,
        still=still,
        steps=steps,
        renewals=steps,
    )


@pytest.mark.parametrize(("name", "start", "certified", "y", "x"), list(sets()), ids=[s[0] for s in sets()])
def test_certified_values_are_met_to_six_digits(name, start, certified, y, x):
    """Eighteen of NIST's sets, of all levels of difficulty, from their second start."""
    (end,) = solved(lambda b: y - MODELS[name](b, x), [task(start, unit=np.abs(start), rows=len(y))])
    assert end.theta == pytest.approx(certified, rel=1e-6)


def test_a_line_with_a_prior_is_its_closed_form():
    """Ridge regression: (XᵀX + P)⁻¹ (Xᵀ y − g)."""
    rng = np.random.default_rng(1)
    x, y = rng.normal(size=(40, 3)), rng.normal(size=40)
    made = task(np.zeros(3), precision=[1.0, 4.0, 0.0], rows=40)
    made = Task(made.start, made.low, made.high, made.unit, made.precision, np.array([0.0, 1.0, -2.0]), made.acts)
    (end,) = solved(lambda b: y - x @ b, [made])
    want = np.linalg.solve(x.T @ x + np.diag(made.precision), x.T @ y - made.slope)
    assert end.converged and end.exact and end.theta == pytest.approx(want, abs=1e-9)


def test_bounds_are_kept_and_the_rest_is_best_beside_them():
    """Rosenbrock's valley with its minimum (1, 1) cut off at x ≤ 0.5: the best is (0.5, 0.25)."""
    model = lambda b: np.array([10 * (b[1] - b[0] ** 2), 1 - b[0]])  # noqa: E731
    starts = [[-1.2, 1.0], [0.4, -2.0], [0.5, 0.9]]
    tasks = [task(s, high=[0.5, np.inf], rows=2) for s in starts]
    for end in solved(model, tasks):
        assert end.converged and end.theta == pytest.approx([0.5, 0.25], abs=1e-6)


def test_data_sharp_a_million_times_beside_the_prior_are_reached_from_a_dozen_units_off():
    """A setting that was stated a dozen of its sigma wrong, seen through something bent with errors of a millionth."""
    truth = np.array([12.0, -9.0])
    x = np.linspace(0.0, 1.0, 30)

    def model(b):
        return 1e6 * (b[0] * x + b[1] * (1 - x) + 0.02 * b[0] * b[1] * x**2)

    (found,) = solved(lambda b: model(b) - model(truth), [task([0.0, 0.0], precision=1.0, rows=30)])
    assert found.theta == pytest.approx(truth, abs=1e-6)


def test_what_no_datum_sees_stays_where_its_prior_has_it():
    """Two parameters of which only the sum is seen, and one that nothing sees."""
    y = np.array([1.0, 1.1, 0.9])
    model = lambda b: y - (b[0] + b[1]) + 0 * b[2]  # noqa: E731
    (free,) = solved(model, [task([0.0, 0.0, 0.7], rows=3)])
    assert free.converged and free.theta[0] + free.theta[1] == pytest.approx(1.0) and free.theta[2] == 0.7
    (held,) = solved(model, [task([0.0, 0.0, 0.7], precision=1.0, rows=3)])
    assert held.theta == pytest.approx([3 / 7, 3 / 7, 0.0], abs=1e-6)


def test_tasks_that_step_together_end_where_each_does_alone():
    rng = np.random.default_rng(3)
    x = np.linspace(0, 2, 30)
    y = 2 * np.exp(-1.5 * x) + 0.01 * rng.normal(size=30)
    model = lambda b: y - b[0] * np.exp(-b[1] * x)  # noqa: E731
    tasks = [task(s, rows=30) for s in ([1.0, 1.0], [3.0, 0.2], [0.5, 4.0])]
    together = solved(model, tasks)
    for end, alone in zip(together, (solved(model, [t])[0] for t in tasks), strict=True):
        assert (end.theta == alone.theta).all() and end.cost == alone.cost


def test_errors_of_days_that_are_eliminated_first_end_where_all_at_once_do():
    """Twelve days of four data each have an error of their own; two parameters bend the prediction, a third is held by
    its bound, and so is one of the days."""
    rng = np.random.default_rng(2)
    x, day = np.linspace(0.0, 2.0, 48), np.repeat(np.arange(12), 4)
    of_day = (day[:, None] == np.arange(12)).astype(float)
    y = 2.0 * np.exp(-0.7 * x) + of_day @ rng.normal(0, 0.5, 12) + rng.normal(0, 0.05, 48)

    def model(theta):
        return 20 * (y - theta[0] * np.exp(-theta[1] * x) + theta[2] ** 2 * x - of_day @ theta[3:])

    whole = task([1.0, 1.0, 0.3, *np.zeros(12)], precision=1.0, rows=48)
    whole.high[[2, 7]] = 0.4, 0.5
    whole.acts[:, 3:] = of_day > 0
    apart = replace(whole, alone=np.arange(15) > 2)
    (one,), (other,) = solved(model, [whole]), solved(model, [apart])
    assert one.converged and other.converged
    # A thousandth of a sigma.
    np.testing.assert_allclose(other.theta, one.theta, atol=2.5e-5)
    assert other.theta[[2, 7]].tolist() == [0.4, 0.5]


def test_without_exact_derivatives_a_fit_follows_its_steps_and_changes_nothing_where_a_parameter_does_not_act():
    """Broyden's update from derivatives that are a third off: data of the second half do not depend on b[1]."""
    x = np.linspace(0.1, 2, 40)
    acts = np.ones((40, 2), bool)
    acts[20:, 1] = False
    truth = np.array([0.8, 0.5])

    def model(b):
        return np.sinh(b[0] * x) + np.where(acts[:, 1], b[1] ** 2 * x, 0.0)

    exact = np.column_stack([x * np.cosh(0.5 * x), np.where(acts[:, 1], 0.6 * x, 0.0)])
    made = task([0.5, 0.3], rows=40)
    made = Task(*(getattr(made, n) for n in ("start", "low", "high", "unit", "precision", "slope")), acts, 1.3 * exact)
    (end,) = minimise(
        lambda points: [model(t) - model(truth) for _, t in points],
        lambda points: pytest.fail("no exact derivatives were to be asked for"),
        [made],
        still=lambda r: 1e-12,
        steps=100,
        renewals=0,
    )
    assert end.converged and not end.exact and end.theta == pytest.approx(truth, abs=1e-5)
    assert (end.jacobian[20:, 1] == 0).all()


def test_a_start_where_nothing_can_be_predicted_is_no_fit():
    (end,) = minimise(
        lambda points: [np.array([np.nan]) for _ in points],
        lambda points: [np.ones((1, 1)) for _ in points],
        [task([0.0])],
        still=lambda r: 1e-9,
        steps=10,
        renewals=5,
    )
    assert not end.converged and end.cost == np.inf


def test_a_bounded_step_is_that_of_brute_force():
    rng = np.random.default_rng(5)
    for _ in range(20):
        root = rng.normal(size=(2, 2))
        hessian, force = root @ root.T + 0.1 * np.eye(2), rng.normal(size=2)
        low, high = -rng.uniform(0, 1, 2), rng.uniform(0, 1, 2)
        step = bounded(hessian, force, low, high)
        grid = np.stack(np.meshgrid(*(np.linspace(a, b, 201) for a, b in zip(low, high, strict=True))), axis=-1)
        best = (grid @ force - 0.5 * np.einsum("...i,ij,...j", grid, hessian, grid)).max()
        assert force @ step - 0.5 * step @ hessian @ step > best - 0.02
        assert (step >= low).all() and (step <= high).all()
