"""The ledger: one line for each thing that was done, each carrying the hash of the one before.

A line is canonical JSON: its own ``hash`` over all else in it, ``before`` the hash of the line before it, ``kind``, and
what the forms in `KINDS` list. A changed byte, a line removed, added or moved breaks the chain; a line that was chained
rightly but says what cannot be (a case judged after the opening) breaks the order of `standing`. What no chain can show
is that all of it was written anew: for that there are `anchors`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from benchsim.bench.errors import BenchsimError
from benchsim.bench.reading import JSON_BYTES, read_file
from benchsim.trial.hashing import canonical, digest

Line = Mapping[str, Any]

NAME = "ledger.jsonl"
START = 64 * "0"

FIRST, FORMAT = "benchsim-trial/1", "benchsim-trial/2"
"""The first format had no signatures, clues and hash of the page; such trials are verified as far as they go."""

Hash = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Count = Annotated[int, Field(ge=1)]
Files = dict[str, Hash]


class _Form(BaseModel):
    """A line of a kind: what it holds beside ``kind``."""

    model_config = ConfigDict(strict=True, extra="forbid")
    kind: str
    before: Hash
    hash: Hash


class _Trial(_Form):
    format: Literal["benchsim-trial/1", "benchsim-trial/2"]
    cases: Count
    withheld: list[str]
    plan: Hash
    certificate: dict[str, Any]
    code: Hash
    versions: dict[str, str]


class _Concealed(_Form):
    case: str
    commitment: Hash
    files: Files
    clues: dict[str, int] = {}


class _Sealed(_Form):
    cases: Count


class _Signed(_Form):
    by: Literal["concealer", "judge"]
    key: Hash
    signature: Annotated[str, Field(pattern=r"^[0-9a-f]{128}$")]


class _Judged(_Form):
    case: str
    run: Count
    files: Files


class _Committed(_Form):
    cases: Count
    code: Hash


class _Opened(_Form):
    case: str
    salt: Hash
    says: str


class _Closed(_Form):
    results: Hash
    page: Hash = START


KINDS: Mapping[str, type[_Form]] = {
    "trial": _Trial,
    "concealed": _Concealed,
    "sealed": _Sealed,
    "signed": _Signed,
    "judged": _Judged,
    "committed": _Committed,
    "opened": _Opened,
    "closed": _Closed,
}
"""Kinds of lines in the order in which they come; ``signed`` follows ``sealed``, and the last of the judge's."""


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
    signed : mapping of "concealer" or "judge" → line
        Of those who signed all that is theirs.
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
    signed: Mapping[str, Line] = field(default_factory=dict)
    sealed: bool = False
    committed: bool = False
    closed: Line | None = None
    head: str = START

    @property
    def twice(self) -> tuple[str, ...]:
        """Cases that were judged more than once."""
        return tuple(case for case, runs in self.judged.items() if len(runs) > 1)


def case_of(number: int) -> str:
    """Name of a case, counted from 1."""
    return f"{number:03d}"


def cases_of(count: int) -> list[str]:
    """Names of the cases of a trial."""
    return [case_of(k) for k in range(1, count + 1)]


def chained(before: str, line: Mapping[str, Any]) -> dict[str, Any]:
    """A line with the hash of the one before and its own."""
    body = {**line, "before": before}
    return {**body, "hash": digest(canonical(body))}


def follow(before: str, lines: Iterable[Mapping[str, Any]]) -> list[Line]:
    """Lines, chained to the hash of the one that stands before them."""
    out: list[Line] = []
    for line in lines:
        out.append(chained(before, line))
        before = out[-1]["hash"]
    return out


def read(path: Path) -> list[Line]:
    """Lines of a ledger whose chain holds.

    Raises
    ------
    BenchsimError
        If it cannot be read, or a line is not what was written, or in no known form; names the line.
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
        _of_form(where, line)
        before = line["hash"]
        lines.append(line)
    if not data.endswith(b"\n"):
        raise BenchsimError(f"{path.name}: line {len(lines) + 1}: is cut off")
    return lines


def _of_form(where: str, line: Line) -> None:
    kind = line.get("kind")
    form = KINDS.get(kind) if isinstance(kind, str) else None
    if form is None:
        raise BenchsimError(f"{where}: is of no kind that is known; it was added, or written by a later version")
    try:
        form.model_validate(line)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))[:60]
        raise BenchsimError(
            f"{where}: is no '{kind}' line ({key}: {first['msg'][:100]}); it was not written by benchsim"
        ) from None


def standing(lines: list[Line], name: str = NAME) -> Standing:
    """What the lines say, if they may follow one another as they do.

    Raises
    ------
    BenchsimError
        Names the first line that cannot stand where it does.
    """
    if not lines or lines[0]["kind"] != "trial":
        raise BenchsimError(f"{name}: line 1: is not the first line of a trial")
    count, newer = lines[0]["cases"], lines[0]["format"] == FORMAT
    concealed: dict[str, Line] = {}
    judged: dict[str, tuple[Line, ...]] = {}
    opened: dict[str, Line] = {}
    signed: dict[str, Line] = {}
    sealed, committed = False, False
    closed: Line | None = None
    last = ""
    for number, line in enumerate(lines, 1):
        kind, case = line["kind"], line.get("case")
        fits = closed is None and line.get("cases", count) == count

        def is_next(done: Mapping[str, Any], case: str | None = case) -> bool:
            return len(done) < count and case == case_of(len(done) + 1)

        if kind == "trial":
            fits &= number == 1
        elif kind == "concealed":
            fits &= not sealed and is_next(concealed) and ("clues" in line) == newer
            concealed[str(case)] = line
        elif kind == "sealed":
            fits &= not sealed and len(concealed) == count
            sealed = True
        elif kind == "signed":
            fits &= newer and last in (("sealed",) if line["by"] == "concealer" else ("committed", "judged"))
            fits &= line["by"] == "concealer" or (committed and not opened)
            signed[line["by"]] = line
        elif kind == "judged" and line["run"] == 1:
            fits &= sealed and not committed and is_next(judged)
            judged[str(case)] = (line,)
        elif kind == "judged":
            fits &= committed and not opened and case in judged and line["run"] == len(judged[str(case)]) + 1
            judged[str(case)] = (*judged.get(str(case), ()), line)
            signed.pop("judge", None)
        elif kind == "committed":
            fits &= not committed and len(judged) == count
            committed = True
        elif kind == "opened":
            fits &= committed and is_next(opened)
            opened[str(case)] = line
        elif kind == "closed":
            fits &= len(opened) == count and ("page" in line) == newer
            closed = line
        last = kind
        if not fits:
            raise BenchsimError(
                f"{name}: line {number}: '{kind}' {(case or '')[:20]} cannot stand here; it was added or moved"
            )
    head = str(lines[-1]["hash"])
    return Standing(lines[0], concealed, judged, opened, signed, sealed, committed, closed, head)


def append(path: Path, lines: Iterable[Mapping[str, Any]]) -> str:
    """Append lines, chained to what stands there, and see them onto the disk; returns the last hash."""
    there = read(path) if path.exists() else []
    new = follow(there[-1]["hash"] if there else START, lines)
    with path.open("ab") as file:
        file.write(b"".join(canonical(line) + b"\n" for line in new))
        file.flush()
        os.fsync(file.fileno())
    return str((new or there)[-1]["hash"])


def mend(path: Path) -> None:
    """Take away a last line that a stop cut off; nothing that was whole is touched."""
    if not path.exists():
        return
    data = path.read_bytes()
    whole = data.rfind(b"\n") + 1
    if whole < len(data):
        with path.open("r+b") as file:
            file.truncate(whole)
