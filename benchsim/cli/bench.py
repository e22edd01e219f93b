"""Commands of a bench: from photographs to a verdict."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from benchsim.cli.common import (
    Json,
    Output,
    Outside,
    Tower,
    Variant,
    app,
    do,
    folder_of,
)


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
    """The main job: render or take photographs, fit, validate, draw."""
    from benchsim import jobs

    do(jobs.run, json, file=file, output=output, variant=variant, allow_outside=allow_outside)


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

    do(
        jobs.render, json, bench=bench, output=folder_of(output, bench, "render"), seed=seed, effects=effect or [],
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

    folder = folder_of(output, source, "fit")
    do(jobs.fit, json, source=source, output=folder, pixels=pixels, allow_outside=allow_outside)


@app.command()
def validate(
    recording: Annotated[Path, typer.Argument(help="Recording folder.")],
    output: Output = None,
    allow_outside: Outside = False,
    json: Json = False,
) -> None:
    """Compare the traces with the vector model. In mm on the screen and mrad of mirror normal."""
    from benchsim import jobs

    folder = folder_of(output, recording, "validate")
    do(jobs.validate, json, recording=recording, output=folder, allow_outside=allow_outside)


class Against(StrEnum):
    """The simulation in doubt."""

    bench = "bench"
    vector = "vector"


InDoubt = Annotated[
    Against, typer.Option(help="Simulation in doubt: the bench as the file states it, or the paper's vector model.")
]


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

    do(
        jobs.diagnose, json, recording=recording, output=folder_of(output, recording, "diagnose"),
        against=against.value, pictures=pictures, tower=tower, allow_outside=allow_outside,
    )  # fmt: skip


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

    do(jobs.effects, json, recording=recording, output=output, against=against.value, allow_outside=allow_outside)


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

    do(
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

    do(jobs.report, json, folder=folder, output=output, allow_outside=allow_outside)


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
    do(jobs.calibrate, json, photos=photos, board=board, output=output, name=name, gamma=value)


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

    do(jobs.sample, json, folder=folder, seed=seed, answer=answer, variant=variant)


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
    form: Annotated[
        bool, typer.Option("--form", help="Write form.html too, to fill in the file in a browser.")
    ] = False,
    json: Json = False,
) -> None:
    """Begin a recording from photographs, or a plant. What they say is filled in, what only you know is marked."""
    from benchsim import jobs

    do(
        jobs.new, json, folder=folder, photos=[*(photos or []), *(more or [])], calibration=calibration, marks=marks,
        like=like, plant=plant, heliostats=heliostats, form=form,
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

    if not do(jobs.check, json, recording=recording, output=output, allow_outside=allow_outside).usable:
        raise typer.Exit(1)
