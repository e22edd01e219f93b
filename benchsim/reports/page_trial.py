"""What the page of a concealed trial shows, and the form of the score that it takes.

The score is one mapping (the trial's ``score.json``). Every number in it is finished: intervals are 95 % (Wilson),
labels are ready to read.

::

    {"format": "benchsim-score/1",
     "title": "2026-a",
     "headline": "57 of 60 concealed causes …",   # the verdict on the trial in a sentence
     "cases": [{"case": "c017",
                "kind": "one effect",              # what sort of case it was
                "concealed": "screen-bow",         # in words; "nothing" for a clean case
                "said": "named: screen-bow",       # the verdict in words
                "cause": "right",                  # right | class | missed | wrong | "" where it does not apply
                "size": "right",                   # right | wrong | ""
                "prediction": "right",             # right | wrong | ""
                "snr": 14.2,                       # or null
                "rival_sigma": 6.1,                # or null
                "note": ""}],                      # e.g. "judged twice"
     "confusion": {"concealed": ["screen-bow", …], # rows
                   "said": ["screen-bow", …],      # columns
                   "counts": [[5, 0, …], …]},
     "reliability": [{"stated": 0.97,              # mean probability in the bin
                      "right": 29, "of": 30, "low95": 0.83, "high95": 0.99}],
     "power": [{"effect": "screen-bow",
                "points": [{"snr": 9.1, "named": 5, "of": 6, "low95": 0.44, "high95": 0.97}]}],
     "bars": [{"quantity": "single effect, SNR ≥ 8", "bar": "≥ 95 %", "value": "96 %",
               "interval": "88 … 99 %", "n": 60, "state": "met"}],    # met | missed | open
     "ledger": [{"line": 1, "time": "2026-11-21T14:00:00+00:00", "what": "commitment c001", "hash": "9f2c…"}],
     "verified": true,                             # or false, or null where it was not checked
     "leak": {"clue": "001.png size", "auc": 0.53, "p_value": 0.4, "at_chance": true},   # values null: too few cases
     "withheld": ["coma", …],                      # effects taken out of the judge's catalogue
     "certificate": {"passed": true},              # of the generator of truths
     "commands": ["benchsim trial run --cases 60 --seed 7"]}

``format``, ``title``, ``headline`` and ``cases`` must be there; what else is left out, or empty, is not shown.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from benchsim.reports import page_plots

FORMAT = "benchsim-score/1"

WIDE = 12
"""Columns up to which the confusion matrix is shown at once; beyond, a list of who was said to be whom reads better."""

OUTCOMES = {"right": "✓ right", "class": "◐ class", "missed": "○ missed", "wrong": "✗ wrong", "": "–"}
"""An outcome in a sign and a word: never told by colour alone."""


def shown(score: Mapping[str, Any]) -> dict[str, Any]:
    """What the template is given: the score, its drawings, and how many cases came out how.

    Parameters
    ----------
    score : mapping
        In the form above.
    """
    nothing: dict[str, Any] = {"concealed": [], "said": [], "counts": []}
    absent = {"confusion": nothing, "verified": None, "leak": None, "certificate": None}
    lists: dict[str, Any] = {key: [] for key in ("reliability", "power", "bars", "ledger", "commands", "withheld")}
    score = {**absent, **lists, **score}
    snr = [p["snr"] for e in score["power"] for p in e["points"] if p["of"]]
    span = (min([3.0, *snr]) / 1.1, max([30.0, *snr]) * 1.1)
    confusion = score["confusion"]
    return {
        "score": score,
        "outcomes": OUTCOMES,
        "counted": {
            part: Counter(case.get(part, "") for case in score["cases"]) for part in ("cause", "size", "prediction")
        },
        "reliability": page_plots.reliability(score["reliability"]) if score["reliability"] else None,
        "power": [page_plots.power(e["effect"], e["points"], span) for e in score["power"]],
        "effects": [e["effect"] for e in score["power"]],
        "confusion": confusion,
        "wide": len(confusion["said"]) > WIDE,
        "most": max((n for row in confusion["counts"] for n in row), default=0) or 1,
        "rows": [
            {"name": name, "counts": counts, "total": sum(counts), "said": _most_first(confusion["said"], counts)}
            for name, counts in zip(confusion["concealed"], confusion["counts"], strict=True)
        ],
    }


def _most_first(names: Sequence[str], counts: Sequence[int]) -> list[tuple[str, int]]:
    """What was said at all, the most frequent first."""
    said = [(name, n) for name, n in zip(names, counts, strict=True) if n]
    return sorted(said, key=lambda pair: -pair[1])
