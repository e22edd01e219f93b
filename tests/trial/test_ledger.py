"""The chain and the order of the ledger: what was changed, removed, moved or added is found."""

import json

import pytest

from benchsim.bench.errors import BenchsimError
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
