"""The fields of a ``recording.toml`` that was begun: its own lines, with the ranges that the reader checks.

Nothing is listed anew: keys, comments and values are those of the text, ranges and choices those of `bench.schema`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args, get_origin

import tomlkit
from pydantic import BaseModel

from benchsim.bench import schema
from benchsim.bench.complaints import UNFILLED

_TABLE = re.compile(r"\[+(?P<table>[^\]]+)\]+\s*(?:#\s*(?P<comment>.*))?$")
_ENTRY = re.compile(r"(?P<key>[A-Za-z0-9_]+) = ")
_UNITS = ("mm", "deg", "mrad", "nm", "px", "s", "fraction")


@dataclass(frozen=True)
class Entry:
    """A line ``key = value  # comment``.

    Attributes
    ----------
    key, comment : str
    unit : str
        That the key carries.
    value : str
        As the file has it; empty where it is not filled in.
    choices : tuple of str
        Texts that the reader takes; empty: any.
    kind : str
        ``number``, ``whole``, ``text`` or ``list``.
    words : tuple of str
        That the reader takes in the place of a number.
    length : int
        Of a list.
    ranges : mapping
        ``ge``, ``gt``, ``le`` and ``lt`` of the number, or of each of a list.
    """

    key: str
    comment: str
    unit: str
    value: str
    choices: tuple[str, ...]
    kind: str
    words: tuple[str, ...]
    length: int
    ranges: dict[str, float]


@dataclass(frozen=True)
class Section:
    """A table of the file: its title, a remark, and its lines; those that are no entry stand as they are."""

    title: str
    remark: str
    lines: tuple[Entry | str, ...]


def sections(text: str) -> list[Section]:
    """The tables of a recording's text in their order. Exposures all have the comments of the first.

    Parameters
    ----------
    text : str
        As `filling.recording_toml` makes it.
    """
    found: list[tuple[str, str, list[Entry | str]]] = [("recording", "", [])]
    said: dict[tuple[str, str], str] = {}
    exposures = 0
    for line in text.split("\n"):
        if head := _TABLE.match(line):
            title = head["table"].replace('"', "")
            exposures += title == "exposure"
            name = f"exposure {exposures}" if title == "exposure" else title
            found.append((name, head["comment"] or "", [line]))
            continue
        title = found[-1][0].split(" ")[0].split(".")[0]
        if entry := _entry(line, title):
            comment = said.setdefault((title, entry.key), entry.comment)
            found[-1][2].append(Entry(**{**asdict(entry), "comment": entry.comment or comment}))
        else:
            found[-1][2].append(line)
    return [Section(title, remark, tuple(lines)) for title, remark, lines in found]


def shown(text: str) -> dict[str, Any]:
    """Plain values for a page: ``lines`` of the file, entries as mappings; ``sections`` with their entries' numbers."""
    lines: list[Any] = []
    out = []
    for s in sections(text):
        first = len(lines)
        lines += [line if isinstance(line, str) else asdict(line) for line in s.lines]
        fields = [(n, line) for n, line in enumerate(lines[first:], first) if not isinstance(line, str)]
        out.append({"title": s.title, "remark": s.remark, "fields": fields})
    return {"lines": lines, "sections": out}


def _entry(line: str, title: str) -> Entry | None:
    match = _ENTRY.match(line)
    if match is None:
        return None
    item: Any = tomlkit.parse(line)[match["key"]]
    value = item.unwrap()
    comment = item.trivia.comment.lstrip("# ")
    constraints = dict(_constraints(_annotation(title, match["key"])))
    if len(constraints.get("choices", ())) == 1:
        return None
    kind = constraints.pop("kind", "text")
    unit = next((u for u in _UNITS if match["key"].endswith(f"_{u}")), "")
    shown = "" if value == UNFILLED else value if isinstance(value, str) else item.as_string()
    return Entry(
        match["key"],
        comment,
        unit,
        shown.strip("[]") if kind == "list" else shown,
        tuple(constraints.pop("choices", ())),
        kind,
        tuple(constraints.pop("words", ())),
        constraints.pop("length", 0),
        constraints,
    )


def _annotation(title: str, key: str) -> Any:
    """Type of a key in the schema, with its ranges as they stand there; None: not in it."""
    model: type[BaseModel] = schema.RecordingFile
    if title != "recording":
        model = next(m for m in _models(schema.RecordingFile.model_fields[title].annotation))
    field = model.model_fields.get(key)
    return None if field is None else (field.annotation, field.metadata)


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from _models(part)


def _constraints(annotation: Any) -> Iterator[tuple[str, Any]]:
    """``kind``, ``length``, ``choices``, ``words`` and ranges of a type: of a list those of each of its numbers."""
    if annotation is None:
        return
    kind, metadata = annotation
    if get_origin(kind) is Literal and all(isinstance(c, str) for c in get_args(kind)):
        yield "choices", get_args(kind)
        return
    if get_origin(kind) is list:
        yield "kind", "list"
        yield "length", next((x.max_length for x in metadata if getattr(x, "max_length", None)), 0)
        inner = get_args(kind)[0]
        yield from _ranges(getattr(inner, "__metadata__", ()))
        return
    if kind in (float, int):
        yield "kind", "number" if kind is float else "whole"
        yield from _ranges(metadata)
        return
    if get_origin(kind) is Literal:
        yield "kind", "whole"
        yield "choices", tuple(map(str, get_args(kind)))
        return
    for part in get_args(kind):
        if getattr(part, "__origin__", part) is float:
            yield "kind", "number"
            yield from _ranges(getattr(part, "__metadata__", ()))
        if get_origin(part) is Literal:
            yield "words", get_args(part)


def _ranges(metadata: Any) -> Iterator[tuple[str, float]]:
    for one in metadata:
        for m in getattr(one, "metadata", [one]):
            yield from ((k, float(getattr(m, k))) for k in ("ge", "gt", "le", "lt") if getattr(m, k, None) is not None)
