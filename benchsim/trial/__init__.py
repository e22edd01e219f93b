"""Concealed trials of the diagnosis: conceal, judge, open, verify, all of it in a run, and keys; see README.md here.

The functions are looked up when they are first used, so that ``import benchsim.trial`` stays light.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_MODULES = {
    "conceal": "concealing",
    "judge": "judging",
    "open": "opening",
    "verify": "verifying",
    "run": "running",
    "key": "anchors",
}

__all__ = ["conceal", "judge", "key", "open", "run", "verify"]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'benchsim.trial' has no attribute {name!r}")
    return getattr(import_module(f"benchsim.trial.{_MODULES[name]}"), name)
