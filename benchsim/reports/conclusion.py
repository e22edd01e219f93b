"""What a diagnosis concludes, in sentences: the one place where they are made, for the terminal and for the page.

They are made from ``diagnosis.json`` alone, so that whatever was kept can be told again.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from benchsim.reports.vocabulary import BENCH, Vocabulary

Json = Mapping[str, Any]

SETTINGS = "setting-errors"

CONFIDENCE = {
    "named": "named",
    "probable": "probable, not certain",
    "provisional": "provisional: it predicts what was left out, its name is not certain",
}
"""Confidence of an effect → how it is told."""


def listed(names: Sequence[str]) -> str:
    """``a``, ``a and b``, ``a, b and c``."""
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def headline(d: Json, words: Vocabulary = BENCH) -> str:
    """The verdict in one or two sentences.

    Parameters
    ----------
    d : mapping
        ``diagnosis.json``.
    words : Vocabulary
    """
    found = [f["name"] for f in d["effects"] if f["name"] != SETTINGS]
    sure = [f["name"] for f in d["effects"] if f["name"] in found and f["confidence"] == "named"]
    settings = next((f for f in d["effects"] if f["name"] == SETTINGS), None)
    parts = []
    match d["verdict"]:
        case "nothing-missing":
            parts.append(f"Nothing is missing that these {words.recordings} could show.")
        case "named" if not found:
            parts.append("Nothing but the settings explains the difference.")
        case "named" if sure == found:
            count = "they have names" if len(found) > 1 else "it has a name"
            parts.append(f"Something is missing from the simulation, and {count}: {listed(found)}.")
        case "named":
            parts.append(f"Something is missing from the simulation: {_each(d, found)}.")
        case "class" if not found and d["classes"] and all([] in c["members"] for c in d["classes"]):
            choice = d["classes"][0]["members"]
            others = " or ".join(" with ".join(m) for m in choice if m)
            parts.append(f"These {words.recordings} cannot tell whether something is missing: nothing, or {others}.")
        case "class":
            parts.append(
                f"Something is missing from the simulation, and these {words.recordings} leave a choice of what it is."
            )
            parts += [f"In any case: {_each(d, found)}."] if found else []
        case "located":
            element = d["location"]["element"]
            if found:
                parts.append(f"Something is missing from the simulation: {_each(d, found)}.")
                parts.append(f"Beside it, what has no name in the catalogue sits in the {element}.")
            else:
                parts.append(f"Something is missing in the {element}, and no effect of the catalogue explains it.")
        case _:
            if found:
                parts.append(f"Something is missing from the simulation: {_each(d, found)}.")
                parts.append("What is left beside it has neither a name nor a place.")
            else:
                parts.append("Something is missing from the simulation; neither its name nor its place can be told.")
    if settings is not None:
        size = settings["parameters"]["scale"]
        parts.append(
            f"The settings were off by {size['value']:.1f} ± {size['sigma']:.1f} times what the file states as their "
            f"uncertainty ({settings['confidence']})."
        )
    return " ".join(parts)


def _each(d: Json, names: Sequence[str]) -> str:
    """Names with their confidence where it is not "named"."""
    said = {f["name"]: f["confidence"] for f in d["effects"]}
    return listed([n if said[n] == "named" else f"{n} ({said[n]})" for n in names])


def leftover(d: Json, words: Vocabulary = BENCH) -> str:
    """What is left of each family without changing the verdict, with its size; empty where nothing is."""
    rows = []
    for x in d.get("left", ()):
        name, unit = words.kinds.get(x["family"], (x["family"], ""))
        if x["family"] == "pulls":
            rows.append("something that all settings share, in their errors")
        elif x["rms_mm"] is not None and unit != "mm":
            rows.append(f"{x['rms_mm']:.2g} mm of something smooth in the {name}")
        elif x["rms"] is not None:
            rows.append(f"{x['rms']:.2g} {unit} of something smooth in the {name}".replace("  ", " "))
        else:
            rows.append(f"something smooth in the {name}")
    return f"Left: {listed(rows)}." if rows else ""


_LONE = re.compile(r"(.+): mark (.+) lies off its neighbours and is left out")


def gathered(remarks: Sequence[str]) -> list[str]:
    """Remarks with those on single marks as one, in the place of the first."""
    marks: dict[str, list[str]] = {}
    out: list[str] = []
    for remark in remarks:
        lone = _LONE.fullmatch(remark)
        if lone is None:
            out.append(remark)
            continue
        if not marks:
            at = len(out)
        marks.setdefault(lone[1], []).append(lone[2])
    if marks:
        where = "; ".join(f"{', '.join(names)} in {picture}" for picture, names in marks.items())
        count = sum(map(len, marks.values()))
        start = "1 mark lies off its" if count == 1 else f"{count} marks lie off their"
        cause = "a fault of the board would show in every one of three or more photographs"
        out.insert(at, f"{start} neighbours, taken as mismeasured ({cause}) and left out: {where}.")
    return out


def removed(part: float) -> str:
    """A part of a misfit as words have it: noise can make it more than all, and what is left may still show."""
    if part >= 1:
        return "all"
    return "more than 99.9 %" if part > 0.9995 else f"{100 * part:.1f} %"


OVERSTATED = 3.0
"""Sigma below zero at which an excess χ² of a tenth of what was there before leaves no gain to be told."""


def below_zero(after: float, sigma: float, words: Vocabulary) -> str:
    """A clause on an excess χ² that noise alone would hardly make negative; empty where it would."""
    if after > -2 * sigma:
        return ""
    return f" (below zero: the noise was estimated larger than that of the {words.setting}s left out)"


def gained(before: float, after: float, sigma: float, words: Vocabulary) -> str:
    """What prediction gained: ``falls from 8891 to 137 (± 20): 98.5 % of it is removed.``"""
    text = f"{'falls' if after < before else 'rises'} from {before:.0f} to {after:.0f} (± {sigma:.0f})"
    if after >= before:
        return text + f": what was found predicts {words.setting}s left out no better."
    if after < -OVERSTATED * sigma and -after > before / 10:
        return text + "; below zero by more than its scatter: the noise is overstated, and no gain can be given."
    if before > 2 * sigma:
        return text + f": {removed(1 - after / before)} of it is removed{below_zero(after, sigma, words)}."
    return text + "; before, it was within its scatter, so that these recordings show no gain."
