"""Commands of mounts: a whole field of heliostats, and what an amended one predicts."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from benchsim.cli.common import (
    Insecure,
    Json,
    Output,
    Outside,
    Processes,
    SchedulerAt,
    Tls,
    Tower,
    app,
    do,
    folder_of,
    scheduler_of,
)


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

    do(
        jobs.field, json, source=heliostats, output=output, tower=tower, draw=pictures, workers=workers,
        scheduler=scheduler_of(scheduler, tls, insecure), allow_outside=allow_outside,
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
        do(jobs.aim, json, amended=amended, target=aim, time=time, tower=tower)
        return
    do(
        jobs.predict, json, amended=amended, recordings=recordings, output=folder_of(output, recordings, "predict"),
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
    do(jobs.export, json, amended=amended, output=output, tower=tower)
