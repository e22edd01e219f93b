"""Detection limits in words: from which size on an effect would have been seen, and of what its limit is said."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

from benchsim.reports.conclusion import listed
from benchsim.reports.quantities import readable, unit_text, words_of

if TYPE_CHECKING:
    from benchsim.diagnosis.problem import Effect
    from benchsim.diagnosis.result import Limit

INVISIBLE = "not visible at any plausible size"
"""Instead of a limit that lies beyond the largest size that an effect is looked for at."""


def shapes_text(catalogue: Sequence[Effect]) -> str:
    """Begins a sentence on the limits of effects that have a shape beside their size; empty where none has."""
    shapes = {e.name: [p.name for p in e.parameters if len(p.grid) > 1] for e in catalogue}
    words = [f"{name} ({', '.join(map(words_of, own))})" for name, own in shapes.items() if own]
    return f"What is said here of {listed(words)} holds" if words else ""


def blind_text(parameters: Iterable[tuple[str, str]]) -> list[str]:
    """Effects with those of their parameters that cannot be seen: ``drift (along y and along z)``."""
    own: dict[str, list[str]] = {}
    for effect, parameter in parameters:
        own.setdefault(effect, []).append(words_of(parameter))
    return [f"{effect} ({listed(some)})" for effect, some in own.items()]


def limit_text(v: Limit) -> str:
    """``bow along z: 0.0042 1/m``."""
    return f"{words_of(v.parameter)}: {_five_sigma(v)}"


def size_text(v: Limit) -> str:
    """``bow_z = 0.0042 1/m``, as files have it."""
    if not v.reachable:
        return f"{v.parameter}: {INVISIBLE}"
    return f"{v.parameter} = {_short(v.five_sigma)} {unit_text(v.unit)}".rstrip()


def _five_sigma(v: Limit) -> str:
    if not v.reachable:
        return INVISIBLE
    factor, unit = readable(v.unit, v.five_sigma)
    return f"{_short(factor * v.five_sigma)} {unit}".rstrip()


def _short(x: float) -> str:
    """Three digits, without an exponent between 1e-4 and 1e5."""
    return f"{x:.3g}" if not 1e3 <= abs(x) < 1e5 else f"{x:.0f}"


def limit_rows(limits: Mapping[str, Limit]) -> list[str]:
    """Effect, parameter and limit, in the order given; keys are ``effect`` or ``effect.parameter``."""
    return [f"  {name.split('.')[0]:<24}{words_of(v.parameter):<38}{_five_sigma(v)}" for name, v in limits.items()]
