"""What every effect of the catalogue does to the data of `scenes/campaign12.toml`, at its cap and at five sigma."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchsim.bench.files import read
from benchsim.diagnosis.problem import Effect, Problem
from benchsim.diagnosis.result import Limit
from benchsim.instruments.bench import observables
from benchsim.instruments.bench.problem import build
from benchsim.jobs.effect_catalogue import isolability
from benchsim.reports.vocabulary import BENCH

Array = NDArray[np.float64]

SCENE = Path(__file__).resolve().parents[1] / "scenes" / "campaign12.toml"


def draw(folder: Path) -> Mapping[str, str]:
    """A picture of each effect in a folder; returns what each shows, by the effect's name."""
    recording = read(SCENE, images=False)
    problem = build(recording, observables.simulate(recording), attached=False)
    limits = isolability(recording).limits
    said = {}
    for effect in problem.catalogue:
        said[effect.name] = _draw(folder / f"{effect.name}.png", problem, effect, limits.get(effect.name))
    return said


def _draw(path: Path, problem: Problem, effect: Effect, limit: Limit | None) -> str:
    """One effect: where it shows most, in the exposure that shows it most."""
    amplitudes = {p.name: p for p in effect.parameters if not p.grid}
    middle = {p.name: float(np.median(p.grid)) for p in effect.parameters if p.grid}
    amplitude = amplitudes.get(limit.parameter if limit else "", next(iter(amplitudes.values())))
    sizes = {"at its cap": 2 * amplitude.sigma}
    if limit is not None and limit.reachable and limit.parameter == amplitude.name:
        sizes["at 5 sigma"] = limit.five_sigma
    changes = {word: _change(problem, {**middle, amplitude.name: size}) for word, size in sizes.items()}
    sigma = np.sqrt(np.concatenate([np.diag(c) for c in problem.covariance]))
    seen = {
        (b, k): float(np.sum((changes["at its cap"] / sigma)[(problem.block == b) & (problem.kind == k)] ** 2))
        for b in range(len(problem.names))
        for k in np.unique(problem.kind[problem.rows(b)])
    }
    block, kind = max(seen, key=lambda at: seen[at])
    mine = (problem.block == block) & (problem.kind == kind)
    name, unit = BENCH.kinds.get(kind, (kind, ""))
    figure = Figure(figsize=(7.2, 2.2), layout="constrained")
    for axes, (word, change) in zip(figure.subplots(1, len(sizes), squeeze=False)[0], changes.items(), strict=True):
        along = problem.position[mine] if kind != "m" else np.arange(mine.sum())
        axes.fill_between(along, -sigma[mine], sigma[mine], color="#e8f3ea", linewidth=0)
        axes.plot(along, change[mine], "-" if kind != "m" else ".", color="#1f78b4", markersize=3)
        axes.set_title(f"{word}: {amplitude.name} = {sizes[word]:.3g} {effect_unit(amplitude.unit)}", fontsize=8)
        axes.set_xlabel(BENCH.along if kind != "m" else "number of the mark's coordinate", fontsize=8)
        axes.set_ylabel(f"{name}{f' ({unit})' if unit else ''}", fontsize=8)
        axes.tick_params(labelsize=7)
    figure.savefig(path, dpi=90, facecolor="white")
    return f"Change of the {name} in the exposure of `campaign12` that shows it most; the band is 1 sigma of a datum."


def effect_unit(unit: str) -> str:
    """A unit as it is printed; none for a pure number."""
    return "" if unit == "1" else unit


def _change(problem: Problem, values: Mapping[str, float]) -> Array:
    blocks = range(len(problem.names))
    return np.concatenate([problem.predict(values, b) - problem.predict({}, b) for b in blocks])
