"""Where this machine keeps a libLLVM that Dr.Jit can use, without which nothing is rendered on a CPU.

Dr.Jit looks one up itself, once, when it is first imported, and takes the first that it meets, which on many machines
is too old: LLVM 14 and 15 abort in the middle of a kernel. So the newest of those that are known not to is chosen here.
"""

from __future__ import annotations

import glob
import os
import re
import sys

OLDEST = 19
"""Version of LLVM that is taken without being asked for."""

PLACES = {
    "linux": ("/usr/lib/llvm-*/lib/libLLVM*.so*", "/usr/lib/*-linux-gnu/libLLVM*.so*", "/usr/lib64/libLLVM*.so*"),
    "darwin": (
        "/opt/homebrew/opt/llvm*/lib/libLLVM*.dylib",
        "/opt/homebrew/Cellar/llvm*/*/lib/libLLVM*.dylib",
        "/usr/local/opt/llvm*/lib/libLLVM*.dylib",
    ),
    "win32": (r"C:\Program Files\LLVM*\bin\LLVM-C.dll",),
}
"""Of Debian and Fedora, Homebrew (Apple's and Intel's), and LLVM's own installer for Windows."""


def find() -> str | None:
    """Path of the libLLVM to use: that of the wheel ``karellen-llvm-core``, else the machine's newest; or None."""
    return _of_the_wheel() or _of_the_machine()


def _of_the_wheel() -> str | None:
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


def _of_the_machine() -> str | None:
    found = [p for pattern in PLACES.get(sys.platform, ()) for p in glob.glob(pattern)]
    return max((p for p in found if _version(p) >= OLDEST), key=_version, default=None)


def _version(path: str) -> int:
    """As its path has it, links resolved: libLLVM.so.19.1, libLLVM-19.so, llvm-19/, llvm@19/; newest where none is."""
    numbers = re.findall(r"(?:llvm|llvm-c)[-@/\\]?(?:\.so\.|\.dylib\.)?(\d+)", os.path.realpath(path), re.IGNORECASE)
    return int(numbers[-1]) if numbers else 1000
