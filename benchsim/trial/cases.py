"""The plan of a trial, and the making of one case: what is concealed, how it is photographed, how visible it is.

Everything hangs on one secret seed of 256 bits; every case and every purpose has a stream of its own
(`hashing.rng_of`). The kind of a case, its design, the number of its effects, its noise and its ray count are drawn
independently of anything that the judge sees.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchsim.bench import settings
from benchsim.bench.errors import BenchsimError
from benchsim.bench.fields import Field
from benchsim.bench.files import shipped, write
from benchsim.bench.model import Recording, RenderOptions
from benchsim.diagnosis.linear import predict_all, whiten
from benchsim.diagnosis.problem import Problem
from benchsim.instruments.bench import observables
from benchsim.instruments.bench import problem as bench_problem
from benchsim.trial import draws
from benchsim.trial.hashing import rng_of
from benchsim.trial.visibility import Sight

Array = NDArray[np.float64]

KINDS: Mapping[str, float] = {
    "single": 0.30,
    "pair": 0.12,
    "below-another": 0.05,
    "below-the-settings": 0.05,
    "removed": 0.10,
    "stranger": 0.13,
    "clean": 0.15,
    "clean-speckle": 0.05,
    "clean-settings": 0.05,
}
"""Share of each kind of case. ``below-another``: a pair of which one is aimed at thrice the SNR of the other or more;
``below-the-settings``: an effect that moves the light less than its setting errors do; ``removed``: an effect that the
judge's catalogue lacks; ``stranger``: one that no catalogue holds; ``clean-settings``: errors thrice those stated."""

DESIGNS: Mapping[str, float] = {"six": 0.85, "fig7": 0.15}
"""Six settings out of the campaign of twelve, moved about; or the two of Fig. 7."""

WITHHELD = 3
"""Effects that the judge's catalogue lacks throughout the trial, so that their lack tells nothing of a case."""

OVERSTATED = 3.0
"""Setting errors over those stated in ``clean-settings``."""


@dataclass(frozen=True)
class Plan:
    """What a trial is made from; secret until it is opened.

    Attributes
    ----------
    seed : str
        64 hexadecimal digits; all is drawn from it.
    kinds, designs : tuple of str
        Of every case.
    withheld : tuple of str
        Effects that the judge's catalogue lacks.
    shrink : int
        Divides the cameras' resolution.
    zero : bool
        Every amplitude is zero and all else as it would be: the leak test's trial.
    """

    seed: str
    kinds: tuple[str, ...]
    designs: tuple[str, ...]
    withheld: tuple[str, ...]
    shrink: int
    zero: bool

    def plain(self) -> dict[str, Any]:
        """For the file."""
        return {"format": "benchsim-trial-plan/1", **{k: _listed(v) for k, v in asdict(self).items()}}


def _listed(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def planned(values: Mapping[str, Any]) -> Plan:
    """A plan read back from its file."""
    lists = {k: tuple(values[k]) for k in ("kinds", "designs", "withheld")}
    return Plan(seed=values["seed"], shrink=values["shrink"], zero=values["zero"], **lists)


def plan(cases: int, seed: int | None = None, *, shrink: int = 2, zero: bool = False) -> Plan:
    """Draw the plan of a trial.

    Parameters
    ----------
    cases : int
    seed : int, optional
        Default: 256 bits from the operating system, which nobody can guess. With a short one a judge who tries seeds
        can open the commitments; use it only to make a trial again that is already open.
    shrink : int
        Divides the cameras' 2000 × 1500 pixels.
    zero : bool
        See `Plan`.
    """
    own = secrets.token_hex(32) if seed is None else f"{seed:064x}"
    rng = rng_of(own, "plan")
    kinds = [kind for kind, count in _shared(cases, KINDS).items() for _ in range(count)]
    rng.shuffle(kinds)
    designs = [str(d) for d in rng.choice(list(DESIGNS), cases, p=list(DESIGNS.values()))]
    # The catalogue of a bench depends on its physics only, which all designs share.
    names = [e.name for e in bench_problem.candidates(shipped("campaign12.toml"))]
    withheld = tuple(sorted(str(n) for n in rng.choice(names, WITHHELD, replace=False)))
    return Plan(own, tuple(kinds), tuple(designs), withheld, shrink, zero)


def _shared(count: int, shares: Mapping[str, float]) -> dict[str, int]:
    """Whole numbers in the ratio of the shares, by largest remainder."""
    exact = {k: count * v / sum(shares.values()) for k, v in shares.items()}
    out = {k: int(v) for k, v in exact.items()}
    for k in sorted(exact, key=lambda k: out[k] - exact[k])[: count - sum(out.values())]:
        out[k] += 1
    return out


@dataclass(frozen=True)
class Concealed:
    """What one case conceals, as drawn for the nominal bench.

    Attributes
    ----------
    effects : mapping of effect → parameter → value
        Of the catalogue, in its units.
    fields : mapping of str to Field
        Of a cause without a name.
    stranger : str
        Its name, or "".
    """

    effects: Mapping[str, Mapping[str, float]]
    fields: Mapping[str, Field]
    stranger: str = ""

    @property
    def values(self) -> dict[str, float]:
        """Parameters of all effects by name."""
        return {k: v for own in self.effects.values() for k, v in own.items()}


def drawn(recording: Recording, kind: str, withheld: tuple[str, ...], rng: np.random.Generator) -> Concealed:
    """Draw what a case of a kind conceals on a bench."""
    if kind.startswith("clean"):
        return Concealed({}, {})
    if kind == "stranger":
        name = str(rng.choice(draws.STRANGERS))
        return Concealed({}, draws.draw_stranger(name, recording, rng), name)
    sight = Sight.of(bench_problem.build(recording, observables.simulate(recording), attached=False))
    own = [e for e in sight.problem.catalogue if (e.name in withheld) == (kind == "removed")]
    count = 2 if kind in ("pair", "below-another") else 1
    effects: dict[str, dict[str, float]] = {}
    bands = [(30.0, 90.0), (6.0, 10.0)] if kind == "below-another" else [draws.SNR] * count
    for i, band in zip(rng.choice(len(own), count, replace=False), bands, strict=True):
        values = draws.possible(draws.draw_effect(sight, own[int(i)], rng, band), recording)
        if kind == "below-the-settings":
            values = draws.below_the_settings(sight, own[int(i)], values, rng)
        effects |= draws.as_effects(values, own[int(i)])
    return Concealed(effects, {})


def zeroed(concealed: Concealed, recording: Recording) -> Concealed:
    """The same with every amplitude zero: what renders it goes the same way."""
    catalogue = {e.name: e for e in bench_problem.candidates(recording)}
    effects = {name: draws.nothing(values, catalogue[name]) for name, values in concealed.effects.items()}
    flat = {k: replace(f, values=tuple(tuple(0.0 for _ in v) for v in f.values)) for k, f in concealed.fields.items()}
    return Concealed(effects, flat, concealed.stranger)


def noise(options: RenderOptions, kind: str, rng: np.random.Generator) -> RenderOptions:
    """Sensor, lens, speckle and ray count of a case."""
    # Of cases without anything concealed one kind has speckle and the others have none, so that each has its own rate;
    # of the others as many have it, so that speckle tells nothing of what is concealed.
    nothing = [k for k in KINDS if k.startswith("clean")]
    share = KINDS["clean-speckle"] / sum(KINDS[k] for k in nothing)
    speckled = kind == "clean-speckle" if kind in nothing else rng.random() < share
    return replace(
        options,
        full_well_e=float(rng.uniform(8000, 20000)),
        read_noise_e=float(rng.uniform(3, 10)),
        blur_px=float(rng.uniform(0.55, 0.85)),
        speckle_px=float(rng.uniform(0.5, 1.2)) if speckled else 0.0,
        relative_error=float(np.exp(rng.uniform(np.log(0.01), np.log(0.03)))),
    )


TRIES = 8
"""Draws of a case of which the first that can be photographed and read is taken: a large effect may throw the trace off
the board, where a person would have taken the recording anew."""


def make(plan: Plan, number: int, folder: Path) -> dict[str, Any]:
    """Conceal, photograph and judge the visibility of case ``number`` (from 1).

    Parameters
    ----------
    plan : Plan
    number : int
    folder : Path
        Where the recording goes: settings, marks and images, nothing of what is concealed.

    Returns
    -------
    dict
        The truth in plain values; see README.md.

    Raises
    ------
    BenchsimError
        If none of `TRIES` draws can be photographed and read.
    """
    return first_that_goes(lambda k: _made(plan, number, k, folder), folder)


def first_that_goes(attempt: Callable[[int], dict[str, Any]], folder: Path) -> dict[str, Any]:
    """Truth of the first attempt without a complaint; the folder holds what that one wrote. See `TRIES`."""
    for k in range(TRIES):
        try:
            return {**attempt(k), "attempt": k}
        except BenchsimError:
            for path in folder.iterdir():
                path.unlink()
            if k == TRIES - 1:
                raise
    raise AssertionError


def _made(plan: Plan, number: int, attempt: int, folder: Path) -> dict[str, Any]:
    import cv2
    import drjit as dr

    from benchsim.renderer import backend
    from benchsim.renderer.recording import render_recording

    backend.use(None)
    dr.set_thread_count(1)
    cv2.setNumThreads(1)
    kind, design = plan.kinds[number - 1], plan.designs[number - 1]
    bench = draws.bench(design, rng_of(plan.seed, number, "bench", attempt), plan.shrink)
    concealed = drawn(bench, kind, plan.withheld, rng_of(plan.seed, number, "concealed", attempt))
    if plan.zero:
        concealed = zeroed(concealed, bench)
    options = noise(bench.render, kind, rng_of(plan.seed, number, "noise", attempt))
    scale = OVERSTATED if kind == "clean-settings" else 1.0
    true = replace(
        bench,
        effects=concealed.effects,
        fields=concealed.fields,
        render=options,
        uncertainty=settings.scaled(bench.uncertainty, scale),
    )
    seed = int(rng_of(plan.seed, number, "photographs", attempt).integers(2**62))
    made = render_recording(true, folder, seed=seed, conceal=True)
    # What the file states are the errors that hands were thought to make, not those that they made.
    stated = replace(made.recording, uncertainty=bench.uncertainty)
    write(stated, stated.path)
    return {
        "case": f"{number:03d}",
        "kind": kind,
        "design": design,
        "zero": plan.zero,
        "effects": {k: dict(v) for k, v in concealed.effects.items()},
        "stranger": concealed.stranger,
        "fields": {k: {"knots": _rows(f.knots), "values": _rows(f.values)} for k, f in concealed.fields.items()},
        "setting_scale": scale,
        "noise": {
            k: getattr(options, k) for k in ("full_well_e", "read_noise_e", "blur_px", "speckle_px", "relative_error")
        },
        "seed": seed,
        **visible(stated, concealed, plan),
    }


def _rows(rows: tuple[tuple[float, ...], ...]) -> list[list[float]]:
    return [list(row) for row in rows]


def visible(recording: Recording, concealed: Concealed, plan: Plan) -> dict[str, Any]:
    """Where the truth sits, its SNR in the photographs' own noise, and the nearest rival.

    Returns
    -------
    dict
        ``element``; ``snr``, name → whitened norm with settings, beam and camera marginalised; ``rival``, the nearest
        other single or pair of the judge's catalogue and its distance in sigma, null where nothing nameable is there.
    """
    observed, _ = observables.observe(recording)
    whole = bench_problem.build(recording, observed, attached=False)
    elements = {e.name: e.element for e in whole.catalogue}
    known = tuple(e for e in whole.catalogue if e.name not in plan.withheld or e.name in concealed.effects)
    sight = Sight.of(replace(whole, catalogue=known))
    snr = {name: float(np.linalg.norm(sight.change(own))) for name, own in concealed.effects.items()}
    if concealed.fields:
        true = bench_problem.build(replace(recording, fields=concealed.fields), observed, attached=False)
        snr[concealed.stranger] = float(np.linalg.norm(sight.through(_moved(whole, true))))
    rival = None
    if concealed.effects and not plan.zero:
        names, distance = sight.rival(concealed.values, tuple(concealed.effects))
        rival = {"effects": names.split("+") if names else [], "separation_sigma": distance}
    element = draws.STRANGER_ELEMENT.get(concealed.stranger, "")
    return {
        "element": element or next((elements[name] for name in concealed.effects), ""),
        "snr": snr,
        "rival": rival,
    }


def _moved(nominal: Problem, true: Problem) -> Array:
    """What the bench of ``true`` changes in the data, whitened; both have the same observations."""
    change = predict_all(true, {}) - true.data + nominal.data - predict_all(nominal, {})
    return whiten(nominal, nominal.covariance, change)[0]
