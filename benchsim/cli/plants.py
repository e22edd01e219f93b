"""Commands of plants: flux, detectors, a drone."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import Annotated, Any

import typer
import typer.core

from benchsim.cli.common import (
    Insecure,
    Json,
    Output,
    Outside,
    SchedulerAt,
    Tls,
    Variant,
    app,
    do,
    folder_of,
    scheduler_of,
)
from benchsim.jobs.flux_choices import DroneSurface, FluxEngine, MountErrors


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
    seed: Annotated[int, typer.Option(min=0, help="Of drawn errors, and of rays.")] = 0,
    aligned: Annotated[
        str | None, typer.Option(help="A time at which all images were put on their aims; they drift from there.")
    ] = None,
    irradiance: Annotated[
        float | None, typer.Option(min=0, max=2000, help="W/m2 on a plane facing the sun; default a clear sky's.")
    ] = None,
    cells: Annotated[
        int | None, typer.Option(min=10, max=1000, help="Of a map along and up; default by the spots' size.")
    ] = None,
    level: Annotated[
        list[float] | None, typer.Option(help="Contour in kW/m2, kWh/m2 of a day; may be repeated.")
    ] = None,
    engine: Annotated[
        FluxEngine, typer.Option(help="Product of error functions, Monte Carlo, or both and where they part.")
    ] = FluxEngine.product,
    accuracy: Annotated[
        float, typer.Option(min=0.1, max=20, help="Of the Monte Carlo's power and brightest cell [%].")
    ] = 1.0,
    rank: Annotated[
        bool, typer.Option("--rank", help="With --day or --year: the energy that its errors cost each heliostat.")
    ] = False,
    scheduler: SchedulerAt = None,
    tls: Tls = None,
    insecure: Insecure = False,
    workers: Annotated[
        int | None, typer.Option(min=0, help="Local processes; default one per core if it takes long; 0: in this one.")
    ] = None,
    allow_outside: Outside = False,
    json: Json = False,
    variant: Variant = None,
) -> None:
    """Flux of a plant on its receivers, and what is lost where. At a time, in a day or a year."""
    from benchsim import jobs

    if [at, day, year].count(None) != 2:
        raise typer.BadParameter("give one of --at, --day and --year", param_hint="--at")
    if rank and at is not None:
        raise typer.BadParameter("errors are ranked in a day or a year: give --day or --year", param_hint="--rank")
    do(
        jobs.flux, json, plant=plant, output=folder_of(output, plant, "flux"), at=at, day=day, year=year,
        step=step, errors=errors and errors.value, seed=seed, aligned=aligned, irradiance=irradiance, cells=cells,
        levels=level or [], engine=engine.value, accuracy=accuracy, variant=variant, rank=rank,
        scheduler=scheduler_of(scheduler, tls, insecure), workers=workers, allow_outside=allow_outside,
    )  # fmt: skip


class PlanFirst(typer.core.TyperGroup):
    """A group whose first command may be left out: ``benchsim detectors PLANT`` plans."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put the first command before words that begin with none; one that is mistyped is named."""
        if args and args[0] not in (*self.commands, "--help", "-h"):
            near = difflib.get_close_matches(args[0], self.commands, n=1)
            if near and len(args) > 1 and not args[1].startswith("-") and not Path(args[0]).exists():
                ctx.fail(f"no command or plant {args[0]!r}, '{near[0]}' may be meant")
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
    "Detectors that watch a plant's heliostats. Planned, or a record read; 'plan' may be left out.", "detectors"
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
    do(
        jobs.detectors, json, plant=plant, output=folder_of(output, plant, "detectors"), at=at, day=day, year=year,
        step=step, place=place, record=record, errors=errors.value, seed=seed, allow_outside=allow_outside,
    )  # fmt: skip


@detectors_app.command("read")
def detectors_read(
    record: Annotated[Path, typer.Argument(help="CSV, WAV or HDF5 of the detectors' currents.")],
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

    do(
        jobs.detectors_read, json, record=record, plant=plant, output=folder_of(output, record, "read"), at=at,
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
    surface: Annotated[
        DroneSurface, typer.Option(help="Glints are compared with mirrors by design, or with a deflectometer's map.")
    ] = DroneSurface.design,
    seed: Annotated[int, typer.Option(min=0, help="Of the virtual flight.")] = 0,
    allow_outside: Outside = False,
    json: Json = False,
) -> None:
    """Where a drone has to fly. Which heliostats it sees from there, and how well that tells their axes."""
    from benchsim import jobs

    do(
        jobs.drone, json, plant=plant, output=folder_of(output, plant, "drone"), virtual=virtual,
        surface=surface.value, seed=seed, allow_outside=allow_outside,
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
    """From pictures of your own to the heliostats' axes. With their uncertainty."""
    from benchsim import jobs

    do(
        jobs.drone_read, json, photos=photos, plant=plant, camera=camera, output=folder_of(output, photos, "read"),
        positions=positions, cluster=cluster, allow_outside=allow_outside,
    )  # fmt: skip
