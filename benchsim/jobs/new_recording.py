"""``benchsim new``: a recording begun from photographs, with what only the user knows marked; or a plant."""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from benchsim.bench.errors import BenchsimError
from benchsim.bench.files import UNFILLED, complaints
from benchsim.bench.files import read as read_bench
from benchsim.bench.marks import read_marks
from benchsim.bench.names import printable
from benchsim.bench.paths import FILE
from benchsim.bench.reading import file_hash
from benchsim.bench.toml_file import load_toml
from benchsim.bench.writing import write_text
from benchsim.calibration.record import read_camera
from benchsim.intake.filling import COMMENT_COLUMN, Shot, alike, cameras_of, recording_toml
from benchsim.intake.form import shown
from benchsim.intake.pairing import laser_light, pair
from benchsim.intake.photo import SUFFIXES, Photo, read_photo
from benchsim.jobs import plant_files
from benchsim.jobs.progress import Progress, silent
from benchsim.jobs.shown import Shown
from benchsim.reports.page import form_page
from benchsim.reports.quantities import counted

FORM = "form.html"


@dataclass(frozen=True, repr=False)
class NewResult(Shown):
    """What ``new`` wrote: ``unfilled`` are the keys that only the user knows."""

    folder: Path
    shots: tuple[Shot, ...]
    unfilled: tuple[str, ...]
    marks: bool
    form: bool = False

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``--json``."""
        return {
            "format": "benchsim-new/1",
            "folder": str(self.folder),
            "exposures": [{"image": s.image, "dark": s.dark, "camera": s.camera} for s in self.shots],
            "unfilled": list(self.unfilled),
        }

    def summary(self) -> str:
        """What a person wants to know, on a terminal."""
        cameras = dict.fromkeys(s.camera for s in self.shots)
        count, dark = len(self.shots), sum(s.dark is not None for s in self.shots)
        lines = [
            f"{counted(count, 'exposure')}, {dark} with a dark picture, of camera {', '.join(cameras)}",
            f'{self.folder}/{FILE}: {len(self.unfilled)} values read "{UNFILLED}" and are yours to fill in',
        ]
        if not self.marks:
            lines.append(f"put the board's marks.csv into {self.folder}/")
        how = f"open {self.folder / FORM} in a browser, or an editor, and fill them in" if self.form else "fill them in"
        return "\n".join([*lines, f"next: {how}, then benchsim check {self.folder}"])


def new(
    folder: Path | str,
    photos: Sequence[Path | str] = (),
    *,
    plant: bool = False,
    heliostats: int = 100,
    calibration: Path | str | None = None,
    marks: Path | str | None = None,
    like: Path | str | None = None,
    form: bool = False,
    progress: Progress = silent,
) -> NewResult | plant_files.PlantMade:
    """Begin a recording from photographs: a commented ``recording.toml``, the pictures and, if given, the marks.

    Parameters
    ----------
    folder : path
        Is made; must not hold a ``recording.toml``, which a person may have filled in.
    photos : sequence of paths
        Pictures, or folders of them. Those that lie in ``folder`` are named where they are, others are copied.
    plant : bool
        Begin a plant instead: ``plant.toml`` and ``heliostats.csv``, laid out in radial stagger.
    heliostats : int
        Of the plant.
    calibration : path, optional
        ``camera.toml`` of ``benchsim calibrate``; its camera tables and their uncertainty are copied.
    marks : path, optional
        The board's ``marks.csv``, copied.
    like : path, optional
        A bench file or recording of the same bench: its laser, mirror, screen and uncertainty are taken over, and
        without a calibration its camera.
    form : bool
        Write ``form.html`` too, in which a browser fills the file in.
    progress : callable
        Called with what is being done and the fraction done.

    Returns
    -------
    NewResult or PlantMade

    Raises
    ------
    BenchsimError
        If a photograph, the calibration or the folder cannot be used; nothing is written then.
    """
    target = Path(folder)
    if plant:
        if photos or calibration or marks or like or form:
            raise BenchsimError("--plant: a plant is not begun from photographs; leave the other options out")
        return plant_files.begin(target, heliostats)
    file = target / FILE
    if file.exists():
        raise BenchsimError(
            f"{file}: is already there and may hold what you filled in; name another folder, or remove it"
        )
    if target.exists() and not target.is_dir():
        raise BenchsimError(f"{target}: is a file, not a folder; write benchsim new DIR --photos …")
    calibrated = read_camera(Path(calibration)) if calibration is not None else None
    if marks is not None:
        if not Path(marks).exists():
            raise BenchsimError(f"{marks}: not there; give --board the marks.csv that 'benchsim board' wrote")
        read_marks(Path(marks))
    paths = _listed(photos)
    read, light = [], []
    for i, path in enumerate(paths):
        progress(f"reading {path.name}", i / len(paths))
        photo, counts = read_photo(path)
        read.append(photo)
        light.append(laser_light(counts))
    order = _order(read)
    taken = [read[i] for i in order]
    names = _names(taken, target)
    pairs = pair(taken, [light[i] for i in order])
    cameras = cameras_of([taken[i] for i, _ in pairs], calibrated)
    shots = tuple(
        Shot(taken[i], names[i], None if dark is None else names[dark], camera)
        for (i, dark), camera in zip(pairs, cameras, strict=True)
    )
    text = recording_toml(
        printable(target.resolve().name), shots, calibrated, str(marks) if marks else None, str(target)
    )
    if like is not None:
        text = alike(text, load_toml(read_bench(like).path), cameras=calibrated is None)
    _put(target, [(p.path, n) for p, n in zip(taken, names, strict=True)], Path(marks) if marks else None)
    write_text(file, text)
    if form:
        name = printable(target.resolve().name)
        write_text(target / FORM, form_page(name, printable(str(target)), FILE, shown(text), COMMENT_COLUMN))
    progress("written", 1.0)
    unfilled = tuple(key for key, mend in complaints(file) if "not filled in" in mend)
    return NewResult(target, shots, unfilled, (target / "marks.csv").exists(), form)


def _listed(photos: Sequence[Path | str]) -> list[Path]:
    out: list[Path] = []
    for path in map(Path, photos):
        if path.is_dir():
            found = sorted((p for p in path.iterdir() if p.suffix.lower() in SUFFIXES), key=_natural)
            if not found:
                raise BenchsimError(f"{path}: no photographs in this folder; name one with .jpg, .png or .tif files")
            out += found
        else:
            out.append(path)
    if not out:
        raise BenchsimError("--photos: no photographs; name them, or a folder of them")
    once = {p.resolve(): p for p in out}
    return list(once.values())


def _natural(path: Path) -> list[Any]:
    """IMG_9 before IMG_10."""
    return [int(part) if part.isdigit() else part.lower() for part in re.split(r"(\d+)", path.name)]


def _order(photos: Sequence[Photo]) -> list[int]:
    """By the camera's clock if every picture has it, then by name; otherwise by name."""
    order = sorted(range(len(photos)), key=lambda i: _natural(photos[i].path))
    if all(p.time for p in photos):
        order.sort(key=lambda i: photos[i].time or datetime.min)
    return order


def _names(photos: Sequence[Photo], folder: Path) -> list[str]:
    """What the recording calls the pictures: paths relative to the folder; of those copied their own names."""
    home = folder.resolve()
    names = []
    for p in photos:
        path = p.path.resolve()
        names.append(path.relative_to(home).as_posix() if path.is_relative_to(home) else p.path.name)
        if printable(names[-1]) != names[-1]:
            raise BenchsimError(f"{p.path}: has a line break or a control character in its name; rename it")
        if names.count(names[-1]) > 1:
            raise BenchsimError(f"{p.path}: another photograph has the same name; rename one of them")
    return names


def _put(folder: Path, pictures: Sequence[tuple[Path, str]], marks: Path | None) -> None:
    """Pictures and marks into the folder; what is there already and is something else is not overwritten."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for source, name in [*pictures, *([(marks, "marks.csv")] if marks else [])]:
            target = folder / name
            if target.resolve() == source.resolve():
                continue
            if target.exists() and file_hash(target) != file_hash(source):
                raise BenchsimError(f"{target}: is already there and differs from {source}; name another folder")
            shutil.copy2(source, target)
    except OSError as error:
        raise BenchsimError(f"{folder}: cannot be written ({error.strerror}); choose another folder") from None
