"""Pages of the manual that are made from the repository: rooms' own pages, the commands' help, the effects."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path

import click
import effect_pictures
import typer

from benchsim.cli import app
from benchsim.instruments.bench.effects import CATALOGUE, Entry

ROOT = Path(__file__).resolve().parents[1]

ROOMS = {
    "recording": "benchsim/bench/README.md",
    "method": "benchsim/diagnosis/README.md",
    "mount-formats": "benchsim/instruments/mount/README.md",
    "effect-of-your-own": "benchsim/instruments/bench/CONTRIBUTING.md",
    "rays": "benchsim/rays/README.md",
    "trials": "benchsim/trial/README.md",
    "published-trial": "analysis/trial/README.md",
    "trial-before": "analysis/trial/d4ec409.md",
    "study": "analysis/study/README.md",
    "phone": "scenes/phone/README.md",
}
"""Page of the manual → page of the repository."""

LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)")


def write(folder: Path, pictures: bool = True) -> None:
    """Make all of these pages in a folder of the manual; pictures of the effects take half a minute."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for name, path in ROOMS.items():
        text = (ROOT / path).read_text(encoding="utf-8")
        (folder / f"{name}.md").write_text(relinked(text, (ROOT / path).parent, f"gathered/{name}"), encoding="utf-8")
    (folder / "help.md").write_text("# What the commands take\n\n" + "\n".join(_help()), encoding="utf-8")
    drawn = effect_pictures.draw(folder) if pictures else {}
    (folder / "catalogue.md").write_text("\n".join(_catalogue(drawn)), encoding="utf-8")


def relinked(text: str, folder: Path, page: str) -> str:
    """Links of a page that lies in a folder of the repository, from a page of the manual.

    What is no page of the manual is named as a file; pictures are taken from where they are.
    """
    pages = {str((ROOT / path).resolve()): f"gathered/{name}.md" for name, path in ROOMS.items()}
    pages |= {str(p): str(p.relative_to(ROOT / "docs")) for p in (ROOT / "docs").rglob("*.md")}
    home = (ROOT / "docs" / page).parent

    def link(match: re.Match[str]) -> str:
        picture, words, to = match.groups()
        path, _, anchor = to.partition("#")
        if to.startswith(("http", "mailto", "#")):
            return match.group()
        there = (folder / path).resolve()
        if picture:
            return f"![{words}]({os.path.relpath(there, home)})"
        if str(there) not in pages:
            return f"{words} (`{there.relative_to(ROOT)}`)" if words != f"`{path}`" else words
        return f"[{words}]({os.path.relpath(ROOT / 'docs' / pages[str(there)], home)}{'#' if anchor else ''}{anchor})"

    return LINK.sub(link, text)


def _commands(group: click.Group, path: tuple[str, ...] = ("benchsim",)) -> Iterator[tuple[str, click.Command]]:
    for name, command in group.commands.items():
        if isinstance(command, click.Group):
            yield from _commands(command, (*path, name))
        else:
            yield " ".join((*path, name)), command


def _help() -> Iterator[str]:
    for name, command in _commands(typer.main.get_command(app)):  # type: ignore[arg-type]
        with click.Context(command, info_name=name, terminal_width=100, max_content_width=100) as context:
            yield f"## {name}\n\n```text\n{command.get_help(context)}\n```\n"


def _catalogue(drawn: Mapping[str, str]) -> Iterator[str]:
    yield "# The catalogue of effects\n"
    yield (
        "What `diagnose` looks for on a bench. The range of a parameter is what is plausible; each amplitude has a "
        "prior of half of it. A picture shows what it does at its cap, and where it would be seen at five sigma: what "
        "setting errors can do too does not count, so that this may lie far outside the noise. In a bench file: "
        "`[effects.NAME]` with these parameters.\n"
    )
    element = ""
    for e in CATALOGUE:
        if e.element != element:
            element = e.element
            yield f"## {element.capitalize()}\n"
        yield from _entry(e)
        if e.name in drawn:
            yield f"![{e.name}]({e.name}.png)\n\n{drawn[e.name]}\n"


def _entry(e: Entry) -> Iterator[str]:
    yield f"### {e.name}\n\n{e.says}\n"
    yield "| parameter | unit | range | |\n|---|---|---|---|"
    for t in e.terms:
        low = "0 …" if t.one_sided else "±"
        yield f"| `{t.name}` | {'' if t.unit == '1' else t.unit} | {low} {t.cap:g} | {'shape' if t.grid else ''} |"
    yield f"\nOn the bench: {e.remedy} Source: {e.source}."
    if e.synonyms:
        yield f"No recording of this bench tells from it: {', '.join(e.synonyms)}."
    if e.drawn:
        yield e.drawn
    yield ""
