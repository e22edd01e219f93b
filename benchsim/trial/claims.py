"""What a diagnosis claims, held against what was concealed: the cause."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from benchsim.diagnosis import settings


def allowed(named: list[str], classes: list[list[list[str]]]) -> list[set[str]]:
    """Every set of effects that a diagnosis allows: its effects plus one member of each class."""
    out = [set(named)]
    for members in classes:
        out = [c | set(m) for c in out for m in members]
    return out


def nameable(truth: Mapping[str, Any], withheld: list[str]) -> set[str]:
    """What the judge could have named rightly: effects, or that settings are further off than stated."""
    if truth["kind"] == "clean-settings":
        return {settings.NAME}
    return set() if truth["zero"] else set(truth["effects"]) - set(withheld)


def outside(truth: Mapping[str, Any]) -> bool:
    """Whether something is concealed that the judge's catalogue lacks."""
    return not truth["zero"] and truth["kind"] in ("removed", "stranger")


def cause(truth: Mapping[str, Any], diagnosis: Mapping[str, Any] | None, withheld: list[str]) -> tuple[str, str]:
    """Outcome and what it rests on.

    Returns
    -------
    outcome : {"right", "class", "missed", "wrong", ""}
        right: named exactly; nothing said where nothing is; located rightly where nothing could be named. class: left
        open, the truth (nothing, where nothing is) among what is. missed: less than what is there. wrong: a name or
        place that is not there. "": no verdict.
    note : str
    """
    if diagnosis is None:
        return "", "no verdict"
    true = nameable(truth, withheld)
    named = [e["name"] for e in diagnosis["effects"]]
    classes = [c["members"] for c in diagnosis["classes"]]
    sets = allowed(named, classes)
    verdict, where = diagnosis["verdict"], diagnosis["location"]
    false = sorted(set(named) - true)
    if false:
        return "wrong", f"{' and '.join(false)} {'is' if len(false) == 1 else 'are'} not there"
    if outside(truth):
        if classes and set() in sets:
            return "missed", "perhaps nothing, or alternatives of which none is there"
        if classes:
            return "wrong", "alternatives of which none is there"
        if where is not None and where["claimed"]:
            right = where["element"] == truth["element"]
            return ("right", "located") if right else ("wrong", f"it is in the {truth['element']}")
        return "missed", "seen, but not where" if verdict != "nothing-missing" else "not seen"
    if verdict == "nothing-missing" and not true:
        return "right", ""
    if not true and not (classes and true in sets):
        return "wrong", "nothing is there"
    if verdict == "named" and set(named) == true:
        return "right", ""
    if true in sets and classes:
        return "class", f"one of {sum(len(m) for m in classes)}"
    if any(held and held < true for held in sets):
        return "missed", "in part"
    if classes:
        return "wrong", "a class without it"
    if set(named) == true:
        return "class", "named, and more is suspected"
    return "missed", "seen, but without a name" if verdict != "nothing-missing" else "not seen"


def lone_wrong(truth: Mapping[str, Any], diagnosis: Mapping[str, Any], withheld: list[str]) -> bool:
    """Whether anything is named that is not there."""
    return bool({e["name"] for e in diagnosis["effects"]} - nameable(truth, withheld))


def holds(truth: Mapping[str, Any], diagnosis: Mapping[str, Any], withheld: list[str]) -> bool:
    """Whether the truth is among what the diagnosis allows."""
    named = [e["name"] for e in diagnosis["effects"]]
    return nameable(truth, withheld) in allowed(named, [c["members"] for c in diagnosis["classes"]])


def exact(truth: Mapping[str, Any], diagnosis: Mapping[str, Any], withheld: list[str]) -> bool:
    """Named exactly, and nothing left."""
    named = {e["name"] for e in diagnosis["effects"]}
    return diagnosis["verdict"] == "named" and named == nameable(truth, withheld)


def shared(truth: Mapping[str, Any], diagnosis: Mapping[str, Any]) -> bool:
    """Whether all that is named belongs to the truth and to its nearest rival: no claim on what tells them apart."""
    return {e["name"] for e in diagnosis["effects"]} <= set(truth["effects"]) & set(truth["rival"]["effects"])


def concealed_in_words(truth: Mapping[str, Any]) -> str:
    """For tables: ``screen-bow + canting``; what could not be named in brackets."""
    if truth["kind"] == "clean-settings":
        return settings.NAME
    if truth["zero"] or truth["kind"].startswith("clean"):
        return "nothing"
    if truth["stranger"]:
        return f"({truth['stranger']})"
    names = " + ".join(sorted(truth["effects"]))
    return f"({names})" if truth["kind"] == "removed" else names


def said_in_words(diagnosis: Mapping[str, Any] | None) -> str:
    """For tables: ``screen-bow``, ``{screen-bow | grid-scale}``, ``in the screen``, ``nothing``."""
    if diagnosis is None:
        return "no verdict"
    parts = sorted(e["name"] for e in diagnosis["effects"])
    parts += ["{" + " | ".join("+".join(m) for m in c["members"]) + "}" for c in diagnosis["classes"]]
    where = diagnosis["location"]
    if diagnosis["verdict"] == "located" and where is not None:
        parts.append(f"in the {where['element']}")
    if diagnosis["verdict"] == "unexplained":
        parts.append("unexplained")
    return " + ".join(parts) or "nothing"
