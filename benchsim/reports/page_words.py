"""The sentences and rows of the report page, from the finished JSON; nothing is computed here."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import inf, log10
from typing import Any

from benchsim.reports.conclusion import CONFIDENCE, SETTINGS, below_zero, gained, gathered, headline, leftover, listed
from benchsim.reports.diagnosis_text import (
    SIMULATION,
    number,
    odds,
    percent,
    place_text,
    several,
    shown_text,
    together,
    unsettled,
)
from benchsim.reports.limits_text import INVISIBLE, blind_text
from benchsim.reports.quantities import readable, rounded, words_of
from benchsim.reports.vocabulary import BENCH, Vocabulary, of

Json = Mapping[str, Any]

ELEMENTS = ("source", "mirror", "air", "screen", "camera", "time", "settings")
"""In the order of the light; others follow in the order in which they come."""


def diagnosis(d: Json, extra: Json) -> dict[str, Any]:
    """What the page says of a diagnosis, by the place where it says it.

    Parameters
    ----------
    d : mapping
        ``diagnosis.json``.
    extra : mapping
        ``page.json``.
    """
    says = {e["name"]: e["says"] for e in extra["catalogue"]}
    open_ = {*(f["name"] for f in d["effects"]), *(n for c in d["classes"] for m in c["members"] for n in m)}
    limits = [(k, v) for k, v in d["limits"].items() if v["reachable"] or k.split(".")[0] not in open_]
    words = of(extra)
    count = f"{number(len(extra['exposures']), 'exposure')} of {number(extra['settings'], 'setting')}"
    if words is not BENCH:
        count = number(extra["settings"], words.one)
    return {
        "headline": " ".join(t for t in (headline(d, words), leftover(d, words)) if t),
        "basis": f"{count}, against {SIMULATION.get(d['against'], d['against'])}.",
        "remedy": words.remedy,
        "told": words,
        "says": says,
        "where": _where(d, words),
        "law": _law(d, words),
        "rms": [(*words.kinds.get(k, (k, "")), v["before"], v["after"]) for k, v in d["fit"]["rms"].items()],
        "left_out": _left_out(d, words),
        "settings": _settings(d, words),
        "seen": [_limit(k, v) for k, v in limits if v["reachable"]],
        "blind": listed(blind_text((k.split(".")[0], v["parameter"]) for k, v in limits if not v["reachable"])),
        "most": most(d, extra),
        "stretches": _stretches(d, words),
        "moves": extra.get("moves", {}),
        "notes": gathered([*d["remarks"], *d["notes"]]),
        "fitted": _fitted(d, extra),
    }


def _where(d: Json, words: Vocabulary) -> str:
    w = d["location"]
    if w is None:
        return ""
    margin, at = inf if w["margin"] is None else w["margin"], place_text(w["element"], w["coordinate"])
    if w["claimed"]:
        text = f"I{at[1:]}: {odds(margin)} over any other element."
    elif several(w["element"]):
        text = f"I{at[1:]}, by what explains it best."
    else:
        text = f"Most likely {at}{unsettled(margin)}"
    # A diagnosis of before this was told has no ``by_kind``.
    return f"{text} {shown_text(w.get('by_kind', {}), words, len(w['along_trace']))}".rstrip()


def most(d: Json, extra: Json) -> dict[str, Any] | None:
    """The kind of datum that shows most of what was found, with its words, where that is not the trace's own place."""
    kind = extra.get("most")
    if kind is None:
        return None
    name, unit = of(extra).kinds.get(kind, (kind, ""))
    return {"kind": kind, "name": name, "unit": unit, "sigma": d["location"]["by_kind"][kind]}


def _stretches(d: Json, words: Vocabulary) -> list[tuple[Json, str]]:
    """The stretches, the strongest first, each with the words of the kind of datum that shows it."""
    found = d["location"]["along_trace"] if d["location"] else []
    told = [(s, words.kinds.get(s.get("kind", ""), ("", ""))[0]) for s in found]
    return sorted(told, key=lambda pair: -pair[0]["z"])


def _law(d: Json, words: Vocabulary) -> str:
    law = d["law"]
    if law is None:
        return ""
    terms = ", ".join(f"{minus(f'{value:.3g}')} · {term}" for term, value in law["terms"].items())
    form = f"a law in {law['coordinate']} ({terms})" if terms else f"a smooth function of {law['coordinate']}"
    return (
        f"Until its cause is known, {form} stands in for it: of the misfit of {words.setting}s left out it removes "
        f"{short(100 * min(law['held_out_gain'], 1.0))} ± {short(100 * law['held_out_gain_sigma'])} %."
    )


def _left_out(d: Json, words: Vocabulary) -> str:
    """What prediction of settings left out says; the same rule as in the summary for when it says nothing."""
    h = d["fit"]["held_out"]
    if h is None:
        return f"Fewer than three {words.setting}s: none could be left out to test the prediction."
    start = f"Every {words.setting} was left out in turn ({h['folds']} folds, {h['data']} data) and predicted from the "
    start += "others. "
    before, after, sigma = h["excess_chi2_before"], h["excess_chi2_after"], h["sigma"]
    if d["verdict"] == "nothing-missing":
        missed = f"Beyond noise and setting errors they miss by an excess χ² of {_chi2(before)} ± {sigma:.0f}"
        return f"{start}{missed}{below_zero(before, sigma, words)}."
    found = minus(gained(before, after, sigma, words))
    return f"{start}Their misfit beyond noise and setting errors (excess χ²) {found}"


def _chi2(x: float) -> str:
    return minus(f"{x:.0f}")


def _settings(d: Json, words: Vocabulary) -> list[str]:
    noise, out = d["noise"], []
    if noise["sigma_scale"] > 1.15:
        out.append(f"The noise is {noise['sigma_scale']:.2f} times {words.noise}.")
    if noise["correlation_mm"] > 0:
        out.append(f"Neighbouring points err together over {noise['correlation_mm']:.2g} mm.")
    return out


def probabilities(d: Json, extra: Json) -> list[tuple[str, list[dict[str, Any]]]]:
    """Effects by element in the order of the light, each with its probability and where that lies on a log-odds bar."""
    known = {e["name"]: e["element"] for e in extra["catalogue"]} | {SETTINGS: "settings"}
    said = {f["name"]: f["confidence"] for f in d["effects"]}
    rivals = {name for c in d["classes"] for member in c["members"] for name in member}
    grouped: dict[str, list[dict[str, Any]]] = {e: [] for e in ELEMENTS}
    for name, p in d["probability"].items():
        word = said.get(name, "in a class" if name in rivals else "")
        row = {"name": name, "p": p, "at": place(p), "word": word}
        grouped.setdefault(known.get(name, "other"), []).append(row)
    return [(element, sorted(rows, key=lambda r: -r["p"])) for element, rows in grouped.items() if rows]


def place(p: float) -> float:
    """Place of a probability on a bar of log odds from 0.0001 (0) to 0.9999 (100)."""
    clipped = min(max(p, 1e-4), 1 - 1e-4)
    return 50 + 12.5 * log10(clipped / (1 - clipped))


def _limit(key: str, v: Json) -> tuple[str, str, str, str]:
    """Effect, parameter, size and unit of a limit."""
    effect, parameter, size = key.split(".")[0], v["parameter"], v["five_sigma"]
    if size is None or not v["reachable"]:
        return effect, parameter, INVISIBLE, ""
    factor, unit = readable(v["unit"], size)
    return effect, parameter, short(factor * size), unit


def _fitted(d: Json, extra: Json) -> list[tuple[str, str, str, str, float | None]]:
    """What is fitted in every hypothesis: its words, how far it is off, how well it was stated, the unit, and sigma."""
    rows = []
    for name, pull in d["pulls"].items():
        prior = extra.get("priors", {}).get(name)
        off, stated, unit = "–", "–", ""
        if prior is not None and pull is not None:
            factor, unit = readable(prior["unit"], prior["sigma"])
            off, stated = rounded(factor * pull * prior["sigma"], factor * prior["sigma"]).split(" ± ")
        rows.append((words_of(name), minus(off), stated, unit, pull))
    return rows


def _profiles(extra: Json) -> str:
    """How many profiles a dot of the residuals' drawings is the mean of; empty where the folder does not say."""
    per = [x["profiles"] / len(x["s_mm"]) for x in extra["exposures"] if x.get("profiles")]
    low, high = (f"{x:.0f}" for x in (min(per), max(per))) if per else ("", "")
    return low if low == high else f"{low} to {high}"


def validation(v: Json, extra: Json) -> dict[str, Any]:
    """What the page says of a validation."""
    rows = v["exposures"]
    agree = [x["exposure"] for x in rows if x["agrees"]]
    against = [x["exposure"] for x in rows if x["agrees"] is False]
    open_ = [x["exposure"] for x in rows if x["agrees"] is None]
    if against:
        headline = f"The vector model disagrees with {_of(against, rows)}: {listed(against)}."
    elif agree:
        headline = f"The vector model agrees with {_of(agree, rows)}."
    else:
        headline = "These recordings cannot tell whether the vector model agrees."
    if open_ and (agree or against):
        headline += f" Of {listed(open_)} it cannot be told."
    return {
        "headline": headline,
        "agrees": {True: "✓ agrees", False: "✗ disagrees", None: "cannot tell"},
        "pulls": list(dict.fromkeys(name for x in rows for name in x["pulls"])),
        "departures": {x["exposure"]: x.get("departures", {}) for x in extra["exposures"]},
        "units": {n: s["unit"] for x in extra["exposures"] for n, s in x.get("departures", {}).items()},
        "profiles": _profiles(extra),
    }


def _of(some: Sequence[str], rows: Sequence[Json]) -> str:
    if len(some) == len(rows):
        return "the trace" if len(rows) == 1 else "both traces" if len(rows) == 2 else f"all {len(rows)} traces"
    return f"{len(some)} of {len(rows)} traces"


def minus(text: str) -> str:
    """With a true minus sign."""
    return text.replace("-", "−")


def short(x: float | None) -> str:
    """Three digits, plain between 1e-4 and 1e5."""
    if x is None:
        return "–"
    if x == 0:
        return "0"
    return minus(f"{x:.0f}" if 1e3 <= abs(x) < 1e5 else f"{x:#.3g}".removesuffix("."))


def chance(p: float) -> str:
    """A probability in two digits, or as far as it is from certainty; never 0 or 1."""
    return percent(p) if p >= 0.9 or p < 1e-4 else f"{100 * p:.2g} %"


def p_value(p: float) -> str:
    """A probability under a hypothesis, three digits after the point."""
    return f"{p:.3f}" if p >= 0.0005 else "< 0.001"


def interval(i: Json) -> str:
    """``1.79 (1.42 … 2.18)``, or that the arc does not determine it."""
    if i["value"] is None or not i["determined"]:
        return "not determined"
    if isinstance(i["value"], str):
        return i["value"]
    value, low, high = ("∞" if x is None else minus(f"{x:.4g}") for x in (i["value"], i["low95"], i["high95"]))
    return f"{value} ({low} … {high})"


def ended(sentence: str) -> str:
    """With a full stop."""
    return sentence if sentence.endswith((".", "!", "?")) else sentence + "."


def _size(s: Json, unit: bool = True) -> str:
    return minus(rounded(s["value"], float("nan") if s["sigma"] is None else s["sigma"], s["unit"] if unit else ""))


def _separation(s: Json) -> str:
    x = s["separation_sigma"]
    return "" if x is None else f"{x:.1f} sigma" if x < 20 else f"{x:.0f} sigma"


FILTERS: Mapping[str, Callable[..., Any]] = {
    "confidence": CONFIDENCE.__getitem__,
    "percent": percent,
    "together": together,
    "chance": chance,
    "size": _size,
    "words": words_of,
    "short": short,
    "p_value": p_value,
    "interval": interval,
    "separation": _separation,
    "minus": minus,
    "listed": listed,
    "ended": ended,
}
