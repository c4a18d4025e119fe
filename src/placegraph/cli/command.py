"""Commands made of functions, groups that import a command when it is asked for, and commands of plugins.

A parameter annotated with `Argument` or `Option` becomes one of the command line, with the type,
default and name of the parameter. One annotated with `Fields` becomes the options of a dataclass.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args, get_origin, get_type_hints

import click
from click.core import ParameterSource

from placegraph.core.options import OptionInfo, options_of
from placegraph.core.plugins import COMMANDS, missing_extra, plugins
from placegraph.errors import MissingExtraError

OPTIONS = "Options"
_TYPES: dict[type, Any] = {
    Path: click.Path(path_type=Path),
    int: click.INT,
    float: click.FLOAT,
    str: click.STRING,
    bool: click.BOOL,
}


@dataclass(frozen=True)
class Argument:
    """Positional argument of a command."""

    help: str
    metavar: str | None = None


class Option:
    """Option of a command: ``--a-name`` of the parameter ``a_name``, or `names`.

    `panel` is the heading of the help under which it stands, `least` the smallest number taken.
    """

    def __init__(
        self,
        *names: str,
        help: str,  # noqa: A002
        panel: str = OPTIONS,
        least: int | None = None,
    ) -> None:
        self.names, self.help, self.panel, self.least = names, help, panel, least


class Fields:
    """Options with flags of a dataclass (`placegraph.core.options`), or only those named.

    The function takes a dict of those given on the command line; the dataclass has the defaults.
    `owner` may be named as ``module:name``, which is imported when the command itself is used.
    """

    def __init__(self, owner: type | str, *names: str) -> None:
        if isinstance(owner, str):
            owner = _import(owner)
        self.options = [
            entry for entry in options_of(owner)
            if entry.info.flag and (not names or entry.name in names)
        ]  # fmt: skip


def _import(place: str) -> Any:  # noqa: ANN401
    module, _, name = place.partition(":")
    return getattr(import_module(module), name)


class Group(click.Group):
    """Commands by name, each a function ``module:name`` that is imported when it is asked for.

    `extend` returns more of them, which others bring.
    """

    def __init__(
        self,
        name: str,
        about: str,
        places: Mapping[str, str | Group],
        extend: Callable[[], Mapping[str, str | click.Command]] = dict,
        **settings: Any,  # noqa: ANN401  # click's
    ) -> None:
        super().__init__(name, help=about, no_args_is_help=True, **settings)
        self._places, self._extend = places, extend

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002  # click's
        """Names, in the order in which the help lists them."""
        return list(dict.fromkeys((*self._places, *self._extend())))

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002
        """Command of a name, None where there is none."""
        place = self._places.get(cmd_name) or self._extend().get(cmd_name)
        if isinstance(place, str):
            place = _import(place)
        if place is None or isinstance(place, click.Command):
            return place
        return command_of(place, cmd_name)

    def resolve_command(self, ctx: click.Context, args: list[str]) -> Any:  # noqa: ANN401  # click's
        """Resolve a command as click does; the error names commands with a similar spelling."""
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError as error:
            near = get_close_matches(args[0], self.list_commands(ctx))
            if near:
                message = f"{error.message} Did you mean {' or '.join(map(repr, near))}?"
                raise click.UsageError(message, ctx) from None
            raise


class _Command(click.Command):
    """Command of a function; its help lists arguments, and options under headings."""

    def __init__(self, name: str, function: Callable[..., Any]) -> None:
        super().__init__(name, callback=self._call, help=inspect.getdoc(function))
        self._function = function
        self._groups: dict[str, list[str]] = {}

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """Parameters of the function, made when they are first asked for."""
        hints = {} if self.params else get_type_hints(self._function, include_extras=True)
        for param in inspect.signature(self._function).parameters.values() if hints else ():
            hint, declaration = get_args(hints[param.name])[:2]
            if isinstance(declaration, Fields):
                self._groups[param.name] = [entry.name for entry in declaration.options]
                self.params += [_field_param(*entry) for entry in declaration.options]
            else:
                self.params.append(_param(param.name, param.default, hint, declaration))
        return super().get_params(ctx)

    def _call(self, **given: Any) -> Any:  # noqa: ANN401
        many = {p.name for p in self.params if getattr(p, "multiple", False) or p.nargs == -1}
        given = {k: (list(v) or None) if k in many else v for k, v in given.items()}
        source = click.get_current_context().get_parameter_source
        for group, names in self._groups.items():
            values = {k: given.pop(k) for k in names}
            given[group] = {
                k: tuple(v) if isinstance(v, list) else v
                for k, v in values.items() if source(k) is not ParameterSource.DEFAULT
            }  # fmt: skip
        return self._function(**given)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        panels: dict[str, list[tuple[str, str]]] = {"Arguments": []}
        for param in self.get_params(ctx):
            if isinstance(param, _Argument):
                panels["Arguments"].append(param.help_record())
            elif (record := param.get_help_record(ctx)) is not None:
                panels.setdefault(getattr(param, "panel", OPTIONS), []).append(record)
        panels[OPTIONS] = panels.pop(OPTIONS)  # the general ones, and --help, come last
        for heading, records in panels.items():
            if records:
                with formatter.section(heading):
                    formatter.write_dl(records)


class _Argument(click.Argument):
    def __init__(self, *given: Any, about: str, **settings: Any) -> None:  # noqa: ANN401  # click's
        super().__init__(*given, **settings)
        self.about = about

    def help_record(self) -> tuple[str, str]:
        return self.human_readable_name, self.about + ("  [required]" if self.required else "")


class _Option(click.Option):
    def __init__(self, names: list[str], panel: str, **settings: Any) -> None:  # noqa: ANN401
        super().__init__(names, **settings | {"show_default": True})
        self.panel = panel


def command_of(function: Callable[..., Any], name: str) -> click.Command:
    """Command of a function, whose docstring is its help."""
    return _Command(name, function)


def _field_param(name: str, default: Any, hint: Any, info: OptionInfo) -> _Option:  # noqa: ANN401
    """Option of a dataclass field; the dataclass checks its range."""
    kind = _scalar(hint)
    declaration = Option(info.flag, help=info.text, panel=info.panel)
    if info.commas:
        made: _Option = _param(name, ",".join(default), str, declaration)
        made.callback = lambda _context, _param, text: [part.strip() for part in text.split(",")]
        return made
    if get_origin(hint) is tuple:
        return _param(name, None, list[kind], declaration)  # type: ignore[valid-type]
    return _param(name, default, kind, declaration)


def _scalar(hint: Any) -> Any:  # noqa: ANN401
    """Return the type of one value on the command line."""
    if get_origin(hint) is Literal:
        return str
    parts = [part for part in get_args(hint) if part is not NoneType]
    return _scalar(parts[0]) if parts else hint


def _param(name: str, default: Any, hint: Any, declaration: Argument | Option) -> Any:  # noqa: ANN401
    (kind,) = (part for part in get_args(hint) or (hint,) if part is not NoneType)
    several = get_origin(kind) is list
    if get_origin(hint) is list:
        kind, several = hint, True
    kind = get_args(kind)[0] if several else kind
    required = default is inspect.Parameter.empty
    settings: dict[str, Any] = {"type": _TYPES[kind], "required": required}
    if not required:
        settings["default"] = default
    if isinstance(declaration, Argument):
        settings |= {"metavar": declaration.metavar, "nargs": -1 if several else 1}
        return _Argument([name], about=declaration.help, **settings)
    if declaration.least is not None:
        settings["type"] = click.IntRange(declaration.least)
    names = declaration.names or (f"--{name.replace('_', '-')}",)
    if kind is bool and not any("/" in name for name in names) and default is not None:
        settings["is_flag"] = True
    return _Option(
        [*names, name], help=declaration.help, panel=declaration.panel, multiple=several, **settings
    )


KNOWN = {
    "bag.info": ("io", "List the contents of a bag, and what they can be used for."),
    "bag.localize": ("ros", "Localize a bag, and write the poses to another bag."),
    "bag.layout": ("ros", "Print a layout for Foxglove."),
    "world.build": ("scale", "Build a world in shards from extracts of any size."),
    "library.shard": ("scale", "Split libraries into shards."),
    "live": (
        "ros",
        "Localize a live or replayed stream: a recording, a growing folder, or a pipe.",
    ),
    "serve": ("serve", "Serve maps over HTTP, with a web page."),
    "city.train": ("learn", "Train the matching network on city maps."),
    "city.convert-kitti360pose": ("lab", "Convert KITTI360Pose from its pickles."),
    "city.evaluate": ("lab", "Evaluate localization on your own descriptions."),
    "scene.train": ("learn", "Train the network SceneGraphLoc on scene maps."),
}
"""Extra and help of the commands of placegraph's other distributions, listed even where missing."""


def extensions(wing: str) -> dict[str, str | click.Command]:
    """Return commands of one wing that others bring, of the root where it is empty.

    Those of a missing distribution say how to get it.
    """
    settings = {"allow_extra_args": True, "ignore_unknown_options": True}
    commands: dict[str, str | click.Command] = {
        name.rpartition(".")[2]: click.Command(
            name, callback=_refuse(name, extra), help=help_, context_settings=settings
        )
        for name, (extra, help_) in KNOWN.items()
        if name.rpartition(".")[0] == wing
    }
    for name, point in plugins(COMMANDS).items():
        if name.rpartition(".")[0] == wing:
            commands[name.rpartition(".")[2]] = point.value
    return commands


def _refuse(name: str, extra: str) -> Callable[[], None]:
    command = f"`placegraph {name.replace('.', ' ')}`"

    def refuse() -> None:
        if extra == "lab":
            raise MissingExtraError(
                f"{command} needs placegraph-lab; install it with `pip install placegraph-lab`."
            )
        raise missing_extra(command, extra)

    return refuse
