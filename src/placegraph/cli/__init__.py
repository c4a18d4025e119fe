"""The command line: thin, typed functions; every answer is also to be had as JSON."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from placegraph.cli import library
from placegraph.cli.city import commands as city
from placegraph.cli.compiling import Compiling, warm_up
from placegraph.cli.scene import commands as scene
from placegraph.errors import InputError, PlacegraphError
from placegraph.kept import listening, use_folder

app = typer.Typer(
    name="placegraph",
    help="Where am I? Answered on a map that is a graph of things.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
app.add_typer(city.app, name="city")
app.add_typer(scene.app, name="scene")
app.add_typer(library.app, name="library")
app.command("warm")(warm_up)


def main() -> None:
    """Run the command line; placegraph's own errors end it with their exit code and one sentence."""
    warnings.formatwarning = lambda message, *_: f"placegraph: {message}\n"
    try:
        with listening(Compiling(sys.argv[1:])):
            app()
    except PlacegraphError as error:
        Console(stderr=True, soft_wrap=True).print(
            f"placegraph: {error}", style="red", markup=False, highlight=False
        )
        sys.exit(error.exit_code)
    except OSError as error:  # an output that cannot be written
        name = f"{error.filename} " if error.filename else ""
        typer.echo(f"placegraph: {name}cannot be written or read: {error.strerror}.", err=True)
        sys.exit(InputError.exit_code)


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
    compiled: Annotated[
        Path | None, typer.Option(help="Folder to keep compiled code in.", show_default=False)
    ] = None,
) -> None:
    if compiled is not None:
        use_folder(compiled)
    if version:
        from placegraph import __version__

        typer.echo(__version__)
        raise typer.Exit


@app.command("demo")
def demo(
    out: Annotated[Path, typer.Option(help="Folder for the pages and pictures.")] = Path(
        "demo-out"
    ),
) -> None:
    """Locate three sentences in a town that ships with placegraph, and a walk in a flat."""
    from placegraph.demo import run_demo

    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{out} cannot be made a folder ({error.strerror}); choose another --out."
        ) from error
    run_demo(out, typer.echo)
