"""The ledger: one line for each thing that was done, each carrying the hash of the one before.

A line is canonical JSON: its own ``hash`` over all else in it, ``before`` the hash of the line before it, ``kind``, and
what `KINDS` lists. A changed byte, a line removed, added or moved breaks the chain; a line that was chained rightly
but says what cannot be (a case judged after the opening) breaks the order of `standing`. What no chain can show is
that all of it was written anew: for that, publish the hash of the last line as each part ends.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchsim.bench.errors import BenchsimError
from benchsim.bench.reading import JSON_BYTES, read_file
from benchsim.trial.hashing import canonical, digest

Line = Mapping[str, Any]

NAME = "ledger.jsonl"
START = 64 * "0"

KINDS: Mapping[str, frozenset[str]] = {
    "trial": frozenset({"format", "cases", "withheld", "plan", "certificate", "code", "versions"}),
    "concealed": frozenset({"case", "commitment", "files"}),
    "sealed": frozenset({"cases"}),
    "judged": frozenset({"case", "run", "files"}),
    "committed": frozenset({"cases", "code"}),
    "opened": frozenset({"case", "salt", "says"}),
    "closed": frozenset({"results"}),
}
"""Kinds of lines in the order in which they come, and what each holds beside ``kind``, ``before`` and ``hash``."""


@dataclass(frozen=True)
class Standing:
    """What a ledger says, checked.

    Attributes
    ----------
    trial : mapping
        The first line.
    concealed : mapping of case → line
    judged : mapping of case → lines, one per run
    opened : mapping of case → line
    sealed, committed : bool
        All recordings, all verdicts are committed to.
    closed : mapping or None
        The last line.
    head : str
        Hash of the last line.
    """

    trial: Line
    concealed: Mapping[str, Line] = field(default_factory=dict)
    judged: Mapping[str, tuple[Line, ...]] = field(default_factory=dict)
    opened: Mapping[str, Line] = field(default_factory=dict)
    sealed: bool = False
    committed: bool = False
    closed: Line | None = None
    head: str = START

    @property
    def twice(self) -> tuple[str, ...]:
        """Cases that were judged more than once."""
        return tuple(case for case, runs in self.judged.items() if len(runs) > 1)


def cases_of(count: int) -> list[str]:
    """Names of the cases of a trial."""
    return [f"{k:03d}" for k in range(1, count + 1)]


def chained(before: str, line: Mapping[str, Any]) -> dict[str, Any]:
    """A line with the hash of the one before and its own."""
    body = {**line, "before": before}
    return {**body, "hash": digest(canonical(body))}


def read(path: Path) -> list[Line]:
    """Lines of a ledger whose chain holds.

    Raises
    ------
    BenchsimError
        If it cannot be read, or a line is not what was written; names the line.
    """
    data = read_file(path, JSON_BYTES)
    lines: list[Line] = []
    before = START
    for number, raw in enumerate(data.split(b"\n")[:-1], 1):
        where = f"{path.name}: line {number}"
        try:
            line = json.loads(raw)
            body = {k: v for k, v in line.items() if k != "hash"}
            same = canonical(line) == raw and line["hash"] == digest(canonical(body))
        except (ValueError, AttributeError, KeyError, TypeError, RecursionError):
            same = False
        if not same:
            raise BenchsimError(f"{where}: was changed after it was written")
        if line.get("before") != before:
            raise BenchsimError(f"{where}: does not follow the line before it; a line was removed, added or moved")
        before = line["hash"]
        lines.append(line)
    if not data.endswith(b"\n"):
        raise BenchsimError(f"{path.name}: line {len(lines) + 1}: is cut off")
    return lines


def standing(lines: list[Line], name: str = NAME) -> Standing:
    """What the lines say, if they may follow one another as they do.

    Raises
    ------
    BenchsimError
        Names the first line that cannot stand where it does.
    """
    count = lines[0].get("cases") if lines and lines[0].get("kind") == "trial" else None
    # It was written with a line for each case.
    if type(count) is not int or not 0 < count < len(lines):
        raise BenchsimError(f"{name}: line 1: is not the first line of a trial")
    cases = cases_of(count)
    concealed: dict[str, Line] = {}
    judged: dict[str, tuple[Line, ...]] = {}
    opened: dict[str, Line] = {}
    sealed, committed = False, False
    closed: Line | None = None
    for number, line in enumerate(lines, 1):
        kind, case = line.get("kind"), line.get("case")
        holds = frozenset(line) - {"kind", "before", "hash"}
        fits = isinstance(kind, str) and KINDS.get(kind) == holds and closed is None
        if fits and kind == "trial":
            fits = number == 1
        elif fits and kind == "concealed":
            fits = not sealed and len(concealed) < len(cases) and case == cases[len(concealed)]
            concealed[str(case)] = line
        elif fits and kind == "sealed":
            fits = not sealed and len(concealed) == len(cases)
            sealed = True
        elif fits and kind == "judged" and line["run"] == 1:
            fits = sealed and not committed and len(judged) < len(cases) and case == cases[len(judged)]
            judged[str(case)] = (line,)
        elif fits and kind == "judged":
            fits = committed and not opened and str(case) in judged and line["run"] == len(judged[str(case)]) + 1
            judged[str(case)] = (*judged.get(str(case), ()), line)
        elif fits and kind == "committed":
            fits = not committed and len(judged) == len(cases)
            committed = True
        elif fits and kind == "opened":
            fits = committed and len(opened) < len(cases) and case == cases[len(opened)]
            opened[str(case)] = line
        elif fits and kind == "closed":
            fits = len(opened) == len(cases)
            closed = line
        if not fits:
            raise BenchsimError(
                f"{name}: line {number}: '{kind}' {case or ''} cannot stand here; it was added or moved"
            )
    head = str(lines[-1]["hash"])
    return Standing(lines[0], concealed, judged, opened, sealed, committed, closed, head)


def append(path: Path, lines: Iterable[Mapping[str, Any]]) -> str:
    """Append lines, chained to what stands there, and see them onto the disk; returns the last hash."""
    there = read(path) if path.exists() else []
    before = str(there[-1]["hash"]) if there else START
    text = b""
    for line in lines:
        whole = chained(before, line)
        before = whole["hash"]
        text += canonical(whole) + b"\n"
    with path.open("ab") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    return before


def mend(path: Path) -> None:
    """Take away a last line that a stop cut off; nothing that was whole is touched."""
    if not path.exists():
        return
    data = path.read_bytes()
    whole = data.rfind(b"\n") + 1
    if whole < len(data):
        with path.open("r+b") as file:
            file.truncate(whole)
