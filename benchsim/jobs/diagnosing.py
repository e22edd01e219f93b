"""``benchsim diagnose``: what the simulation lacks, where, how large, and what to do; or what would have been seen."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from matplotlib.figure import Figure
from threadpoolctl import threadpool_limits

from benchsim import diagnosis
from benchsim.bench.errors import BenchsimError
from benchsim.bench.files import given, sources
from benchsim.bench.model import Recording
from benchsim.bench.writing import write_text
from benchsim.diagnosis.problem import Effect, Problem
from benchsim.diagnosis.result import Diagnosis
from benchsim.instruments.bench import amended_file, candidates, displacement, effects, observables
from benchsim.instruments.bench import problem as bench_problem
from benchsim.jobs import diagnosis_drawing, exhibits
from benchsim.jobs.effect_sizes import Moves, moves
from benchsim.jobs.output import label, wanted_folder, written
from benchsim.jobs.progress import Progress, silent
from benchsim.jobs.reporting import report
from benchsim.jobs.shown import Diagnosed
from benchsim.jobs.workers import Workers, workers
from benchsim.reports import diagnosis_pictures as pictures
from benchsim.reports.diagnosis_text import About, listed, summary
from benchsim.reports.quantities import counted

if TYPE_CHECKING:
    from benchsim.jobs.mount_diagnosis import MountDiagnosis


@dataclass(frozen=True, repr=False)
class DiagnosisResult(Diagnosed):
    """A finished diagnosis and what it rests on.

    Attributes
    ----------
    recording : Recording
    amended : Recording
        With what was found.
    diagnosis : Diagnosis
    problem : Problem
    lost : tuple of str
        One sentence for each exposure that was dropped.
    remarks : tuple of str
        One sentence for each thing about the recording that limits what can be told.
    against : {"bench", "vector"}
    folder : Path, optional
        Where it was written.
    not_drawn : tuple of str
        One sentence for each picture that could not be made.
    moves : mapping
        What the effects that were found move, see `effect_sizes.moves`.
    """

    recording: Recording
    amended: Recording
    diagnosis: Diagnosis
    problem: Problem
    lost: tuple[str, ...]
    remarks: tuple[str, ...]
    against: str
    folder: Path | None = None
    not_drawn: tuple[str, ...] = ()
    moves: Moves = field(default_factory=dict)

    @property
    def title(self) -> str:
        """What the person calls the recording."""
        return label(self.recording)

    @property
    def catalogue(self) -> tuple[Effect, ...]:
        """The effects that were looked for."""
        return self.problem.catalogue

    def plot_residuals(self) -> Figure:
        """Residuals along every trace, before and after, of the kind of datum that shows most of what was found."""
        blocks, most = range(len(self.problem.names)), exhibits.most(self.diagnosis)
        kind = most if most in pictures.FILES else "c"
        return pictures.residual_figure(self.problem, self.diagnosis, blocks, self.title, kind)

    def figures(self) -> list[Figure]:
        """Both pictures."""
        return [self.plot_residuals(), self.plot_probability()]

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``diagnosis.json``."""
        return {
            **self.diagnosis.as_dict(),
            "against": self.against,
            "lost": list(self.lost),
            "remarks": list(self.remarks),
            "defaults_used": list(self.recording.defaults_used),
        }

    def text(self) -> str:
        """Plain sentences for ``summary.txt``."""
        r = self.recording
        put = amended_file.put_in(r, self.amended)
        where = "amended" if self.folder is None else "amended.toml"
        sentence = f"{where} holds the recording's file with what was found put in"
        return summary(
            self.diagnosis,
            About(
                title=self.title,
                exposures=len(self.problem.names),
                settings=len(set(self.problem.groups)),
                against=self.against,
                catalogue=self.problem.catalogue,
                lost=self.lost,
                remarks=self.remarks,
                defaults=r.defaults_used,
                amended=f"{sentence}: {', '.join(put)}." if put else "",
                moves=self.moves,
            ),
        )

    def summary(self) -> str:
        """What a person wants to know, on a terminal."""
        missing = "".join(f"\nnot drawn: {sentence}" for sentence in self.not_drawn)
        return f"{self.text()}\n{missing}{written(self.folder, page=True)}"


def diagnose(
    recording: Recording | Path | str,
    output: Path | str | None = None,
    *,
    against: str = "bench",
    pictures: bool = True,
    tower: Path | str | None = None,
    allow_outside: bool = False,
    progress: Progress = silent,
) -> DiagnosisResult | MountDiagnosis:
    """Say what a simulation lacks, from settings and photographs alone; or from the recordings of a two-axis mount.

    ``diagnosis.json``, ``summary.txt`` and ``amended.toml`` lie in the folder, whole, before the pictures are begun;
    each picture is put beside them as it is finished, and ``report.html``, which shows it all, comes last.

    Parameters
    ----------
    recording : Recording or path
        A recording, its folder or file; a folder of PAINT files or a telescope's pointing file, told by what it holds.
    output : path, optional
        Folder to write; by default nothing is written or drawn.
    against : {"bench", "vector"}
        The simulation in doubt: the bench as the file states it, or the paper's vector model.
    pictures : bool
        Whether to draw; without, the page shows no photographs either.
    tower : path, optional
        Tower file of PAINT recordings; default it is looked for in their folder and above.
    allow_outside : bool
        Whether marks and images may lie outside of the file's folder, see `paths.inside`.
    progress : callable
        Called with what is being done and the fraction done.

    Returns
    -------
    DiagnosisResult or MountDiagnosis

    Raises
    ------
    BenchsimError
        If the recording or the folder cannot be used, or no exposure gives a trace.
    """
    folder = None if output is None else Path(output)
    if not isinstance(recording, Recording) and _of_a_mount(source := Path(recording)):
        from benchsim.jobs import mount_diagnosis

        if against != "bench":
            raise BenchsimError(
                f"{source}: --against {against} is for the bench; leave it out for a mount's recordings"
            )
        place = None if tower is None else Path(tower)
        return mount_diagnosis.diagnose(source, folder, tower=place, draw=pictures, progress=progress)
    checked = given(recording, images=True, allow_outside=allow_outside)
    effects.check(checked)
    candidates.simulated(checked, against)
    options = {"against": against, "pictures": pictures}
    with workers() as pool:
        with wanted_folder(folder, "diagnose", sources(checked), options, checked.defaults_used) as staging:
            result = diagnose_recording(checked, folder, against=against, pool=pool, progress=progress)
            if folder is None or staging is None:
                return alone(result)
            write_text(staging / "diagnosis.json", json.dumps(result.as_dict(), indent=1, allow_nan=False) + "\n")
            write_text(staging / "summary.txt", result.text() + "\n")
            amended_file.write_amended(result.amended, staging / "amended.toml", folder)
        if pictures:
            result = replace(result, not_drawn=diagnosis_drawing.draw(result, folder, pool, progress))
        exhibits.write_diagnosis(checked, result.problem, result.diagnosis, result.moves, folder, photographs=pictures)
        report(folder)
    progress("done", 1.0)
    return alone(result)


def alone(result: DiagnosisResult) -> DiagnosisResult:
    """A result that outlives the processes it was made with."""
    return replace(result, problem=replace(result.problem, spread=map))


def _of_a_mount(source: Path) -> bool:
    """Whether a path holds a mount's recordings; a recording of the bench is never taken for one.

    Raises
    ------
    BenchsimError
        If it holds folders of mounts.
    """
    if source.name == "recording.toml" or (source / "recording.toml").is_file():
        return False
    from benchsim.instruments.mount import stated

    if stated.recognises(source):
        return True
    inside = sorted(p for p in source.iterdir() if p.is_dir()) if source.is_dir() else []
    if mounts := [p.name for p in inside if stated.recognises(p)]:
        raise BenchsimError(
            f"{source}: holds a folder for each of {counted(len(mounts), 'mount')}; name one of them ({mounts[0]}), or "
            "judge them together by 'benchsim field'"
        )
    return False


@threadpool_limits.wrap(limits=1)  # of thousands of small matrices a second thread of BLAS makes five times the work
def diagnose_recording(
    recording: Recording,
    folder: Path | None,
    *,
    against: str = "bench",
    pool: Workers,
    without: Sequence[str] = (),
    progress: Progress = silent,
) -> DiagnosisResult:
    """Diagnose a recording that was read, by the catalogue without some effects; writes nothing."""
    progress("reading the photographs", 0.0)
    observed, lost = observables.observe(recording, spread=pool.each)
    progress("building the problem", 0.3)
    problem = replace(bench_problem.build(recording, observed, against=against), spread=pool.spread)
    problem = replace(problem, catalogue=tuple(e for e in problem.catalogue if e.name not in without))
    found = diagnosis.diagnose(problem, lambda what, done: progress(what, 0.35 + 0.4 * done))
    found = displacement.sized(problem, found)
    said = tuple(note for o in observed for note in o.notes)
    return DiagnosisResult(
        recording=recording,
        amended=amended_file.amended(recording, found, against),
        diagnosis=found,
        problem=problem,
        lost=lost,
        remarks=(*remarks(recording, observed), *said, *not_judged(recording, against)),
        against=against,
        folder=folder,
        moves=moves(recording, problem, found),
    )


def remarks(recording: Recording, observed: Sequence[observables.Observed]) -> tuple[str, ...]:
    """What about a recording limits what can be told, one sentence each."""
    exposures = [recording.exposures[o.index] for o in observed]
    out = []
    if len(exposures) == 1:
        out.append(
            "One exposure alone: almost everything that could be missing looks like a setting error there, so that "
            "only what marks, width or flux show can be named; take more settings."
        )
    else:
        placed = {(e.laser_azimuth, e.laser_elevation, e.mirror_position) for e in exposures}
        boards = {(e.screen_shift, e.screen_roll) for e in exposures}
        if len(placed) == 1 and len(boards) == 1:
            out.append(
                "All settings are equal: what is constant from exposure to exposure cannot be told from their common "
                "setting errors; move the laser or the mirror."
            )
        elif len({e.setting for e in exposures}) == 1:
            out.append("All exposures are of one setting, whose errors they share; take more settings.")
    if recording.screen.marks is not None:
        whole = len(recording.screen.marks.ids)
        few = [(o.name, len(o.marks)) for o in observed if len(o.marks) < 0.8 * whole]
        if few:
            words = ", ".join(f"{name} ({count} of {whole})" for name, count in few)
            out.append(f"Marks are missing in {words}: the camera's pose and lens are known less well there.")
    blind = sorted({e.camera for e in exposures if recording.cameras[e.camera].gamma == "unknown"})
    if blind:
        out.append(f"The gamma of camera {', '.join(blind)} is not known, so that its flux and width are not used.")
    return tuple(out)


def not_judged(recording: Recording, against: str) -> tuple[str, ...]:
    """The effects of the catalogue that this recording says nothing of, and why, in one sentence; () if there are none.

    What was left out of the catalogue for a trial is not among them: that is no matter of the recording.
    """
    reasons: dict[str, list[str]] = {}
    for name, why in candidates.not_judged(recording, against).items():
        reasons.setdefault(why, []).append(name)
    if not reasons:
        return ()
    words = ", ".join(f"{listed(names)} ({why})" for why, names in reasons.items())
    return (f"Not judged here: {words}.",)
