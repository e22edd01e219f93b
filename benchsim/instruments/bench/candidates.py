"""Which effects of the catalogue a recording can be judged for, in which form, and why the others cannot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Physics, Recording
from benchsim.bench.place import place
from benchsim.diagnosis.problem import Effect, Parameter
from benchsim.instruments.bench.effects import CATALOGUE, PHYSICS_OF, Term

NEEDS: Mapping[str, str] = {
    "polygon": "the mirror is a cylinder",
    "facets": "the simulation has no facets",
    "gamma": "no camera's gamma is known",
    "gate or gamma": "no exposure is gated to a facet, and no camera's gamma is known",
    "times": "all exposures are of one time",
}
"""What an effect may need of a recording, and why it is not judged where that is wanting.

A mirror that is a polygon; facets, simulated or in doubt; widths and flux, which take a known gamma; those, or
exposures gated to one facet; exposures at several times."""


def simulated(recording: Recording, against: str = "bench") -> Physics:
    """The ``[physics]`` of the simulation in doubt: the file's ("bench"), or all false ("vector").

    Raises
    ------
    BenchsimError
        If ``against`` is neither.
    """
    if against == "bench":
        return recording.physics
    if against == "vector":
        return Physics(facets=False, beam=False, diffraction=False)
    raise BenchsimError(f"--against {against}: no such simulation; give bench or vector")


def candidates(recording: Recording, against: str = "bench") -> tuple[Effect, ...]:
    """What a recording could show to be missing from the simulation in doubt; `not_judged` says why not the others.

    Parameters
    ----------
    recording : Recording
    against : {"bench", "vector"}

    Returns
    -------
    tuple of diagnosis.Effect
        In the catalogue's order, parameters in the file's units under the file's names.

    Notes
    -----
    Without gated exposures the facets' tilts and the wobble only widen the trace, by the square of one number; with
    them each gated facet's tilt is a draw of one population. Drift needs two times, blooming and widths a known gamma.
    """
    barred = not_judged(recording, against)
    gated = _gated(recording)
    out: list[Effect] = []
    for entry in CATALOGUE:
        name = entry.name
        if name in barred:
            continue
        own = tuple(t for t in entry.terms if t.observable)
        if not own:  # setting errors are a hypothesis of the diagnosis' own
            continue
        random = False
        if name == "facet-tilts" and gated:
            own, random = tuple(Term(f"tilt_{k}", "mrad", 3.0) for k in gated), True
        if name == "axis-wobble" and not gated:
            own = (Term("wob_c", "mrad", 2.0, one_sided=True, power=2),)
        if name == "plume":
            own = _plume_terms(recording, own)
        if name == "rolling-shutter":
            own = _shutter_terms(recording, own)
        parameters = tuple(
            Parameter(t.name, t.unit, t.cap / 2, one_sided=t.one_sided, power=t.power, grid=t.grid) for t in own
        )
        whole = name in PHYSICS_OF
        out.append(Effect(name, entry.element, parameters, entry.says, entry.remedy, random, whole))
    return tuple(out)


def not_judged(recording: Recording, against: str = "bench") -> Mapping[str, str]:
    """Effects of the catalogue that are no candidates in a recording, each with why, in the catalogue's order."""
    physics = simulated(recording, against)
    linear = any(recording.cameras[e.camera].gamma != "unknown" for e in recording.exposures)
    has = {
        "polygon": recording.mirror.shape == "polygon",
        "facets": physics.facets or against == "vector",
        "gamma": linear,
        "gate or gamma": linear or bool(_gated(recording)),
        "times": len({e.time for e in recording.exposures}) > 1,
    }
    out: dict[str, str] = {}
    for entry in CATALOGUE:
        wanting = [NEEDS[need] for need in entry.needs if not has[need]]
        if entry.name in PHYSICS_OF and getattr(physics, PHYSICS_OF[entry.name]):
            wanting.append("already in the simulation")
        if wanting:
            out[entry.name] = wanting[0]
    return out


def _gated(recording: Recording) -> tuple[int, ...]:
    """Facets to which exposures are gated."""
    return tuple(sorted({e.facet for e in recording.exposures if e.facet is not None}))


def _plume_terms(recording: Recording, own: tuple[Term, ...]) -> tuple[Term, ...]:
    """Places and widths of a plume on the way of this recording's light.

    Light crosses the plane half way midway between the mirror and the point of the board that it goes to. Nodes stand
    80 mm apart, or as far as four by five of them have to: 80 mm throughout cost a clean recording 40 % more time.
    """
    from benchsim import rays

    bare = replace(recording, effects={}, fields={})
    crossings = []
    for exposure in recording.exposures:
        at = place(recording.mirror, exposure)
        try:
            board = rays.predict(bare, exposure, samples=12, width=False).points
        except BenchsimError:
            continue
        crossings.append(0.5 * (at.centre + at.screen_origin + board @ at.screen_rotation[:, 1:].T)[:, 1:])
    if not crossings:
        return own
    low, high = np.percentile(np.concatenate(crossings), [0, 100], axis=0)

    def spread(axis: int, most: int) -> tuple[float, ...]:
        count = int(np.clip(np.ceil((high[axis] - low[axis]) / 80.0), 2, most))
        middle = (np.arange(count) + 0.5) / count
        return tuple(float(x) for x in (low[axis] + middle * (high[axis] - low[axis])).round(1))

    grids = {"plume_y": spread(0, 4), "plume_z": spread(1, 5), "plume_width": (40.0, 90.0)}
    return tuple(
        t if t.name not in grids else Term(t.name, t.unit, t.cap, one_sided=t.one_sided, grid=grids[t.name])
        for t in own
    )


def _shutter_terms(recording: Recording, own: tuple[Term, ...]) -> tuple[Term, ...]:
    """Periods from a quarter to two cycles over the tallest picture, a quarter apart: what its rows can resolve."""
    rows = max(recording.cameras[e.camera].resolution[1] for e in recording.exposures)
    grid = tuple(float(round(rows / f)) for f in (0.4, 0.6, 0.8, 1.0, 1.25, 1.6, 2.0))
    return tuple(Term(t.name, t.unit, 2 * max(grid), one_sided=True, grid=grid) if t.grid else t for t in own)
