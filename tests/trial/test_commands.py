"""The commands: exit 0 done, 1 not verified or unusable, and what a person reads."""

import json
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from benchsim import trial
from benchsim.cli import app


def called(*arguments):
    return CliRunner().invoke(app, ["trial", *map(str, arguments)])


def test_verify_tells_and_exits(spoilt):
    done = called("verify", spoilt)
    assert done.exit_code == 0 and "verified: 20 cases, opened and scored" in done.output
    assert json.loads(called("verify", spoilt, "--json").output)["verified"] is True
    (spoilt / "recordings" / "001" / "001.png").write_bytes(b"")
    done = called("verify", spoilt)
    assert done.exit_code == 1 and "recordings/001/001.png: was changed" in done.output


def test_open_tells_every_case(spoilt):
    done = called("open", spoilt)
    assert done.exit_code == 0
    assert all(f"{k:03d}  " in done.output for k in range(1, 21))


def test_judge_wants_sealed_recordings(tmp_path):
    done = called("judge", tmp_path, "-o", tmp_path / "v")
    assert done.exit_code == 1 and "ledger.jsonl: cannot be read" in done.output


@pytest.mark.parametrize("name", ["conceal", "run"])
def test_what_is_begun_is_what_was_named(monkeypatch, tmp_path, name):
    def job(which):
        return lambda cases, output, **_: SimpleNamespace(summary=lambda: f"{which} {cases} {output}")

    monkeypatch.setattr(trial, "conceal", job("conceal"))
    monkeypatch.setattr(trial, "run", job("run"))
    assert called(name, "--cases", 3, "-o", tmp_path).output == f"{name} 3 {tmp_path}\n"


def test_usage_is_told():
    assert called("conceal", "--cases", 0).exit_code == 2
    assert called().exit_code == 2
