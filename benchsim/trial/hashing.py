"""What a commitment is: canonical bytes, SHA-256 over them, and random streams that hang on one secret seed."""

from __future__ import annotations

import hashlib
import hmac
import json
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

import benchsim
from benchsim.bench.errors import BenchsimError
from benchsim.bench.reading import file_hash


def canonical(value: Any) -> bytes:
    """The one form in which plain values are hashed: JSON, keys sorted, no blanks, ASCII, shortest floats."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode("ascii")


def digest(data: bytes) -> str:
    """SHA-256, in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def commitment(salt: str, value: Any) -> str:
    """SHA-256 over a salt (hexadecimal) and the canonical value: binds to the value and tells nothing of it."""
    return digest(bytes.fromhex(salt) + canonical(value))


def derived(seed: str, *purpose: str | int) -> bytes:
    """32 bytes that hang on a secret seed and a purpose; without the seed they tell nothing of one another.

    What a judge sees (a bench's settings, noise) and what he must not know (effects, salts) are drawn from streams of
    their own, so that the one cannot be computed from the other.
    """
    return hmac.new(seed.encode("ascii"), canonical(list(purpose)), hashlib.sha256).digest()


def rng_of(seed: str, *purpose: str | int) -> np.random.Generator:
    """Random stream of a purpose."""
    return np.random.default_rng(int.from_bytes(derived(seed, *purpose), "big"))


def files_of(folder: Path) -> dict[str, str]:
    """Relative name → SHA-256 of every file under a folder, sorted.

    Raises
    ------
    BenchsimError
        If something there is neither file nor folder, or a link.
    """
    out = {}
    for path in sorted(folder.rglob("*")):
        if path.is_symlink() or not (path.is_file() or path.is_dir()):
            raise BenchsimError(f"{path}: is a link or no plain file; put the file itself there")
        if path.is_file():
            out[path.relative_to(folder).as_posix()] = file_hash(path)
    return out


@lru_cache(maxsize=1)
def code() -> str:
    """SHA-256 over the package's own modules: which code concealed or judged, as it was when first asked."""
    root = Path(benchsim.__file__).parent
    return digest(canonical({p.relative_to(root).as_posix(): digest(p.read_bytes()) for p in root.rglob("*.py")}))
