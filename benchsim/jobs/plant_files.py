"""``benchsim new --plant`` and ``benchsim check`` of a plant: one begun by rule, and what one lacks."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.errors import BenchsimError
from benchsim.bench.names import printable
from benchsim.bench.writing import write_text
from benchsim.jobs.output import output_folder
from benchsim.jobs.shown import Shown
from benchsim.plant import begun, files
from benchsim.plant.model import Plant
from benchsim.reports.quantities import counted


@dataclass(frozen=True, repr=False)
class PlantMade(Shown):
    """A plant that was begun in a folder."""

    folder: Path
    heliostats: int

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``--json``."""
        return {"format": "benchsim-new/1", "folder": str(self.folder), "heliostats": self.heliostats}

    def summary(self) -> str:
        """What a person wants to know, on a terminal."""
        return (
            f"{self.folder}/{files.NAME}: a plant of {counted(self.heliostats, 'heliostat')} in {begun.TABLE}; "
            "change what is not as yours\n"
            f"next: benchsim check {self.folder}, then benchsim flux {self.folder} --at 2026-06-21T12:00"
        )


@dataclass(frozen=True, repr=False)
class PlantCheck(Shown):
    """What a plant's files lack, as key and sentence; ``plant`` is there where they lack nothing."""

    name: str
    findings: tuple[tuple[str, str], ...]
    plant: Plant | None

    @property
    def usable(self) -> bool:
        """Nothing is missing or wrong."""
        return self.plant is not None

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``check.json``."""
        out: dict[str, Any] = {
            "format": "benchsim-check/1",
            "usable": self.usable,
            "findings": [{"kind": "inconsistent", "where": where, "says": says} for where, says in self.findings],
        }
        if self.plant is not None:
            out |= {"heliostats": len(self.plant.field), "remarks": list(self.plant.remarks)}
        return out

    def summary(self) -> str:
        """What a person wants to know, on a terminal."""
        if self.plant is None:
            lines = [f"  {where}: {says}" if where else f"  {says}" for where, says in self.findings]
            return "\n".join([f"INCONSISTENT ({len(lines)})", *lines, f"{self.name}: not ready"])
        f, spread = self.plant.field, 1e3 * self.plant.spread
        far = f.distance / 1e3
        kinds = ", ".join(f"{r.name} ({r.kind})" for r in self.plant.receivers)
        errors = sorted({*f.errors, *f.sigmas})
        return "\n".join(
            [
                f"{self.name}: {counted(len(f), 'heliostat')}, {f.area.sum() / 1e6:.4g} m² of mirrors, "
                f"{_ends(far, 0)} m from where they aim: {kinds}",
                f"light spreads by {_ends(spread, 2)} mrad "
                "(1 sigma in one direction), of which "
                f"the sun's shape {1e3 * self.plant.sun.sigma:.2f}",
                f"errors of the mounts ({f.kinematics}): {', '.join(errors) or 'none are stated'}"
                + ("; a diagnosis is named" if self.plant.diagnosed else ""),
                *self.plant.remarks,
                f"next: benchsim flux {self.plant.path.parent} --at TIME, or --day DATE",
            ]
        )


def _ends(values: NDArray[np.float64], decimals: int) -> str:
    """The least and the largest, once if they are alike."""
    return " to ".join(dict.fromkeys(f"{x:.{decimals}f}" for x in (values.min(), values.max())))


def begin(folder: Path, heliostats: int) -> PlantMade:
    """Begin a plant in a folder, which must not hold one.

    Raises
    ------
    BenchsimError
        If the folder holds one, cannot be written, or so many heliostats are not laid out.
    """
    file = folder / files.NAME
    if file.exists() or (folder / begun.TABLE).exists():
        raise BenchsimError(f"{folder}: holds a plant already, which may be yours; name another folder")
    if folder.exists() and not folder.is_dir():
        raise BenchsimError(f"{folder}: is a file, not a folder; write benchsim new DIR --plant")
    if not 1 <= heliostats <= begun.MOST:
        raise BenchsimError(f"--heliostats: {heliostats} is out of range; it must be 1 to {begun.MOST}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        begun.radial(folder, heliostats)
    except OSError as error:
        raise BenchsimError(f"{folder}: cannot be written ({error.strerror}); choose another folder") from None
    return PlantMade(folder, heliostats)


def check(path: Path, output: Path | None, allow_outside: bool) -> PlantCheck:
    """Say what a plant's files lack; raises only where there is no file to be checked."""
    file = files.toml_path(path)
    name = printable(file.resolve().parent.name)
    findings = files.complaints(path)
    plant = None
    if not findings:
        try:
            plant = files.read(path, allow_outside=allow_outside)
        except BenchsimError as error:
            findings = [("", str(error))]
    result = PlantCheck(name, tuple(findings), plant)
    if output is not None:
        with output_folder(output, "check", [file] if plant is None else plant.files) as staging:
            write_text(staging / "check.json", json.dumps(result.as_dict(), indent=1) + "\n")
            write_text(staging / "check.txt", result.summary() + "\n")
    return result
