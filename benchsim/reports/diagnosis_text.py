"""The diagnosis in plain sentences, for a person at the bench; nothing is computed here."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import exp, isfinite, log
from textwrap import fill
from typing import TYPE_CHECKING

from benchsim.reports.conclusion import CONFIDENCE, below_zero, gained, gathered, headline, leftover, listed
from benchsim.reports.limits_text import blind_text, limit_rows, limit_text, shapes_text
from benchsim.reports.quantities import rounded, words_of
from benchsim.reports.vocabulary import BENCH, Vocabulary

if TYPE_CHECKING:
    # The diagnosis is heavy to load, and pages of plants are made without it.
    from benchsim.diagnosis.problem import Effect
    from benchsim.diagnosis.result import Diagnosis, Found, Size, SplitBy

WIDTH = 100

SIMULATION = {
    "bench": "the bench as the file states it",
    "vector": "the paper's vector model (no facets, a single ray, no diffraction)",
    "mount": "the mount as the files state it",
}


@dataclass(frozen=True)
class About:
    """What the text says of the recording beside what was found.

    Attributes
    ----------
    title : str
    exposures, settings : int
        Used.
    against : {"bench", "vector", "mount"}
    catalogue : sequence of Effect
        The candidates.
    lost : sequence of str
        One sentence for each exposure that was dropped.
    remarks : sequence of str
        One sentence for each thing about the recording that limits what can be told.
    defaults : sequence of str
        ``key = value`` of every default taken.
    amended : str
        One sentence on the file that holds what was found; empty: none.
    words : Vocabulary
    moves : mapping of str to (Size, str)
        What an effect of that name, or of a parameter of that name alone, moves, and where or how that is measured.
    """

    title: str
    exposures: int
    settings: int
    against: str
    catalogue: Sequence[Effect]
    lost: Sequence[str] = ()
    remarks: Sequence[str] = ()
    defaults: Sequence[str] = ()
    amended: str = ""
    words: Vocabulary = BENCH
    moves: Mapping[str, tuple[Size, str]] = field(default_factory=dict)


def summary(d: Diagnosis, about: About) -> str:
    """What is missing, where, what it is, how large, and what to do; or how large it would have had to be.

    Parameters
    ----------
    d : Diagnosis
    about : About

    Returns
    -------
    str
        Paragraphs of at most 100 columns.
    """
    words = about.words
    count = number(about.exposures, words.one)
    if words is BENCH:
        count += f" of {number(about.settings, 'setting')}"
    parts = [f"{about.title}: {count}, against {SIMULATION.get(about.against, about.against)}."]
    parts.append(_headline(d, words))
    parts += [_found(f, about) for f in d.effects]
    parts += list(_classes(d, about))
    parts += list(_where(d, words))
    parts += list(_better(d, words))
    parts += list(_next(d))
    parts += list(_limits(d, about))
    parts += list(_settings(d, words))
    if about.lost:
        one = len(about.lost) == 1
        parts.append(_wrapped(f"Dropped: {about.lost[0]}") if one else "\n".join(["Dropped:", *map(_item, about.lost)]))
    if about.remarks or d.notes:
        parts.append("\n".join(_item(sentence) for sentence in gathered([*about.remarks, *d.notes])))
    if about.defaults:
        parts.append(defaults_text(about.defaults))
    if about.amended:
        parts.append(_wrapped(about.amended))
    return "\n\n".join(parts)


def defaults_text(defaults: Sequence[str]) -> str:
    """Defaults taken, those of several exposures together: ``exposure[1, 2, 4].time_s = 0.0``."""
    grouped: dict[tuple[str, str], list[str]] = {}
    for text in defaults:
        table, bracket, rest = text.partition("[")
        number, close, key = rest.partition("]")
        if table == "exposure" and bracket and close:
            grouped.setdefault((table, key), []).append(number)
        else:
            grouped[text, ""] = []
    words = [f"{start}[{', '.join(n)}]{key}" if n else start for (start, key), n in grouped.items()]
    return fill(f"Defaults taken for what the file leaves out: {'; '.join(words)}.", WIDTH, break_long_words=False)


def percent(p: float) -> str:
    """A probability that is never said to be 0 or 1."""
    if p > 0.9999:
        return "above 99.99 %"
    return "below 0.01 %" if p < 1e-4 else f"{100 * p:.4g} %"


def together(p: float) -> str:
    """The probability of a class. What is stated may be what predicts best though evidence alone favours others."""
    return f"together {percent(p)}" + (", other sets more by evidence alone" if p < 0.5 else "")


SETTLED = log(1e6)
"""ln Z beyond which odds are told as more than a million to 1, and are not what keeps an element from being claimed."""


def odds(margin: float) -> str:
    """A difference of ln Z as odds."""
    if margin > SETTLED:
        return "odds of more than a million to 1"
    return f"odds of {exp(max(margin, 0.0)):.3g} to 1"


def unsettled(margin: float) -> str:
    """Why an element that leads by so much is not claimed: by too little, or since its functions leave too much."""
    if margin > SETTLED:
        return f", by {odds(margin)} over the next element; but some of it no function there explains."
    return f"; {odds(margin)} over the next element do not settle it."


def number(n: int, noun: str) -> str:
    """``1 exposure``, ``2 exposures``."""
    return f"{n} {noun}{'' if n == 1 else 's'}"


def _wrapped(text: str, indent: str = "") -> str:
    return fill(
        text, WIDTH, initial_indent=indent, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )


def _item(text: str) -> str:
    return fill(
        text, WIDTH, initial_indent="- ", subsequent_indent="  ", break_long_words=False, break_on_hyphens=False
    )


def _headline(d: Diagnosis, words: Vocabulary) -> str:
    """The verdict, its first words in capitals: the eye is to find it."""
    plain = d.as_dict()
    first, rest = re.split(r"(?<=missing)|(?<=settings)", headline(plain, words), maxsplit=1)
    tail = " What would have been seen is listed below." if d.verdict == "nothing-missing" else ""
    left = leftover(plain, words)
    return _wrapped(first.upper() + rest + tail + (f" {left}" if left else ""))


def _size(size: Size) -> str:
    return rounded(size.value, size.sigma, size.unit)


def _found(f: Found, about: About) -> str:
    alone = " among the catalogue's effects" if f.confidence == "provisional" else ""
    lines = [f"{f.name} ({f.element}; {CONFIDENCE[f.confidence]}; probability {percent(f.probability)}{alone})"]
    lines.append(_wrapped(f.says, "  "))
    sizes = []
    for name, size in f.parameters.items():
        word, moved = words_of(name), about.moves.get(name)
        told = f"{name} = {_size(size)}" if word == name else f"{word} ({name}) {_size(size)}"
        sizes.append(told + (f", which is {_size(moved[0])} {moved[1]}" if moved else ""))
    apart = "; " if about.moves.keys() & f.parameters.keys() else ", "
    lines.append(_wrapped(f"Size: {apart.join(sizes)} (1 sigma).", "  "))
    if f.name in about.moves:
        size, how = about.moves[f.name]
        lines.append(_wrapped(f"Alone it moves the trace by {_size(size)} {how}.", "  "))
    if f.remedy:
        lines.append(_wrapped(f"{about.words.remedy}: {f.remedy}", "  "))
    return "\n".join(lines)


def _classes(d: Diagnosis, about: About) -> Iterator[str]:
    known = {e.name: e for e in about.catalogue}
    for c in d.classes:
        stated = "the first" if c.stated else "none of it"
        lines = [f"One of these {len(c.members)}, {together(c.probability)}; amended.toml states {stated}:"]
        for member, sizes in zip(c.members, c.sizes or [{}] * len(c.members), strict=True):
            if not member:
                lines.append("  - nothing else" if d.effects or len(d.classes) > 1 else "  - nothing")
                continue
            says = " ".join(known[name].says for name in member if name in known)
            told = ", ".join(f"{w}{' =' * (w == n)} {_size(s)}" for n, s in sizes.items() if (w := words_of(n)))
            text = " with ".join(member) + (f" ({told})" if told else "") + (f": {says}" if says else "")
            lines.append(fill(text, WIDTH, initial_indent="  - ", subsequent_indent="    ", break_on_hyphens=False))
        if c.split_by is not None:
            s = c.split_by
            lines.append(_wrapped(f"To tell them apart: {_ended(s.what)} It separates them by {_sigma(s)}.", "  "))
        else:
            lines.append(_wrapped("Nothing that was considered would tell them apart.", "  "))
        yield "\n".join(lines)


def several(element: str) -> bool:
    """Whether a location lists the elements of several effects, ``mirror + screen``, instead of saying which one."""
    return " + " in element


def place_text(element: str, coordinate: str) -> str:
    """``in the camera, as a function of image row``; ``in the mirror and the screen``."""
    where = f"in {listed([f'the {e}' for e in element.split(' + ')])}"
    return f"{where}, as a function of {coordinate}" if coordinate else where


STANDS_OUT = 3.0
"""Sigma from which on a kind of datum is said to show what was found."""


def shown_text(by_kind: Mapping[str, float], words: Vocabulary, stretches: int) -> str:
    """``It shows in marks (12.1 sigma), all exposures together; no single stretch of a trace stands out.``"""
    seen = sorted((k for k in by_kind if by_kind[k] >= STANDS_OUT), key=lambda k: -by_kind[k])
    if not seen:
        return ""
    each = listed([f"{words.kinds.get(k, (k, ''))[0]} ({by_kind[k]:.1f} sigma)" for k in seen])
    alone = "" if stretches else "; no single stretch stands out"
    return f"It shows in {each}, all {words.one}s together{alone}."


def _where(d: Diagnosis, words: Vocabulary) -> Iterator[str]:
    where = d.location
    if where is None:
        return
    lines = []
    place = place_text(where.element, where.coordinate)
    if where.claimed:
        lines.append(_wrapped(f"Where: {place} ({odds(where.margin)} over every other element)."))
    elif several(where.element):
        lines.append(_wrapped(f"Where: {place}, by what explains it best."))
    else:
        lines.append(_wrapped(f"Where: most likely {place}{unsettled(where.margin)}"))
    shown = shown_text(where.by_kind, words, len(where.along_trace))
    if shown:
        lines.append(_wrapped(shown, "  "))
    for s in sorted(where.along_trace, key=lambda s: -s.z)[:6]:
        place = f"{s.exposure}: from {s.from_mm:.0f} to {s.to_mm:.0f} mm along the trace"
        lines.append(f"  {place}, {s.z:.1f} sigma, {words.kinds.get(s.kind, (s.kind, ''))[0]}")
    if len(where.along_trace) > 6:
        lines.append(f"  and weaker stretches: {len(where.along_trace) - 6} (diagnosis.json lists them)")
    if d.law is not None:
        if d.law.terms:
            terms = ", ".join(f"{value:.3g} · {term}" for term, value in d.law.terms.items())
            form = f"a law in {d.law.coordinate} ({terms})"
        else:
            form = f"a smooth function of {d.law.coordinate}"
        lines.append(
            _wrapped(
                f"Until its cause is known, {form} stands in for it: of the misfit of {words.setting}s left out it "
                f"removes {100 * min(d.law.held_out_gain, 1.0):.0f} ± {100 * d.law.gain_sigma:.0f} %.",
                "  ",
            )
        )
    yield "\n".join(lines)


def _better(d: Diagnosis, words: Vocabulary) -> Iterator[str]:
    if d.verdict == "nothing-missing":
        rows = [
            f"{words.kinds.get(k, (k, ''))[0]} {a:.3g} {words.kinds.get(k, (k, ''))[1]}".rstrip()
            for k, (_, a) in d.rms.items()
        ]
        if rows:
            yield _wrapped(
                f"The simulation fits the {words.recordings} to {', '.join(rows)}{words.of} rms, settings fitted."
            )
    else:
        rows = [
            f"{words.kinds.get(k, (k, ''))[0]} {b:.3g} → {a:.3g} {words.kinds.get(k, (k, ''))[1]}".rstrip()
            for k, (b, a) in d.rms.items()
            if isfinite(b) and isfinite(a)
        ]
        if rows:
            yield _wrapped(f"Residuals before → after, rms, settings fitted: {', '.join(rows)}{words.of}.")
    held = d.held_out
    if held is None:
        return  # fewer than three settings, as the notes say
    before, after = held.excess_chi2_before, held.excess_chi2_after
    start = f"Left out in turn ({held.folds} folds, {held.data} data) and predicted from the other {words.setting}s, "
    if d.verdict == "nothing-missing":
        yield _wrapped(
            start + f"the {words.recordings} miss the prediction by an excess χ² of {before:.0f} ± {held.sigma:.0f} "
            f"beyond noise and setting errors{below_zero(before, held.sigma, words)}."
        )
        return
    yield _wrapped(
        start + f"the {words.recordings}' misfit beyond noise and setting errors (excess χ²) "
        f"{gained(before, after, held.sigma, words)}"
    )


def _sigma(s: SplitBy) -> str:
    return f"{s.separation_sigma:.1f} sigma" if s.separation_sigma < 20 else f"{s.separation_sigma:.0f} sigma"


def _ended(text: str) -> str:
    return text if text.endswith((".", "!", "?")) else text + "."


def _next(d: Diagnosis) -> Iterator[str]:
    if not d.next:
        return
    best = d.next[0]
    lines = [_wrapped(f"Next: {_ended(best.what)} It separates what is still open by {_sigma(best)}.")]
    for s in d.next[1:3]:
        lines.append(_wrapped(f"or: {_ended(s.what)} ({_sigma(s)})", "  "))
    yield "\n".join(lines)


def _limits(d: Diagnosis, about: About) -> Iterator[str]:
    """All of them where nothing was found; else those that could not be seen at all, and those of physics that the
    simulation leaves out as a whole: whoever puts it in doubt asks after each of them."""
    seen = {k: v for k, v in d.limits.items() if v.reachable}
    open_ = {*(f.name for f in d.effects), *(name for c in d.classes for member in c.members for name in member)}
    blind = {k: v for k, v in d.limits.items() if not v.reachable and k.split(".")[0] not in open_}
    if d.verdict != "nothing-missing":
        whole = {e.name for e in about.catalogue if e.whole} - open_
        seen = {k: v for k, v in seen.items() if k.split(".")[0] in whole}
    if d.verdict == "nothing-missing" and seen:
        lines = ["Each of these would have been seen at five sigma had it been as large as:"]
        lines += limit_rows(seen)
        yield "\n".join(lines)
    elif seen:
        words = ", ".join(f"{k.split('.')[0]} ({limit_text(v)})" for k, v in seen.items())
        yield _wrapped(f"Not found, and would have been seen at five sigma had it been as large as: {words}.")
    if blind:
        start = f"Not visible in these {about.words.recordings} at any plausible size: "
        yield _wrapped(start + listed(blind_text((k.split(".")[0], v.parameter) for k, v in blind.items())) + ".")
    told = {k.split(".")[0] for k in (*seen, *blind)}
    if shaped := shapes_text([e for e in about.catalogue if e.name in told]):
        yield _wrapped(f"{shaped} at one point of these only, the most probable that was tried.")


def _settings(d: Diagnosis, words: Vocabulary) -> Iterator[str]:
    text = []
    if d.sigma_scale > 1.15:
        text.append(f"The noise is {d.sigma_scale:.2f} times {words.noise}.")
    if d.correlation > 0:
        text.append(f"Neighbouring points err together over {d.correlation:.2g} mm.")
    far = sorted(
        ((k, v) for k, v in d.pulls.items() if abs(v) > 3 and not k.startswith("drift.")), key=lambda kv: -abs(kv[1])
    )
    if far:
        listed = ", ".join(f"{words_of(k)} ({v:+.1f} sigma)" for k, v in far[:5])
        text.append(f"Far from where it was set: {listed}.")
    if text:
        yield _wrapped(" ".join(text))
