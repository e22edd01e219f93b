"""Pictures of a diagnosis, beside its files: residuals, probabilities, where a misfit lies, photograph less render."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from benchsim import trace
from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Exposure, Recording
from benchsim.bench.names import file_name
from benchsim.bench.writing import write_text
from benchsim.diagnosis.problem import Problem
from benchsim.diagnosis.result import Diagnosis
from benchsim.instruments.bench.prediction import Predict
from benchsim.jobs import exhibits
from benchsim.jobs.output import label
from benchsim.jobs.progress import Progress, silent
from benchsim.jobs.workers import Workers
from benchsim.reports import diagnosis_pictures as pictures

if TYPE_CHECKING:
    from benchsim.jobs.diagnosing import DiagnosisResult

MOST_LOCATED = 4
"""Photographs in which stretches are drawn: those of the most significant."""


def draw(result: DiagnosisResult, folder: Path, pool: Workers, progress: Progress = silent) -> tuple[str, ...]:
    """Draw a diagnosis into the folder that holds it; returns what could not be drawn, in sentences."""
    d, problem = result.diagnosis, result.problem
    title = result.title
    progress("drawing", 0.78)
    pictures.residuals(folder, problem, d, title)
    if (most := exhibits.most(d)) in pictures.FILES and most != "c":
        pictures.residuals(folder, problem, d, title, most)
    pictures.observables(folder / "observables.png", problem, d, title)
    pictures.save(result.plot_probability(), folder / "probability.png")
    _draw_located(result, folder, pool, title)
    try:
        return draw_pixels(result, folder, progress)
    except BenchsimError as error:
        # Unknown gammas or a missing back end cost this picture, not the diagnosis.
        return (str(error),)


def draw_pixels(result: DiagnosisResult, folder: Path, progress: Progress = silent) -> tuple[str, ...]:
    """Render the most telling exposure again without and with what was found, and draw photograph less render.

    All six of an example take two thirds of what the diagnosis itself does. With what was found the most probable
    settings are the diagnosis' own, without it those of the null; both as the unevenness of the light across the traces
    has them too. A law's field is rendered like any effect. Writes ``pixels.png`` and ``pixels.json``; returns a
    sentence for every exposure that could not be compared.
    """
    from benchsim.instruments.bench.asymmetry import settled
    from benchsim.instruments.bench.fitted_simulation import probable, state
    from benchsim.instruments.bench.pixels import pixels_of
    from benchsim.jobs import comparing
    from benchsim.renderer import backend

    d, problem = result.diagnosis, result.problem
    predict = problem.predict
    assert isinstance(predict, Predict)
    progress("fitting settings for the renders", 0.8)
    of_effects = {p.name for e in problem.catalogue for p in e.parameters}
    values = dict(d.values)
    bare = {k: v for k, v in values.items() if k not in of_effects}
    amended, lawful = predict, problem
    if d.law is not None:
        amended = replace(predict, recording=replace(predict.recording, fields=result.amended.fields), cache={})
        lawful = replace(problem, predict=amended)
        values = probable(lawful, problem.nuisances, values, setting_scale=d.setting_scale)
    blocks = range(len(problem.names))
    shown = _telling(problem, d)
    view = pixels_of(result.recording, predict.blocks[shown].observed)
    seen = [view if b == shown else None for b in blocks]
    each = settled(lawful, seen, [values for _ in blocks], d.setting_scale)
    after = [state(amended, shown, each[shown])]
    before = after
    if d.law is not None or values.keys() & of_effects:
        null = probable(problem, problem.nuisances, bare, setting_scale=d.setting_scale)
        each = settled(problem, seen, [null for _ in blocks], d.setting_scale)
        before = [state(predict, shown, each[shown])]
    backend.use(None)
    compared = comparing.compare(
        result.recording,
        [predict.blocks[shown].observed],
        before,
        after,
        pixels=[view],
        progress=lambda what, done: progress(what, 0.82 + 0.17 * done),
    )
    # The renderer's threads add light in the order in which they finish: further digits differ from run to run.
    told = partial(round, ndigits=5)
    rows = [
        {"exposure": x.name, "pixels": x.pixels, "before": told(x.before.z_std), "after": told(x.after.z_std)}
        for x in compared.exposures
    ]
    pooled = {which: told(compared.pooled(which)) for which in ("before", "after")}
    plain = {"exposures": rows, "pooled": pooled, "lost": list(compared.lost)}
    write_text(folder / "pixels.json", json.dumps(plain, indent=1) + "\n")
    comparing.draw(
        compared,
        folder / "pixels.png",
        f"{label(result.recording)}: a photograph less its render, settings fitted; "
        f"all pixels together {pooled['before']:.2f} → {pooled['after']:.2f} sigma",
    )
    return compared.lost


def _telling(problem: Problem, d: Diagnosis) -> int:
    """The block of the exposure whose residuals changed the most."""
    blocks = range(len(problem.names))
    if len(blocks) == 1:
        return 0
    changed = ((d.residuals.before - d.residuals.after) / d.residuals.sigma) ** 2
    return max(blocks, key=lambda b: float(changed[problem.rows(b)].sum()))


def _draw_located(result: DiagnosisResult, folder: Path, pool: Workers, title: str) -> None:
    """The stretches of the most significant exposures over their photographs."""
    where = result.diagnosis.location
    if where is None or not where.along_trace:
        return
    strongest: dict[str, float] = {}
    for s in where.along_trace:
        strongest[s.exposure] = max(s.z, strongest.get(s.exposure, 0.0))
    names = sorted(strongest, key=lambda n: -strongest[n])[:MOST_LOCATED]
    exposures = [e for e in result.recording.exposures if e.name in names]
    for exposure, found in zip(exposures, pool.each(_Extract(result.recording), exposures), strict=True):
        assert exposure.image is not None
        light = trace.read_image(
            result.recording.folder / exposure.image, result.recording.cameras[exposure.camera]
        ).light
        ridge = pictures.Ridge(
            exposure.name, np.asarray(light, float), found.s_mm, np.column_stack([found.u_px, found.v_px])
        )
        pictures.located(
            folder / f"located-{file_name(Path(exposure.image).stem)}.png",
            ridge,
            [s for s in where.along_trace if s.exposure == exposure.name],
            result.problem,
            result.diagnosis,
            f"{title}: where the misfit lies in {exposure.name}; by the sum of all, in the {where.element}",
        )


@dataclass(frozen=True)
class _Extract:
    """The main ridge of an exposure, in a worker."""

    recording: Recording

    def __call__(self, exposure: Exposure) -> trace.Trace:
        return trace.only_ridge(trace.extract(self.recording, exposure), 0)
