"""One function per command; each takes paths and options, writes an output folder and returns the finished result.

The functions are looked up when they are first used, so that ``import benchsim.jobs`` stays light.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_MODULES = {
    "run": "running",
    "render": "rendering",
    "fit": "fitting",
    "validate": "validating",
    "diagnose": "diagnosing",
    "field": "field_diagnosis",
    "flux": "plant_flux",
    "detectors": "plant_detectors",
    "detectors_read": "detector_record",
    "drone": "plant_drone",
    "drone_read": "drone_photos",
    "effects": "effect_catalogue",
    "report": "reporting",
    "board": "board_print",
    "calibrate": "calibrating",
    "new": "new_recording",
    "check": "checking",
    "sample": "sample_recording",
    "predict": "predicting",
    "aim": "aiming",
    "export": "exporting",
}

__all__ = [
    "aim",
    "board",
    "calibrate",
    "check",
    "detectors",
    "detectors_read",
    "diagnose",
    "drone",
    "drone_read",
    "effects",
    "export",
    "field",
    "fit",
    "flux",
    "new",
    "predict",
    "render",
    "report",
    "run",
    "sample",
    "validate",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'benchsim.jobs' has no attribute {name!r}")
    return getattr(import_module(f"benchsim.jobs.{_MODULES[name]}"), name)
