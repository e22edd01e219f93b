"""Rates of `diagnosis_study.py` with their binomial intervals, held against the bars."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from benchsim.trial.rates import judged, wilson

Case = dict[str, Any]


def claims(case: Case) -> list[set[str]]:
    """Every set of effects that a diagnosis allows: its effects plus one member of each class."""
    out = [set(case["named"])]
    for members in case["classes"]:
        out = [c | set(m) for c in out for m in members]
    return out


def exact(case: Case) -> bool:
    """Named, nothing else, and nothing left."""
    return case["verdict"] == "named" and set(case["named"]) == set(case["truth"]["effects"])


def holds(case: Case) -> bool:
    """Named exactly, or a class that holds the truth."""
    return set(case["truth"]["effects"]) in claims(case)


def lone_wrong(case: Case) -> bool:
    """A name that is not in the truth."""
    return bool(set(case["named"]) - set(case["truth"]["effects"]))


def row(title: str, cases: Sequence[Case], hit: Callable[[Case], bool], bar: float, at_least: bool = True) -> str:
    """One line of the table."""
    n, k = len(cases), sum(hit(c) for c in cases)
    low, high = wilson(k, n, 1.96)
    sign = "≥" if at_least else "≤"
    rate = k / n if n else float("nan")
    return (
        f"{title:<66}{k:>5}/{n:<5}{100 * rate:6.1f} %  ({100 * low:.1f}–{100 * high:.1f})  {sign} {100 * bar:g} %  "
        f"{judged(k, n, bar, at_least)}"
    )


def table(cases: Iterable[Case]) -> str:
    """All bars that the cases can speak about."""
    every = [c for c in cases if "verdict" in c]
    of: dict[str, list[Case]] = {}
    for c in every:
        of.setdefault(c["row"], []).append(c)
    lines = []

    def weakest(c: Case) -> float:
        return min(c["snr"].values(), default=0.0)

    def near(c: Case) -> float:
        return float(c["rival"][1])

    for name, key, bars in (
        ("single effect, six settings", "single", ((8, 0.95), (12, 0.99))),
        ("pairs, six settings", "pair", ((8, 0.90), (12, 0.97))),
        ("single effect, two settings of Fig. 7", "fig7", ((8, 0.95), (12, 0.99))),
    ):
        group = of.get(key, [])
        for snr, bar in bars:
            chosen = [c for c in group if weakest(c) >= snr and near(c) >= 5]
            lines.append(row(f"{name}: SNR ≥ {snr}, rival ≥ 5 σ: exactly named", chosen, exact, bar))
        between = [c for c in group if weakest(c) >= 8 and 3 <= near(c) < 5]
        lines.append(row(f"{name}: rival at 3-5 σ: named or a class that holds it", between, holds, 0.95))
        below = [c for c in group if weakest(c) >= 8 and near(c) < 3]
        lines.append(
            row(
                f"{name}: rival below 3 σ: a class that holds it, no lone name",
                below,
                lambda c: holds(c) and c["verdict"] != "named",
                0.95,
            )
        )
        # Where one of the two does it all by itself, a class of single effects is what the data allow.
        two = [c for c in below if c.get("alone", math.inf) >= 3]
        if len(two) < len(below):
            lines.append(row("    of these more than 3 σ from either effect alone", two, holds, 0.95))
        sizes = [len(m) for c in below for m in c["classes"]]
        if sizes:
            lines.append(f"    mean size of those classes {np.mean(sizes):.2f}")
        weak = [c for c in group if weakest(c) < 8]
        lines.append(row(f"{name}: weakest SNR < 8: a wrong lone name", weak, lone_wrong, 0.02, at_least=False))
        lines.append(row(f"{name}: all: a wrong lone name", group, lone_wrong, 0.02, at_least=False))
    for key, title, bar in (
        ("clean", "clean", 0.02),
        ("clean-noise", "clean, σ × 1.3", 0.05),
        ("clean-settings", "clean, setting errors × 3", 0.05),
        ("clean-correlated", "clean, correlated noise", 0.05),
    ):
        lines.append(
            row(
                f"{title}: anything named",
                of.get(key, []),
                lambda c: bool(c["named"] or c["classes"]),
                bar,
                at_least=False,
            )
        )
        lines.append(
            row(
                f"{title}: not 'nothing-missing'",
                of.get(key, []),
                lambda c: c["verdict"] != "nothing-missing",
                bar,
                at_least=False,
            )
        )
    outside = [*of.get("removed", []), *of.get("stranger", [])]
    for title, low, high, bar in (("SNR < 20", 0, 20, 0.10), ("SNR ≥ 20", 20, math.inf, 0.03)):
        chosen = [c for c in outside if low <= weakest(c) < high]
        lines.append(
            row(f"not in the catalogue, {title}: a wrong name", chosen, lambda c: bool(c["named"]), bar, at_least=False)
        )
        apart = [c for c in chosen if near(c) >= 5]
        lines.append(
            row("    of these with no rival within 5 σ", apart, lambda c: bool(c["named"]), bar, at_least=False)
        )
    claimed = [c for c in outside if c["location"] and c["location"]["claimed"]]
    lines.append(
        row("location, when claimed: right", claimed, lambda c: c["location"]["element"] == c["truth_element"], 0.90)
    )
    for title, low, high, bar in (("12-20", 12, 20, 0.5), ("> 20", 20, math.inf, 0.75)):
        chosen = [c for c in outside if low <= weakest(c) < high]
        lines.append(
            row(
                f"location, SNR {title}: claimed",
                chosen,
                lambda c: bool(c["location"] and c["location"]["claimed"]),
                bar,
            )
        )
    pulls = np.array([x for c in every if exact(c) for x in c["parameter_pulls"]])
    if len(pulls):
        far = int((np.abs(pulls) > 3).sum())
        lines.append(f"parameters of what was exactly named: pull std {pulls.std():.3f} (0.9-1.15), n = {len(pulls)}")
        lines.append(
            f"    beyond 3 σ {far}/{len(pulls)} = {100 * far / len(pulls):.1f} % (≤ 1.5 %), mean {pulls.mean():+.3f}"
        )
    for title, wanted, bar in (
        ("named", [c for c in every if exact(c) and c["held_out"]], 0.95),
        ("law", [c for c in every if c["law"] and c["held_out"]], 0.8),
    ):
        seen = [c["held_out"] for c in wanted if c["held_out"]["before"] >= 60 * math.sqrt(2 * c["held_out"]["data"])]
        before, after = (sum(h[k] for h in (c["held_out"] for c in wanted)) for k in ("before", "after"))
        if before > 0:
            each = [1 - h["after"] / h["before"] for h in seen]
            lines.append(
                f"held-out excess χ² removed, {title}: pooled {1 - after / before:.3f} (≥ {bar}), n = {len(wanted)}; "
                f"{sum(e >= bar for e in each)}/{len(each)} of those with much to remove"
            )
    fresh = [c for c in every if c.get("fresh") is not None]
    lines.append(
        row(
            "amended.toml on a fresh recording: nothing-missing", fresh, lambda c: c["fresh"] == "nothing-missing", 0.95
        )
    )
    return "\n".join(lines)


def confusion(cases: Iterable[Case]) -> str:
    """Concealed single effects against what was said of them."""
    by: dict[str, Counter[str]] = {}
    for c in cases:
        if "verdict" not in c or len(c["truth"]["effects"]) > 1:
            continue
        true = c["truth"]["stranger"] or next(iter(c["truth"]["effects"]), "nothing")
        if c["row"] == "removed":
            true += " (removed)"
        said = " + ".join(sorted(c["named"]))
        if c["classes"]:
            said = " ".join(filter(None, [said, "{" + " | ".join("+".join(m) for m in c["classes"][0]) + "}"]))
        by.setdefault(true, Counter())[said or c["verdict"]] += 1
    lines = []
    for true in sorted(by):
        said = ", ".join(f"{what} {n}" for what, n in by[true].most_common(6))
        lines.append(f"{true:<34}{sum(by[true].values()):>4}: {said}")
    return "\n".join(lines)


def reliability(cases: Iterable[Case]) -> str:
    """P(present) as stated against how often the effect is there."""
    stated, there = [], []
    for c in cases:
        if "verdict" not in c or c["row"] in ("removed", "stranger"):
            continue
        for name, p in c["probability"].items():
            stated.append(p)
            there.append(name in c["truth"]["effects"])
    p, t = np.array(stated), np.array(there)
    lines = ["P(present) stated      n    there"]
    edges = [0, 0.001, 0.01, 0.05, 0.2, 0.5, 0.8, 0.95, 0.99, 0.999, 1.0000001]
    for low, high in itertools.pairwise(edges):
        inside = (p >= low) & (p < high)
        if inside.any():
            k, n = int(t[inside].sum()), int(inside.sum())
            a, b = wilson(k, n, 1.96)
            lines.append(
                f"{low:6.3f} - {min(high, 1):5.3f} {n:>8} {k / n:8.4f} ({a:.4f}-{b:.4f})  mean P {p[inside].mean():.4f}"
            )
    return "\n".join(lines)
