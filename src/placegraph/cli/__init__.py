"""The command line: thin, typed functions; every answer is also to be had as JSON."""

from __future__ import annotations

import errno
import os
import sys
import warnings
from functools import partial
from pathlib import Path
from typing import NoReturn

import click

from placegraph.cli.command import Group, extensions
from placegraph.cli.common import INTERRUPTED, bare, guard_streams, harmless, interruptible
from placegraph.cli.compiling import CompileListener
from placegraph.core import cache
from placegraph.core.cache import listen_to_compilation
from placegraph.errors import InputError, PlacegraphError

NAME = "placegraph"
_COMPLETE = "_PLACEGRAPH_COMPLETE"
_HERE = __name__

CITY = Group(
    "city",
    "Outdoor: locate a description in a city map made from OpenStreetMap.\n\n"
    "First `build` a map from an extract, then `locate` descriptions in it, or `track` a walk. "
    "`embed` speeds up large maps, `train` makes your own weights, `evaluate` tests your own "
    "descriptions.",
    {
        "build": f"{_HERE}.city:build",
        "locate": f"{_HERE}.city:locate",
        "info": f"{_HERE}.city:info",
        "check": f"{_HERE}.city:check",
        "fetch": f"{_HERE}.city:fetch",
        "track": f"{_HERE}.city:track",
        "embed": f"{_HERE}.city:embed",
        "stores": f"{_HERE}.city:stores",
    },
    partial(extensions, "city"),
)
SCENE = Group(
    "scene",
    "Indoor: build scene maps of rooms, and localize a few camera frames in them.",
    {
        "build": f"{_HERE}.scene_build:build",
        "info": f"{_HERE}.scene_build:info",
        "check": f"{_HERE}.scene_build:check",
        "anchor": f"{_HERE}.scene_anchor:anchor",
        "diff": f"{_HERE}.scene_diff:diff",
        "update": f"{_HERE}.scene_diff:update",
        "encode": f"{_HERE}.scene_build:encode",
        "export": f"{_HERE}.scene_build:export",
        "view": f"{_HERE}.scene_render:view",
        "localize": f"{_HERE}.scene_localize:localize",
        "refine": f"{_HERE}.scene_localize:refine",
        "render": f"{_HERE}.scene_render:render",
    },
    partial(extensions, "scene"),
)
LIBRARY = Group(
    "library",
    "Libraries of scene maps: find the scene that a capture shows or a text describes.",
    {
        "build": f"{_HERE}.library:build",
        "add": f"{_HERE}.library:add",
        "remove": f"{_HERE}.library:remove",
        "info": f"{_HERE}.library:info",
        "search": f"{_HERE}.library:search",
        "localize": f"{_HERE}.library:localize",
    },
    partial(extensions, "library"),
)
WORLD = Group(
    "world",
    "Worlds in shards: build a map folder from OpenStreetMap extracts of any size, up to "
    "the planet.",
    {},
    partial(extensions, "world"),
)
BAG = Group(
    "bag",
    "ROS bags: list their contents and check what they can be used for. Every command that "
    "takes a capture also takes a bag.",
    {},
    partial(extensions, "bag"),
)
CAPTURE = Group(
    "capture",
    "Recordings: write capture folders from any layout.",
    {"init": f"{_HERE}.capture:init"},
    partial(extensions, "capture"),
)


def main() -> NoReturn:
    """Run the command line; placegraph's own errors end it with their exit code and one sentence."""
    warnings.formatwarning = lambda message, *_: f"{NAME}: {message}\n"
    words = sys.argv[1:]
    with guard_streams(), interruptible(), listen_to_compilation(CompileListener(words)):
        sys.exit(_run(words))


def _run(arguments: list[str]) -> int:
    """Exit code of a command."""
    try:
        if instruction := os.environ.get(_COMPLETE):  # by which a shell asks for completions
            from click.shell_completion import shell_complete

            return shell_complete(APP, {}, NAME, _COMPLETE, instruction)
        with APP.make_context(NAME, arguments) as context:
            APP.invoke(context)
    except click.exceptions.Exit as exit_:
        return exit_.exit_code
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except KeyboardInterrupt:
        return INTERRUPTED
    except click.Abort:
        click.echo("Aborted.", err=True)
        return 1
    except PlacegraphError as error:
        text = harmless(f"{NAME}: {error}")
        click.secho(text, file=bare(sys.stderr), fg="red")
        return error.exit_code
    except OSError as error:
        return _failed(error)
    return 0


def _failed(error: OSError) -> int:
    """Report a file that cannot be read or written; nothing if the reader is gone (``| head``)."""
    if error.errno == errno.EPIPE:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    name = f"{error.filename} " if error.filename else ""
    click.echo(f"{NAME}: {name}cannot be written or read: {error.strerror}.", err=True)
    return InputError.exit_code


def _version(context: click.Context, _param: click.Parameter, wanted: bool) -> None:
    if wanted:
        from placegraph import __version__

        click.echo(__version__)
        context.exit()


def _compiled(_context: click.Context, _param: click.Parameter, folder: Path | None) -> None:
    if folder is not None:
        cache.FOLDERS.choose(folder)


def _completion(context: click.Context, _param: click.Parameter, shell: str | None) -> None:
    if shell is not None:
        from click.shell_completion import get_completion_class

        made = get_completion_class(shell)
        assert made is not None  # noqa: S101  # the choices are those that exist
        click.echo(made(APP, {}, NAME, _COMPLETE).source())
        context.exit()


APP = Group(
    NAME,
    "Where am I? Localize descriptions and camera frames on maps that are graphs of objects.",
    {
        "demo": f"{_HERE}.demo:demo",
        "locate": f"{_HERE}.locate:locate",
        "warm": f"{_HERE}.compiling:warm_up",
        "city": CITY,
        "scene": SCENE,
        "library": LIBRARY,
        "world": WORLD,
        "bag": BAG,
        "capture": CAPTURE,
    },
    partial(extensions, ""),
    params=[
        click.Option(
            ["--version"], is_flag=True, expose_value=False, is_eager=True, callback=_version,
            help="Print the version.",
        ),
        click.Option(
            ["--compiled"], type=click.Path(path_type=Path), expose_value=False,
            callback=_compiled, help="Folder for the cache of compiled code.",
        ),
        click.Option(
            ["--show-completion"], type=click.Choice(["bash", "zsh", "fish"]), metavar="SHELL",
            expose_value=False, is_eager=True, callback=_completion,
            help="Print the completion script for bash, zsh or fish.",
        ),
    ],
)  # fmt: skip
