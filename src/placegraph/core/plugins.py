"""Plugins: other distributions extend placegraph by entry points, in one group a kind of extension."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from placegraph.errors import MissingExtraError

COMMANDS = "placegraph.commands"
"""Commands by their place in the command line, such as ``city.train``."""
CAPTURES = "placegraph.captures"
"""Tuples of `placegraph.io.formats.Format`."""
SOURCES = "placegraph.sources"
"""Tuples of `placegraph.io.formats.Format`."""
ENCODERS = "placegraph.encoders"
"""Classes of encoders by the name that `placegraph.encoder` takes."""
MATCHERS = "placegraph.matchers"
"""Classes of matchers by the name that `placegraph.matcher` takes."""
MAPS = "placegraph.maps"
"""Kinds of maps that are folders (`placegraph.maps.FOLDERS`); each has `open(path, ...)`."""


@cache
def plugins(group: str) -> dict[str, EntryPoint]:
    """Return the entry points of a group by name, sorted."""
    return {point.name: point for point in sorted(entry_points(group=group))}


def load_plugin(group: str, name: str, extra: str) -> Any:  # noqa: ANN401  # any object
    """Return the object of an entry point; `MissingExtraError` names the extra that installs it."""
    point = plugins(group).get(name)
    if point is None:
        raise missing_extra(name, extra)
    return point.load()


def load_module(name: str, extra: str) -> Any:  # noqa: ANN401  # a module
    """Import a module of a plugin; `MissingExtraError` names the extra that installs it."""
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        if error.name is not None and error.name.partition(".")[0] == name.partition(".")[0]:
            raise missing_extra(name, extra) from error
        raise


def missing_extra(name: str, extra: str) -> MissingExtraError:
    """Return the error for a part of placegraph that is not installed."""
    return MissingExtraError(
        f"{name} is part of placegraph-{extra}, which is not installed; run `pip install "
        f"'placegraph[{extra}]'`."
    )
