"""``benchsim render``: a bench file becomes a recording, as a camera would photograph it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from benchsim.bench.errors import BenchsimError
from benchsim.bench.files import given, read, sources
from benchsim.bench.model import Recording
from benchsim.instruments.bench import effects as bench_effects
from benchsim.jobs.output import lasting_folder, output_folder
from benchsim.jobs.progress import Progress, silent
from benchsim.reports.quantities import counted


@dataclass(frozen=True)
class RenderResult:
    """What ``render`` wrote."""

    folder: Path
    recording: Recording
    seed: int
    notes: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``--json``."""
        return {
            "folder": str(self.folder),
            "images": [e.image for e in self.recording.exposures],
            "seed": self.seed,
            "notes": list(self.notes),
        }

    def summary(self) -> str:
        """What a person wants to know, on a terminal."""
        count = len(self.recording.exposures)
        lines = [f"{counted(count, 'exposure')} rendered with seed {self.seed} into {self.folder}/"]
        return "\n".join([*lines, *self.notes, f"next: benchsim run {self.folder}"])


@dataclass(frozen=True)
class PhoneResult:
    """What ``render --phone`` wrote: paths relative to ``folder``."""

    folder: Path
    bench: tuple[str, ...]
    board: tuple[str, ...]
    seed: int

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``--json``."""
        return {
            "folder": str(self.folder),
            "images": list(self.bench),
            "calibration": list(self.board),
            "seed": self.seed,
        }

    def summary(self) -> str:
        """What a person wants to know, on a terminal."""
        counts = f"{len(self.bench)} photographs of the bench and {len(self.board)} of the board"
        return (
            f"{counts}, made with seed {self.seed}, in {self.folder}/\n"
            f"next: benchsim calibrate {self.folder}/board --board marks.csv, then benchsim new DIR --photos "
            f"{self.folder}/bench"
        )


def render(
    bench: Recording | Path | str,
    output: Path | str | None = None,
    *,
    seed: int | None = None,
    effects: Sequence[str] = (),
    noise: bool = True,
    setting_errors: bool = True,
    conceal: bool = False,
    phone: bool = False,
    variant: str | None = None,
    allow_outside: bool = False,
    progress: Progress = silent,
) -> RenderResult | PhoneResult:
    """Render a bench file as a recording folder.

    Parameters
    ----------
    bench : Recording or path
        A bench, or its file; of a recording its images are ignored and rendered anew.
    output : path, optional
        Folder to write; by default one that lasts as long as this process.
    seed : int, optional
        Of sensor noise and setting errors; default ``[render] seed``.
    effects : sequence of str
        ``NAME.PARAMETER=VALUE``, each overrides ``[effects]``.
    noise : bool
        False: no shot and read noise and no speckle.
    setting_errors : bool
        False: every setting exactly as stated, in place of a draw from ``[uncertainty]`` once per setting.
    conceal : bool
        True: effects and fields are rendered, but not written into the recording.
    phone : bool
        True: photographs alone, as a phone makes them, of the bench and of the board; no recording is written.
    variant : str, optional
        Mitsuba's back end.
    allow_outside : bool
        Whether its marks may lie outside of the file's folder, see `paths.inside`.
    progress : callable
        Called with what is being done and the fraction done.

    Returns
    -------
    RenderResult or PhoneResult

    Raises
    ------
    BenchsimError
        If the bench cannot be used or the folder not be written.
    """
    recording = given(bench, images=False, allow_outside=allow_outside)
    recording = replace(recording, effects=override(recording.effects, effects))
    bench_effects.check(recording)
    folder = lasting_folder(recording.title or recording.path.stem) if output is None else Path(output)
    options = {
        "seed": seed,
        # The stamp lies in the folder: what is concealed must not stand there either.
        "effects": [] if conceal or phone else list(effects),
        "noise": noise,
        "setting_errors": setting_errors,
        "conceal": conceal or phone,
    }
    if phone:
        return _with_phone(recording, folder, options, variant, progress)
    with output_folder(folder, "render", sources(recording), options, recording.defaults_used) as staging:
        rendered, notes = render_into(
            recording,
            staging,
            seed=seed,
            noise=noise,
            setting_errors=setting_errors,
            conceal=conceal,
            variant=variant,
            progress=progress,
        )
    rendered = replace(rendered, path=folder / "recording.toml")
    return RenderResult(folder, rendered, recording.render.seed if seed is None else seed, notes)


def _with_phone(
    recording: Recording, folder: Path, options: dict[str, Any], variant: str | None, progress: Progress
) -> PhoneResult:
    from benchsim.renderer import backend
    from benchsim.renderer.phone import photograph_with_phone

    progress("testing Mitsuba's back end", 0.0)
    backend.use(variant)
    seed = recording.render.seed if options["seed"] is None else options["seed"]
    with output_folder(folder, "render", sources(recording), options, recording.defaults_used) as staging:
        truth = photograph_with_phone(
            recording,
            staging,
            seed=seed,
            noise=options["noise"],
            setting_errors=options["setting_errors"],
            progress=progress,
        )
    return PhoneResult(folder, truth.bench, truth.board, seed)


def render_into(
    recording: Recording,
    folder: Path,
    *,
    seed: int | None = None,
    noise: bool = True,
    setting_errors: bool = True,
    conceal: bool = False,
    variant: str | None = None,
    progress: Progress = silent,
) -> tuple[Recording, tuple[str, ...]]:
    """Render into an existing folder; returns the recording as it was written, and what there is to say about it."""
    from benchsim.renderer import backend
    from benchsim.renderer.recording import render_recording

    progress("testing Mitsuba's back end", 0.0)
    backend.use(variant)
    truth = render_recording(
        recording,
        folder,
        seed=seed,
        noise=noise,
        setting_errors=setting_errors,
        conceal=conceal,
        progress=progress,
    )
    return read(folder, images=True), truth.notes


def override(effects: Mapping[str, Mapping[str, float]], changes: Sequence[str]) -> dict[str, dict[str, float]]:
    """``[effects]`` with ``NAME.PARAMETER=VALUE`` put in.

    Raises
    ------
    BenchsimError
        If a change does not read so.
    """
    out = {name: dict(parameters) for name, parameters in effects.items()}
    for change in changes:
        key, _, value = change.partition("=")
        name, _, parameter = key.strip().partition(".")
        try:
            number = float(value)
        except ValueError:
            number = float("nan")
        if not name or not parameter or number != number or number in (float("inf"), float("-inf")):
            raise BenchsimError(f"--effect {change}: write NAME.PARAMETER=VALUE, for instance canting.pyr=1.5")
        out.setdefault(name, {})[parameter] = number
    return out
