"""What all the other terms of a heliostat's mount do, each a little, beside what was found.

A real mount has some error in each of its constants. A few are large enough to be found; the others are not, one by
one, and are too much alike to be told apart, but together they decide how well a later record is predicted. Where
records left out, all of a stretch of days together, are predicted better with all of them (`diagnosis.forward.beside`),
they are fitted together with what was found. None of them is said to be there, and the sizes of what was found are
those without them: beside near synonyms of itself an effect has no size of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from benchsim.diagnosis import forward
from benchsim.diagnosis.evidence import amplitudes, shapes
from benchsim.diagnosis.problem import Parameter, Problem


@dataclass(frozen=True)
class SmallTerms:
    """What is added by effect and term, in the catalogue's units, to what was found as well; ``parameters`` of what was
    not, with the prior sigmas that they had."""

    values: Mapping[str, Mapping[str, float]]
    parameters: tuple[Parameter, ...]


def small_terms(problem: Problem, values: Mapping[str, float], found: Mapping[str, object]) -> SmallTerms:
    """The small terms of a heliostat; none where it is predicted as well without.

    Parameters
    ----------
    problem : Problem
    values : mapping
        Of all that was fitted.
    found : mapping
        Effects that are stated.
    """
    there = [e for e in problem.catalogue if e.name in found]
    rest = [e for e in problem.catalogue if e.name not in found and not shapes(e)]
    own = [*problem.nuisances, *(p for e in there for p in amplitudes(e))]
    small, fitted = forward.beside(problem, own, [p for e in rest for p in amplitudes(e)], values)
    if not small:
        return SmallTerms({}, ())
    more = {e.name: {p.name: fitted[p.name] - values.get(p.name, 0.0) for p in amplitudes(e)} for e in (*there, *rest)}
    return SmallTerms(more, small)
