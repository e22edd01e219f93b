"""benchsim: a heliostat bench as software, and the instrument that reads it.

>>> import benchsim as bs
>>> bench = bs.load("scenes/fig7a.toml")
>>> bench.mirror.facets, len(bench.exposures)
(12, 1)

``bs.render(bench)`` photographs it, and ``bs.fit``, ``bs.validate`` and ``bs.diagnose`` take what that returns. Each
command is the function of its name here; it takes a path or what another has returned, and writes where told.
What these functions and classes are made of is looked up when they are first used, so that this import stays light.

Mitsuba's ``llvm_*`` variants need a shared libLLVM, which Dr.Jit looks up once, when it is first imported; this module
points Dr.Jit to one that works (`llvm`). A path the user set in ``DRJIT_LIBLLVM_PATH`` is left alone.
"""

import os
import sys
from typing import TYPE_CHECKING, Any

from benchsim.llvm import find

if TYPE_CHECKING:
    __version__: str

    from benchsim.api import load, render
    from benchsim.bench.errors import BenchsimError
    from benchsim.bench.model import Camera, Exposure, Laser, Mirror, Physics, Recording, Screen, Uncertainty
    from benchsim.bench.model import Recording as Bench
    from benchsim.jobs.aiming import aim
    from benchsim.jobs.board_print import board
    from benchsim.jobs.calibrating import calibrate
    from benchsim.jobs.checking import check
    from benchsim.jobs.detector_record import detectors_read
    from benchsim.jobs.diagnosing import diagnose
    from benchsim.jobs.drone_photos import drone_read
    from benchsim.jobs.effect_catalogue import effects
    from benchsim.jobs.exporting import export
    from benchsim.jobs.field_diagnosis import field
    from benchsim.jobs.fitting import fit
    from benchsim.jobs.new_recording import new
    from benchsim.jobs.plant_detectors import detectors
    from benchsim.jobs.plant_drone import drone
    from benchsim.jobs.plant_flux import flux
    from benchsim.jobs.predicting import predict
    from benchsim.jobs.reporting import report
    from benchsim.jobs.running import run
    from benchsim.jobs.sample_recording import sample
    from benchsim.jobs.validating import validate

__all__ = [
    "Bench", "BenchsimError", "Camera", "Exposure", "Laser", "Mirror", "Physics", "Recording", "Screen", "Uncertainty",
    "aim", "board", "calibrate", "check", "detectors", "detectors_read", "diagnose", "drone", "drone_read", "effects",
    "export", "field", "fit", "flux", "load", "new", "predict", "render", "report", "run", "sample", "validate",
]  # fmt: skip

#: Sentence shown when drjit was imported before benchsim and no libLLVM was chosen; None if all is well.
llvm_import_order: str | None = None


if "DRJIT_LIBLLVM_PATH" not in os.environ:
    _path = find()
    if _path is not None:
        if "drjit" in sys.modules or "mitsuba" in sys.modules:
            llvm_import_order = (
                "drjit or mitsuba was imported before benchsim, so the libLLVM that benchsim chose was not "
                "used: move the line 'import benchsim' above 'import mitsuba' and 'import drjit'."
            )
        else:
            os.environ["DRJIT_LIBLLVM_PATH"] = _path


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("benchsim")
    if name not in __all__:
        raise AttributeError(f"module 'benchsim' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module("benchsim.api"), name)


def __dir__() -> list[str]:
    return [*globals(), *__all__]
