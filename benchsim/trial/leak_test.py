"""The leak test: what could be told from names, sizes, times and metadata alone?

A judge who never looks at a picture turns every case's folder into numbers and takes the one that best separates the
cases with something concealed from those without. How well it does by chance is found by shuffling the truth.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

Array = NDArray[np.float64]

SHUFFLES = 999

FALSE_ALARM = 0.01
"""Of the test: a trial without any leak fails it so often."""

FEWEST = 4
"""Cases of either sort below which nothing can be said."""


PASSING = (" time", " order on disk")
"""Ends of clues that a copy of the files does not keep."""


def clues(folder: Path) -> dict[str, int]:
    """Numbers that a folder tells without any content of its files: names, sizes, times, PNG's chunks."""
    paths = sorted(p for p in folder.rglob("*") if p.is_file())
    out = {"files": len(paths), "folder time": folder.stat().st_mtime_ns}
    total = 0
    for path in paths:
        name, stat = path.relative_to(folder).as_posix(), path.stat()
        total += stat.st_size
        out[f"{name} size"] = stat.st_size
        out[f"{name} time"] = stat.st_mtime_ns
        out[f"{name} order on disk"] = stat.st_ino
        if path.suffix == ".png":
            chunks = _chunks(path)
            out[f"{name} chunks"] = len(chunks)
            out[f"{name} metadata"] = sum(size for kind, size in chunks if kind not in (b"IHDR", b"IDAT"))
    return {**out, "size": total}


def _chunks(path: Path) -> list[tuple[bytes, int]]:
    """Kinds and sizes of a PNG's chunks."""
    data = path.read_bytes()
    out, at = [], 8
    while at + 8 <= len(data):
        size, kind = struct.unpack(">I4s", data[at : at + 8])
        out.append((kind, size))
        at += 12 + size
    return out


def blind(found: Sequence[Mapping[str, float]], concealed: Sequence[bool], seed: int = 0) -> dict[str, Any]:
    """How well the best clue tells cases with something concealed from those without.

    Parameters
    ----------
    found : sequence of mapping
        `clues` of every case.
    concealed : sequence of bool
        Whether something is concealed in it.
    seed : int
        Of the shuffles.

    Returns
    -------
    dict
        ``clue``; ``auc``, how often a case with something concealed has more of it than one without (ties count half);
        ``p_value``, how often shuffled truths give some clue that is as good; ``at_chance``, None where there are too
        few cases of either sort.

    Notes
    -----
    Clues are taken one by one. A leak that shows only in two of them together is not found.
    """
    label = np.asarray(concealed, bool)
    n, k = len(label), int(label.sum())
    names = sorted({name for f in found for name in f})
    if min(k, n - k) < FEWEST or not names:
        return {"cases": n, "clue": None, "auc": None, "p_value": None, "at_chance": None}
    # A file that is not there is a clue as well.
    table = np.array([[f.get(name, -1.0) for name in names] for f in found])
    ranks = rankdata(table, axis=0)
    spread = ranks.std(axis=0)
    keep = spread > 0
    names = [name for name, use in zip(names, keep, strict=True) if use]
    if not names:
        return {"cases": n, "clue": "none differs", "auc": 0.5, "p_value": 1.0, "at_chance": True}
    # Mann and Whitney's statistic in units of its spread, which ties make smaller.
    unit = (ranks[:, keep] - ranks[:, keep].mean(axis=0)) / spread[keep]

    def strength(rows: NDArray[np.bool_]) -> Array:
        return np.abs(unit[rows].sum(axis=0))

    own = strength(label)
    best = int(own.argmax())
    rng = np.random.default_rng(seed)
    better = sum(strength(rng.permutation(label)).max() >= own[best] - 1e-9 for _ in range(SHUFFLES))
    column = ranks[:, keep][:, best]
    auc = (column[label].sum() - k * (k + 1) / 2) / (k * (n - k))
    p = (1 + better) / (1 + SHUFFLES)
    return {"cases": n, "clue": names[best], "auc": float(auc), "p_value": p, "at_chance": bool(p >= FALSE_ALARM)}
