"""What the command line says of itself."""

import json
import re

import pytest
import typer
from typer.testing import CliRunner

from benchsim import __version__
from benchsim.cli import app


def commands(group=None, path=()):
    """Every command with the words that lead to it."""
    group = group or typer.main.get_command(app)
    for name, command in group.commands.items():
        yield (*path, name), command
        if hasattr(command, "commands"):
            yield from commands(command, (*path, name))


COMMANDS = dict(commands())


def squeezed(text):
    return re.sub(r"\s", "", text)


def help_of(path):
    done = CliRunner().invoke(app, [*path, "--help"], env={"COLUMNS": "80", "TERMINAL_WIDTH": "80"})
    assert done.exit_code == 0
    return squeezed(done.output)


@pytest.mark.parametrize("path", COMMANDS, ids=" ".join)
def test_every_word_of_a_help_text_survives(path):
    """Help is written as it is shown: nothing in it is taken for markup, and no option is cut short."""
    shown, command = help_of(path), COMMANDS[path]
    assert squeezed(command.help) in shown
    for parameter in command.params:
        assert squeezed(parameter.help or "") in shown
        assert all(o in shown for o in parameter.opts if o.startswith("-"))


@pytest.mark.parametrize("path", [(), ("trial",), ("detectors",), ("drone",)], ids=lambda p: p[0] if p else "benchsim")
def test_the_list_of_commands_says_each_in_a_sentence(path):
    assert "..." not in help_of(path).partition("Commands:")[2]


def test_the_version_is_said():
    assert CliRunner().invoke(app, ["--version"]).output == f"benchsim {__version__}\n"


def test_a_complaint_is_json_too_where_that_was_asked_for(tmp_path):
    done = CliRunner().invoke(app, ["check", str(tmp_path / "none"), "--json"])
    assert done.exit_code == 1
    assert done.stderr == f"benchsim: {json.loads(done.stdout)['error']}\n"
    assert CliRunner().invoke(app, ["check", str(tmp_path / "none")]).stdout == ""


@pytest.mark.parametrize(
    ("args", "mend"),
    [
        (["fit", "--pixel", "x"], "did you mean --pixels? 'benchsim fit --help' tells what it takes."),
        (["fit"], "'benchsim fit --help' tells what it takes."),
        (["--versoin"], "did you mean --version? 'benchsim --help'"),
        (["trial", "judge", "--agian", "x"], "did you mean --again? 'benchsim trial judge --help'"),
        (["render", "x.toml", "--seed", "one"], "'benchsim render --help' tells what it takes."),
        (["flux", "x", "--engine", "y"], "Invalid value for '--engine': 'y' is not one of"),
        (["fitt"], "'benchsim --help' tells what it takes."),
    ],
)
def test_a_usage_error_names_its_mend(args, mend):
    done = CliRunner().invoke(app, args, prog_name="benchsim")
    assert done.exit_code == 2 and mend in done.output
