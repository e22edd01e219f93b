"""What the pages of plants share: sentences of a summary, pictures, and tables, one with a row for each heliostat."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

from markupsafe import Markup

MOST_ROWS = 500
"""Rows of a table: more would make the page slow to sort on a phone; the CSV file has all."""

WIDE = 24
"""Letters of a cell from which on its column is one of sentences, which a phone does not squeeze to a word a line."""


class Column(NamedTuple):
    """Head of a column, decimals of a number, and the key of its sigma, which stands beside it."""

    head: str
    decimals: int | None = None
    sigma: str = ""


def shown(
    name: str, what: str, headline: str, summary: str, *, pictures: Mapping[str, bytes], heliostats: Mapping[str, Any],
    maps: str = "From above", sections: Sequence[Mapping[str, Any]] = (), against: Sequence[str] = (), order: str = "",
) -> dict[str, Any]:  # fmt: skip
    """What the template is given.

    Parameters
    ----------
    name, what : str
        The plant, and what the page is of.
    headline : str
    summary : str
        ``summary.txt``; its first line stands below the headline, the others follow.
    pictures : mapping of str to bytes
        PNG by caption.
    heliostats : mapping
        As `table`.
    maps : str
        Head over the pictures.
    sections : sequence of mapping
        As `section`.
    against : sequence of str
        Sentences of the summary that are said first.
    order : str
        A sentence on that of the heliostats.
    """
    first, *rest = summary.splitlines()
    # What is indented twice, and what leads to it, has a table of its own.
    deep = [line.startswith("    ") for line in rest] + [False]
    plain = [line.strip() for k, line in enumerate(rest) if not (deep[k] or deep[k + 1] or line.endswith(":"))]
    return {
        "name": name,
        "what": what,
        "headline": headline,
        "basis": first.removeprefix(f"{name}: "),
        "against": against,
        "sentences": [line for line in plain if line not in against],
        "maps": maps,
        "pictures": [
            (caption, Markup("data:image/png;base64," + b64encode(png).decode("ascii")))
            for caption, png in pictures.items()
        ],
        "sections": sections,
        "heliostats": heliostats,
        "order": order,
    }


def section(id: str, head: str, *tables: Mapping[str, Any], says: str = "") -> dict[str, Any]:
    """A head, a sentence, and tables below it."""
    return {"id": id, "head": head, "says": says, "tables": tables}


def table(
    columns: Mapping[str, Column], rows: Sequence[Mapping[str, Any]], left_out: Collection[str] = (), caption: str = ""
) -> dict[str, Any]:
    """Those of some columns that hold anything, in their order.

    Parameters
    ----------
    columns : mapping of str to Column
        By key of the rows.
    rows : sequence of mapping
        None: not known.
    left_out : collection of str
        Keys that are not shown.
    caption : str
    """
    there = [k for k in columns if k not in left_out and any(r.get(k) not in (None, "") for r in rows)]
    body = [[_cell(r, k, columns[k]) for k in there] for r in rows[:MOST_ROWS]]
    kinds = [
        "number" if columns[k].decimals is not None else "words" if max(map(len, cells)) >= WIDE else ""
        for k, cells in zip(there, zip(*body, strict=True), strict=True)
    ]
    return {
        "caption": caption,
        "heads": [(columns[k].head, kind) for k, kind in zip(there, kinds, strict=True)],
        "rows": body,
        "of": len(rows),
    }


def _cell(row: Mapping[str, Any], key: str, column: Column) -> str:
    value, sigma = row.get(key), row.get(column.sigma)
    if value is None or column.decimals is None:
        return "" if value is None else str(value)
    return f"{value:.{column.decimals}f}" + ("" if sigma is None else f" ± {sigma:.{column.decimals}f}")
