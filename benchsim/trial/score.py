"""Truths against verdicts: cause, size and prediction, each for itself, per case and as rates."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from benchsim.trial import claims
from benchsim.trial.prediction import much
from benchsim.trial.rates import Rate, wilson

Plain = Mapping[str, Any]

SIZE_SIGMA = 3.0
"""A size is right if its parameters lie within so many of their sigma: by chance 0.3 % of single ones do not."""

REMOVED = 0.95
"""Share of left-out settings' excess χ² that a right prediction removes; `LAW_REMOVED` for a law without a name."""

LAW_REMOVED = 0.8

SNR_EDGES = (0.0, 4.0, 8.0, 12.0, 20.0, 40.0, math.inf)
STATED_EDGES = (0, 0.001, 0.01, 0.05, 0.2, 0.5, 0.8, 0.95, 0.99, 0.999, 1.0000001)

KIND_WORDS = {
    "single": "one effect",
    "pair": "two effects",
    "below-another": "an effect hidden below another",
    "below-the-settings": "an effect smaller than the setting errors",
    "removed": "an effect that the catalogue lacks",
    "stranger": "a cause without a name",
    "clean": "nothing",
    "clean-speckle": "nothing, with speckle",
    "clean-settings": "nothing, with setting errors thrice those stated",
}


def scored(
    truth: Plain, diagnosis: Plain | None, withheld: Sequence[str], runs: int, kept_back: Plain | None = None
) -> dict[str, Any]:
    """One case in the form of ``score.json``.

    Parameters
    ----------
    truth : mapping
        Of `cases.make`.
    diagnosis : mapping or None
        ``diagnosis.json``; None where there is no verdict.
    withheld : sequence of str
    runs : int
        How often it was judged.
    kept_back : mapping or None
        What it predicts of settings that the judge never saw, see `prediction.of_case`.
    """
    lacks = list(withheld)
    outcome, note = claims.cause(truth, diagnosis, lacks)
    sizes = sizes_of(truth, diagnosis)
    prediction = judged_prediction(diagnosis, kept_back)
    notes = [note, "judged twice" if runs == 2 else f"judged {runs} times" if runs > 2 else ""]
    snr = list(truth["snr"].values())
    rival = truth["rival"]
    return {
        "case": truth["case"],
        "kind": KIND_WORDS[truth["kind"]] + (", of zero size" if truth["zero"] else ""),
        "concealed": claims.concealed_in_words(truth),
        "said": claims.said_in_words(diagnosis),
        "cause": outcome,
        "size": "" if not sizes else "right" if all(abs(s["pull"]) <= SIZE_SIGMA for s in sizes) else "wrong",
        "prediction": "" if prediction is None else prediction["outcome"],
        "snr": min(snr) if snr and not truth["zero"] else None,
        "rival_sigma": None if rival is None else rival["separation_sigma"],
        "note": "; ".join(n for n in notes if n),
        "design": truth["design"],
        "row": truth["kind"],
        "sizes": sizes,
        "kept_back": prediction,
        "held_out": None if diagnosis is None else judged_prediction(diagnosis, diagnosis["fit"]["held_out"]),
    }


def sizes_of(truth: Plain, diagnosis: Plain | None) -> list[dict[str, Any]]:
    """Every amplitude that was named rightly and whose truth is known: estimate, truth and (estimate − truth)/σ."""
    out = []
    for e in [] if diagnosis is None or truth["zero"] else diagnosis["effects"]:
        for name, size in e["parameters"].items():
            true = truth["effects"].get(e["name"], {}).get(name)
            if true is not None and size["value"] is not None and size["sigma"]:
                out.append(
                    {
                        "effect": e["name"],
                        "parameter": name,
                        "unit": size["unit"],
                        "truth": true,
                        "estimate": size["value"],
                        "sigma": size["sigma"],
                        "pull": (size["value"] - true) / size["sigma"],
                    }
                )
    return out


def judged_prediction(diagnosis: Plain | None, excess: Plain | None) -> dict[str, Any] | None:
    """Excess χ² before and after what was found is put in; None where nothing was, or none was left out.

    A case alone is judged only where there is much to remove, see `prediction.much`.
    """
    if diagnosis is None or excess is None:
        return None
    if not diagnosis["effects"] and not diagnosis["classes"] and diagnosis["law"] is None:
        return None
    before, after, data = excess["excess_chi2_before"], excess["excess_chi2_after"], excess["data"]
    if before is None or after is None:
        return None
    kind, bar = ("named", REMOVED) if diagnosis["law"] is None else ("law", LAW_REMOVED)
    outcome = "" if not much(data, before) else "right" if 1 - after / before >= bar else "wrong"
    return {"before": before, "after": after, "data": data, "kind": kind, "outcome": outcome}


def bars(
    cases: Sequence[tuple[Plain, Plain | None]], withheld: Sequence[str], kept_back: Mapping[str, Plain | None]
) -> list[dict[str, Any]]:
    """The bars of the study, each with its rate, interval and standing.

    Parameters
    ----------
    cases : sequence of (truth, diagnosis)
    withheld : sequence of str
    kept_back : mapping of case → what it predicts of settings that the judge never saw
    """
    lacks = list(withheld)
    every = [(t, d) for t, d in cases if d is not None]

    def of(*kinds: str, design: str | None = None) -> list[tuple[Plain, Plain | None]]:
        return [
            (t, d)
            for t, d in cases
            if t["kind"] in kinds and not t["zero"] and (design is None or t["design"] == design)
        ]

    def weakest(t: Plain) -> float:
        return min(t["snr"].values(), default=0.0)

    def near(t: Plain) -> float:
        return math.inf if t["rival"] is None else float(t["rival"]["separation_sigma"])

    def rate(
        quantity: str,
        chosen: Sequence[tuple[Plain, Plain | None]],
        hit: Callable[[Plain, Plain], bool],
        bar: float,
        at_least: bool = True,
    ) -> dict[str, Any]:
        # A case without a verdict was not found; nothing wrong was said of it either.
        told = [(t, d) for t, d in chosen if d is not None]
        return Rate(quantity, sum(hit(t, d) for t, d in told), len(chosen if at_least else told), bar, at_least).plain()

    def exact(t: Plain, d: Plain) -> bool:
        return claims.exact(t, d, lacks)

    def holds(t: Plain, d: Plain) -> bool:
        return claims.holds(t, d, lacks)

    def wrong(t: Plain, d: Plain) -> bool:
        return claims.lone_wrong(t, d, lacks)

    def said(t: Plain, d: Plain) -> bool:
        members = {e for c in d["classes"] for m in c["members"] for e in m}
        return wrong(t, d) or bool(members - claims.nameable(t, lacks))

    out = []
    singles, pairs = ("single", "below-the-settings"), ("pair", "below-another")
    for title, kinds, design, levels in (
        ("one effect, six settings", singles, "six", ((8, 0.95), (12, 0.99))),
        ("two effects, six settings", pairs, "six", ((8, 0.90), (12, 0.97))),
        ("two settings of Fig. 7", singles, "fig7", ((8, 0.95), (12, 0.99))),
    ):
        group = of(*kinds, design=design)
        for snr, bar in levels:
            chosen = [c for c in group if weakest(c[0]) >= snr and near(c[0]) >= 5]
            out.append(rate(f"{title}, SNR ≥ {snr}, rival ≥ 5 σ: exactly named", chosen, exact, bar))
        chosen = [c for c in group if weakest(c[0]) >= 8 and 3 <= near(c[0]) < 5]
        out.append(rate(f"{title}, rival at 3 to 5 σ: named, or a class that holds it", chosen, holds, 0.95))
        chosen = [c for c in group if weakest(c[0]) >= 8 and near(c[0]) < 3]
        out.append(
            rate(
                f"{title}, rival below 3 σ: a class that holds it",
                chosen,
                lambda t, d: holds(t, d) and d["verdict"] != "named",
                0.95,
            )
        )
    chosen = [c for c in of(*singles, *pairs) if near(c[0]) < 3]
    out.append(
        rate(
            "rival below 3 σ: a lone name that the rival does not share",
            chosen,
            lambda t, d: d["verdict"] == "named" and not d["classes"] and not claims.shared(t, d),
            0.0,
            False,
        )
    )
    named_effects = of(*singles, *pairs)
    out.append(rate("one or two effects: a name that is not there", named_effects, wrong, 0.02, False))
    for kind, title, bar in (
        ("clean", "nothing concealed: anything named", 0.02),
        ("clean-speckle", "nothing concealed, speckle: anything named", 0.05),
        ("clean-settings", "setting errors × 3: anything else named", 0.05),
    ):
        out.append(rate(title, of(kind), said, bar, False))
    out.append(rate("setting errors × 3: setting-errors, or a class that holds it", of("clean-settings"), holds, 0.9))
    zero = [c for c in cases if c[0]["zero"]]
    if zero:
        out.append(rate("amplitudes set to zero: anything named", zero, said, 0.02, False))
    for title, low, high, bar in (("SNR < 20", 0, 20, 0.10), ("SNR ≥ 20", 20, math.inf, 0.03)):
        chosen = [c for c in of("removed", "stranger") if low <= weakest(c[0]) < high]
        out.append(rate(f"not in the catalogue, {title}: a wrong name", chosen, wrong, bar, False))
    placed = [
        (t, d)
        for t, d in of("removed", "stranger")
        if d is not None and d["location"] is not None and d["location"]["claimed"]
    ]
    out.append(
        rate("location, when claimed: right", placed, lambda t, d: d["location"]["element"] == t["element"], 0.9)
    )
    for title, low, high, bar in (("12 to 20", 12, 20, 0.5), ("above 20", 20, math.inf, 0.75)):
        chosen = [c for c in of("removed", "stranger") if low <= weakest(c[0]) < high]
        out.append(
            rate(
                f"location, SNR {title}: claimed",
                chosen,
                lambda t, d: d["location"] is not None and bool(d["location"]["claimed"]),
                bar,
            )
        )
    out += _sizes_bars([s for t, d in every if exact(t, d) for s in sizes_of(t, d)])
    # The first share is of names that are right, as the bar has it; a law stands for what has no name.
    told = [(t, d) for t, d in every if (t["effects"] and exact(t, d)) or d["law"] is not None]
    for title, excess in (
        ("settings that the judge never saw", [kept_back.get(t["case"]) for t, _ in told]),
        ("left-out settings, by the judge", [d["fit"]["held_out"] for _, d in told]),
    ):
        found = [judged_prediction(d, x) for (_, d), x in zip(told, excess, strict=True)]
        out += _prediction_bars(title, [p for p in found if p is not None])
    return out


def _sizes_bars(sizes: Sequence[Plain]) -> list[dict[str, Any]]:
    pulls = np.array([s["pull"] for s in sizes])
    far = Rate("sizes of what was exactly named: beyond 3 σ", int((np.abs(pulls) > 3).sum()), len(pulls), 0.015, False)
    out = [far.plain()]
    if len(pulls) > 1:
        std = float(np.sqrt(np.mean(pulls**2)))
        # Of n independent unit normals about zero.
        half = 1.96 * std / math.sqrt(2 * len(pulls))
        state = "met" if 0.9 <= std <= 1.15 else "open" if std - half <= 1.15 and std + half >= 0.9 else "missed"
        out.append(
            {
                "quantity": "sizes of what was exactly named: rms of (estimate − truth)/σ",
                "bar": "0.9 … 1.15",
                "value": f"{std:.2f}",
                "interval": f"{std - half:.2f} … {std + half:.2f}",
                "n": len(pulls),
                "state": state,
            }
        )
    return out


def _prediction_bars(title: str, predictions: Sequence[Plain]) -> list[dict[str, Any]]:
    out = []
    for kind, bar in (("named", REMOVED), ("law", LAW_REMOVED)):
        chosen = [p for p in predictions if p["kind"] == kind]
        before, after = (sum(p[k] for p in chosen) for k in ("before", "after"))
        if before > 0:
            value = 1 - after / before
            low, high = _bootstrap(chosen)
            state = "met" if value >= bar else "missed" if high < bar else "open"
            out.append(
                {
                    "quantity": f"{title}: excess χ² removed, {kind}, pooled",
                    "bar": f"≥ {bar}",
                    "value": f"{value:.3f}",
                    "interval": f"{low:.3f} … {high:.3f}",
                    "n": len(chosen),
                    "state": state,
                }
            )
    return out


def _bootstrap(chosen: Sequence[Plain], draws: int = 2000) -> tuple[float, float]:
    """95 % of the pooled share when cases are drawn anew with replacement."""
    before, after = (np.array([p[k] for p in chosen]) for k in ("before", "after"))
    pick = np.random.default_rng(0).integers(len(chosen), size=(draws, len(chosen)))
    total = np.maximum(before[pick].sum(axis=1), 1e-9)
    low, high = np.percentile(1 - after[pick].sum(axis=1) / total, [2.5, 97.5])
    return float(low), float(high)


def confusion(cases: Sequence[Plain]) -> dict[str, Any]:
    """Concealed against said, in words, with counts; most frequent columns first."""
    counts = Counter((c["concealed"], c["said"]) for c in cases)
    rows = sorted({r for r, _ in counts})
    said = Counter(c["said"] for c in cases)
    columns = [s for s, _ in sorted(said.items(), key=lambda item: (-item[1], item[0]))]
    return {"concealed": rows, "said": columns, "counts": [[counts[r, c] for c in columns] for r in rows]}


def reliability(cases: Sequence[tuple[Plain, Plain | None]], withheld: Sequence[str]) -> list[dict[str, Any]]:
    """P(present) as stated against how often the effect is there; what the catalogue lacks is left out."""
    stated, there = [], []
    for truth, diagnosis in cases:
        if diagnosis is None or claims.outside(truth):
            continue
        true = claims.nameable(truth, list(withheld))
        for name, p in diagnosis["probability"].items():
            stated.append(p)
            there.append(name in true)
    p, t = np.array(stated), np.array(there, bool)
    out = []
    for low, high in itertools.pairwise(STATED_EDGES):
        inside = (p >= low) & (p < high)
        if inside.any():
            out.append(
                {"stated": float(p[inside].mean()), **_binomial(int(t[inside].sum()), int(inside.sum()), "right")}
            )
    return out


def power(cases: Sequence[tuple[Plain, Plain | None]], withheld: Sequence[str]) -> list[dict[str, Any]]:
    """Per effect: how often it is named, or in a class, by its SNR; "every effect" first."""
    seen: dict[str, list[tuple[float, bool]]] = {"every effect": []}
    for truth, diagnosis in cases:
        for name in sorted(claims.nameable(truth, list(withheld)) & set(truth["snr"])):
            found = diagnosis is not None and (
                name in {e["name"] for e in diagnosis["effects"]}
                or any(name in m for c in diagnosis["classes"] for m in c["members"])
            )
            for key in ("every effect", name):
                seen.setdefault(key, []).append((truth["snr"][name], found))
    out: list[dict[str, Any]] = []
    for effect, found_at in seen.items():
        points = []
        for low, high in itertools.pairwise(SNR_EDGES):
            inside = [(snr, found) for snr, found in found_at if low <= snr < high]
            if inside:
                middle = math.exp(float(np.mean([math.log(max(snr, 0.1)) for snr, _ in inside])))
                points.append({"snr": middle, **_binomial(sum(f for _, f in inside), len(inside), "named")})
        if points:
            out.append({"effect": effect, "points": points})
    return [out[0], *sorted(out[1:], key=lambda e: str(e["effect"]))] if out else []


def _binomial(k: int, n: int, word: str) -> dict[str, Any]:
    low, high = wilson(k, n, 1.96)
    return {word: k, "of": n, "low95": low, "high95": high}


def headline(cases: Sequence[Plain]) -> str:
    """The trial in a sentence."""
    something = [c for c in cases if c["concealed"] != "nothing"]
    nothing = [c for c in cases if c["concealed"] == "nothing"]
    outcomes = Counter(c["cause"] for c in something)
    false = sum(c["cause"] == "wrong" for c in nothing)
    silent = f", {outcomes['']} without a verdict" if outcomes[""] else ""
    return (
        f"Of {len(something)} concealed causes {outcomes['right']} were found rightly, {outcomes['class']} left open "
        f"among alternatives, {outcomes['missed']} missed, {outcomes['wrong']} told wrongly{silent}; "
        f"{false} false alarms in {len(nothing)} cases without any."
    )
