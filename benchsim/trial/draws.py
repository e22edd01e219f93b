"""Draws of benches and of what is concealed in them.

What is concealed is drawn by its signal-to-noise ratio: the whitened norm of what it changes in the data after setting
errors, beam and camera are marginalised, in the problem that it is drawn for.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from benchsim.bench.fields import Field, field
from benchsim.bench.files import shipped
from benchsim.bench.model import Exposure, Recording
from benchsim.diagnosis.evidence import amplitudes
from benchsim.diagnosis.linear import predict_all, whiten
from benchsim.diagnosis.problem import Effect
from benchsim.trial.visibility import Sight

STRANGERS = ("dent", "ripple", "spot", "stage", "jump", "facets")
"""Causes that no catalogue holds, and the element where each sits."""
STRANGER_ELEMENT = {
    "dent": "screen", "ripple": "screen", "spot": "camera", "stage": "source", "jump": "time", "facets": "mirror",
}  # fmt: skip

SNR = (6.0, 60.0)
"""Whitened norms that are aimed at, log-uniform."""

NEAREST = 0.8
"""Part of the mirror's radius by which a concealed offset may bring its facets nearer to the axis."""


def bench(design: str, rng: np.random.Generator, shrink: int = 1) -> Recording:
    """A recording's settings: ``six`` near those of the campaign, ``campaign`` itself, or ``fig7``, the two of Fig. 7.

    ``shrink`` divides the cameras' resolution.
    """
    whole = shipped("campaign12.toml")
    every = whole.exposures
    if design == "fig7":
        chosen = [every[0], every[1]]
    elif design == "six":
        # Six settings of which at least two poses of the screen; the repeat of the first setting comes along at times.
        picked = np.sort(rng.choice(len(every), 6, replace=False))
        chosen = [every[i] for i in picked]
    else:
        chosen = list(every)
    # Drawn for every design, so that all take the same numbers.
    shifted = moved(chosen, rng)
    placed = shifted if design == "six" else tuple(chosen)
    used = {e.camera for e in placed}
    cameras = {name: c.binned(shrink) for name, c in whole.cameras.items() if name in used}
    return replace(whole, exposures=placed, cameras=cameras)


def moved(exposures: Sequence[Exposure], rng: np.random.Generator) -> tuple[Exposure, ...]:
    """Exposures with every setting moved about: up to 5° and 3° of the laser, 40 mm of the mirror."""
    jitter = {e.setting: rng.uniform(-1, 1, 5) for e in exposures}
    out = []
    for e in exposures:
        j = jitter[e.setting]
        x, y, z = e.mirror_position
        out.append(
            replace(
                e,
                laser_azimuth=e.laser_azimuth + math.radians(5) * j[0],
                laser_elevation=e.laser_elevation + math.radians(3) * j[1],
                mirror_position=(x + 40 * j[2], y + 40 * j[3], z + 40 * j[4]),
            )
        )
    return tuple(out)


def shapes(effect: Effect, rng: np.random.Generator) -> dict[str, float]:
    """A draw of its shape parameters, uniform over their range."""
    return {p.name: float(rng.uniform(min(p.grid), max(p.grid))) for p in effect.parameters if p.grid}


def draw_effect(
    sight: Sight, effect: Effect, rng: np.random.Generator, snr: tuple[float, float] = SNR
) -> dict[str, float]:
    """Values of an effect whose SNR in this problem is the one drawn, or as near as its caps let it come."""
    own = amplitudes(effect)
    direction = rng.standard_normal(len(own))
    if effect.random_field:
        direction -= direction.mean()
    direction /= np.linalg.norm(direction)
    direction = np.array([abs(d) if p.one_sided or p.power > 1 else d for d, p in zip(direction, own, strict=True)])
    at = shapes(effect, rng)
    target = float(np.exp(rng.uniform(*np.log(snr))))
    cap = np.array([2 * p.sigma for p in own])
    probe = {**at, **{p.name: 0.2 * d * c for p, d, c in zip(own, direction, cap, strict=True)}}
    size = float(np.linalg.norm(sight.change(probe)))
    power = max(p.power for p in own)
    factor = 0.2 * (target / max(size, 1e-12)) ** (1.0 / power)
    factor = min(factor, 1.0 / max(float(np.abs(direction).max()), 1e-12))
    return {**at, **{p.name: float(factor * d * c) for p, d, c in zip(own, direction, cap, strict=True)}}


def possible(values: Mapping[str, float], recording: Recording) -> dict[str, float]:
    """The same values, ``dr`` with its sign turned where it would put a facet on the axis or behind it.

    Its cap is wider than the bench's mirror; such a mirror reflects nothing that could be photographed.
    """
    behind = values.get("dr", 0.0) < -NEAREST * recording.mirror.radius
    return {k: -v if behind and k == "dr" else v for k, v in values.items()}


def below_the_settings(
    sight: Sight, effect: Effect, values: Mapping[str, float], rng: np.random.Generator
) -> dict[str, float]:
    """The same effect, smaller: it moves the data by 5 to 50 % of what setting errors of 1 sigma move them by.

    Nothing is marginalised here: both are what an eye sees on the board, in sigma of the data.
    """
    problem, own = sight.problem, {p.name: p for p in amplitudes(effect)}
    delta = predict_all(problem, values) - predict_all(problem, {k: v for k, v in values.items() if k not in own})
    moved = float(np.linalg.norm(whiten(problem, problem.covariance, delta)[0]))
    # Root of the expected square over draws of every setting error from its prior.
    scaled = np.array([p.scaled for p in problem.nuisances])
    errors = float(np.linalg.norm(sight.linear.nuisance[:, scaled]))
    factor = min(1.0, float(rng.uniform(0.05, 0.5)) * errors / max(moved, 1e-12))
    return {k: v * factor ** (1 / own[k].power) if k in own else v for k, v in values.items()}


def nothing(values: Mapping[str, float], effect: Effect) -> dict[str, float]:
    """The same effect with its amplitudes zero and its shapes as they were."""
    own = {p.name for p in amplitudes(effect)}
    return {k: 0.0 if k in own else v for k, v in values.items()}


def draw_stranger(kind: str, recording: Recording, rng: np.random.Generator) -> dict[str, Field]:
    """A cause that no catalogue holds, as a free field; its amplitude is of the order of a few to many sigma."""
    size = float(np.exp(rng.uniform(math.log(0.5), math.log(5.0))))
    y = np.linspace(-350, 350, 71)
    board_y, board_z = np.meshgrid(y, y, indexing="ij")
    if kind == "dent":
        place, width = rng.uniform(-200, 200, 2), rng.uniform(40, 90)
        bump = np.exp(-((board_y - place[0]) ** 2 + (board_z - place[1]) ** 2) / (2 * width**2))
        return {"height": field([y, y], [size * bump])}
    if kind == "ripple":
        k, phase = rng.uniform(0.015, 0.045, 2) * rng.choice([-1, 1], 2), rng.uniform(0, 2 * math.pi)
        return {"height": field([y, y], [0.3 * size * np.sin(k[0] * board_y + k[1] * board_z + phase)])}
    if kind == "spot":
        c = next(iter(recording.cameras.values()))
        u, v = (np.linspace(0, n - 1, 61) for n in c.resolution)
        centre = [rng.uniform(0.3, 0.7) * n for n in c.resolution]
        width = 0.05 * c.resolution[0]
        bump = np.exp(-((u[:, None] - centre[0]) ** 2 + (v[None, :] - centre[1]) ** 2) / (2 * width**2))
        lean = rng.uniform(0, 2 * math.pi)
        return {"pixel": field([u, v], [0.5 * size * math.cos(lean) * bump, 0.5 * size * math.sin(lean) * bump])}
    if kind == "stage":
        azimuth, elevation = np.linspace(0, 2 * math.pi, 121), np.array([0.0, math.pi / 2])
        wave = 2e-3 * size * np.sin(3 * azimuth + rng.uniform(0, 2 * math.pi))
        both = np.repeat(wave[:, None], 2, axis=1)
        return {"stage": field([azimuth, elevation], [both, 0 * both])}
    if kind == "jump":
        times = [e.time for e in recording.exposures]
        moment = rng.uniform(min(times) + 1.0, max(times))
        t = np.array([min(times) - 1.0, moment - 0.5, moment + 0.5, max(times) + 1.0])
        lean = rng.uniform(0, 2 * math.pi)
        step = np.array([0.0, 0.0, 1.0, 1.0]) * size
        return {"time": field([t], [step * math.cos(lean), step * math.sin(lean)])}
    turn, facet = np.linspace(-0.2, 0.2, 41), np.arange(recording.mirror.facets, dtype=float)
    wave = 0.1e-3 * size * np.sin(2 * math.pi * turn / rng.uniform(0.05, 0.15) + rng.uniform(0, 2 * math.pi))
    return {"lean": field([turn, facet], [np.repeat(wave[:, None], len(facet), axis=1)])}


def as_effects(values: Mapping[str, float], effect: Effect) -> dict[str, dict[str, float]]:
    """Values of one effect as a recording's ``[effects]``."""
    return {effect.name: {p.name: values[p.name] for p in effect.parameters if p.name in values}}
