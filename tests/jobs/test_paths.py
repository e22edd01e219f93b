"""Files from strangers: no key of theirs makes a command show, or read as its own, what lies elsewhere on the disk.

Every key that holds a path is led out of its folder in each way there is: by an absolute path, by ``..``, by a link.
"""

import hashlib
import json
import os
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from benchsim import jobs
from benchsim.bench.errors import BenchsimError
from benchsim.bench.files import read
from benchsim.cli import app
from benchsim.jobs.field_list import heliostats

CORPUS = Path(__file__).resolve().parents[1] / "hostile" / "corpus"
BENCH = (CORPUS / "recording" / "recording.toml").read_text()
for _before, _after in (
    ("[cameras.A]", '[screen]\nmarks = "marks.csv"\n\n[cameras.A]'),
    ('image = "001.png"', 'image = "001.png"\ndark = "001-dark.png"'),
):
    BENCH = BENCH.replace(_before, _after)


@pytest.fixture
def sent(tmp_path):
    """A folder as it was sent, and beside it what it may not name."""
    folder = tmp_path / "sent"
    (folder / "photographs").mkdir(parents=True)
    (folder / "recording.toml").write_text(BENCH)
    (folder / "marks.csv").write_text("id,y_mm,z_mm,side_mm\n0,0,318.0,32.0\n")
    for name in ("001.png", "001-dark.png", "photographs/1.jpg"):
        (folder / name).write_bytes(b"a picture")
    for name in ("page.json", "validation.json", "conics.json"):
        shutil.copy(CORPUS / "validation" / name, folder)
    (folder / "list.csv").write_text("id,path,tower\nAA39,plant,tower.json\n")
    (folder / "plant").mkdir()
    (folder / "tower.json").write_text("{}")
    (tmp_path / "private").mkdir()
    return folder


KEYS = {
    # file and key as the complaint names them; what is named; the reader
    "marks": ("recording.toml", "screen.marks", "marks.csv", lambda f, **k: read(f, **k)),
    "image": ("recording.toml", "exposure[1].image", "001.png", lambda f, **k: read(f, **k)),
    "dark": ("recording.toml", "exposure[1].dark", "001-dark.png", lambda f, **k: read(f, **k)),
    "photograph": ("page.json", "exposures[1].photograph", "photographs/1.jpg", lambda f, **k: jobs.report(f, **k)),
    "path": ("list.csv", "path", "plant", lambda f, **k: heliostats(f / "list.csv", None, **k)),
    "tower": (
        "list.csv",
        "tower",
        "tower.json",
        lambda f, **k: heliostats(f / "list.csv", None, **k),
    ),
}


def led_out(sent, name, way, file):
    """Move what a file names into the folder beside, and name it there, or link to it."""
    private = sent.parent / "private" / Path(name).name
    shutil.move(sent / name, private)
    if way == "link":
        (sent / name).symlink_to(private)
        return
    new = str(private) if way == "absolute" else f"../private/{private.name}"
    text = (sent / file).read_text()
    assert name in text
    (sent / file).write_text(text.replace(f'"{name}"', f'"{new}"') if file != "list.csv" else text.replace(name, new))


@pytest.mark.parametrize("way", ["absolute", "..", "link"])
@pytest.mark.parametrize("what", KEYS)
def test_what_leads_out_of_the_folder_is_one_sentence_with_file_key_and_mend(sent, what, way):
    file, key, name, reader = KEYS[what]
    led_out(sent, name, way, file)
    with pytest.raises(BenchsimError, match="--allow-outside") as caught:
        reader(sent)
    told = str(caught.value)
    assert file in told and f"{key}: " in told and "leads out of" in told and "\n" not in told
    assert not (sent / "report.html").exists()
    assert reader(sent, allow_outside=True)


@pytest.mark.parametrize("name", ["validation.json", "conics.json", "page.json", "benchsim.json"])
def test_a_result_that_is_a_link_to_elsewhere_is_not_shown(sent, name):
    (sent / "benchsim.json").write_text("{}")
    shutil.move(sent / name, sent.parent / "private" / name)
    (sent / name).symlink_to(sent.parent / "private" / name)
    with pytest.raises(BenchsimError, match=f"{name}: .*leads out of"):
        jobs.report(sent)


def test_paths_and_links_within_the_folder_are_followed(sent):
    shutil.move(sent / "001.png", sent / "photographs" / "first.png")
    (sent / "001.png").symlink_to("photographs/first.png")
    toml = sent / "recording.toml"
    toml.write_text(toml.read_text().replace('"001-dark.png"', f'"{sent}/photographs/../001-dark.png"'))
    assert read(sent, images=True).exposures[0].image == "001.png"
    linked = sent.parent / "linked"
    linked.symlink_to(sent)
    assert read(linked, images=True).exposures


@pytest.mark.parametrize("name", ["a" * 300, "/".join(["deep"] * 1000)])
def test_what_is_no_path_is_one_sentence(sent, name):
    toml = sent / "recording.toml"
    toml.write_text(toml.read_text().replace('"001.png"', f'"{name}"'))
    with pytest.raises(BenchsimError, match=r"exposure\[1\]\.image: .* cannot be followed") as caught:
        read(sent)
    assert str(caught.value).isprintable() and len(str(caught.value)) < 400


def test_pictures_outside_are_read_where_the_writer_had_them(sent):
    """As in an ``amended.toml`` beside its ``benchsim.json``; another file in their place is refused."""
    picture = sent.parent / "private" / "001.png"
    led_out(sent, "001.png", "..", "recording.toml")
    known = {"../private/001.png": hashlib.sha256(picture.read_bytes()).hexdigest()}
    (sent / "benchsim.json").write_text(json.dumps({"command": "diagnose", "inputs": known}))
    assert read(sent, images=True).exposures[0].image == "../private/001.png"
    picture.write_bytes(b"another picture")
    with pytest.raises(BenchsimError, match="leads out of"):
        read(sent, images=True)


@pytest.mark.parametrize(
    "command",
    ["run", "render", "fit", "validate", "diagnose", "check", "effects --for"],
)
def test_every_command_that_reads_a_recording_has_the_option(sent, command, monkeypatch):
    """Told of the key without the option; with it, of something else, or of nothing."""
    led_out(sent, "marks.csv", "..", "recording.toml")
    (sent / "001.png").unlink()
    monkeypatch.chdir(sent.parent)
    if command in ("render", "effects --for"):
        (sent.parent / "private" / "marks.csv").write_text("no marks")
    arguments = [*command.split(), str(sent), "-o", str(sent.parent / "out")]
    without, with_it = (CliRunner().invoke(app, [*arguments, *more]) for more in ([], ["--allow-outside"]))
    assert without.exit_code == 1 and "screen.marks" in without.output and "--allow-outside" in without.output
    assert with_it.exit_code == 1 and "leads out" not in with_it.output
    assert not os.path.exists(sent.parent / "out") or command == "check"
