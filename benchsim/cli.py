"""The command line: parses, calls one job, prints its summary; exit 0 done, 1 unusable data or back end, 2 usage."""

from __future__ import annotations

import errno
import os
import signal
import sys
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
import typer.core

from benchsim.bench.names import printable

app = typer.Typer(
    help="A heliostat bench as software: render it, read it back, validate the vector model, diagnose what is missing.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # which would take [sections] of a file for markup, and cuts long options short
    context_settings={"help_option_names": ["-h", "--help"]},
)

Output = Annotated[Path | None, typer.Option("-o", "--output", help="Folder to write; default ./NAME-COMMAND/.")]
Json = Annotated[bool, typer.Option("--json", help="Print the machine-readable result.")]
Outside = Annotated[bool, typer.Option("--allow-outside", help="Let the files name others outside of their folder.")]
Variant = Annotated[str | None, typer.Option(help="Mitsuba's back end; default llvm_ad_mono, cuda_ad_mono with a GPU.")]


def _do(job: Callable[..., Any], as_json: bool, **options: Any) -> Any:
    """Run a job, print its result and return it; a complaint about the data is one sentence on stderr and exit 1."""
    from benchsim.bench.errors import BenchsimError
    from benchsim.jobs.progress import bar

    try:
        with bar() as progress:
            result = job(progress=progress, **options)
    except BenchsimError as error:
        _complain(str(error), as_json)
    except OSError as error:
        if error.errno != errno.ENAMETOOLONG:
            raise
        _complain(f"{str(error.filename)[:60]}…: longer than names of files may be; shorten it", as_json)
    except KeyboardInterrupt as stop:
        typer.echo("benchsim: stopped; nothing is left half-written", err=True)
        raise typer.Exit(128 + (*stop.args, signal.SIGINT)[0]) from None
    if as_json:
        import json

        text = json.dumps(result.as_dict(), indent=1, allow_nan=False)
    else:
        text = printable(result.summary(), breaks="\n")
    try:
        typer.echo(text)
    except OSError as error:
        _unprinted(error)
    return result


def _complain(sentence: str, as_json: bool) -> NoReturn:
    """What is wrong with the data: on stderr for a person, and on stdout for who asked for JSON."""
    import json

    if as_json:
        typer.echo(json.dumps({"error": sentence}))
    typer.echo(f"benchsim: {sentence}", err=True)
    raise typer.Exit(1) from None


def _folder(output: Path | None, source: Path, command: str) -> Path:
    """Where a command writes: the folder that was said, or ./NAME-COMMAND/."""
    from benchsim.jobs.output import default_folder

    return output or default_folder(source, command)


def _unprinted(error: OSError) -> NoReturn:
    """What a person reads if the output went nowhere; what is left in its buffer would fail again at the end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    typer.echo(f"benchsim: the output cannot be printed ({error.strerror}); free the disk or read to its end", err=True)
    sys.exit(1)


def _version(wanted: bool) -> None:
    if wanted:
        from benchsim import __version__

        typer.echo(f"benchsim {__version__}")
        raise typer.Exit()


@app.callback()
def _main(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    pass


@app.command()
def run(
    file: Annotated[
        Path | None, typer.Argument(help="Bench file, or recording folder; default: both settings of Fig. 7.")
    ] = None,
    output: Output = None,
    allow_outside: Outside = False,
    json: Json = False,
    variant: Variant = None,
) -> None:
    """The main job: render (or take photographs), fit, validate, draw."""
    from benchsim import jobs

    _do(jobs.run, json, file=file, output=output, variant=variant, allow_outside=allow_outside)


@app.command()
def render(
    bench: Annotated[Path, typer.Argument(help="Bench file (TOML), or a recording whose settings are to be rendered.")],
    output: Output = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Seed of noise and setting errors; default [render] seed.")
    ] = None,
    effect: Annotated[
        list[str] | None, typer.Option(help="NAME.PARAMETER=VALUE, overrides [effects]; may be repeated.")
    ] = None,
    noise: Annotated[bool, typer.Option("--noise/--no-noise", help="Sensor noise and speckle.")] = True,
    setting_errors: Annotated[
        bool,
        typer.Option("--setting-errors/--no-setting-errors", help="Draw each setting's errors from [uncertainty]."),
    ] = True,
    conceal: Annotated[
        bool, typer.Option("--conceal", help="Render [effects] and [fields], but leave them out of the recording.")
    ] = False,
    phone: Annotated[
        bool, typer.Option("--phone", help="Photographs alone, of bench and board, as a phone makes them.")
    ] = False,
    allow_outside: Outside = False,
    json: Json = False,
    variant: Variant = None,
) -> None:
    """Render what the camera would photograph, as a recording."""
    from benchsim import jobs

    _do(
        jobs.render, json, bench=bench, output=_folder(output, bench, "render"), seed=seed, effects=effect or [],
        noise=noise, setting_errors=setting_errors, conceal=conceal, phone=phone, variant=variant,
        allow_outside=allow_outside,
    )  # fmt: skip


@app.command()
def fit(
    source: Annotated[Path, typer.Argument(help="Recording folder, or a single image (with --pixels).")],
    output: Output = None,
    pixels: Annotated[
        bool, typer.Option("--pixels", help="Fit a single image in pixels, without a recording file.")
    ] = False,
    allow_outside: Outside = False,
    json: Json = False,
) -> None:
    """Photographs → marks → trace with error bars → conics."""
    from benchsim import jobs

    folder = _folder(output, source, "fit")
    _do(jobs.fit, json, source=source, output=folder, pixels=pixels, allow_outside=allow_outside)


@app.command()
def validate(
    recording: Annotated[Path, typer.Argument(help="Recording folder.")],
    output: Output = None,
    allow_outside: Outside = False,
    json: Json = False,
) -> None:
    """Compare the traces with the vector model. In mm on the screen and mrad of mirror normal."""
    from benchsim import jobs

    folder = _folder(output, recording, "validate")
    _do(jobs.validate, json, recording=recording, output=folder, allow_outside=allow_outside)


class Against(StrEnum):
    """The simulation in doubt."""

    bench = "bench"
    vector = "vector"


InDoubt = Annotated[
    Against, typer.Option(help="Simulation in doubt: the bench as the file states it, or the paper's vector model.")
]


Tower = Annotated[Path | None, typer.Option(help="Tower file of PAINT recordings; default: beside or above.")]


@app.command()
def diagnose(
    recording: Annotated[
        Path, typer.Argument(help="Recording folder; or a folder of PAINT files, or a telescope's pointing file.")
    ],
    output: Output = None,
    against: InDoubt = Against.bench,
    pictures: Annotated[bool, typer.Option("--pictures/--no-pictures", help="Draw what was found.")] = True,
    tower: Tower = None,
    allow_outside: Outside = False,
    json: Json = False,
) -> None:
    """Say what the simulation lacks: where, what, how large. And what to do about it; or what would have been seen."""
    from benchsim import jobs

    _do(
        jobs.diagnose, json, recording=recording, output=_folder(output, recording, "diagnose"), against=against.value,
        pictures=pictures, tower=tower, allow_outside=allow_outside,
    )  # fmt: skip


SchedulerAt = Annotated[
    str | None,
    typer.Option("--scheduler", help="tls:// address of a dask scheduler whose workers see these folders."),
]
Tls = Annotated[
    tuple[Path, Path, Path] | None,
    typer.Option(metavar="CA CERTIFICATE KEY", help="PEM files for the scheduler; default Dask's configuration."),
]
Insecure = Annotated[bool, typer.Option("--insecure", help="Let the scheduler do without TLS.")]
Processes = Annotated[
    int | None, typer.Option("--workers", min=0, help="Local processes; default one per core; 0: in this one.")
]


def _scheduler(address: str | None, tls: tuple[Path, Path, Path] | None, insecure: bool) -> Any:
    from benchsim.jobs.cluster import Scheduler

    if address is None and (tls or insecure):
        raise typer.BadParameter("give --scheduler too", param_hint="--tls" if tls else "--insecure")
    return None if address is None else Scheduler(address, tls, insecure)


@app.command()
def field(
    heliostats: Annotated[Path, typer.Argument(help="Folder of heliostats' PAINT folders, or a CSV with id and path.")],
    output: Output = None,
    tower: Tower = None,
    scheduler: SchedulerAt = None,
    tls: Tls = None,
    insecure: Insecure = False,
    workers: Processes = None,
    pictures: Annotated[bool, typer.Option("--pictures/--no-pictures", help="Draw every heliostat's.")] = False,
    allow_outside: Outside = False,
    json: Json = False,
) -> None:
    """Diagnose every heliostat of a field, and what they share. A field that was stopped goes on."""
    from benchsim import jobs

    _do(
        jobs.field, json, source=heliostats, output=output, tower=tower, draw=pictures, workers=workers,
        scheduler=_scheduler(scheduler, tls, insecure), allow_outside=allow_outside,
    )  # fmt: skip


class MountErrors(StrEnum):
    """Whose errors of the mounts a flux is computed with."""

    stated = "stated"
    none = "none"
    drawn = "drawn"
    diagnosed = "diagnosed"


@app.command()
def flux(
    plant: Annotated[Path, typer.Argument(help="plant.toml, or the folder that holds it.")],
    output: Output = None,
    at: Annotated[str | None, typer.Option(help="A time like 2026-06-21T12:00; without a zone in the site's.")] = None,
    day: Annotated[str | None, typer.Option(help="A date like 2026-06-21 instead: sums through the day.")] = None,
    year: Annotated[
        int | None, typer.Option(min=1950, max=2100, help="A year instead: sums by four days, each for a quarter.")
    ] = None,
    step: Annotated[float, typer.Option(help="Hours for which each time of a day stands.")] = 1.0,
    errors: Annotated[
        MountErrors | None, typer.Option(help="Of the mounts; default diagnosed where the plant names it, or stated.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of drawn errors.")] = 0,
    irradiance: Annotated[
        float | None, typer.Option(min=0, max=2000, help="W/m2 on a plane facing the sun; default a clear sky's.")
    ] = None,
    cells: Annotated[
        int | None, typer.Option(min=10, max=1000, help="Of a map along and up; default by the spots' size.")
    ] = None,
    level: Annotated[
        list[float] | None, typer.Option(help="Contour in kW/m2, kWh/m2 of a day; may be repeated.")
    ] = None,
    rank: Annotated[
        bool, typer.Option("--rank", help="With --day or --year: the energy that its errors cost each heliostat.")
    ] = False,
    allow_outside: Outside = False,
    json: Json = False,
) -> None:
    """Flux of a plant on its receivers, and what is lost where. At a time, in a day or a year."""
    from benchsim import jobs

    if [at, day, year].count(None) != 2:
        raise typer.BadParameter("give one of --at, --day and --year", param_hint="--at")
    if rank and at is not None:
        raise typer.BadParameter("errors are ranked in a day or a year: give --day or --year", param_hint="--rank")
    _do(
        jobs.flux, json, plant=plant, output=_folder(output, plant, "flux"), at=at, day=day, year=year,
        step=step, errors=errors and errors.value, seed=seed, irradiance=irradiance, cells=cells, levels=level or [],
        rank=rank, allow_outside=allow_outside,
    )  # fmt: skip


class PlanFirst(typer.core.TyperGroup):
    """A group whose first command may be left out: ``benchsim detectors PLANT`` plans."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put the first command before words that begin with none."""
        if args and args[0] not in (*self.commands, "--help", "-h"):
            args = ["plan", *args]
        return super().parse_args(ctx, args)


def _plan_or_read(what: str, name: str) -> typer.Typer:
    group = typer.Typer(
        cls=PlanFirst, help=what, no_args_is_help=True, rich_markup_mode=None,
        context_settings={"help_option_names": ["-h", "--help"]},
    )  # fmt: skip
    app.add_typer(group, name=name)
    return group


detectors_app = _plan_or_read(
    "Detectors that watch a plant's heliostats. Planned, or a record read; 'plan' may be left out.",
    "detectors",
)

PlantArgument = Annotated[Path, typer.Argument(help="plant.toml, or the folder that holds it.")]


@detectors_app.command("plan")
def detectors_plan(
    plant: PlantArgument,
    output: Output = None,
    at: Annotated[str | None, typer.Option(help="A time like 2026-06-21T12:00 alone.")] = None,
    day: Annotated[str | None, typer.Option(help="A date like 2026-06-21 alone.")] = None,
    year: Annotated[
        int | None, typer.Option(min=1950, max=2100, help="Whose equinoxes and solstices are taken; default 2026.")
    ] = None,
    step: Annotated[float, typer.Option(help="Hours between the times of a day.")] = 1.0,
    place: Annotated[bool, typer.Option("--place", help="Look for places of the arrays that see the most.")] = False,
    record: Annotated[
        str | None, typer.Option(metavar="TIME", help="Simulate a record then, measure it, and correct.")
    ] = None,
    errors: Annotated[MountErrors, typer.Option(help="Of the mounts, in the record.")] = MountErrors.drawn,
    seed: Annotated[int, typer.Option(min=0, help="Of drawn errors and of the record.")] = 0,
    allow_outside: Outside = False,
    json: Json = False,
) -> None:
    """Which heliostats the arrays see, and when. How well; labels, and the length of a record."""
    from benchsim import jobs

    if [at, day, year].count(None) < 2:
        raise typer.BadParameter("give one of --at, --day and --year, or none", param_hint="--at")
    _do(
        jobs.detectors, json, plant=plant, output=_folder(output, plant, "detectors"), at=at, day=day, year=year,
        step=step, place=place, record=record, errors=errors.value, seed=seed, allow_outside=allow_outside,
    )  # fmt: skip


@detectors_app.command("read")
def detectors_read(
    record: Annotated[Path, typer.Argument(help="CSV or WAV of the detectors' currents.")],
    plant: PlantArgument,
    at: Annotated[str, typer.Option(help="Time of the record's middle.")],
    output: Output = None,
    labels: Annotated[
        Path | None, typer.Option(help="CSV with id, rate_elevation_hz, rate_azimuth_hz; default as planned.")
    ] = None,
    round: Annotated[int, typer.Option(min=1, help="Which of the plan's rounds it is.")] = 1,
    allow_outside: Outside = False,
    json: Json = False,
) -> None:
    """Misalignments from a record of your own. And how to turn each heliostat."""
    from benchsim import jobs

    _do(
        jobs.detectors_read, json, record=record, plant=plant, output=_folder(output, record, "read"), at=at,
        labels=labels, round=round, allow_outside=allow_outside,
    )  # fmt: skip


drone_app = _plan_or_read(
    "A drone that looks into a plant's mirrors. Planned, or pictures read; 'plan' may be left out.", "drone"
)


@drone_app.command("plan")
def drone_plan(
    plant: PlantArgument,
    output: Output = None,
    virtual: Annotated[bool, typer.Option("--fly", help="Fly it virtually: errors drawn, axes estimated.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of the virtual flight.")] = 0,
    allow_outside: Outside = False,
    json: Json = False,
) -> None:
    """Where a drone has to fly. Which heliostats it sees from there, and how well that tells their axes."""
    from benchsim import jobs

    _do(
        jobs.drone, json, plant=plant, output=_folder(output, plant, "drone"), virtual=virtual, seed=seed,
        allow_outside=allow_outside,
    )  # fmt: skip


@drone_app.command("read")
def drone_read(
    photos: Annotated[Path, typer.Argument(help="Folder of the pictures of one cluster.")],
    plant: PlantArgument,
    camera: Annotated[Path, typer.Option(help="camera.toml of 'benchsim calibrate'.")],
    output: Output = None,
    positions: Annotated[
        Path | None, typer.Option(help="CSV with name and the camera's place in each picture; default EXIF's.")
    ] = None,
    cluster: Annotated[
        int | None, typer.Option(min=1, help="Which of the plan's; default that whose camera point is nearest.")
    ] = None,
    allow_outside: Outside = False,
    json: Json = False,
) -> None:
    """From pictures of your own to heliostats' axes. With their uncertainty."""
    from benchsim import jobs

    _do(
        jobs.drone_read, json, photos=photos, plant=plant, camera=camera, output=_folder(output, photos, "read"),
        positions=positions, cluster=cluster, allow_outside=allow_outside,
    )  # fmt: skip


Amended = Annotated[
    Path, typer.Argument(help="amended.toml of a mount; or a heliostat's properties in the PAINT format.")
]


@app.command()
def predict(
    amended: Amended,
    recordings: Annotated[
        Path | None, typer.Argument(help="PAINT folder, or a telescope's pointing file; not needed with --aim.")
    ] = None,
    output: Output = None,
    aim: Annotated[
        str | None, typer.Option(help="Motor positions that hit: a target's name, or EAST,NORTH,UP in m.")
    ] = None,
    time: Annotated[str | None, typer.Option(help="Of the aim, like 2024-06-21T10:00:00Z.")] = None,
    tower: Tower = None,
    pictures: Annotated[bool, typer.Option("--pictures/--no-pictures", help="Draw the misses.")] = True,
    json: Json = False,
) -> None:
    """By how much an amended mount misses other recordings. With --aim, motor positions that hit."""
    from benchsim import jobs

    if (aim is None) != (time is None):
        raise typer.BadParameter("give both --aim and --time, or neither", param_hint="--aim")
    if recordings is None:
        if aim is None:
            raise typer.BadParameter("name recordings to predict, or --aim and --time", param_hint="RECORDINGS")
        if output is not None:
            raise typer.BadParameter("an aim alone is only printed; leave it out", param_hint="-o")
        _do(jobs.aim, json, amended=amended, target=aim, time=time, tower=tower)
        return
    _do(
        jobs.predict, json, amended=amended, recordings=recordings, output=_folder(output, recordings, "predict"),
        tower=tower, aim=aim, time=time, draw=pictures,
    )  # fmt: skip


@app.command()
def export(
    amended: Amended,
    paint: Annotated[
        bool, typer.Option("--paint", help="As a heliostat's properties file of the PAINT data base.")
    ] = False,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="File to write; default ./NAME-heliostat-properties.json.")
    ] = None,
    tower: Tower = None,
    json: Json = False,
) -> None:
    """Write an amended heliostat as a file for other simulations."""
    from benchsim import jobs

    if not paint:
        raise typer.BadParameter("say --paint: there is no other format", param_hint="--paint")
    _do(jobs.export, json, amended=amended, output=output, tower=tower)


@app.command()
def effects(
    recording: Annotated[
        Path | None, typer.Option("--for", help="Recording or bench file: what its settings could show.")
    ] = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Folder to write; default: none.")] = None,
    against: InDoubt = Against.bench,
    allow_outside: Outside = False,
    json: Json = False,
) -> None:
    """List the effects of the catalogue. With --for, those that a recording could detect and tell apart."""
    from benchsim import jobs

    _do(jobs.effects, json, recording=recording, output=output, against=against.value, allow_outside=allow_outside)


class Paper(StrEnum):
    """What a board is printed on."""

    sheet = "sheet"
    a4 = "a4"
    a3 = "a3"
    letter = "letter"


@app.command()
def board(
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Folder to write; default ./board/.")] = None,
    size: Annotated[
        tuple[float, float] | None, typer.Option("--size-mm", help="Along y and z; default 700 700.")
    ] = None,
    side: Annotated[
        float | None, typer.Option("--side-mm", help="Of the AprilTags' black squares; default 36.")
    ] = None,
    paper: Annotated[Paper | None, typer.Option(help="One large sheet (the default), or tiles to be joined.")] = None,
    measured: Annotated[
        tuple[float, float] | None,
        typer.Option("--measured-mm", help="What a ruler reads on the print's check rules along y and z."),
    ] = None,
    over: Annotated[float, typer.Option("--over-mm", help="What was measured, as it was meant.")] = 100.0,
    json: Json = False,
) -> None:
    """The calibrated screen to print, with its marks.csv. Corrected by what the print measures."""
    from benchsim import jobs

    _do(
        jobs.board, json, output=output, size=size, side=side, paper=paper and paper.value, measured=measured,
        over=over,
    )  # fmt: skip


@app.command()
def report(
    folder: Annotated[Path, typer.Argument(help="Folder that run, diagnose or trial open wrote.")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="File to write; default report.html in the folder.")
    ] = None,
    allow_outside: Outside = False,
    json: Json = False,
) -> None:
    """One self-contained HTML file of a finished folder. Verdict, photographs, residuals, probabilities."""
    from benchsim import jobs

    _do(jobs.report, json, folder=folder, output=output, allow_outside=allow_outside)


trial_app = typer.Typer(
    help="Concealed trials: is the diagnosis right when it cannot know?",
    no_args_is_help=True,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.add_typer(trial_app, name="trial")

Cases = Annotated[int, typer.Option(min=1, help="Number of cases.")]
TrialSeed = Annotated[
    int | None,
    typer.Option(min=0, help="Only to make an opened trial again; default 256 bits that nobody can guess."),
]
Shrink = Annotated[int, typer.Option(min=1, max=4, help="Divides the cameras' 2000 x 1500 pixels.")]
Key = Annotated[
    Path | None,
    typer.Option(help="Ed25519 key to sign with ('trial key' makes one); keep it out of the trial's folder."),
]
Zero = Annotated[bool, typer.Option("--zero", help="The leak test's trial: every amplitude zero, all else the same.")]


@trial_app.command(
    "run", help="A whole trial: conceal, judge, open, verify. Judged in a process of its own; a stopped one goes on."
)
@trial_app.command("conceal", help="Draw benches, conceal effects in them, photograph them. And commit to the truth.")
def trial_begin(
    command: typer.Context,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder for recordings/ and truth/, and in a run verdicts/.")
    ] = Path("trial"),
    cases: Cases = 60,
    seed: TrialSeed = None,
    shrink: Shrink = 2,
    zero: Zero = False,
    key: Key = None,
    scheduler: SchedulerAt = None,
    tls: Tls = None,
    insecure: Insecure = False,
    workers: Processes = None,
    json: Json = False,
) -> None:
    """Begin a trial: its first step alone, or all of it; both draw the same cases, by the same options."""
    from benchsim import trial

    job = trial.run if command.info_name == "run" else trial.conceal
    _do(
        job, json, output=output, cases=cases, seed=seed, shrink=shrink, zero=zero, key=key, workers=workers,
        scheduler=_scheduler(scheduler, tls, insecure),
    )  # fmt: skip


@trial_app.command("judge")
def trial_judge(
    recordings: Annotated[Path, typer.Argument(help="Folder recordings/ of a concealed trial, and nothing else.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the verdicts.")] = Path("verdicts"),
    again: Annotated[
        list[str] | None, typer.Option(help="Case to judge once more, recorded as such; may be repeated.")
    ] = None,
    key: Key = None,
    scheduler: SchedulerAt = None,
    tls: Tls = None,
    insecure: Insecure = False,
    workers: Processes = None,
    json: Json = False,
) -> None:
    """Diagnose every recording once, and commit to the verdicts."""
    from benchsim import trial

    _do(
        trial.judge, json, recordings=recordings, output=output, again=again or [], key=key, workers=workers,
        scheduler=_scheduler(scheduler, tls, insecure),
    )  # fmt: skip


Folder = Annotated[Path, typer.Argument(help="Folder of the trial: recordings/, truth/, verdicts/.")]


@trial_app.command("open")
def trial_open(folder: Folder, workers: Processes = None, json: Json = False) -> None:
    """Check every commitment, open, score, close the ledger. Cause, size and prediction are scored."""
    from benchsim import trial

    _do(trial.open, json, folder=folder, workers=workers)


Public = Annotated[str | None, typer.Option(metavar="PUBLIC", help="Key by which this part has to be signed.")]


@trial_app.command("verify")
def trial_verify(
    folder: Folder,
    root: Annotated[
        list[str] | None, typer.Option(help="Root hash that was published: a part ends with it; may be repeated.")
    ] = None,
    concealer: Public = None,
    judge: Public = None,
    timestamp: Annotated[
        tuple[Path, Path] | None,
        typer.Option(
            metavar="RESPONSE CA", help="RFC 3161 time stamp of a root hash, and whom to trust (needs openssl)."
        ),
    ] = None,
    commit: Annotated[
        tuple[Path, str] | None,
        typer.Option(metavar="REPOSITORY HASH", help="Git commit whose message holds a root hash."),
    ] = None,
    unopened: Annotated[bool, typer.Option("--unopened", help="It is on its way: check it as far as it is.")] = False,
    recordings: Annotated[
        bool, typer.Option("--recordings/--no-recordings", help="Check the images; without, they may be missing.")
    ] = True,
    page: Annotated[
        bool, typer.Option("--page/--no-page", help="Make report.html again; without, it is another version's.")
    ] = True,
    workers: Processes = None,
    json: Json = False,
) -> None:
    """Check that everything is as it was committed to. Makes again what follows from it; needs no secret."""
    from benchsim import trial

    _do(
        trial.verify, json, folder=folder, roots=root or [], concealer=concealer, judge=judge, timestamp=timestamp,
        commit=commit, unopened=unopened, recordings=recordings, page=page, workers=workers,
    )  # fmt: skip


@trial_app.command("key")
def trial_key(
    path: Annotated[Path, typer.Argument(help="File for the private half; its public half is printed.")],
    json: Json = False,
) -> None:
    """Make an Ed25519 key to sign with, or tell the public half of one."""
    from benchsim import trial

    _do(trial.key, json, path=path)


@app.command()
def calibrate(
    photos: Annotated[list[Path], typer.Argument(help="A dozen photographs of the board, or the folder they are in.")],
    board: Annotated[
        Path, typer.Option("--board", "--marks", help="The board's marks.csv, corrected by what its print measures.")
    ],
    output: Annotated[Path | None, typer.Option("-o", "--output", help="File to write; default ./camera.toml.")] = None,
    name: Annotated[str, typer.Option(help="What the camera is called in recordings.")] = "A",
    gamma: Annotated[
        str, typer.Option(help="Of the pictures: a number, srgb or unknown; goes into the file.")
    ] = "unknown",
    json: Json = False,
) -> None:
    """Calibrate a camera from photographs of the board. Distortion and covariance too, or which views to add."""
    from benchsim import jobs

    value: float | str = gamma
    if gamma not in ("srgb", "unknown"):
        try:
            value = float(gamma)
        except ValueError:
            value = 0.0
        if not value > 0:
            raise typer.BadParameter("give a number above 0, srgb or unknown", param_hint="--gamma")
    _do(jobs.calibrate, json, photos=photos, board=board, output=output, name=name, gamma=value)


@app.command()
def sample(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder to make.")],
    seed: Annotated[int, typer.Option(help="Decides what is concealed.", min=0)] = 1,
    answer: Annotated[bool, typer.Option("--answer", help="Say what was concealed; nothing is rendered.")] = False,
    json: Json = False,
    variant: Variant = None,
) -> None:
    """Make a small recording to try the other commands on. Something is concealed in it."""
    from benchsim import jobs

    _do(jobs.sample, json, folder=folder, seed=seed, answer=answer, variant=variant)


@app.command()
def new(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder to make; holds the recording afterwards.")],
    more: Annotated[
        list[Path] | None, typer.Argument(metavar="[PHOTOS]...", help="More photographs, as the shell expands *.jpg.")
    ] = None,
    photos: Annotated[
        list[Path] | None, typer.Option("--photos", help="Photographs with their dark pictures, or a folder of them.")
    ] = None,
    calibration: Annotated[Path | None, typer.Option(help="camera.toml of 'benchsim calibrate'.")] = None,
    marks: Annotated[Path | None, typer.Option("--board", "--marks", help="The board's marks.csv.")] = None,
    like: Annotated[
        Path | None, typer.Option(help="Bench file or recording of the same bench, whose values are taken over.")
    ] = None,
    plant: Annotated[
        bool, typer.Option("--plant", help="Begin a plant instead: plant.toml and a field in radial stagger.")
    ] = False,
    heliostats: Annotated[int, typer.Option(min=1, help="Of the plant.")] = 100,
    json: Json = False,
) -> None:
    """Begin a recording from photographs, or a plant. What they say is filled in, what only you know is marked."""
    from benchsim import jobs

    _do(
        jobs.new, json, folder=folder, photos=[*(photos or []), *(more or [])], calibration=calibration, marks=marks,
        like=like, plant=plant, heliostats=heliostats,
    )  # fmt: skip


@app.command()
def check(
    recording: Annotated[Path, typer.Argument(help="Recording folder, or a plant's.")],
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Folder to write; default: none.")] = None,
    allow_outside: Outside = False,
    json: Json = False,
) -> None:
    """Say what a recording or plant lacks, before anything is fitted. And where it contradicts itself."""
    from benchsim import jobs

    if not _do(jobs.check, json, recording=recording, output=output, allow_outside=allow_outside).usable:
        raise typer.Exit(1)


def _stop(number: int, _: Any) -> NoReturn:
    """End as for Ctrl-C: staging folders are removed and processes ended on the way."""
    raise KeyboardInterrupt(number)


def main() -> None:
    """Entry point of the console script."""
    # A shell may have said that its end is to be outlived.
    for number in (getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)):
        if signal.getsignal(number) == signal.SIG_DFL:
            signal.signal(number, _stop)
    try:
        app()
    except OSError as error:
        # Of help, which the parser prints itself; a file that cannot be written has a name.
        if error.filename or error.errno not in (errno.ENOSPC, errno.EPIPE, errno.EIO):
            raise
        _unprinted(error)


if __name__ == "__main__":
    main()
