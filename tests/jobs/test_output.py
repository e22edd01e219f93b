"""Output folders: replaced whole by the same command, refused otherwise, never half-written."""

import json
import os

import pytest

from benchsim.bench.errors import BenchsimError
from benchsim.jobs.output import default_folder, output_folder


def write(target, command="fit", inputs=(), text="one"):
    with output_folder(target, command, inputs) as staging:
        (staging / "result.txt").write_text(text)


def test_a_stamp_names_command_inputs_versions_and_defaults(tmp_path):
    source = tmp_path / "a.toml"
    source.write_text("x")
    with output_folder(tmp_path / "out", "fit", [source], {"pixels": False}, ["laser.wavelength_nm = 632.8"]):
        pass
    stamp = json.loads((tmp_path / "out" / "benchsim.json").read_text())
    assert stamp["command"] == "fit" and stamp["options"] == {"pixels": False}
    assert stamp["inputs"]["a.toml"].startswith("2d711642b726b044")
    assert {"benchsim", "numpy", "mitsuba"} <= set(stamp["versions"])
    assert stamp["defaults_used"] == ["laser.wavelength_nm = 632.8"]


def test_the_same_command_replaces_the_folder_whole(tmp_path):
    write(tmp_path / "out", text="one")
    (tmp_path / "out" / "left-over.txt").write_text("from before")
    write(tmp_path / "out", text="two")
    assert (tmp_path / "out" / "result.txt").read_text() == "two"
    assert not (tmp_path / "out" / "left-over.txt").exists()
    assert [p.name for p in tmp_path.iterdir()] == ["out"], "no temporary folder stays behind"


def test_an_empty_folder_is_taken(tmp_path):
    (tmp_path / "out").mkdir()
    write(tmp_path / "out")
    assert (tmp_path / "out" / "result.txt").exists()


@pytest.mark.parametrize("kind", ["foreign", "other command", "broken stamp"])
def test_another_non_empty_folder_is_refused_before_the_work(tmp_path, kind):
    out = tmp_path / "out"
    out.mkdir()
    (out / "precious.txt").write_text("mine")
    if kind == "other command":
        (out / "benchsim.json").write_text('{"command": "render"}')
    if kind == "broken stamp":
        (out / "benchsim.json").write_text("[")
    with pytest.raises(BenchsimError, match="not empty"), output_folder(out, "fit", []):
        pytest.fail("the work must not start")
    assert (out / "precious.txt").read_text() == "mine"


def test_a_failure_leaves_the_old_result_and_nothing_half_written(tmp_path):
    write(tmp_path / "out", text="good")
    with pytest.raises(RuntimeError), output_folder(tmp_path / "out", "fit", []) as staging:
        (staging / "result.txt").write_text("half")
        raise RuntimeError("stopped on the way")
    assert (tmp_path / "out" / "result.txt").read_text() == "good"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_a_file_in_the_way_is_named(tmp_path):
    (tmp_path / "out").write_text("a file")
    with pytest.raises(BenchsimError, match="is a file"):
        write(tmp_path / "out")


def test_an_input_inside_the_output_is_refused(tmp_path):
    write(tmp_path / "out")
    with pytest.raises(BenchsimError, match=r"holds the input result\.txt"):
        write(tmp_path / "out", inputs=[tmp_path / "out" / "result.txt"])


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_permission_is_named(tmp_path):
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(BenchsimError, match=r"permission|Permission"):
            write(tmp_path / "out")
    finally:
        tmp_path.chmod(0o700)


def test_a_file_as_parent_is_named(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(BenchsimError, match="cannot be written"):
        write(tmp_path / "file" / "out")


def test_default_names(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bench.toml").write_text("")
    (tmp_path / "rec").mkdir()
    (tmp_path / "rec" / "recording.toml").write_text("")
    assert str(default_folder(tmp_path / "bench.toml", "run")) == "bench-run"
    assert str(default_folder(tmp_path / "rec", "fit")) == "rec-fit"
    assert str(default_folder(tmp_path / "rec" / "recording.toml", "fit")) == "rec-fit"
