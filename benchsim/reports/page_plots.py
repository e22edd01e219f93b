"""Line drawings of the report page as inline SVG: their numbers are finished, only their place is found here.

Colours and fonts come from the page's style sheet by class, so that a drawing follows the reader's light or dark
scheme. A drawing is 360 units wide, a phone's width, and is never shrunk much below that: its letters stay readable.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import ceil, floor, hypot, isfinite, log10
from typing import Any

from markupsafe import Markup, escape

from benchsim.reports.vocabulary import BENCH, Vocabulary

WIDTH = 360
LEFT, RIGHT, TOP = 46, 8, 24

FINE = 0.15
"""Distances of fewer mm are written in µm."""

MARKS_REACH = 0.08
"""Largest displacement of a mark in a drawing, as a part of its diagonal: some of the distance between marks."""

Numbers = Sequence[float | None]


@dataclass(frozen=True)
class Scale:
    """Linear or logarithmic map of ``low`` … ``high`` to ``start`` … ``end`` of the drawing."""

    low: float
    high: float
    start: float
    end: float
    log: bool = False

    def __call__(self, x: float) -> float:
        low, high, x = (log10(v) for v in (self.low, self.high, x)) if self.log else (self.low, self.high, x)
        return self.start + (self.end - self.start) * (x - low) / ((high - low) or 1.0)


def nice(x: float) -> float:
    """Largest of 1, 2, 5, 10, … (and 0.5, 0.2, …) that is not above ``x``."""
    power = 10.0 ** floor(log10(x))
    return next(m * power for m in (5.0, 2.0, 1.0) if m * power <= x * (1 + 1e-9) or m == 1.0)


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """At most ``count`` + 1 round numbers within a range."""
    if not high > low:
        return [low]
    step = nice((high - low) / count)
    while (high - low) / step > count:
        step = nice(step * 2.5)
    return [k * step for k in range(ceil(low / step - 1e-9), floor(high / step + 1e-9) + 1)]


def text_of(x: float) -> str:
    """A tick's number with a true minus."""
    return f"{x:.6g}".replace("-", "−")


def _n(x: float) -> str:
    return f"{x:.1f}".removesuffix(".0")


def _text(x: float, y: float, words: str, anchor: str = "middle", kind: str = "") -> str:
    css = f' class="{kind}"' if kind else ""
    return f'<text x="{_n(x)}" y="{_n(y)}" text-anchor="{anchor}"{css}>{escape(words)}</text>'


def _line(x1: float, y1: float, x2: float, y2: float, kind: str) -> str:
    return f'<path class="{kind}" d="M{_n(x1)} {_n(y1)}L{_n(x2)} {_n(y2)}"/>'


def polyline(points: Iterable[Sequence[float]]) -> str:
    """Path data of straight pieces through points."""
    return "M" + "L".join(f"{_n(x)} {_n(y)}" for x, y in points)


def _dots(points: Iterable[tuple[float, float]]) -> str:
    """Filled dots: pieces of no length with round ends, a few bytes each."""
    return "".join(f"M{_n(x)} {_n(y)}h0" for x, y in points)


def _rings(points: Iterable[tuple[float, float]], r: float = 2.0) -> str:
    return "".join(f"M{_n(x - r)} {_n(y)}a{r} {r} 0 1 0 {2 * r} 0a{r} {r} 0 1 0 {-2 * r} 0" for x, y in points)


def _svg(height: float, body: Iterable[str], title: str, description: str, kind: str = "plot") -> Markup:
    inner = "".join(body)
    return Markup(
        f'<svg class="{kind}" viewBox="0 0 {WIDTH} {_n(height)}" role="img">'
        f"<title>{escape(title)}</title><desc>{escape(description)}</desc>{inner}</svg>"
    )


def _known(values: Numbers) -> list[float]:
    return [v for v in values if v is not None and isfinite(v)]


def _rms(values: Numbers) -> float | None:
    known = _known(values)
    return (sum(v * v for v in known) / len(known)) ** 0.5 if known else None


def reach(exposures: Iterable[Mapping[str, Any]], earlier: bool = True) -> float:
    """Half the height of all residual panels of a page: traces are compared on one scale."""
    shown = []
    for x in exposures:
        r = x["residual_mm"]
        shown += [*_known(r["after"]), *_known(r["held_out_after"])]
        if earlier and not x["same"]:
            shown += [*_known(r["before"]), *_known(r["held_out_before"])]
    return 1.12 * max(map(abs, shown), default=1.0) or 1.0


def residuals(exposure: Mapping[str, Any], reach: float, earlier: bool = True, words: Vocabulary = BENCH) -> Markup:
    """Distances of one trace from its prediction along the trace, before and after; below them those left out.

    Parameters
    ----------
    exposure : mapping
        One of ``exposures`` of ``page.json`` (see `report.page`).
    reach : float
        Half the height of a panel.
    earlier : bool
        Whether those before are drawn too.
    words : Vocabulary
    """
    earlier = earlier and not exposure["same"]
    s = exposure["s_mm"]
    r = exposure["residual_mm"]
    panels = [("fitted", r["before"], r["after"])]
    if _known(r["held_out_after"]):
        panels.append(("left out", r["held_out_before"], r["held_out_after"]))
    tall, gap, top = 104, 30, TOP
    x = Scale(min(s), max(s), LEFT, WIDTH - RIGHT)
    body, said = [], []
    for k, (word, before, after) in enumerate(panels):
        first = top + k * (tall + gap)
        sigma = exposure["sigma_mm"]
        y = Scale(-reach, reach, first + tall, first)
        factor, unit = (1e3, "µm") if reach < FINE and words.unit == "mm" else (1.0, words.unit)
        label = f"{word} ({unit})" if unit else word
        body += _axis_y(y, [v / factor for v in ticks(-factor * reach, factor * reach, 5)], first, label, factor)
        body.append(_band(x, y, s, sigma, "band"))
        body.append(_band(x, y, s, exposure["sigma_alone_mm"], "band alone"))
        body.append(_line(x.start, y(0.0), x.end, y(0.0), "zero"))
        if earlier:
            body.append(f'<path class="before ring" d="{_rings(_points(x, y, s, before))}"/>')
        body.append(f'<path class="after dot" d="{_dots(_points(x, y, s, after))}"/>')
        b, a = _rms(before), _rms(after)
        if a is not None:
            start = f"{b:.2g} before, " if b is not None and earlier else ""
            said.append(f"{word}: rms {start}{a:.2g} {words.unit}".rstrip() + (" after" if start else ""))
    bottom = top + len(panels) * (tall + gap) - gap
    body += _axis_x(x, ticks(min(s), max(s), 6), bottom, words.along)
    bench = words.one == BENCH.one
    name = f"{exposure['exposure']}, setting {exposure['setting']}" if bench else exposure["exposure"]
    over = f" over {max(s) - min(s):.0f} mm" if bench else ""
    return _svg(
        bottom + 34,
        body,
        f"{name}: {words.distance}",
        f"{'; '.join(said)}. {len(s)} points{over}.",
    )


def enlarged_marks(exposures: Iterable[Mapping[str, Any]]) -> float:
    """Round factor by which the largest displacement of a mark is a part of its frame that is seen."""
    most = max(
        (
            hypot(*v) / hypot(*x["size_px"])
            for x in exposures
            for key in ("before_px", "after_px")
            for v in x["most"][key]
        ),
        default=0.0,
    )
    return max(nice(MARKS_REACH / most), 1.0) if most > 0 else 1.0


def marks(exposure: Mapping[str, Any], factor: float) -> Markup:
    """From where each mark is predicted to where it is seen, in the frame of its photograph, before and after.

    Parameters
    ----------
    exposure : mapping
        One of ``exposures`` of ``page.json`` with ``most`` of marks (see `report.page`).
    factor : float
        By which displacements are drawn too large.
    """
    wide, tall = exposure["size_px"]
    scale, seen = WIDTH / wide, exposure["most"]
    body, said = [f'<rect class="frame" width="{WIDTH}" height="{_n(scale * tall)}"/>'], []
    for key, word, kind in (("before_px", "before", "before"), ("after_px", "after", "after")):
        path = "".join(
            f"M{_n(scale * u)} {_n(scale * v)}l{_n(scale * factor * a)} {_n(scale * factor * b)}"
            for (u, v), (a, b) in zip(seen["at_px"], seen[key], strict=True)
        )
        body.append(f'<path class="{kind} shift" d="{path}"/>')
        rms = _rms([hypot(*v) for v in seen[key]])
        said.append(f"{word}: rms {rms or 0.0:.2g} px")
    name = f"{exposure['exposure']}, setting {exposure['setting']}"
    return _svg(scale * tall, body, f"{name}: displacement of its marks", f"{'; '.join(said)}.")


def _points(x: Scale, y: Scale, at: Sequence[float], values: Numbers) -> list[tuple[float, float]]:
    return [(x(a), y(v)) for a, v in zip(at, values, strict=True) if v is not None and isfinite(v)]


def _band(x: Scale, y: Scale, at: Sequence[float], sigma: Sequence[float], kind: str) -> str:
    """±1 sigma, cut at the panel's edge."""
    top = [(x(a), y(min(v, y.high))) for a, v in zip(at, sigma, strict=True)]
    low = [(x(a), y(max(-v, y.low))) for a, v in zip(at, sigma, strict=True)]
    return f'<path class="{kind}" d="{polyline([*top, *reversed(low)])}Z"/>'


def _axis_y(y: Scale, at: Sequence[float], top: float, words: str, factor: float = 1.0) -> list[str]:
    out = [_text(2, top - 9, words, "start", "label")]
    for v in at:
        out.append(_line(LEFT, y(v), WIDTH - RIGHT, y(v), "grid"))
        out.append(_text(LEFT - 5, y(v) + 3.5, text_of(factor * v), "end"))
    return out


def _axis_x(x: Scale, at: Sequence[float], bottom: float, words: str, names: Sequence[str] = ()) -> list[str]:
    out = [_line(x.start, bottom, x.end, bottom, "zero")]
    for k, v in enumerate(at):
        out.append(_line(x(v), bottom, x(v), bottom + 4, "zero"))
        out.append(_text(x(v), bottom + 15, names[k] if names else text_of(v)))
    out.append(_text((x.start + x.end) / 2, bottom + 29, words, kind="label"))
    return out


def reliability(bins: Sequence[Mapping[str, Any]]) -> Markup:
    """How often what was stated with a probability was there, against that probability.

    Parameters
    ----------
    bins : sequence of mapping
        ``reliability`` of a trial's score (see `report.page_trial`).
    """
    side = 270
    x, y = Scale(0, 1, LEFT, LEFT + side), Scale(0, 1, TOP + side, TOP)
    five = [0, 0.2, 0.4, 0.6, 0.8, 1]
    body = _axis_y(y, five, TOP, "share that was there")
    body += _axis_x(x, five, TOP + side, "probability stated")
    body.append(_line(x(0), y(0), x(1), y(1), "ideal"))
    said = []
    for b in bins:
        if not b["of"]:
            continue
        at, share = b["stated"], b["right"] / b["of"]
        body.append(_line(x(at), y(b["low95"]), x(at), y(b["high95"]), "after bar"))
        body.append(f'<circle class="after face" cx="{_n(x(at))}" cy="{_n(y(share))}" r="4"/>')
        said.append(f"stated {at:.3g}: {b['right']} of {b['of']} there")
    return _svg(
        TOP + side + 34, body, "Reliability: share that was there against the probability stated", "; ".join(said) + "."
    )


def power(effect: str, points: Sequence[Mapping[str, Any]], span: tuple[float, float]) -> Markup:
    """Share of the cases of one effect that were named, against the signal-to-noise ratio.

    Parameters
    ----------
    effect : str
    points : sequence of mapping
        Of one entry of ``power`` of a trial's score (see `report.page_trial`).
    span : (2,)
        Range of the signal-to-noise ratio, the same for every effect.
    """
    top, tall = TOP, 96
    x = Scale(*span, LEFT, WIDTH - RIGHT - 10, log=True)
    y = Scale(0, 1, top + tall, top)
    body = _axis_y(y, [0, 0.5, 1], top, "share named")
    at = [v for v in (1, 2, 3, 5, 8, 12, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10000) if span[0] <= v <= span[1]]
    while len(at) > 7:
        at = at[::2]
    body += _axis_x(x, at, top + tall, "signal-to-noise ratio")
    seen = [p for p in points if p["of"]]
    if len(seen) > 1:
        line = polyline([(x(p["snr"]), y(p["named"] / p["of"])) for p in seen])
        body.append(f'<path class="after thin" d="{line}"/>')
    for p in seen:
        share = p["named"] / p["of"]
        body.append(_line(x(p["snr"]), y(p["low95"]), x(p["snr"]), y(p["high95"]), "after bar"))
        body.append(f'<circle class="after face" cx="{_n(x(p["snr"]))}" cy="{_n(y(share))}" r="3.5"/>')
    said = "; ".join(f"at {p['snr']:.3g}: {p['named']} of {p['of']}" for p in seen) or "no case"
    return _svg(top + tall + 34, body, f"{effect}: share named against signal-to-noise ratio", f"{said}.")
