"""Usage errors with their mend: what click says of them names neither the option that was meant nor where to look."""

from __future__ import annotations

import difflib
from typing import Any

from typer.core import TyperGroup


class Commands(TyperGroup):
    """The commands; an error in how one was called ends with the nearest option or the command's ``--help``."""

    def make_context(self, *args: Any, **options: Any) -> Any:
        """As click's, of the options before a command."""
        try:
            return super().make_context(*args, **options)
        except Exception as error:
            _mend(error)
            raise

    def invoke(self, ctx: Any) -> Any:
        """As click's, of a command and all below it."""
        try:
            return super().invoke(ctx)
        except Exception as error:
            _mend(error)
            raise


def _mend(error: Exception) -> None:
    """Put the mend into a usage error. Typer brings a click of its own or not, so that it is known by what it has."""
    where = getattr(error, "ctx", None)
    if where is None or not hasattr(error, "format_message") or type(error).__name__ == "NoArgsIsHelpError":
        return
    mend = f"'{where.command_path} --help' tells what it takes"
    if hasattr(error, "option_name") and hasattr(error, "possibilities"):
        known = [o for p in where.command.params for o in (*p.opts, *p.secondary_opts)]
        near = difflib.get_close_matches(error.option_name, known, n=1)
        mend = f"did you mean {near[0]}? {mend}" if near else mend
        error.possibilities = None
    # Of an option's choices a newer click says what kind of error it met.
    said = str(error.message or "").replace("Value error, ", "").rstrip(".")  # type: ignore[attr-defined]
    error.message = f"{said}; {mend}." if said else f"{mend[0].upper()}{mend[1:]}."  # type: ignore[attr-defined]
