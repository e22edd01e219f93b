"""What pydantic finds amiss in a file, as one sentence with key and mend."""

from __future__ import annotations

import difflib
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

UNFILLED = "?"
"""Value of a key that only the person at the bench knows, in a file that was begun for them."""


def first(error: ValidationError, model: type[BaseModel]) -> str:
    """Turn pydantic's first error into one sentence with key and mend; unknown keys first, they explain the rest."""
    errors = sorted(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
    return ": ".join(complaint(errors[0], model))


def complaint(one: Any, model: type[BaseModel]) -> tuple[str, str]:
    """Key and mend of one of pydantic's errors about a file that ``model`` describes."""
    loc = [
        part
        for part in one["loc"]
        if part not in ("float", "constrained-float", "function-wrap") and not _is_union_tag(part)
    ]
    key = _key_name(loc)
    kind, value = one["type"], one.get("input")
    if kind == "extra_forbidden":
        return key, f"unknown key; {_suggestion(loc, model)}"
    if kind == "missing":
        return key, "required and missing; add it"
    if value == UNFILLED:
        return key, "not filled in; write what it is on your bench"
    return key, _mend(kind, one, value)


def _is_union_tag(part: Any) -> bool:
    return isinstance(part, str) and (part.startswith(("literal[", "constrained")) or part in {"int", "str", "none"})


def _key_name(loc: list[Any]) -> str:
    name = ""
    for part in loc:
        name += f"[{part + 1}]" if isinstance(part, int) else f".{part}" if name else str(part)
    return name


def _suggestion(loc: list[Any], model: type[BaseModel]) -> str:
    for part in loc[:-1]:
        if isinstance(part, str) and part in model.model_fields:
            model = _within(model.model_fields[part].annotation) or model
    known = list(model.model_fields)
    close = difflib.get_close_matches(str(loc[-1]), known, n=1, cutoff=0.6)
    return f"did you mean '{close[0]}'?" if close else f"remove it, known keys are {', '.join(known)}"


def _within(annotation: Any) -> type[BaseModel] | None:
    """The table in an annotation: itself, or that of a list, a mapping or an optional one."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((found for a in get_args(annotation) if (found := _within(a))), None)


def _mend(kind: str, one: Any, value: Any) -> str:
    ctx = one.get("ctx", {})
    shown = repr(value) if len(repr(value)) < 60 else repr(value)[:57] + "…"
    if kind in ("float_type", "int_type", "float_parsing"):
        what = "a whole number" if kind == "int_type" else "a number"
        return f"{shown} is not {what}; write {what} in the key's own unit, without quotes"
    if kind == "finite_number":
        return f"{shown} is not finite; give a finite number"
    if kind in ("too_short", "too_long"):
        want = ctx.get("min_length", ctx.get("max_length"))
        limit = "at least" if kind == "too_short" else "at most"
        return f"{shown} has {len(value)} entries; {limit} {want} are"
    if kind == "list_type":
        return f"{shown} is not a list; write it in brackets"
    if kind == "literal_error":
        return f"{shown} is not known; use {ctx.get('expected')}"
    if kind in ("greater_than", "greater_than_equal", "less_than", "less_than_equal"):
        word = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most"}
        limits = ", ".join(f"{word[k]} {v:g}" for k, v in ctx.items() if k in word)
        return f"{shown} is out of range; it must be {limits} (check the unit in the key)"
    if kind == "bool_type":
        return f"{shown} is neither true nor false; write true or false without quotes"
    if kind == "string_type":
        return f"{shown} is not text; put it in quotes"
    if kind in ("model_type", "dict_type", "model_attributes_type"):
        return f"{shown} is not a table; write it as a [table]"
    return f"{shown}: {one['msg'][0].lower()}{one['msg'][1:]}; mend that value"
