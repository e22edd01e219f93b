"""``benchsim effects``: the catalogue, and which of it a recording could detect and tell apart, before any data."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from benchsim.bench.files import given, sources
from benchsim.bench.model import Recording
from benchsim.bench.writing import write_text
from benchsim.diagnosis.degeneracy import Space, separation, space
from benchsim.diagnosis.detection_limits import SIGMAS, limits
from benchsim.diagnosis.levels import APART
from benchsim.diagnosis.linear import linearise
from benchsim.diagnosis.problem import Effect, Problem
from benchsim.diagnosis.result import Limit
from benchsim.instruments.bench import effects as bench_effects
from benchsim.jobs.output import label, wanted_folder
from benchsim.jobs.progress import Progress, silent
from benchsim.jobs.shown import Shown
from benchsim.jobs.workers import workers
from benchsim.reports import effects_text
from benchsim.reports.limits_text import shapes_text

TOLD_AT = 10.0
"""Size in sigma at which effects are compared: at their caps many differ only because one cap is larger."""


@dataclass(frozen=True, repr=False)
class CatalogueResult(Shown):
    """The catalogue as it stands."""

    entries: tuple[bench_effects.Entry, ...]

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``--json``."""
        return {
            "format": "benchsim-effects/1",
            "effects": [
                {
                    "name": e.name,
                    "element": e.element,
                    "parameters": {
                        t.name: {"unit": t.unit, "cap": t.cap, "one_sided": t.one_sided, "shape": bool(t.grid)}
                        for t in e.terms
                    },
                    "says": e.says,
                    "remedy": e.remedy,
                    "source": e.source,
                    "synonyms": list(e.synonyms),
                    "drawn": e.drawn,
                }
                for e in self.entries
            ],
        }

    def summary(self) -> str:
        """The catalogue by element, in the order of the light."""
        rows = [
            effects_text.Row(
                e.name,
                e.element,
                tuple((t.name, t.unit, t.cap, t.one_sided, bool(t.grid)) for t in e.terms),
                e.says,
                e.synonyms,
                e.drawn,
            )
            for e in sorted(self.entries, key=lambda e: bench_effects.ELEMENTS.index(e.element))
        ]
        return effects_text.catalogue(rows)


@dataclass(frozen=True, repr=False)
class IsolabilityResult(Shown):
    """What a set of settings and observables could show.

    Attributes
    ----------
    recording : Recording
    against : str
    observables : tuple of str
        Kinds of data.
    limits : mapping
        As in ``diagnosis.json``.
    at_cap : mapping of str to float
        By effect: its signal in sigma at its cap, setting errors and other nuisances marginalised; of several
        parameters that which is hardest to see.
    separation : mapping of (str, str) to float
        How far, in sigma, the first at a size of `TOLD_AT` sigma, or at its cap if that is less, is from the nearest
        that the second can produce within its own cap; of several parameters that which is hardest to tell.
    """

    recording: Recording
    against: str
    observables: tuple[str, ...]
    effects: tuple[Effect, ...]
    limits: Mapping[str, Limit]
    at_cap: Mapping[str, float]
    separation: Mapping[tuple[str, str], float]

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``--json``."""
        return {
            "format": "benchsim-isolability/1",
            "against": self.against,
            "observables": list(self.observables),
            "limits": {
                k: {
                    "parameter": v.parameter,
                    "five_sigma": v.five_sigma if np.isfinite(v.five_sigma) else None,
                    "unit": v.unit,
                    "reachable": v.reachable,
                }
                for k, v in self.limits.items()
            },
            "at_cap_sigma": dict(self.at_cap),
            "compared_at_sigma": TOLD_AT,
            "separation_sigma": {
                a.name: {b.name: self.separation[a.name, b.name] for b in self.effects if b is not a}
                for a in self.effects
            },
            "defaults_used": list(self.recording.defaults_used),
        }

    def summary(self) -> str:
        """Limits, rivals, and the pairs that cannot be told apart."""
        r = self.recording
        return effects_text.isolability(
            effects_text.Plan(
                title=label(r),
                exposures=len(r.exposures),
                settings=len({e.setting for e in r.exposures}),
                against=self.against,
                observables=self.observables,
                effects=tuple(
                    (e.name, e.element)
                    for e in sorted(self.effects, key=lambda e: bench_effects.ELEMENTS.index(e.element))
                ),
                limits=self.limits,
                at_cap=self.at_cap,
                separation=self.separation,
                seen_at=SIGMAS,
                close=APART,
                told_at=TOLD_AT,
                defaults=r.defaults_used,
                shaped=shapes_text(self.effects),
            )
        )


def effects(
    recording: Recording | Path | str | None = None,
    output: Path | str | None = None,
    *,
    against: str = "bench",
    allow_outside: bool = False,
    progress: Progress = silent,
) -> CatalogueResult | IsolabilityResult:
    """The catalogue of effects; or, for a recording or bench file, which of them it could show, before any data.

    Parameters
    ----------
    recording : Recording or path, optional
        A recording, its folder or file, or a bench file; its photographs are not looked at.
    output : path, optional
        Folder for ``effects.json`` and ``effects.txt``; default: nothing is written.
    against : {"bench", "vector"}
        The simulation in doubt.
    allow_outside : bool
        Whether its marks may lie outside of the file's folder, see `paths.inside`.
    progress : callable
        Called with what is being done and the fraction done.

    Returns
    -------
    CatalogueResult or IsolabilityResult

    Raises
    ------
    BenchsimError
        If the recording or the folder cannot be used.

    Examples
    --------
    >>> import benchsim as bs
    >>> [entry.name for entry in bs.effects().entries if entry.element == "air"]
    ['window', 'window-tilt', 'air-gradient', 'plume']
    """
    if recording is None:
        return _written(CatalogueResult(bench_effects.CATALOGUE), output, [Path(bench_effects.__file__)])
    read_in = given(recording, images=False, allow_outside=allow_outside)
    bench_effects.check(read_in)
    return _written(isolability(read_in, against, progress), output, sources(read_in)[:2])


def _written(result: Any, output: Path | str | None, inputs: list[Path]) -> Any:
    with wanted_folder(output, "effects", inputs) as staging:
        if staging is not None:
            write_text(staging / "effects.json", json.dumps(result.as_dict(), indent=1, allow_nan=False) + "\n")
            write_text(staging / "effects.txt", result.summary() + "\n")
    return result


def isolability(recording: Recording, against: str = "bench", progress: Progress = silent) -> IsolabilityResult:
    """Limits and separations on simulated observables, linear about the simulation in doubt.

    Single effects against single effects; shape parameters at the middle of their range. The settings' errors are as
    large as stated.
    """
    from benchsim.instruments.bench import observables
    from benchsim.instruments.bench.problem import build

    progress("simulating what would be seen", 0.05)
    problem = build(recording, observables.simulate(recording), against=against, attached=False)
    with workers() as pool:
        problem = replace(problem, spread=pool.spread)
        progress("asking what every effect would do", 0.2)
        within, names = _space(problem)
    progress("comparing", 0.95)
    found, apart, at_cap = limits(problem, within, names), {}, {}
    for a in problem.catalogue:
        signals = _signals(within, a, names)
        at_cap[a.name] = min((float(np.sqrt(max(0.0, s @ within.gram @ s))) for s in signals), default=0.0)
        compared = [s * min(1.0, TOLD_AT / max(1e-12, float(np.sqrt(s @ within.gram @ s)))) for s in signals]
        for b in problem.catalogue:
            if b is not a:
                apart[a.name, b.name] = min((separation(within, s, (b.name,)) for s in compared), default=0.0)
    kinds = tuple(k for k, _ in groupby(sorted(problem.kind.tolist(), key=_kind_order(problem))))
    return IsolabilityResult(recording, against, kinds, problem.catalogue, found, at_cap, apart)


def _kind_order(problem: Problem) -> Callable[[str], int]:
    order = {k: i for i, k in reversed(list(enumerate(problem.kind.tolist())))}
    return order.__getitem__


def _space(problem: Problem) -> tuple[Space, tuple[str, ...]]:
    amplitudes = tuple(p for e in problem.catalogue for p in e.parameters if not p.grid)
    middle = {p.name: float(np.median(p.grid)) for e in problem.catalogue for p in e.parameters if p.grid}
    linear = linearise(problem, middle, amplitudes)
    return space(problem, linear, 1.0), linear.names


def _signals(within: Space, effect: Effect, names: tuple[str, ...]) -> list[np.ndarray]:
    """Amplitude vectors of an effect: each parameter alone at its cap; of a random field all at half of it."""
    own = [p for p in effect.parameters if p.name in names]
    out = []
    if effect.random_field:
        signal = np.zeros(len(names))
        for k, p in enumerate(own):
            signal[names.index(p.name)] = p.sigma * (-1.0) ** k
        return [signal]
    for p in own:
        signal = np.zeros(len(names))
        signal[names.index(p.name)] = (2 * p.sigma) ** p.power
        out.append(signal)
    return out
