"""The catalogue and the isolability of a plan as tables that fit a terminal of 100 columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from math import isfinite
from textwrap import fill

from benchsim.diagnosis.result import Limit
from benchsim.reports.diagnosis_text import SIMULATION, WIDTH, defaults_text, number
from benchsim.reports.limits_text import size_text
from benchsim.reports.quantities import unit_text
from benchsim.reports.vocabulary import BENCH


@dataclass(frozen=True)
class Row:
    """An effect of the catalogue; parameters as (name, unit, cap, one-sided, shape); ``drawn`` as the entry has it."""

    name: str
    element: str
    parameters: tuple[tuple[str, str, float, bool, bool], ...]
    says: str
    synonyms: tuple[str, ...]
    drawn: str = ""


def catalogue(rows: Sequence[Row]) -> str:
    """Effects by element: parameters with units and plausible range, a sentence of physics, and of how it is drawn
    where that is by a closed form."""
    lines = [
        "In a file: [effects.NAME] with these parameters; with `render`: --effect NAME.PARAMETER=VALUE.",
        "The ranges are what is plausible; diagnosis gives each amplitude a prior of half of it.",
    ]
    for element, group in groupby(rows, key=lambda r: r.element):
        lines += ["", element.upper()]
        for r in group:
            first, *more = _parameters(r)
            lines.append(f"  {r.name:<22}{first}")
            lines += [f"  {'':<22}{text}" for text in more]
            says = r.says + (f" Counts as the same: {', '.join(r.synonyms)}." if r.synonyms else "")
            lines += [
                fill(text, WIDTH, initial_indent=" " * 6, subsequent_indent=" " * 6) for text in (says, r.drawn) if text
            ]
    return "\n".join(lines)


def _parameters(r: Row) -> list[str]:
    """Parameters in lines of what fits beside the name."""
    words = []
    for name, unit, cap, one_sided, shape in r.parameters:
        start = "0 … " if one_sided else "±"
        words.append(f"{name} {start}{cap:g} {unit_text(unit)}".rstrip() + (" (shape)" if shape else ""))
    lines = [""]
    for i, word in enumerate(words):
        word += "," if i < len(words) - 1 else ""
        if lines[-1] and len(lines[-1]) + 1 + len(word) > WIDTH - 24:
            lines.append("")
        lines[-1] += f" {word}" if lines[-1] else word
    return lines


@dataclass(frozen=True)
class Plan:
    """What `isolability` prints; see ``jobs.effect_catalogue.IsolabilityResult``. ``shaped``: `shapes_text` of the
    effects."""

    title: str
    exposures: int
    settings: int
    against: str
    observables: tuple[str, ...]
    effects: tuple[tuple[str, str], ...]
    limits: Mapping[str, Limit]
    at_cap: Mapping[str, float]
    separation: Mapping[tuple[str, str], float]
    seen_at: float
    close: float
    told_at: float
    defaults: tuple[str, ...]
    shaped: str = ""


def isolability(p: Plan) -> str:
    """What could be seen, from which size on, and what could not be told apart."""
    kinds = ", ".join(BENCH.kinds.get(k, (k, ""))[0] for k in p.observables)
    head = (
        f"{p.title}: {number(p.exposures, 'exposure')} of {number(p.settings, 'setting')}, against "
        f"{SIMULATION.get(p.against, p.against)}. Observables: {kinds}. Computed before any data, the setting "
        "errors as uncertain as stated."
    )
    lines = [fill(head, WIDTH), ""]
    lines.append(f"{'':<24}{f'seen at {p.seen_at:g} sigma from':<28}{'at its cap':>12}   hardest to tell from, and by")
    names = [name for name, _ in p.effects]
    blind = [name for name in names if not _reachable(p, name)]
    for element, group in groupby(p.effects, key=lambda e: e[1]):
        lines.append(element.upper())
        for name, _ in group:
            if name in blind:
                continue
            rivals = sorted((p.separation[name, other], other) for other in names if other != name)
            rival = f"{rivals[0][1]} ({_sigmas(rivals[0][0])})" if rivals else ""
            limit = size_text(p.limits[name]) if name in p.limits else ""
            lines.append(f"  {name:<22}{limit:<28}{_sigmas(p.at_cap[name]):>12}   {rival}")
            for key, other in p.limits.items():
                if key.startswith(f"{name}."):
                    lines.append(f"  {'':<22}{size_text(other)}")
    lines.append("")
    if blind:
        lines.append(_paragraph("Not visible at any plausible size", blind))
    if p.shaped:
        lines.append(_paragraph_of(f"{p.shaped} at one point of these only, the middle of their range."))
    pairs = []
    for i, a in enumerate(names):
        for b in names[i + 1 :]:
            if a in blind or b in blind:
                continue
            apart = max(p.separation[a, b], p.separation[b, a])
            if apart < p.close:
                pairs.append((apart, f"{a} / {b} ({_sigmas(apart)})"))
    lines.append(
        fill(
            f"Told apart: at a size of {p.told_at:g} sigma (its cap where that is less), how much of an effect no "
            "amount of the other could stand in for.",
            WIDTH,
        )
    )
    if pairs:
        start = f"Not told apart, less than {p.close:g} sigma then"
        lines.append(_paragraph(start, [text for _, text in sorted(pairs)]))
    else:
        lines.append(f"Every two that can be seen are told apart by {p.close:g} sigma or more.")
    if p.defaults:
        lines.append(defaults_text(p.defaults))
    return "\n".join(lines)


def _reachable(p: Plan, name: str) -> bool:
    own = [v for k, v in p.limits.items() if k == name or k.startswith(f"{name}.")]
    return any(v.reachable for v in own)


def _paragraph(start: str, words: Sequence[str]) -> str:
    return _paragraph_of(f"{start}: {'; '.join(words)}.")


def _paragraph_of(text: str) -> str:
    return fill(text, WIDTH, subsequent_indent="  ", break_on_hyphens=False)


def _sigmas(x: float) -> str:
    if not isfinite(x):
        return "-"
    return f"{x:.1f} sigma" if x < 20 else f"{x:.0f} sigma"
