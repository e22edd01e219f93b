"""What the effects that were found move: a curvature in 1/m says little at the bench, millimetres at an edge do."""

from __future__ import annotations

from collections.abc import Mapping
from math import hypot, isfinite

import numpy as np

from benchsim.bench.model import Recording
from benchsim.diagnosis.linear import predict_each
from benchsim.diagnosis.problem import Problem
from benchsim.diagnosis.result import Diagnosis, Found, Size
from benchsim.instruments.bench.displacement import NOTHING
from benchsim.instruments.bench.prediction import FAR

Moves = Mapping[str, tuple[Size, str]]
"""Parameter or effect → how much it moves, and where or how that is measured."""

HOW = "rms over all traces, settings held, which may take up most of it"


def moves(recording: Recording, problem: Problem, d: Diagnosis) -> Moves:
    """What every effect that was found moves: by parameter at an edge, and by effect on the trace.

    Parameters
    ----------
    recording : Recording
    problem : Problem
        Of the bench.
    d : Diagnosis
        Of that problem.

    Returns
    -------
    mapping of str to (Size, str)
        An effect that leaves the centre line where it is has no entry, nor has one whose parameters say it already.
    """
    edges, out = _edges(recording), {}
    for f in d.effects:
        for name, size in f.parameters.items():
            if name in edges:
                per, unit, where = edges[name]
                out[name] = Size(per * size.value, per * size.sigma, unit), where
        on_trace = _on_trace(problem, d, f)
        if on_trace is not None:
            out[f.name] = on_trace, HOW
    return out


def _edges(recording: Recording) -> dict[str, tuple[float, str, str]]:
    """By parameter: how much moves where, per unit of it; by the closed forms that `rays` has for each."""
    y, z = (0.5 * side for side in recording.screen.size)
    edge = recording.laser.waist
    sides, ends = "at the board's left and right edges", "at the board's upper and lower edges"
    around, rim = "at the board's edges, at most", "at the beam's 1/e² edge"
    out = {
        "bow_y": (0.5e-3 * y**2, "mm", sides),
        "bow_z": (0.5e-3 * z**2, "mm", ends),
        "st_y": (1e-3 * z, "mm", ends),
        "st_z": (1e-3 * y, "mm", sides),
        **{name: (1e-3 * max(y, z), "mm", around) for name in ("srot", "gs", "ga", "gsh")},
        **{name: (edge, "mrad", rim) for name in ("curv", "astig0", "astig45")},
        **{name: (3 * edge**2, "mrad", rim) for name in ("coma_u", "coma_v")},
    }
    cameras = [recording.cameras[name] for name in dict.fromkeys(e.camera for e in recording.exposures)]
    if len(cameras) == 1:
        focal = cameras[0].focal
        u, v = (0.5 * side / focal for side in cameras[0].resolution)
        out |= {
            "k1": (focal * hypot(u, v) ** 3, "px", "in the picture's corners"),
            "k2": (focal * hypot(u, v) ** 5, "px", "in the picture's corners"),
            "p1": (3 * focal * v**2, "px", "at the picture's upper and lower edges"),
            "p2": (3 * focal * u**2, "px", "at the picture's left and right edges"),
        }
    return out


def _on_trace(problem: Problem, d: Diagnosis, f: Found) -> Size | None:
    """Rms of what an effect changes in the centre lines; its sigma to first order, of parameters that err apart."""
    own = next((e.parameters for e in problem.catalogue if e.name == f.name), ())
    if not own or len(f.parameters) > len(own):  # a switch is told with its size in mm already
        return None
    bare = {**d.values, **{p.name: 0.0 for p in own if not p.grid}}
    uncertain = {name: size.sigma for name, size in f.parameters.items() if isfinite(size.sigma)}
    off = [{**d.values, name: d.values.get(name, 0.0) + sigma} for name, sigma in uncertain.items()]
    there, without, *others = predict_each(problem, [d.values, bare, *off])
    lit = problem.kind == "c"
    for each in (there, without, *others):
        lit = lit & (each != FAR)
    moved = (there - without)[lit]
    rms = float(np.sqrt(np.mean(moved**2))) if lit.any() else 0.0
    if rms < NOTHING:
        return None
    by = [float(np.mean(moved * (each - there)[lit])) / rms for each in others]
    return Size(rms, float(np.linalg.norm(by)), "mm")
