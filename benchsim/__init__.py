"""benchsim: a heliostat bench as software, and the instrument that reads it.

Mitsuba's ``llvm_*`` variants need a shared libLLVM, which Dr.Jit looks up once, when it is first
imported. The wheel ``karellen-llvm-core`` brings one; this module points Dr.Jit to it and imports
nothing heavy. A path the user set in ``DRJIT_LIBLLVM_PATH`` is left alone.
"""

import os
import sys

__version__ = "0.1.0"

#: Sentence shown when drjit was imported before benchsim and no libLLVM was chosen; None if all is well.
llvm_import_order: str | None = None


def _bundled_llvm() -> str | None:
    """Path of the libLLVM that the wheel ``karellen-llvm-core`` installed, or None."""
    from importlib.metadata import PackageNotFoundError, files

    try:
        entries = files("karellen-llvm-core") or []
    except PackageNotFoundError:
        return None
    for entry in entries:
        if entry.name.startswith("libLLVM.so."):
            path = entry.locate()
            if os.path.exists(path):
                return os.path.realpath(path)
    return None


if "DRJIT_LIBLLVM_PATH" not in os.environ:
    _path = _bundled_llvm()
    if _path is not None:
        if "drjit" in sys.modules or "mitsuba" in sys.modules:
            llvm_import_order = (
                "drjit or mitsuba was imported before benchsim, so the libLLVM that benchsim brings was not "
                "used: move the line 'import benchsim' above 'import mitsuba' and 'import drjit'."
            )
        else:
            os.environ["DRJIT_LIBLLVM_PATH"] = _path
