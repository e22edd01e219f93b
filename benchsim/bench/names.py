"""Names that came with a file, on their way out: to a terminal, into a cell of a table, into the name of a file."""

from __future__ import annotations

import unicodedata

FORMULA = ("=", "+", "-", "@", "\t", "\r", "＝", "＋", "－", "＠")
"""A cell that begins so is computed by spreadsheets, and may start programs (OWASP, CSV injection)."""

IN_PATHS = '/\\:*?"<>|'
"""What separates or stands for other things in the names of files, on one system or another."""

LONGEST = 120
"""Bytes of a name within the name of a file, which has 255."""


def printable(text: str, breaks: str = "") -> str:
    r"""Text that moves no cursor, turns no line round and breaks none: such characters are spelled, ``\x1b``.

    Parameters
    ----------
    text : str
    breaks : str
        Characters that stay as they are: ``\n`` of a text of several lines.
    """
    return "".join(c if c in breaks or not _steers(c) else c.encode("unicode_escape").decode() for c in text)


def _steers(c: str) -> bool:
    """Control, format, surrogate, private and unassigned characters; separators of lines and paragraphs."""
    kind = unicodedata.category(c)
    return kind[0] == "C" or kind in ("Zl", "Zp")


def cell(text: str) -> str:
    """Text as a table holds it: printable, and with ``'`` before what a spreadsheet would take for a formula."""
    return f"'{printable(text)}" if text.startswith(FORMULA) else printable(text)


def file_name(text: str) -> str:
    """Text as a part of the name of a file: in no other folder, not hidden, and no option of a command."""
    kept = "".join("_" if c in IN_PATHS or _steers(c) else c for c in text).encode()[:LONGEST].decode(errors="ignore")
    return "_" + kept[1:] if kept[:1] in ("", ".", "-", " ") else kept
