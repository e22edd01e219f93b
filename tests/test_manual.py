"""README and manual: short where they should be, true of the commands they name, and built without a warning."""

import doctest
import importlib
import inspect
import re
import shlex
import subprocess
import sys
from pathlib import Path
from urllib.parse import urlsplit

import pytest
import typer

import benchsim
from benchsim.cli import app

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted(
    p
    for pattern in ("*.md", "docs/**/*.md", "benchsim/**/*.md", "scenes/**/*.md", "analysis/**/*.md")
    for p in ROOT.glob(pattern)
    if "gathered" not in p.parts
)
MAKER = (ROOT / "docs" / "gathered.py").read_text(encoding="utf-8")
LINK = re.compile(r"\]\(([^)\s]+)\)")


def named(path):
    return str(path.relative_to(ROOT))


def commands_in(text):
    """Command lines of benchsim in the code of a page: blocks, and spans that begin with its name."""
    blocks = re.findall(r"```\w*\n(.*?)```", text, re.S)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    for line in [*lines, *re.findall(r"`(benchsim [^`\n]+)`", text)]:
        for part in re.split(r"&&|;|\|", line):
            if match := re.match(r"\s*(?:\$ |\S*/bin/)?benchsim (\S.*)", part):
                yield match.group(1)


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_commands_that_a_page_names_are_there(page):
    for line in commands_in(page.read_text(encoding="utf-8")):
        words, command = shlex.split(line, comments=True), typer.main.get_command(app)
        while words and hasattr(command, "commands") and not words[0].startswith("-"):
            assert words[0] in command.commands, f"benchsim {line}"
            command = command.commands[words.pop(0)]
        options = {o for p in command.params for o in (*p.opts, *p.secondary_opts)} | {"--help", "-h"}
        assert {w.partition("=")[0] for w in words if re.match(r"--?[a-z]", w)} <= options, f"benchsim {line}"


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_what_a_page_links_to_is_there(page):
    for to in LINK.findall(page.read_text(encoding="utf-8")):
        there = page.parent / to.partition("#")[0]
        if there.parent.name == "gathered":
            # Made when the manual is built, perhaps by another test at this very time.
            assert f'"{there.stem}"' in MAKER or f'"{there.name}"' in MAKER, to
        elif not to.startswith(("http", "mailto", "#")):
            assert there.exists(), to


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_web_addresses_are_well_formed(page):
    """Whether somebody answers there, `sphinx-build -b linkcheck` asks."""
    for address in re.findall(r"https?:[^\s)>`\"]*", page.read_text(encoding="utf-8")):
        parts = urlsplit(address)
        assert parts.scheme == "https" and re.fullmatch(r"[a-z0-9-]+(\.[a-z0-9-]+)+", parts.netloc), address
        assert not address.endswith((".", ",", ";", ":")), address
        assert parts.netloc != "doi.org" or re.fullmatch(r"/10\.\d{4,9}/\S+", parts.path), address


EXAMPLES = sorted(p for p in (ROOT / "benchsim").rglob("*.py") if ">>>" in p.read_text(encoding="utf-8"))


@pytest.mark.parametrize("path", EXAMPLES, ids=named)
def test_examples_in_docstrings_do_what_they_say(path, monkeypatch):
    monkeypatch.chdir(ROOT)
    name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    done = doctest.testmod(importlib.import_module(name))
    assert done.attempted and not done.failed


FUNCTIONS = [name for name in benchsim.__all__ if inspect.isfunction(getattr(benchsim, name))]


def test_most_functions_of_the_interface_have_an_example_that_is_run():
    """In a docstring, or in a cell of a tutorial: at least three in five."""
    cells = [
        cell
        for page in (ROOT / "docs" / "tutorials").glob("*.md")
        for cell in re.findall(r"```\{code-cell\} python\n(.*?)```", page.read_text(encoding="utf-8"), re.S)
    ]
    lines = [line for path in EXAMPLES for line in path.read_text(encoding="utf-8").splitlines() if ">>>" in line]
    shown = set(re.findall(r"\bbs\.(\w+)\(", "\n".join([*cells, *lines]))) & set(FUNCTIONS)
    print(f"functions with examples: {len(shown)} of {len(FUNCTIONS)}")
    assert len(shown) >= 0.6 * len(FUNCTIONS), f"none for {', '.join(sorted(set(FUNCTIONS) - shown))}"


def test_the_front_page_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 150
    assert sum(p.stat().st_size for p in (ROOT / "docs" / "pictures").iterdir()) <= 300_000


def built(folder, *options):
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", *options, str(ROOT / "docs"), str(folder)]
    return subprocess.run(command, capture_output=True, text=True)


def test_the_manual_is_built_without_a_warning(tmp_path):
    """Its tutorials are not run here, which takes a minute; `built` without the option does."""
    done = built(tmp_path, "-D", "nb_execution_mode=off")
    assert done.returncode == 0, done.stderr
    api = (tmp_path / "api.html").read_text(encoding="utf-8")
    assert not [name for name in FUNCTIONS if f'id="benchsim.{name}"' not in api]


@pytest.mark.slow
def test_the_tutorials_run(tmp_path):
    done = built(tmp_path)
    assert done.returncode == 0, done.stderr
