"""The chain and the order of the ledger: what was changed, removed, moved or added is found, whatever it looks like."""

import json
import os

import pytest

from benchsim import trial
from benchsim.bench.errors import BenchsimError
from benchsim.bench.reading import JSON_BYTES
from benchsim.trial import ledger
from benchsim.trial.hashing import canonical


@pytest.fixture(scope="module")
def lines(opened):
    return ledger.read(opened / ledger.NAME)


def chained_anew(lines):
    """The same lines with all hashes computed again, as a forger would."""
    before, out = ledger.START, []
    for line in lines:
        whole = ledger.chained(before, {k: v for k, v in line.items() if k not in ("before", "hash")})
        before = whole["hash"]
        out.append(whole)
    return out


def written(path, lines):
    path.write_bytes(b"".join(canonical(line) + b"\n" for line in lines))
    return path


def stands(path):
    return ledger.standing(ledger.read(path))


def test_what_was_written_stands(opened, lines):
    found = ledger.standing(lines)
    assert found.sealed and found.committed and found.closed is not None
    assert list(found.concealed) == list(found.judged) == list(found.opened) == ledger.cases_of(20)
    assert found.twice == ()


def test_every_changed_byte_is_found(opened, tmp_path):
    data = (opened / ledger.NAME).read_bytes()
    path = tmp_path / "l"
    for at in range(0, len(data), 97):
        path.write_bytes(data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :])
        with pytest.raises(BenchsimError):
            stands(path)


def test_a_line_removed_moved_or_added_is_found(lines, tmp_path):
    path = tmp_path / "l"
    for k in range(len(lines) - 1):
        with pytest.raises(BenchsimError, match=r"removed|first line"):
            stands(written(path, [*lines[:k], *lines[k + 1 :]]))
        with pytest.raises(BenchsimError):
            stands(written(path, [*lines[:k], lines[k + 1], lines[k], *lines[k + 2 :]]))
        with pytest.raises(BenchsimError):
            stands(written(path, [*lines[: k + 1], lines[k], *lines[k + 1 :]]))


def test_a_forger_who_chains_anew_is_found_by_the_order(lines, tmp_path):
    path = tmp_path / "l"
    for k, line in enumerate(lines[:-1]):
        if line["kind"] == "signed":
            assert line["by"] not in stands(written(path, chained_anew([*lines[:k], *lines[k + 1 :]]))).signed
            continue
        with pytest.raises(BenchsimError):
            stands(written(path, chained_anew([*lines[:k], *lines[k + 1 :]])))
    for extra in (lines[1], lines[30], lines[-1], {"kind": "remark", "case": "001"}):
        with pytest.raises(BenchsimError, match=r"cannot stand here|no kind that is known"):
            stands(written(path, chained_anew([*lines, extra])))


def test_judged_twice_stands_between_commitment_and_opening_only(lines, tmp_path):
    path = tmp_path / "l"
    committed = next(k for k, line in enumerate(lines) if line["kind"] == "committed") + 1
    first = next(line for line in lines if line["kind"] == "judged")
    again = {**first, "run": 2}
    found = stands(written(path, chained_anew([*lines[:committed], again, *lines[committed:]])))
    assert found.twice == ("001",)
    found = stands(written(path, chained_anew([*lines[: committed + 1], again])))
    assert found.twice == ("001",) and list(found.signed) == ["concealer"]
    for place in (committed - 1, committed + 2, len(lines)):
        with pytest.raises(BenchsimError, match="cannot stand here"):
            stands(written(path, chained_anew([*lines[:place], again, *lines[place:]])))
    with pytest.raises(BenchsimError, match="cannot stand here"):
        stands(written(path, chained_anew([*lines[:committed], {**first, "run": 3}])))


def test_lines_are_appended_and_a_cut_one_is_mended(lines, tmp_path):
    path = tmp_path / "l"
    new = [{k: v for k, v in line.items() if k not in ("before", "hash")} for line in lines[:3]]
    ledger.append(path, new[:1])
    ledger.append(path, new[1:])
    whole = path.read_bytes()
    with path.open("ab") as file:
        file.write(b'{"before":"')
    with pytest.raises(BenchsimError, match="cut off"):
        ledger.read(path)
    ledger.mend(path)
    assert path.read_bytes() == whole
    assert [json.loads(line)["kind"] for line in whole.splitlines()] == ["trial", "concealed", "concealed"]


def refused(do, *arguments):
    """The one sentence that it ends in."""
    with pytest.raises(BenchsimError) as error:
        do(*arguments)
    assert "\n" not in str(error.value) and len(str(error.value)) < 1000
    return str(error.value)


NO_LEDGERS = {
    "empty": b"",
    "no JSON": b"format = 1\n",
    "nests": b"[" * 100_000 + b"]" * 100_000 + b"\n",
    "nests in a line": b'{"a":' * 50_000 + b"1" + b"}" * 50_000 + b"\n",
    "digits": b'{"before":' + b"9" * 5_000 + b"}\n",
    "no mapping": b"[]\nnull\n",
    "not a number": b'{"before":NaN}\n',
    "NUL": bytes(1000) + b"\n",
    "no UTF-8": b"\xff\xfe{}\n",
    "lines": b"\n" * 1000,
}


@pytest.mark.parametrize("name", NO_LEDGERS)
def test_what_is_no_ledger_ends_in_a_sentence(spoilt, name):
    for part in ("recordings", "verdicts", "."):
        path = spoilt / part / ledger.NAME
        whole = path.read_bytes()
        path.write_bytes(NO_LEDGERS[name])
        assert ledger.NAME in refused(trial.verify, spoilt)
        path.write_bytes(whole)


def test_what_is_no_file_of_its_size_ends_in_a_sentence(spoilt):
    path = spoilt / ledger.NAME
    with path.open("r+b") as file:
        file.truncate(JSON_BYTES + 1)
    assert "may have 64 MiB" in refused(trial.verify, spoilt)
    path.unlink()
    path.mkdir()
    refused(trial.verify, spoilt)
    path.rmdir()
    if hasattr(os, "mkfifo"):
        os.mkfifo(path)
        assert "no ordinary file" in refused(trial.verify, spoilt)


WRONG = (None, True, -1, 10**30, 1e300, "", "x" * 500, "\x1b[2J\n", "\ud800", [], [[]], {}, {"a": {"a": 0}})


def test_lines_of_another_form_end_in_a_sentence(lines, tmp_path):
    """Every key of every kind of line with every wrong value, without it, and with one more; chained rightly."""
    path, tried = tmp_path / "l", 0
    for kind in ledger.KINDS:
        k = next(k for k, line in enumerate(lines) if line["kind"] == kind)
        # What else there is may hold what it likes: it is compared with files, or shown.
        free = {"withheld": ([],), "versions": ({},), "certificate": ({}, {"a": {"a": 0}}), "files": ({},)}
        free |= {"clues": ({},), "says": ("", "x" * 500, "\x1b[2J\n", "\ud800")}
        own = {key: value for key, value in lines[k].items() if key not in ("before", "hash")}
        mutants = [{**own, key: bad} for key in own for bad in WRONG if bad not in free.get(key, ())]
        mutants += [{key: v for key, v in own.items() if key != gone} for gone in own] + [{**own, "more": 1}]
        for mutant in mutants:
            refused(stands, written(path, chained_anew([*lines[:k], mutant, *lines[k + 1 :]])))
        tried += len(mutants)
    assert tried > 400
