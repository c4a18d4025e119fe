"""Commands that other distributions add, by entry points of the group `placegraph.commands`.

An entry point is named after its place in the command line, such as ``city.train``.
"""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import TYPE_CHECKING

from placegraph.errors import MissingExtraError

if TYPE_CHECKING:
    from collections.abc import Callable

    import typer

LAB = {
    "city": {
        "train": "Train the matching network on city maps.",
        "convert-kitti360pose": "Convert KITTI360Pose from its pickles.",
        "evaluate": "How well texts of your own find their places.",
    },
    "scene": {"train": "Train the network SceneGraphLoc on scene maps."},
}
"""Commands of placegraph-lab, which are listed and explained even where it is not installed."""


def add_extensions(app: typer.Typer, wing: str) -> None:
    """Add the commands of one wing that others bring; those of a missing lab say how to get it."""
    found = {p.name.partition(".")[2]: p for p in _points() if p.name.startswith(f"{wing}.")}
    for name, help_ in LAB[wing].items():
        if name not in found:
            settings = {"allow_extra_args": True, "ignore_unknown_options": True}
            app.command(name, help=help_, context_settings=settings)(_missing(f"{wing} {name}"))
    for name, point in found.items():
        app.command(name)(point.load())


def _points() -> tuple:  # type: ignore[type-arg]
    return tuple(entry_points(group="placegraph.commands"))


def _missing(command: str) -> Callable[[], None]:
    def missing() -> None:
        raise MissingExtraError(
            f"`placegraph {command}` is part of placegraph-lab, which is not installed; "
            "`pip install placegraph-lab` brings it."
        )

    return missing
