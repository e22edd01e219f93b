"""What all commands share: the list of them, their common options, and how one runs a job and ends.

Exit 0: done; 1: unusable data or back end; 2: usage.
"""

from __future__ import annotations

import errno
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from benchsim.bench.names import printable
from benchsim.cli.usage import Commands

app = typer.Typer(
    cls=Commands,
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
Tower = Annotated[Path | None, typer.Option(help="Tower file of PAINT recordings; default: beside or above.")]
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


def do(job: Callable[..., Any], as_json: bool, **options: Any) -> Any:
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
        unprinted(error)
    return result


def _complain(sentence: str, as_json: bool) -> NoReturn:
    """What is wrong with the data: on stderr for a person, and on stdout for who asked for JSON."""
    import json

    if as_json:
        typer.echo(json.dumps({"error": sentence}))
    typer.echo(f"benchsim: {sentence}", err=True)
    raise typer.Exit(1) from None


def folder_of(output: Path | None, source: Path, command: str) -> Path:
    """Where a command writes: the folder that was said, or ./NAME-COMMAND/."""
    from benchsim.jobs.output import default_folder

    return output or default_folder(source, command)


def scheduler_of(address: str | None, tls: tuple[Path, Path, Path] | None, insecure: bool) -> Any:
    from benchsim.jobs.cluster import Scheduler

    if address is None and (tls or insecure):
        raise typer.BadParameter("give --scheduler too", param_hint="--tls" if tls else "--insecure")
    return None if address is None else Scheduler(address, tls, insecure)


def unprinted(error: OSError) -> NoReturn:
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
