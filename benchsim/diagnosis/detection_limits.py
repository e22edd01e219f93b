"""How large each effect would have had to be to be seen at five sigma."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from benchsim.diagnosis.degeneracy import Space
from benchsim.diagnosis.hypothesis import Effects
from benchsim.diagnosis.problem import Problem
from benchsim.diagnosis.result import Limit

SIGMAS = 5.0


def limits(problem: Problem, within: Space, names: tuple[str, ...], found: Effects = ()) -> Mapping[str, Limit]:
    """Five-sigma size of every amplitude, one at a time.

    The nuisances are integrated with their priors at the setting scale of ``within``, and so are the amplitudes of what
    was found. A parameter to which the data respond by its square is given as itself. A random field is given by the
    rms of its amplitudes.

    Parameters
    ----------
    problem : Problem
    within : Space
    names : tuple of str
        Of the amplitudes of ``within``.
    found : Effects

    Returns
    -------
    mapping
        By effect: the parameter that is hardest to see against its cap. Further parameters stand under
        ``effect.parameter``. ``five_sigma`` is infinite where the data do not respond at all.
    """
    held = within.places(found)
    gram = within.gram
    if len(held):
        inner = gram[np.ix_(held, held)] + np.diag(within.sigma[held] ** -2.0)
        gram = gram - gram[:, held] @ np.linalg.solve(inner, gram[held])
    out: dict[str, Limit] = {}
    for effect in problem.catalogue:
        if effect.name in found:
            continue
        many = [p for p in effect.parameters if p.name in names]
        power = np.array([max(0.0, gram[names.index(p.name), names.index(p.name)]) for p in many])
        if effect.random_field and many:
            rms = SIGMAS / np.sqrt(power.sum()) if power.sum() > 0 else np.inf
            name = many[0].name.rstrip("0123456789") + "rms"
            out[effect.name] = Limit(name, float(rms), many[0].unit, bool(rms < 2 * many[0].sigma))
            continue
        sizes = []
        for p, g in zip(many, power, strict=True):
            size = float((SIGMAS / np.sqrt(g)) ** (1 / p.power)) if g > 0 else float("inf")
            sizes.append((size / (2 * p.sigma), Limit(p.name, size, p.unit, size < 2 * p.sigma)))
        sizes.sort(key=lambda s: -s[0])
        for k, (_, limit) in enumerate(sizes):
            out[effect.name if k == 0 else f"{effect.name}.{limit.parameter}"] = limit
    return out
