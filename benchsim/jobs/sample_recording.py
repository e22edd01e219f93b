"""``benchsim sample``: a small recording to try the other commands on, with something concealed in it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchsim.bench.errors import BenchsimError
from benchsim.bench.files import read, shipped, sources
from benchsim.bench.model import Recording
from benchsim.bench.paths import FILE, STAMP
from benchsim.bench.reading import load_json
from benchsim.jobs.output import output_folder
from benchsim.jobs.progress import Progress, silent
from benchsim.jobs.shown import Shown

CONCEALED = {
    "screen-bow": ("bow_z", 0.0015, "1/m"),
    "screen-tilt": ("st_z", 15.0, "mrad"),
    "screen-rotation": ("srot", 12.0, "mrad"),
    "coma": ("coma_v", 0.03, "mrad/mm2"),
    "facet-curvature": ("fcurv", 0.1, "1/m"),
    "pivot-offset": ("dr", 7.0, "mm"),
}
"""What may be concealed, and its size: some twenty sigma in six photographs."""


@dataclass(frozen=True, repr=False)
class SampleResult(Shown):
    """What ``sample`` wrote, and what it would say if asked: ``concealed`` is name, parameter, value and unit."""

    folder: Path
    recording: Recording | None
    seed: int
    concealed: tuple[str, str, float, str]

    @property
    def answer(self) -> str:
        """What was concealed, in words."""
        name, parameter, value, unit = self.concealed
        return f"with seed {self.seed} is concealed: {name}, {parameter} = {value:g} {unit}"

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``--json``."""
        if self.recording is None:
            name, parameter, value, unit = self.concealed
            return {"seed": self.seed, "effect": name, "parameter": parameter, "value": value, "unit": unit}
        images = [e.image for e in self.recording.exposures]
        return {"folder": str(self.folder), "images": images, "seed": self.seed}

    def summary(self) -> str:
        """What a person wants to know, on a terminal."""
        if self.recording is None:
            return self.answer
        there = self.folder
        return (
            f"{len(self.recording.exposures)} photographs of a bench in {there}/; something is concealed in them\n"
            f"next: benchsim fit {there}, the hyperbolas in the photographs\n"
            f"      benchsim validate {there}, whether the vector model agrees\n"
            f"      benchsim diagnose {there}, what the simulation lacks (a minute or two)\n"
            f"and then, what was concealed: benchsim sample {there} --answer"
        )


def sample(
    folder: Path | str,
    *,
    seed: int = 1,
    answer: bool = False,
    variant: str | None = None,
    progress: Progress = silent,
) -> SampleResult:
    """Render a small recording, 1 MB of JPEG, in which one effect is concealed.

    Parameters
    ----------
    folder : path
        Is made; must not hold a recording: that of another sample is somebody's to remove.
    seed : int
        Decides what is concealed, and everything else that is drawn.
    answer : bool
        True: say what was concealed in the folder; nothing is rendered.
    variant : str, optional
        Mitsuba's back end.
    progress : callable
        Called with what is being done and the fraction done.

    Returns
    -------
    SampleResult

    Raises
    ------
    BenchsimError
        If the folder cannot be written or nothing rendered; with ``answer``, if no sample lies there.
    """
    if answer:
        seed = _seed_of(Path(folder))
    rng = np.random.default_rng([seed, 0])
    name = sorted(CONCEALED)[int(rng.integers(len(CONCEALED)))]
    parameter, size, unit = CONCEALED[name]
    value = size * (1 if rng.integers(2) else -1)
    result = SampleResult(Path(folder), None, seed, (name, parameter, value, unit))
    if answer:
        return result
    if (there := Path(folder) / FILE).exists():
        raise BenchsimError(f"{there}: a recording lies there already; name another folder, or remove it")
    from benchsim.renderer import backend
    from benchsim.renderer.recording import render_recording

    bench = shipped("campaign12.toml")
    cameras = {
        n: replace(c.binned(2), bit_depth=8, gamma="srgb", black_level=0.0, saturation_level=255.0)
        for n, c in bench.cameras.items()
    }
    six = replace(
        bench, title="six settings", exposures=bench.exposures[:6], cameras=cameras, effects={name: {parameter: value}}
    )
    progress("testing Mitsuba's back end", 0.0)
    backend.use(variant)
    images = [f"{k}.jpg" for k in range(1, 7)]
    with output_folder(Path(folder), "sample", sources(bench), {"seed": seed}, ()) as staging:
        render_recording(six, staging, seed=seed, images=images, conceal=True, progress=progress)
        recording = read(staging, images=True)
    return replace(result, recording=replace(recording, path=Path(folder) / FILE))


def _seed_of(folder: Path) -> int:
    try:
        stamp = load_json(folder / STAMP)
        if stamp["command"] == "sample":
            return int(stamp["options"]["seed"])
    except (KeyError, TypeError, ValueError):
        pass
    raise BenchsimError(f"{folder}: no sample lies there; make one with 'benchsim sample {folder}'")
