"""A toy instrument: straight lines drawn at several angles t, in thirty lines; proof that diagnosis knows no bench.

Each block is one line y(x), x in [-1, 1], drawn at its own angle t; a block is a setting of its own unless
``per_group`` says otherwise. What was set by hand: offset, slope and shift along x of every setting. Effects are the
shapes below times an amplitude; ``lens-a`` and ``lens-b`` are all but the same, ``creep`` lies within the settings'
errors and shows only in how they go with t, ``blur`` widens a second observable by its square. ``SECRET`` shapes are in
no catalogue.
"""

from collections.abc import Mapping
from functools import partial

import numpy as np

from benchsim.diagnosis.problem import Attachment, Effect, NextRecording, Parameter, Problem

SHAPES = {
    "bow": ("screen", lambda x, t: x**2),
    "swell": ("source", lambda x, t: np.sin(3 * x) * t**2),
    "lean": ("mirror", lambda x, t: t * x**2),
    "lens-a": ("camera", lambda x, t: t * x**3),
    "lens-b": ("camera", lambda x, t: t * (x**3 + 0.02 * x**2)),
    "creep": ("time", lambda x, t: t + 0 * x),
}
SECRET = {
    "bump": lambda x, t: np.exp(-(((x - 0.3) / 0.25) ** 2)),
    "warp": lambda x, t: t * np.cos(5 * x),
    "hum": lambda x, t: np.sin(14 * x) * np.sign(np.sin(40 * t)),
}
NOISE, POINTS, WIDTHS = 0.05, 24, 8


def predict(values: Mapping[str, float], block: int, angles: tuple[float, ...], groups: tuple[str, ...]) -> np.ndarray:
    x, t, g = np.linspace(-1, 1, POINTS), angles[block], groups[block]
    at = x + values.get(f"{g}.shift", 0.0)
    y = values.get(f"{g}.offset", 0.0) + values.get(f"{g}.slope", 0.0) * x + 0.3 * x**2
    for name, (_, shape) in SHAPES.items():
        y = y + values.get(name.replace("-", "_"), 0.0) * shape(at, t)
    for name, shape in SECRET.items():
        y = y + values.get(name, 0.0) * shape(x, t)
    width = np.full(WIDTHS, 1 + values.get("focus", 0.0) + 0.5 * values.get("blur", 0.0) ** 2)
    return np.concatenate([y, width])


def toy(
    truth: Mapping[str, float] | None = None,
    seed: int = 0,
    *,
    blocks: int = 8,
    without: tuple[str, ...] = (),
    noise: float = 1.0,
    setting_scale: float = 1.0,
    per_group: int = 1,
    attached: bool = True,
) -> Problem:
    """The problem with ``truth`` in its data; ``without`` names effects that the catalogue is not to hold."""
    rng = np.random.default_rng(seed)
    angles = tuple(np.linspace(-1, 1, blocks) + 0.03 * np.sin(np.arange(blocks)))
    groups = tuple(f"g{b // per_group}" for b in range(blocks))
    sigmas = {"offset": 0.3, "slope": 0.3, "shift": 0.02}
    nuisances = [
        Parameter(f"{g}.{k}", "mm", s, scaled=True, blocks=tuple(b for b in range(blocks) if groups[b] == g))
        for g in dict.fromkeys(groups)
        for k, s in sigmas.items()
    ]
    nuisances.append(Parameter("focus", "mm", 0.05))
    drawn = {p.name: rng.normal() * p.sigma * (setting_scale if p.scaled else 1) for p in nuisances}
    model = partial(predict, angles=angles, groups=groups)
    catalogue = [
        Effect(
            n, e, (Parameter(n.replace("-", "_"), "mm", 2.0 if n == "creep" else 0.5),), f"{n} is there.", f"Mend {n}."
        )
        for n, (e, _) in SHAPES.items()
    ]
    catalogue.append(
        Effect("blur", "camera", (Parameter("blur", "mm", 0.5, one_sided=True, power=2),), "It is blurred.", "Focus.")
    )
    m, n = POINTS + WIDTHS, (POINTS + WIDTHS) * blocks
    exact = np.concatenate([model({**drawn, **(truth or {})}, b) for b in range(blocks)])
    x = np.concatenate([np.linspace(-1, 1, POINTS), np.linspace(-1, 1, WIDTHS)])
    return Problem(
        data=exact + NOISE * noise * rng.normal(size=n),
        block=np.repeat(np.arange(blocks), m),
        kind=np.tile(np.array(["c"] * POINTS + ["w"] * WIDTHS), blocks),
        position=np.tile(x, blocks),
        stretch=np.tile(np.array([0] * POINTS + [1] * WIDTHS), blocks),
        covariance=tuple(np.eye(m) * NOISE**2 for _ in range(blocks)),
        names=tuple(f"line{b}" for b in range(blocks)),
        groups=groups,
        nuisances=tuple(nuisances),
        catalogue=tuple(e for e in catalogue if e.name not in without),
        predict=model,
        attachments=attachments(angles) if attached else (),
        next_recordings=partial(further, angles),
    )


def hats(knots: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Linear interpolation as a matrix."""
    return np.column_stack([np.interp(at, knots, unit) for unit in np.eye(len(knots))])


def attachments(angles: tuple[float, ...]) -> tuple[Attachment, ...]:
    """A function of x (screen), of x times t (mirror), of t (time): each free."""
    x = np.tile(np.concatenate([np.linspace(-1, 1, POINTS), np.full(WIDTHS, np.nan)]), len(angles))
    t = np.repeat(angles, POINTS + WIDTHS)
    knots, some = np.linspace(-1, 1, 13), np.isfinite(x)
    by_x, by_t = np.where(some[:, None], hats(knots, np.nan_to_num(x)), 0), np.where(some[:, None], hats(knots, t), 0)

    def make(name: str, coordinate: str, basis: np.ndarray, position: np.ndarray) -> Attachment:
        lengths, zero = (0.15, 0.3, 0.6, 1.2), np.zeros(13, int)
        where = np.where(some, position, np.nan)[:, None]
        element, largest = name.split(".")[0], 2.0 if name == "time.shift" else 0.5
        return Attachment(name, element, coordinate, "mm", basis, knots[:, None], zero, largest, lengths, where, ("x",))

    return (
        make("screen.height", "screen x", by_x, x),
        make("mirror.lean", "mirror phase", by_x * t[:, None], x),
        make("time.shift", "time", by_t, t),
    )


def further(angles: tuple[float, ...]) -> tuple[NextRecording, ...]:
    """Two observables: a closer look at the middle, which tells the lenses apart, and one that tells nothing."""
    x, t = np.linspace(-1, 1, 40), 1.0
    shapes = {n.replace("-", "_"): shape(x, t) for n, (_, shape) in SHAPES.items()}
    fine = NextRecording("observable", "the line through a microscope", np.eye(40) * 1e-8, {}, {}, shapes)
    nothing = NextRecording("recording", "the same once more", np.eye(40), {}, {}, {k: np.zeros(40) for k in shapes})
    return nothing, fine
