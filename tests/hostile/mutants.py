"""Mutants of small files as hypothesis draws them: values exchanged, left out, doubled; bytes that nobody wrote."""

import copy
import json
import re
import tomllib

from hypothesis import strategies as st

from benchsim.trial import ledger

VALUES = (
    None, True, -1, 0, 1, 2**64, 10**400, 1e308, -1e308, 5e-324, 1e-9, float("nan"), float("inf"), "", "?", "x", "nan",
    "x" * 5000, "\0", "\x1b[2J", "a\nb", "../../etc/passwd", "/dev/zero", ".", "a/" * 3000, "=1+1", "\ud800", "ä", [],
    [[]], [0, 0], [1e308, 1e308, 1e308], {}, {"a": 1}, [{}], "2024-02-30T25:61:00Z",
)  # fmt: skip

WORDS = (
    b"", b"\0", b"\xff\xfe", b"\n", b"\r", b'"', b"'", b"[", b"{" * 200, b"[" * 2000, b"=", b",", b":", b"\\", b"#",
    b"1" * 5000, b"1e999", b"-1e308", b"nan", b"inf", b"0x" + b"f" * 5000, b"1_0", b"90:60:60", b"359d59m59s", b"END",
    "\u0663".encode(), b"\xef\xbb\xbf", b"\x1b[31m", b"!", b"RAA:", b"id",
)  # fmt: skip

LARGEST = 2**20
"""Bytes of a mutant: what is larger is tried elsewhere, and is not to be made thousands of times."""

parts = st.floats(0, 1, exclude_max=True)


def literal(value):
    """A value as TOML has it, if it has: None has no form there."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(k, ensure_ascii=False)} = {literal(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(literal, value)) + "]"
    if isinstance(value, float):
        return repr(value)
    return json.dumps(value, ensure_ascii=False)


def places(value, at=()):
    """Every place of nested values."""
    if at:
        yield at
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, one in inner:
        yield from places(one, (*at, key))


def changed(draw, value):
    """One value left out, doubled, moved or exchanged."""
    value = copy.deepcopy(value)
    there = list(places(value))
    *way, last = there[int(draw(parts) * len(there))]
    at = value
    for key in way:
        at = at[key]
    how = draw(st.sampled_from(["exchange"] * 6 + ["leave out", "double", "rename"]))
    if how == "leave out":
        del at[last]
    elif how == "double" and isinstance(at, list):
        at.extend([at[last]] * draw(st.sampled_from([1, 2, 1000])))
    elif how == "rename" and isinstance(at, dict):
        at[draw(st.sampled_from([v for v in VALUES if isinstance(v, str)]))] = at.pop(last)
    else:
        at[last] = draw(st.sampled_from(VALUES) | st.floats() | st.integers() | st.text(max_size=8))
    return value


def scrambled(draw, body):
    """Bytes exchanged for others, whole fields and lines above all."""
    pieces = re.split(rb"([\s,=:]+)", body) if draw(st.booleans()) else [body[i : i + 1] for i in range(len(body))]
    if pieces:
        start = int(draw(parts) * len(pieces))
        end = start + draw(st.sampled_from([0, 1, 1, 1, 2, 8, 10**6]))
        word = draw(st.sampled_from(WORDS) | st.binary(max_size=4))
        pieces[start:end] = draw(st.sampled_from([[word], [], pieces[start:end] * 2, pieces[start:end][:1000] * 300]))
    return b"".join(pieces)[:LARGEST]


@st.composite
def mutants(draw, body, suffix):
    """Bytes of a mutant of a file: of its values where it is JSON, TOML or a ledger, or of its bytes."""
    times = draw(st.integers(1, 3))
    if suffix in (".json", ".toml", ".jsonl") and draw(st.integers(0, 3)):
        if suffix == ".jsonl":
            value = [json.loads(line) for line in body.splitlines()]
        else:
            value = json.loads(body) if suffix == ".json" else tomllib.loads(body.decode())
        for _ in range(times):
            value = changed(draw, value) if value else value
        if suffix == ".json":
            return json.dumps(value).encode()
        if suffix == ".toml":
            lines = (f"{json.dumps(k, ensure_ascii=False)} = {literal(v)}\n" for k, v in value.items())
            return "".join(lines).encode(errors="surrogatepass")
        return chained(value)
    for _ in range(times):
        body = scrambled(draw, body)
    return body


def chained(lines):
    """A ledger whose chain holds, as a forger would write it; lines that cannot be chained as they are."""
    out, before = [], ledger.START
    for line in lines:
        try:
            whole = ledger.chained(before, {k: v for k, v in line.items() if k not in ("before", "hash")})
            before = whole["hash"]
            out.append(ledger.canonical(whole))
        except (AttributeError, ValueError, TypeError):
            out.append(json.dumps(line).encode())
    return b"".join(line + b"\n" for line in out)
