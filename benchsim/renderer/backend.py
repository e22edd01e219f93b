"""Mitsuba's back end: chosen, tested once in a process of its own, and explained when it does not work.

A bad libLLVM aborts the process in the middle of compiling a kernel, where nothing can be caught; hence the process of
its own. What passed is remembered in the user's cache under the versions and the library that it was tested with.
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib.metadata
import os
import re
import subprocess
import sys
from functools import lru_cache
from pathlib import Path

import drjit as dr
import mitsuba as mi

import benchsim
from benchsim.bench.errors import BenchsimError
from benchsim.bench.writing import write_text

LLVM, CUDA = "llvm_ad_mono", "cuda_ad_mono"

_PROBE = """
import math, sys
import benchsim, drjit as dr, mitsuba as mi
mi.set_variant(sys.argv[1])
x = dr.arange(mi.Float, 1000)
bins = dr.zeros(mi.Float, 10)
dr.scatter_add(bins, dr.maximum(dr.sin(x), 0.5), mi.UInt32(x) % 10)
scene = mi.load_dict({"type": "scene", "shape": {"type": "rectangle"}})
hit = scene.ray_intersect(mi.Ray3f(mi.Point3f(0.002 * x - 1, 0, 1), mi.Vector3f(0, 0, -1)))
expected = sum(max(math.sin(k), 0.5) for k in range(1000))
assert abs(dr.sum(bins)[0] - expected) < 0.01, "wrong sum"
assert dr.count(hit.is_valid())[0] > 990, "wrong hits"
print("works")
"""

_LLVM_MEND = (
    "install a working libLLVM with 'pip install karellen-llvm-core' (Linux x86-64), or set DRJIT_LIBLLVM_PATH to the "
    "file of LLVM 19 or newer"
)


def use(variant: str | None = None) -> str:
    """Set Mitsuba's variant, tested.

    Parameters
    ----------
    variant : str, optional
        Default: what is set already; else ``cuda_ad_mono`` where there is a GPU that passes the test; else
        ``llvm_ad_mono``.

    Returns
    -------
    str
        The variant that is set.

    Raises
    ------
    BenchsimError
        If this Mitsuba is not 3.9, has no such variant, or the variant does not work here; the message says the mend.
    """
    version = importlib.metadata.version("mitsuba")
    if tuple(int(x) for x in version.split(".")[:2]) < (3, 9):
        raise BenchsimError(f"Mitsuba {version} is installed, but benchsim needs 3.9: pip install 'mitsuba>=3.9,<4'")
    name = variant or mi.variant()
    if name is None:
        name = CUDA if dr.has_backend(dr.JitBackend.CUDA) and not _complaint(CUDA, _fingerprint(CUDA)) else LLVM
    if name not in mi.variants():
        raise BenchsimError(
            f"Mitsuba has no variant {name!r}: choose one of {', '.join(v for v in mi.variants() if '_ad_' in v)}"
        )
    if not name.startswith(("llvm_", "cuda_")):
        raise BenchsimError(f"the variant {name!r} cannot render: choose {LLVM} or {CUDA}")
    if name.startswith("llvm_") and benchsim.llvm_import_order:
        raise BenchsimError(benchsim.llvm_import_order)
    complaint = _complaint(name, _fingerprint(name))
    if complaint:
        where = os.environ.get("DRJIT_LIBLLVM_PATH")
        mend = (
            f"{f'DRJIT_LIBLLVM_PATH is {where}; ' if where else ''}{_LLVM_MEND}"
            if name.startswith("llvm_")
            else f"choose the variant {LLVM} to render without a GPU"
        )
        raise BenchsimError(f"Mitsuba's back end {name} does not work here ({complaint}): {mend}")
    if mi.variant() != name:
        mi.set_variant(name)
    return name


def release() -> None:
    """Give back to the system what is no longer used: Dr.Jit's arrays and, where glibc is, what lies free on the heap.

    Of a diagnosis' 0.4 GB a quarter lies free on the heap when its pictures are rendered; a render takes 0.25.
    """
    dr.flush_malloc_cache()
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)


def _fingerprint(name: str) -> str:
    """What the outcome of the test depends on."""
    library = os.environ.get("DRJIT_LIBLLVM_PATH", "")
    try:
        status = os.stat(library)
        state = f"{status.st_size} {status.st_mtime_ns}"
    except OSError:
        state = "none"
    parts = [
        name,
        importlib.metadata.version("mitsuba"),
        importlib.metadata.version("drjit"),
        sys.executable,
        library,
        state,
        os.environ.get("CUDA_VISIBLE_DEVICES", ""),
    ]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:24]


def _cache_file(fingerprint: str) -> Path:
    root = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(root) / "benchsim" / f"backend-{fingerprint}"


@lru_cache(maxsize=8)
def _complaint(name: str, fingerprint: str) -> str | None:
    """None if the variant passes the test, else why not."""
    passed = _cache_file(fingerprint)
    if passed.exists():
        return None
    try:
        done = subprocess.run(
            [sys.executable, "-c", _PROBE, name], capture_output=True, text=True, timeout=180, check=False
        )
    except subprocess.TimeoutExpired:
        return "its self-test took more than three minutes"
    if done.returncode != 0 or "works" not in done.stdout:
        lines = [line.strip() for line in (done.stderr + done.stdout).splitlines() if line.strip()]
        told = [line for line in lines if re.search(r"llvm|cuda|error|cannot", line, re.IGNORECASE)] or lines
        return f"self-test ended with {done.returncode}" + (f", {told[-1].split('! ')[0][:200]}" if told else "")
    try:
        passed.parent.mkdir(parents=True, exist_ok=True)
        write_text(passed, f"{name} works\n")
    except OSError:
        pass  # a cache that cannot be written costs a second each time
    return None
