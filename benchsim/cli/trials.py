"""Commands of concealed trials."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from benchsim.cli.common import (
    Insecure,
    Json,
    Processes,
    SchedulerAt,
    Tls,
    app,
    do,
    scheduler_of,
)

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
    do(
        job, json, output=output, cases=cases, seed=seed, shrink=shrink, zero=zero, key=key, workers=workers,
        scheduler=scheduler_of(scheduler, tls, insecure),
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

    do(
        trial.judge, json, recordings=recordings, output=output, again=again or [], key=key, workers=workers,
        scheduler=scheduler_of(scheduler, tls, insecure),
    )  # fmt: skip


Folder = Annotated[Path, typer.Argument(help="Folder of the trial: recordings/, truth/, verdicts/.")]


@trial_app.command("open")
def trial_open(folder: Folder, workers: Processes = None, json: Json = False) -> None:
    """Check every commitment, open, score, close the ledger. Cause, size and prediction are scored."""
    from benchsim import trial

    do(trial.open, json, folder=folder, workers=workers)


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

    do(
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

    do(trial.key, json, path=path)
