"""What the page of a field shows: plans of its heliostats, and a row for each, from ``field.json``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import date
from math import log10
from typing import Any

from markupsafe import Markup, escape

from benchsim.reports.page_plots import nice, text_of

SHADES = ("#440154", "#414487", "#2a788e", "#22a884", "#7ad151", "#fde725")
"""Of viridis, from the smallest miss to the largest: told apart in grey and by the colour-blind."""

HUES = ("#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377")
"""Paul Tol's bright scheme, for the commonest causes."""

OTHER, NOTHING = "#8a8f94", "none"

WIDTH, MARGIN = 340, 26


def shown(field: Mapping[str, Any]) -> dict[str, Any]:
    """What the template is given.

    Parameters
    ----------
    field : mapping
        ``field.json``.
    """
    rows = field["heliostats"]
    both = [r[f"miss_{w}_mrad"] for r in rows for w in ("before", "after")]
    edges = _edges(both)
    counts = Counter(e["name"] for r in rows for e in r["effects"])
    hues = dict(zip((name for name, _ in counts.most_common(len(HUES))), HUES, strict=False))
    changed = [r for r in rows if r["changed_at"]]
    plans = [
        ("Miss as stated", plan(rows, [_shade(r["miss_before_mrad"], edges) for r in rows])),
        ("Miss with what was found", plan(rows, [_shade(r["miss_after_mrad"], edges) for r in rows])),
        ("Causes, the commonest first", plan(rows, [_hue(r, hues) for r in rows])),
    ]
    if changed:
        dates = sorted(r["changed_on"] for r in changed if r["changed_on"])
        told = f", from {dates[0]} (dark) to {dates[-1]} (light)" if dates else ""
        plans.append((f"Changed on the way{told}", plan(rows, [_since(r, dates) for r in rows])))
    return {
        "field": field,
        "rows": rows,
        "plans": plans if rows else [],
        "steps": [
            (shade, f"{low:.2g} to {high:.2g}") for shade, low, high in zip(SHADES, edges[:-1], edges[1:], strict=True)
        ],
        "hues": [*((h, f"{n} ({counts[n]})") for n, h in hues.items()), (OTHER, "another, or left open")],
        "median": {w: _median([r[f"miss_{w}_mrad"] for r in rows]) for w in ("before", "after")},
    }


def _median(values: Sequence[float]) -> float:
    middle = sorted(values)
    return (middle[(len(middle) - 1) // 2] + middle[len(middle) // 2]) / 2 if middle else float("nan")


def _edges(values: Sequence[float]) -> list[float]:
    """Steps of the colour scale, even in the logarithm."""
    low, high = max(min(values, default=0.1), 1e-3), max(max(values, default=1.0), 2e-3)
    span = max(log10(high / low), 1e-3)
    return [low * 10 ** (span * k / len(SHADES)) for k in range(len(SHADES))] + [high]


def _shade(miss: float, edges: Sequence[float]) -> str:
    return SHADES[max(k for k in range(len(SHADES)) if k == 0 or miss >= edges[k])]


def _since(row: Mapping[str, Any], dates: Sequence[str]) -> str:
    """Of the day of a heliostat's change among those of all."""
    if not row["changed_at"] or not row["changed_on"]:
        return HUES[1] if row["changed_at"] else NOTHING
    first, day, last = (date.fromisoformat(d).toordinal() for d in (dates[0], row["changed_on"], dates[-1]))
    return SHADES[(day - first) * (len(SHADES) - 1) // max(last - first, 1)]


def _hue(row: Mapping[str, Any], hues: Mapping[str, str]) -> str:
    """Of what was said of a heliostat, what most others have too."""
    names = {e["name"] for e in row["effects"]}
    first = next((hue for name, hue in hues.items() if name in names), None)
    return first or (OTHER if row["causes"] else NOTHING)


def plan(rows: Sequence[Mapping[str, Any]], colours: Sequence[str]) -> Markup:
    """The field from above, north up; every heliostat leads to its own page."""
    east, north = ([r[key] for r in rows] for key in ("east_m", "north_m"))
    low = [min(min(east), 0.0), min(min(north), 0.0)]
    span = max(max(max(east), 0.0) - low[0], max(max(north), 0.0) - low[1], 1.0)
    scale = (WIDTH - 2 * MARGIN) / span
    height = 2 * MARGIN + scale * (max(max(north), 0.0) - low[1])

    def place(e: float, n: float) -> tuple[float, float]:
        return MARGIN + scale * (e - low[0]), height - MARGIN - scale * (n - low[1])

    radius = min(5.0, max(1.6, 0.36 * (WIDTH - 2 * MARGIN) / max(len(rows), 1) ** 0.5))
    x, y = place(0.0, 0.0)
    parts = [
        f'<svg class="plot plan" viewBox="0 0 {WIDTH} {height:.0f}" role="img" aria-label="Plan of the field">',
        f'<path class="zero" d="M{x - 6:.1f} {y:.1f}H{x + 6:.1f}M{x:.1f} {y - 6:.1f}V{y + 6:.1f}"/>',
        f'<text x="{x + 8:.1f}" y="{y + 4:.1f}">tower</text>',
    ]
    step = nice(span / 3)
    parts.append(f'<path class="zero" d="M{MARGIN} {height - 8:.1f}H{MARGIN + scale * step:.1f}"/>')
    parts.append(f'<text x="{MARGIN + scale * step + 4:.1f}" y="{height - 5:.1f}">{text_of(step)} m east</text>')
    for row, colour in zip(rows, colours, strict=True):
        x, y = place(row["east_m"], row["north_m"])
        said = (
            f"{row['id']}: {', '.join(row['causes']) or row['verdict']}; {row['miss_before_mrad']:.2f} mrad as stated, "
        )
        said += f"{row['miss_after_mrad']:.2f} with what was found"
        said += f"; changed {row['changed_on'] or 'at ' + row['changed_at']}" if row["changed_at"] else ""
        parts.append(
            f'<a href="{escape(row["page"])}"><circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:.1f}" fill="{colour}">'
            f"<title>{escape(said)}</title></circle></a>"
        )
    return Markup("".join(parts) + "</svg>")
