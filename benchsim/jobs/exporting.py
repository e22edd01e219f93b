"""``benchsim export``: what was found in a heliostat, as a file that other simulations read."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchsim.bench.errors import BenchsimError
from benchsim.bench.names import file_name
from benchsim.bench.writing import write_text
from benchsim.instruments.mount import paint_heliostat
from benchsim.instruments.mount.absorbing import absorbed
from benchsim.instruments.mount.json_values import load, triple
from benchsim.jobs import amended_mounts
from benchsim.jobs.progress import Progress, silent
from benchsim.jobs.shown import Shown


@dataclass(frozen=True, repr=False)
class Export(Shown):
    """A heliostat's file that was written.

    Attributes
    ----------
    file : Path
    put_in : tuple of str
        Effects that the mount was amended by.
    left : tuple of str
        What such a file cannot hold, one sentence each.
    note : Path or None
        Text beside the file that says so; None where nothing is left.
    """

    file: Path
    put_in: tuple[str, ...]
    left: tuple[str, ...]
    note: Path | None

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        note = None if self.note is None else str(self.note)
        return {"file": str(self.file), "put_in": list(self.put_in), "left": list(self.left), "note": note}

    def summary(self) -> str:
        """What a person wants to know, on a terminal."""
        lines = [f"{self.file}: the heliostat with {', '.join(self.put_in) or 'nothing'} in its constants", *self.left]
        if {"axis-tilt", "non-perpendicular-axes", "canting"} & set(self.put_in):
            lines.append("ARTIST 2.0 reads neither the tilts nor initial_orientation from such a file: set them there.")
        return "\n".join(lines + ([] if self.note is None else [f"also said in {self.note}"]))


def export(
    amended: Path | str,
    output: Path | str | None = None,
    *,
    tower: Path | str | None = None,
    progress: Progress = silent,
) -> Export:
    """Write an amended heliostat as a properties file of the PAINT data base, which ARTIST reads, too.

    What was found stands in the constants themselves: position, actuators, translations, the tilts under ARTIST's keys,
    canting as the normal at angles 0. ``benchsim predict`` with that file misses by the same as with ``amended``, to
    less than 1 µrad, where nothing is left. Of such a file ARTIST 2.0 reads the rest: the tilts have to be put into its
    rotation deviations, π/2 to be taken from the first initial angle, which it counts from the vertical mirror, and
    ``initial_orientation`` it does not use. Its mirror lies behind the axes by ``concentrator_translation_n``, not in
    front of them.

    Parameters
    ----------
    amended : path
        As `amended_mounts.read` takes it.
    output : path, optional
        Default ``./NAME-heliostat-properties.json``. What the file cannot hold is written beside it, as text.
    tower : path, optional
    progress : callable

    Returns
    -------
    Export

    Raises
    ------
    BenchsimError
        If the mount is no heliostat of the data base, or the file cannot be written.
    """
    session = amended_mounts.read(Path(amended), None if tower is None else Path(tower))
    if session.mount.axes != "east-west":
        raise BenchsimError(f"{session.path}: is of a telescope; --paint is for heliostats of the PAINT data base")
    heliostat, place = session.files[-2:]
    file = Path(output) if output is not None else Path(f"{file_name(session.title)}-heliostat-properties.json")
    note = file.with_suffix(".txt")
    for target in (file, note):
        if target.resolve() in [p.resolve() for p in session.files]:
            raise BenchsimError(f"{target}: is an input, which would be replaced; choose another file with -o")
    mount, left = absorbed(session)
    plain = paint_heliostat.written(mount, triple(place, load(place), paint_heliostat.ORIGIN), load(heliostat))
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        write_text(file, json.dumps(plain, indent=4, allow_nan=False) + "\n")
        if left:
            write_text(note, "\n".join(left) + "\n")
    except OSError as error:
        raise BenchsimError(f"{file}: cannot be written ({error.strerror}); choose another file with -o") from None
    progress("done", 1.0)
    known = {n for n, terms in session.effects.items() if any(terms.values())}
    put_in = tuple(n for n in session.effects if n in known and not any(s.startswith(f"{n} (") for s in left))
    return Export(file, put_in, left, note if left else None)
