"""Rates of `diagnosis_study.py` with their intervals, held against the bars."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from scipy.stats import chi2, fisher_exact
from study_cases import SEEN

from benchsim.diagnosis import settings
from benchsim.trial import claims
from benchsim.trial.prediction import much
from benchsim.trial.rates import judged, wilson

Case = Mapping[str, Any]

CATALOGUED = ("single", "pair", "fig7", "fig7-pair")
OUTSIDE = ("removed", "stranger")
"""Rows of cases with something concealed: in the judge's catalogue, and not there."""

BESIDE = ("beside", "fig7-beside")
"""Rows of cases with two effects of which the judge's catalogue has the first."""

STRETCHED = (settings.NAME,)
"""All that is named where only the settings are further off than stated."""

STD = (0.9, 1.15)
FAR = 0.015
"""Bars of the parameters' (estimate − truth)/σ: standard deviation about zero, and share beyond 3."""

LOST = 0.5
"""ln Z."""

COUNTED = 20
"""Effective sample from which on sampled evidence is known to a quarter in ln Z."""

WIDTH = 100
"""Of the quantities' names."""


def exact(case: Case) -> bool:
    """Named, nothing else, and nothing left."""
    named = set(case["named"])
    return case["verdict"] == "named" and bool(named) and named == set(case["truth"]["effects"])


def holds(case: Case, verdicts: Sequence[str] = ("class",)) -> bool:
    """A verdict of these whose effects and classes allow just what is concealed."""
    return case["verdict"] in verdicts and set(case["truth"]["effects"]) in claims.allowed(
        case["named"], case["classes"]
    )


def lone_wrong(case: Case) -> bool:
    """A name that is not in the truth."""
    return bool(set(case["named"]) - set(case["truth"]["effects"]))


def spoken(case: Case) -> set[str]:
    """All that is named or in a class."""
    return {e for members in case["classes"] for m in members for e in m} | set(case["named"])


def said(case: Case, beside: Sequence[str] = ()) -> bool:
    """Anything is named beside some that may be, or a class of names is given."""
    return bool(set(case["named"]) - set(beside) or case["classes"])


def unshared(case: Case, rival: str = "rival") -> bool:
    """Named as if nothing were open, by a name that the truth and its nearest rival do not share."""
    shared = set(case["truth"]["effects"]) & set(case.get(rival, case["rival"])[0].split("+"))
    return case["verdict"] == "named" and not set(case["named"]) <= shared


def places(case: Case) -> bool:
    """A location is all that is claimed: beside a wrong name it is no merit."""
    return bool(case["location"] and case["location"]["claimed"]) and not said(case)


def weakest(case: Case) -> float:
    """SNR of the least visible thing that is concealed; nan where the case ended before it was known."""
    return min(case["snr"].values(), default=0.0) if "snr" in case else math.nan


def firm(case: Case) -> float:
    """`weakest`, where settings are fitted anew and take up what they can; where that is not known, to first order."""
    known = case.get("refitted", {})
    return min((min(snr, known.get(name, snr)) for name, snr in case.get("snr", {}).items()), default=0.0)


def near(case: Case) -> float:
    """Distance of the nearest rival [sigma]; nan where the case ended before it was known."""
    return float(case["rival"][1]) if "rival" in case else math.nan


def near_anew(case: Case) -> float:
    """`near`, where the rival is fitted anew; where that is not known, to first order."""
    return float(case["rival_refitted"][1]) if "rival_refitted" in case else near(case)


def told(cases: Sequence[Case]) -> list[Case]:
    """Cases with a verdict."""
    return [c for c in cases if "verdict" in c]


def row(
    title: str, cases: Sequence[Case], hit: Callable[[Case], bool], bar: float | None = None, at_least: bool = True
) -> str:
    """One line of the table.

    A case without a verdict was not found: it misses what has to happen at least so often. Nothing wrong was said of it
    either: of what may happen at most so often it is left out. Both are stated.

    Parameters
    ----------
    title : str
    cases : sequence of case
    hit : callable
        Of a case with a verdict.
    bar : float, optional
        None: a rate that no bar is set for.
    at_least : bool
    """
    with_verdict = told(cases)
    ended = len(cases) - len(with_verdict)
    n, k = len(cases if at_least else with_verdict), sum(hit(c) for c in with_verdict)
    low, high = wilson(k, n, 1.96)
    rate = f"{100 * k / n:6.1f} %  ({100 * low:.1f}–{100 * high:.1f})" if n else "     –"
    held = "" if bar is None else f"  {'≥' if at_least else '≤'} {100 * bar:g} %  {judged(k, n, bar, at_least)}"
    lost = f"  ({ended} without a verdict {'missed' if at_least else 'left out'})" if ended else ""
    return f"{title:<{WIDTH}}{k:>5}/{n:<5}{rate}{held}{lost}"


def table(cases: Iterable[Case]) -> str:
    """All bars that the cases of one tier can speak about."""
    every = list(cases)
    of: dict[str, list[Case]] = {}
    for c in every:
        of.setdefault(c["row"], []).append(c)
    lines = []
    for name, key, bars in (
        ("single effect, six settings", "single", ((8, 0.95), (12, 0.99))),
        ("pairs, six settings", "pair", ((8, 0.90), (12, 0.97))),
        ("single effect, two settings of Fig. 7", "fig7", ((8, 0.95), (12, 0.99))),
        ("pairs, two settings of Fig. 7", "fig7-pair", ((8, 0.90), (12, 0.97))),
    ):
        lines += naming(name, of.get(key, []), bars)
    lines += faint([c for key in CATALOGUED for c in of.get(key, [])])
    for key, title, bar in (
        ("clean", "clean", 0.02),
        ("clean-noise", "clean, σ × 1.3", 0.05),
        ("clean-settings", "clean, setting errors × 3", 0.05),
        ("clean-correlated", "clean, correlated noise", 0.05),
    ):
        group, far = of.get(key, []), key == "clean-settings"
        # Settings that are further off than stated are what is there.
        more, or_so = (" beside setting-errors", " or 'setting-errors'") if far else ("", "")
        alarm = partial(said, beside=STRETCHED if far else ())
        lines.append(row(f"{title}: anything named{more}", group, alarm, bar, at_least=False))
        lines.append(row(f"{title}: 'nothing-missing'{or_so}", group, passed if far else quiet, 1 - bar))
    lines += outside([c for key in OUTSIDE for c in of.get(key, [])])
    lines += beside([c for key in BESIDE for c in of.get(key, [])])
    lines.append(found(every))
    known = told(every)
    lines += sizes([x for c in known if exact(c) for x in c["parameter_pulls"]])
    lines += removed("named", [c["held_out"] for c in known if exact(c) and c["held_out"]], 0.95)
    lines += removed("law", [c["held_out"] for c in known if c["law"] is not None and c["held_out"]], 0.8)
    anew = [c for c in known if c.get("fresh") is not None or "fresh_error" in c]

    def nothing_more(c: Case) -> bool:
        return bool(c.get("fresh") == "nothing-missing")

    lines.append(row("amended.toml on a fresh recording: nothing-missing", anew, nothing_more, 0.95))
    # A law of finite resolution leaves something of a misfit of hundreds of sigma, which a fresh recording shows.
    lines.append(row("    of these without a law", [c for c in anew if c["law"] is None], nothing_more))
    # What was too weak to be said of one recording, another has its own chance of showing.
    whole = [c for c in anew if exact(c) or holds(c)]
    lines.append(row("    of these with all that was concealed named or in a class", whole, nothing_more))
    return "\n".join([*lines, *silent(of)])


def against(cases: Sequence[Case], before: Sequence[Case]) -> str:
    """Rates that have a bar beside those of a study before: Fisher's exact probability of one as bad, if none changed.

    Of some sixty rows three are below 0.05 by chance.
    """

    def counts(lines: Sequence[str]) -> dict[tuple[str, str], tuple[int, int, bool]]:
        head, out = "", {}
        for line in lines:
            title, rest = line[:WIDTH].rstrip(), line[WIDTH:]
            head = head if title.startswith(" ") else title
            if held := re.match(r" *(\d+)/(\d+) .* ([≥≤]) ", rest):
                out[head, title] = int(held[1]), int(held[2]), held[3] == "≥"
        return out

    now, then = (counts(table(c).splitlines()) for c in (cases, before))
    lines = []
    for key in now.keys() & then.keys():
        (k, n, at_least), (kept, of, _) = now[key], then[key]
        if n and of:
            alternative = "less" if at_least else "greater"
            p = float(fisher_exact([[k, n - k], [kept, of - kept]], alternative=alternative).pvalue)
            title = " ".join(part.strip() for part in dict.fromkeys(key))
            lines.append((p, f"p {p:.3f} {k:>5}/{n:<5}{kept:>5}/{of:<5} {title}"))
    return "\n".join(["beside a study before, the worst first", *(line for _, line in sorted(lines))])


def found(cases: Sequence[Case]) -> str:
    """Of the search alone, whatever is said then."""
    begun = [c for c in cases if "truth_ahead" in c]
    title = f"search: the fit that begins at the truth lies at most {LOST} in ln Z above the best found"
    sampled = [c for c in cases if (c.get("evidence_off") or (0.0, 0.0))[1] >= COUNTED]
    within = f"evidence: the best fit's is within {LOST} in ln Z of importance sampling (effective sample ≥ {COUNTED})"
    return "\n".join(
        [
            row(title, begun, lambda c: c["truth_ahead"] <= LOST, 0.99),
            row(within, sampled, lambda c: abs(c["evidence_off"][0]) <= LOST),
        ]
    )


def quiet(case: Case) -> bool:
    return bool(case["verdict"] == "nothing-missing")


def passed(case: Case) -> bool:
    """Nothing is said to be missing but that settings are further off."""
    return quiet(case) or tuple(case["named"]) == STRETCHED


def stressed(cases: Sequence[Case]) -> str:
    """What is said of what is visible and of the rest, beside a defect that nothing explains or by another program."""

    def among(case: Case) -> bool:
        """All that is concealed is named or in a class."""
        return set(case["truth"]["effects"]) <= spoken(case)

    def like_wander(case: Case) -> bool:
        """Of the centre line, in mm."""
        # Of 0.0196 mm along six traces their settings leave 0.0105 (5 to 95 % of 40 draws: 0.0072 to 0.0133).
        true = 0.5 * case["stress"]["rms_mm"]
        return any(family == "c" and true / 2 <= mm <= 2 * true for family, _, _, mm in case["left"])

    lines = []
    for kind in [*dict.fromkeys(c["stress"]["stress"] for c in cases if "stress" in c), ""]:
        mine = [c for c in cases if kind in ("", c.get("stress", {}).get("stress"))]
        seen, clean = [c for c in mine if firm(c) >= 8], [c for c in mine if c["row"] == "clean"]
        title = kind or "all"
        lines += [
            row(f"{title}: visible (8 sigma and more), named or in a class", seen, among, 0.80),
            row(f"{title}: visible, passed over", seen, passed, 0.02, at_least=False),
            row(f"{title}: a wrong name", mine, lone_wrong, 0.05, at_least=False),
            row(f"{title}: clean, anything named", clean, lambda c: bool(c["named"])),
            row(f"{title}: a rest is stated with its size", mine, lambda c: bool(c["left"])),
        ]
        if kind == "wander":
            lines.append(
                row(f"{title}: that size is within a factor of two of what settings leave of it", mine, like_wander)
            )
    return "\n".join([*lines, found(cases)])


def beside(cases: Sequence[Case]) -> list[str]:
    """What is said of an effect beside one that the catalogue lacks."""

    def first(case: Case) -> str:
        return next(iter(case["truth"]["effects"]))

    def seen(case: Case, effect: str) -> bool:
        return bool(min(case["snr"][effect], case.get("refitted", case["snr"])[effect]) >= SEEN)

    def among(case: Case) -> bool:
        return first(case) in spoken(case)

    visible = [c for c in cases if "snr" in c and seen(c, first(c))]
    wrong = row("beside one not in the catalogue: a name of neither", cases, lone_wrong, at_least=False)
    return [row("beside one not in the catalogue, SNR ≥ 8: named or in a class", visible, among), wrong]


def naming(name: str, group: Sequence[Case], bars: Sequence[tuple[float, float]]) -> list[str]:
    """Lines of one or two concealed effects: bars are (SNR, rate)."""
    lines = []
    for snr, bar in bars:
        chosen = [c for c in group if weakest(c) >= snr and near(c) >= 5]
        lines.append(row(f"{name}: SNR ≥ {snr}, rival ≥ 5 σ: exactly named", chosen, exact, bar))
        lines += anew(chosen, snr, exact, bar, 5.0)

    def loud(chosen: Sequence[Case]) -> list[Case]:
        return [c for c in chosen if weakest(c) >= SEEN]

    def allowed(c: Case) -> bool:
        return holds(c, ("named", "class"))

    between = [c for c in group if 3 <= near(c) < 5]
    # The bar states no SNR; what nobody could see has nothing for a rival, and is in no class.
    lines.append(
        row(f"{name}: rival at 3-5 σ, SNR ≥ {SEEN:g}: named or a class that holds it", loud(between), allowed, 0.95)
    )
    lines.append(row("    at any SNR", between, allowed))
    bent = [c for c in loud(group) if 3 <= near_anew(c) < 5]
    lines += moved("    with rivals fitted anew", bent, loud(between), allowed, 0.95)
    below = [c for c in group if near(c) < 3]
    lines.append(row(f"{name}: rival below 3 σ, SNR ≥ {SEEN:g}: a class that holds it", loud(below), holds, 0.95))
    lines.append(row("    at any SNR", below, holds))
    bent = [c for c in loud(group) if near_anew(c) < 3]
    lines += moved("    with rivals fitted anew", bent, loud(below), holds, 0.95)
    # Where one of the two does it all by itself, a class of single effects is what the data allow.
    two = [c for c in loud(below) if c.get("alone", math.inf) >= 3]
    if len(two) < len(loud(below)):
        lines.append(row("    with SNR and more than 3 σ from either effect alone", two, holds, 0.95))
    lines.append(
        row(f"{name}: rival below 3 σ: a lone name that the rival does not share", below, unshared, 0.0, at_least=False)
    )
    bent = [c for c in group if near_anew(c) < 3]

    def alone(c: Case) -> bool:
        return unshared(c, "rival_refitted")

    lines += moved("    with rivals fitted anew", bent, below, alone, 0.0, at_least=False)
    counts = [len(m) for c in told(below) if c["verdict"] == "class" for m in c["classes"]]
    if counts:
        lines.append(f"    mean size of those classes {np.mean(counts):.2f}, n = {len(counts)}")
    weak = [c for c in group if weakest(c) < SEEN]
    lines.append(row(f"{name}: weakest SNR < {SEEN:g}: a wrong lone name", weak, lone_wrong, 0.02, at_least=False))
    lines.append(row(f"{name}: all: a wrong lone name", group, lone_wrong, 0.02, at_least=False))
    return lines


def anew(chosen: Sequence[Case], snr: float, hit: Callable[[Case], bool], bar: float, apart: float = 0.0) -> list[str]:
    """A line of those that stay as visible, and ``apart`` from a rival, when settings and rivals are fitted anew.

    To first order a beam 3 mm beside the axis is 10 sigma before the two settings of Fig. 7; a mirror moved by 1 mm
    takes up all of it but 5. And a width goes with the square of what widens a line: a large wavefront-curvature of one
    sign is 9 sigma from an astigmatism of the other to first order, and 0.4 if that is fitted.
    """
    left = [c for c in chosen if firm(c) >= snr]
    lines = moved("    of these with that SNR beside settings fitted anew", left, chosen, hit, bar)
    far = [c for c in left if not apart or near_anew(c) >= apart]
    return lines + moved("    of these with a rival as far, fitted anew", far, left, hit, bar)


def moved(
    title: str,
    cases: Sequence[Case],
    before: Sequence[Case],
    hit: Callable[[Case], bool],
    bar: float,
    at_least: bool = True,
) -> list[str]:
    """A line of cases chosen otherwise; none where they are the same."""
    same = {id(c) for c in cases} == {id(c) for c in before}
    return [] if same else [row(title, cases, hit, bar, at_least)]


def faint(cases: Sequence[Case]) -> list[str]:
    """Lines of effects that no size within their cap would make visible."""
    chosen = [c for c in cases if unreachable(c)]
    title = f"an effect below SNR {SEEN:g} even at its cap"
    how = Counter(what(c, name) for c in told(chosen) for name in unreachable(c))
    return [
        row(f"{title}: a wrong name", chosen, lone_wrong, 0.0, at_least=False),
        row(
            f"{title}: limit stated, a class, nothing-missing, or rightly named",
            chosen,
            lambda c: all(what(c, name) != "nothing said" for name in unreachable(c)),
            1.0,
        ),
        *([f"    of these effects {', '.join(f'{k} {n}' for k, n in how.most_common())}"] if how else []),
    ]


def unreachable(case: Case) -> list[str]:
    """Concealed effects whose SNR at their cap is below `SEEN`."""
    return [name for name, snr in case.get("reach", {}).items() if snr < SEEN]


def what(case: Case, name: str) -> str:
    """What a verdict says of one effect that is concealed."""
    if name in case["named"]:
        return "named"
    if any(name in m for members in case["classes"] for m in members):
        return "in a class"
    if case["verdict"] == "nothing-missing":
        return "nothing-missing"
    return "limit stated" if case.get("limit_stated", {}).get(name) else "nothing said"


def outside(cases: Sequence[Case]) -> list[str]:
    """Lines of what the judge's catalogue does not hold: every name, and every class of names, is wrong."""
    lines = []
    for title, low, high, bar in (("SNR < 20", 0, 20, 0.10), ("SNR ≥ 20", 20, math.inf, 0.03)):
        chosen = [c for c in cases if low <= weakest(c) < high]
        name = f"not in the catalogue, {title}"
        lines.append(row(f"{name}: a wrong name", chosen, lambda c: bool(c["named"]), bar, at_least=False))
        apart = [c for c in chosen if near(c) >= 5]
        lines.append(
            row("    of these with no rival within 5 σ", apart, lambda c: bool(c["named"]), bar, at_least=False)
        )
        lines.append(row(f"{name}: a wrong name or a wrong class", chosen, said, at_least=False))
    claimed = [c for c in told(cases) if places(c)]
    lines.append(
        row("location, when claimed: right", claimed, lambda c: c["location"]["element"] == c["truth_element"], 0.90)
    )
    for title, low, high, bar in (("12-20", 12, 20, 0.5), ("above 20", 20, math.inf, 0.75)):
        chosen = [c for c in cases if low <= weakest(c) < high]
        lines.append(row(f"location, SNR {title}: claimed, and nothing named", chosen, places, bar))
        lines.append(row("    of these with no rival within 5 σ", [c for c in chosen if near(c) >= 5], places, bar))
        lines += anew(chosen, low, places, bar)
    return lines


def sizes(pulls: Sequence[float]) -> list[str]:
    """Lines of (estimate − truth)/σ of what was exactly named."""
    x = np.array(pulls)
    n = len(x)
    if not n:
        return ["parameters of what was exactly named: no cases"]
    square = float(x @ x)
    std = math.sqrt(square / n)

    def bound(q: float) -> float:
        # n independent normals about zero: their sum of squares over σ² is χ² of n degrees of freedom.
        return math.sqrt(square / float(chi2.ppf(q, n)))

    missed = bound(0.95) > STD[1] or bound(0.05) < STD[0]
    state = "met" if STD[0] <= std <= STD[1] else "missed" if missed else "open"
    title = "parameters of what was exactly named: std of (estimate − truth)/σ about 0"
    far = [{"verdict": "", "far": abs(p) > 3} for p in x]
    return [
        f"{title:<{WIDTH}}{std:11.3f}  ({bound(0.975):.3f}–{bound(0.025):.3f})  {STD[0]} … {STD[1]}  {state}, n = {n}, "
        f"mean {x.mean():+.3f}",
        row("    beyond 3 σ", far, lambda c: c["far"], FAR, at_least=False),
    ]


def removed(title: str, excess: Sequence[Mapping[str, float]], bar: float) -> list[str]:
    """Lines of left-out settings' excess χ² that is gone after what was found is put in."""
    name = f"held-out excess χ² removed, {title}: pooled"
    before, after = (np.array([h[k] for h in excess]) for k in ("before", "after"))
    if before.sum() <= 0:
        return [f"{name}: no cases"]
    value = 1 - after.sum() / before.sum()
    # Cases drawn anew with replacement, always alike.
    pick = np.random.default_rng(0).integers(len(excess), size=(2000, len(excess)))
    pooled = 1 - after[pick].sum(axis=1) / np.maximum(before[pick].sum(axis=1), 1e-9)
    low, most, high = np.percentile(pooled, [2.5, 95, 97.5])
    state = "met" if value >= bar else "missed" if most < bar else "open"
    alone = [
        {"verdict": "", "share": 1 - h["after"] / h["before"]} for h in excess if much(int(h["data"]), h["before"])
    ]
    return [
        f"{name:<{WIDTH}}{value:11.3f}  ({low:.3f}–{high:.3f})  ≥ {bar}  {state}, n = {len(excess)}",
        row(f"    cases with much to remove: {bar} or more of it", alone, lambda c: c["share"] >= bar),
    ]


def silent(of: Mapping[str, Sequence[Case]]) -> list[str]:
    """A line that counts the cases without a verdict, by row; those of unknown SNR stand in no line by SNR."""
    parts = []
    for key, group in of.items():
        lost = [c for c in group if "verdict" not in c]
        # Of a clean case there is no SNR to know.
        unknown = 0 if key.startswith("clean") else sum("snr" not in c for c in lost)
        if lost:
            where = f", {unknown} of unknown SNR and in no line by SNR" if unknown else ""
            parts.append(f"{key} {len(lost)} of {len(group)}{where}")
    return [f"without a verdict: {'; '.join(parts)}"] if parts else []
