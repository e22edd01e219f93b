"""What was said of what was concealed, in words and counts, and whether probabilities are what they say."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable

import numpy as np
from study_score import CATALOGUED, OUTSIDE, Case, told

from benchsim.trial import claims
from benchsim.trial.rates import wilson

EDGES = (0, 0.001, 0.01, 0.05, 0.2, 0.5, 0.8, 0.95, 0.99, 0.999, 1.0000001)


def confusion(cases: Iterable[Case]) -> str:
    """What is concealed against what was said of it, apart for what the catalogue holds, what it lacks, and nothing."""
    groups: dict[str, dict[str, Counter[str]]] = {}
    for c in cases:
        key = c["row"]
        held = "in the catalogue" if key in CATALOGUED else "not in the catalogue"
        group = f"concealed, {held}" if key in (*CATALOGUED, *OUTSIDE) else "nothing concealed"
        groups.setdefault(group, {}).setdefault(concealed(c), Counter())[words(c)] += 1
    lines = []
    for group in sorted(groups):
        lines.append(f"{group}:")
        for true in sorted(groups[group]):
            counts = groups[group][true]
            line = ", ".join(f"{text} {n}" for text, n in counts.most_common())
            lines.append(f"  {true:<44}{sum(counts.values()):>4}: {line}")
    return "\n".join(lines)


def concealed(case: Case) -> str:
    """What a case conceals: ``screen-bow + canting``, ``dent``, ``nothing (clean-settings)``."""
    if "truth" not in case:
        return f"not known ({case['row']})"
    truth = case["truth"]
    name = truth["stranger"] or " + ".join(sorted(truth["effects"])) or "nothing"
    return name if case["row"] in (*CATALOGUED, "stranger", "clean") else f"{name} ({case['row']})"


def words(case: Case) -> str:
    """What was said of it: ``screen-bow``, ``{screen-bow | grid-scale}``, ``in the screen``, ``nothing``."""
    if "verdict" not in case:
        return "no verdict"
    text = claims.said_in_words(
        {
            "effects": [{"name": name} for name in case["named"]],
            "classes": [{"members": members} for members in case["classes"]],
            "location": case["location"],
            "verdict": case["verdict"],
        }
    )
    return text if text != "nothing" or case["verdict"] == "nothing-missing" else f"{case['verdict']}, without a name"


def reliability(cases: Iterable[Case]) -> str:
    """P(present) as stated against how often the effect is there."""
    stated, there = [], []
    for c in told(list(cases)):
        if c["row"] in OUTSIDE:
            continue
        for name, p in c["probability"].items():
            stated.append(p)
            there.append(name in c["truth"]["effects"])
    p, t = np.array(stated), np.array(there, bool)
    lines = ["P(present) stated      n    there"]
    for low, high in itertools.pairwise(EDGES):
        inside = (p >= low) & (p < high)
        if inside.any():
            k, n = int(t[inside].sum()), int(inside.sum())
            a, b = wilson(k, n, 1.96)
            lines.append(
                f"{low:6.3f} - {min(high, 1):5.3f} {n:>8} {k / n:8.4f} ({a:.4f}-{b:.4f})  mean P {p[inside].mean():.4f}"
            )
    return "\n".join(lines)
