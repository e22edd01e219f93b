"""``benchsim check``: what a recording still lacks, and where it contradicts itself, before anything is fitted."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchsim.bench.errors import BenchsimError
from benchsim.bench.files import UNFILLED, complaints, read, sources
from benchsim.bench.model import Recording
from benchsim.bench.names import printable
from benchsim.bench.paths import FILE, inside
from benchsim.bench.reading import TOML_BYTES, file_hash, read_file
from benchsim.bench.settings import screen_seats
from benchsim.bench.toml_file import load_toml
from benchsim.bench.writing import write_text
from benchsim.instruments.bench import effects as bench_effects
from benchsim.intake import metadata, trace_placement
from benchsim.intake.finding import Finding, Kind
from benchsim.intake.photo import Photo, read_photo
from benchsim.intake.picture_content import look
from benchsim.jobs import plant_files
from benchsim.jobs.output import label, output_folder
from benchsim.jobs.progress import Progress, silent
from benchsim.jobs.shown import Shown
from benchsim.plant import files as plants
from benchsim.reports.quantities import counted

SETTINGS_TO_HOLD_OUT = 3
"""Fewer settings leave none to test a diagnosis on."""


@dataclass(frozen=True, repr=False)
class CheckResult(Shown):
    """What ``check`` found; ``looked`` says whether the pictures were looked at, which needs every key."""

    name: str
    findings: tuple[Finding, ...]
    exposures: int
    looked: bool
    file: Path

    @property
    def usable(self) -> bool:
        """Nothing is missing or inconsistent."""
        return self.looked and all(f.kind is Kind.remark for f in self.findings)

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``check.json``."""
        return {
            "format": "benchsim-check/1",
            "usable": self.usable,
            "pictures_looked_at": self.looked,
            "findings": [{"kind": f.kind.value, "where": f.where, "says": f.says} for f in self.findings],
        }

    def summary(self) -> str:
        """What a person wants to know, on a terminal."""
        lines = []
        there = self.file.parent if self.file.name == FILE else self.file
        for kind, title in ((Kind.missing, "MISSING"), (Kind.inconsistent, "INCONSISTENT"), (Kind.remark, "REMARKS")):
            some = [f for f in self.findings if f.kind is kind]
            if some:
                lines += [f"{title} ({len(some)})", *(f"  {where}: {says}" for where, says in _folded(some))]
        if self.usable:
            lines.append(
                f"{self.name}: {counted(self.exposures, 'exposure')}, nothing missing and nothing inconsistent"
            )
            lines.append(f"next: benchsim diagnose {there}")
        else:
            what = "" if self.looked else "; the settings are compared with the pictures when every key can be read"
            lines.append(f"{self.name}: not ready{what}")
            lines.append(f"next: mend {self.file} or the pictures, then benchsim check {there}")
        return "\n".join(lines)


def _folded(findings: Sequence[Finding]) -> list[tuple[str, str]]:
    """Where and what, the same of several exposures in one: ``exposure[1–5].laser_azimuth_deg``."""
    numbers: dict[tuple[str, str, str], list[int]] = {}
    for f in findings:
        before, number, after = re.fullmatch(r"(?:(.*exposure\[)(\d+))?(.*)", f.where, re.S).groups()  # type: ignore[union-attr]
        numbers.setdefault((before or "", after, f.says), []).append(int(number or 0))
    out = []
    for (before, after, says), some in numbers.items():
        runs: list[list[int]] = []
        for n in some if before else ():
            if runs and n == runs[-1][-1] + 1:
                runs[-1].append(n)
            else:
                runs.append([n])
        words = ", ".join(f"{run[0]}–{run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs)
        out.append((before + words + after, says))
    return out


def check(
    recording: Path | str,
    output: Path | str | None = None,
    *,
    allow_outside: bool = False,
    progress: Progress = silent,
) -> CheckResult | plant_files.PlantCheck:
    """Say what a recording, or a plant, lacks and where it contradicts itself.

    Parameters
    ----------
    recording : path
        Recording folder or file; or a plant's.
    output : path, optional
        Folder for ``check.json`` and ``check.txt``; default: nothing is written.
    allow_outside : bool
        Whether marks and images may lie outside of the file's folder, see `paths.inside`.
    progress : callable
        Called with what is being done and the fraction done.

    Returns
    -------
    CheckResult or PlantCheck

    Raises
    ------
    BenchsimError
        If there is no recording, or it is no TOML file.

    Examples
    --------
    >>> import benchsim as bs
    >>> (found,) = bs.check("scenes/fig7a.toml").findings
    >>> found.where, found.says
    ('exposure[1].image', "required and missing; name the photograph, or run 'benchsim render' first")
    """
    path = Path(recording)
    if plants.recognises(path):
        return plant_files.check(path, None if output is None else Path(output), allow_outside)
    findings = _keys(path)
    read_in: Recording | None = None
    if not findings:
        try:
            read_in = read(path, images=True, allow_outside=allow_outside)
            bench_effects.check(read_in)
        except BenchsimError as error:
            read_in = None
            where, says = _split(str(error))
            findings.append(Finding(Kind.inconsistent, where, says))
    file = path / FILE if path.is_dir() else path
    if read_in is None:
        findings += _files(file, allow_outside, progress)
        result = CheckResult(printable(file.parent.name), tuple(findings), 0, False, file)
        inputs = [file]
    else:
        findings += _settings(read_in) + _pictures(read_in, progress)
        result = CheckResult(label(read_in), tuple(findings), len(read_in.exposures), True, file)
        inputs = sources(read_in)
    if output is not None:
        with output_folder(Path(output), "check", inputs) as staging:
            write_text(staging / "check.json", json.dumps(result.as_dict(), indent=1) + "\n")
            write_text(staging / "check.txt", result.summary() + "\n")
    return result


def _keys(path: Path) -> list[Finding]:
    """Keys that are missing or cannot be read."""
    absent = ("not filled in", "required and missing")
    hints: dict[str, str] | None = None
    out = []
    for key, mend in complaints(path):
        if mend.startswith(absent[0]):
            hints = _hints(path) if hints is None else hints
            mend = f"not filled in; {hints.get(key.rpartition('.')[2]) or mend.partition('; ')[2]}"
        out.append(Finding(Kind.missing if mend.startswith(absent) else Kind.inconsistent, key, mend))
    return out


def _hints(path: Path) -> dict[str, str]:
    """What the file itself says of a key that is to be filled in, at the first place where it does."""
    text = read_file(path / FILE if path.is_dir() else path, TOML_BYTES).decode("utf-8-sig")
    hints: dict[str, str] = {}
    for key, says in re.findall(rf'^\s*(\w+) *= *"{re.escape(UNFILLED)}" *# *(.*)$', text, re.M):
        hints.setdefault(key, printable(says.strip()))
    return hints


def _split(message: str) -> tuple[str, str]:
    """Of a complaint of the recording's own file, the key and what of it; of another's, its name and the rest."""
    file, _, rest = message.partition(": ")
    key, found, what = rest.partition(": ")
    return (key, what) if found and file.endswith(".toml") else (file, rest)


def _files(file: Path, allow_outside: bool, progress: Progress) -> list[Finding]:
    """What the pictures' own words tell of a file that cannot be read as a recording yet."""
    table = load_toml(file).get("exposure", [])
    named = [(i, e) for i, e in enumerate(table, 1) if isinstance(e, dict) and isinstance(e.get("image"), str)]
    photos: list[Photo] = []
    out, cameras = [], []

    def photo_of(number: int, kind: str, name: str) -> Photo:
        key = f"{file.name}: exposure[{number}].{kind}"
        return read_photo(inside(file.parent, name, key, allow_outside=allow_outside))[0]

    for i, e in named:
        progress(f"reading {e['image']}", len(photos) / len(named))
        try:
            photo = photo_of(i, "image", e["image"])
            photos.append(photo)
            cameras.append(str(e.get("camera")))
            if isinstance(e.get("dark"), str):
                out += metadata.dark_alike(photo, photo_of(i, "dark", e["dark"]))
        except BenchsimError as error:
            where, says = _split(str(error))
            out.append(Finding(Kind.inconsistent, where, says))
    return out + metadata.same_lens(photos, cameras) + metadata.merged(photos)


def _settings(r: Recording) -> list[Finding]:
    """What the file says of itself: settings that share a name but not their numbers, and what is worth knowing."""
    out = []
    first: dict[str, Any] = {}
    for i, e in enumerate(r.exposures, 1):
        stated = (e.laser_azimuth, e.laser_elevation, e.mirror_position)
        if first.setdefault(e.setting, stated) != stated:
            says = (
                f"setting {e.setting} has other angles or another position in an earlier exposure; give it its own name"
            )
            out.append(Finding(Kind.inconsistent, f"exposure[{i}].setting", says))
    count = len(first)
    if count < SETTINGS_TO_HOLD_OUT:
        says = (
            f"{count} of them: a diagnosis cannot be tested on settings left out; record {SETTINGS_TO_HOLD_OUT} or more"
        )
        out.append(Finding(Kind.remark, "settings", says))
    for name, camera in r.cameras.items():
        if camera.gamma == "unknown":
            says = "unknown: the light's place is used, its width and flux are not"
            out.append(Finding(Kind.remark, f"cameras.{name}.gamma", says))
        if not any(camera.distortion) and not any(r.uncertainty.intrinsics_sigma):
            says = "stated as exact and without distortion; calibrate the camera, or state intrinsics_sigma"
            out.append(Finding(Kind.remark, f"cameras.{name}", says))
    taken = [d for d in r.defaults_used if re.match(r"(laser|mirror|uncertainty)\.", d)]
    if taken:
        out.append(Finding(Kind.remark, "defaults", f"taken where the file is silent: {', '.join(taken)}"))
    return out


def _pictures(r: Recording, progress: Progress) -> list[Finding]:
    """What the pictures say and show, and whether the settings put the line where it is."""
    out: list[Finding] = []
    photos: list[Photo] = []
    same: dict[str, str] = {}
    seats = screen_seats(r.exposures)
    sigma = r.uncertainty.intrinsics_sigma
    for i, e in enumerate(r.exposures):
        progress(f"looking at {e.name}", i / len(r.exposures))
        assert e.image is not None
        image, dark = r.folder / e.image, r.folder / e.dark if e.dark else None
        twin = same.setdefault(file_hash(image), e.image)
        if twin != e.image:
            says = f"is the same picture as {twin}; mend image"
            out.append(Finding(Kind.inconsistent, e.image, says))
        try:
            photos.append(read_photo(image)[0])
            if dark is not None:
                out += metadata.dark_alike(photos[-1], read_photo(dark)[0])
        except BenchsimError as error:
            where, says = _split(str(error))
            out.append(Finding(Kind.inconsistent, where, says))
            continue
        seen = look(image, dark, r.cameras[e.camera], r.screen, sigma)
        out += seen.findings
        out += trace_placement.stands(r, e, seen.line, reseated=seats[i] > 0)
    if len(photos) == len(r.exposures):
        out += metadata.same_lens(photos, [e.camera for e in r.exposures])
        out += metadata.in_order(photos, [e.time for e in r.exposures])
        for name, camera in r.cameras.items():
            own = [p for p, e in zip(photos, r.exposures, strict=True) if e.camera == name]
            out += metadata.focal_agrees(own, camera, sigma[0])
        out += metadata.merged(photos)
        lone = [e.image for e in r.exposures if e.dark is None]
        if lone:
            says = (
                f"{len(lone)} exposures have none (first: {lone[0]}); the room's light is then guessed beside the line"
            )
            out.append(Finding(Kind.remark, "dark pictures", says))
    return out
