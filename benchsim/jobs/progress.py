"""How a job tells what it is doing."""

from collections.abc import Callable

Progress = Callable[[str, float], None]
"""Called with what is being done and the fraction done."""


def silent(what: str, done: float) -> None:
    """Tell nobody."""
