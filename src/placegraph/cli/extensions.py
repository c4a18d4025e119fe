"""Commands that other distributions add, by entry points of the group `placegraph.commands`.

An entry point is named after its place in the command line, such as ``city.train``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from placegraph.errors import MissingExtraError

if TYPE_CHECKING:
    from collections.abc import Callable

LAB = {
    "city": {
        "train": "Train the matching network on city maps.",
        "convert-kitti360pose": "Convert KITTI360Pose from its pickles.",
        "evaluate": "How well texts of your own find their places.",
    },
    "scene": {"train": "Train the network SceneGraphLoc on scene maps."},
}
"""Commands of placegraph-lab, which are listed and explained even where it is not installed."""


def extensions(wing: str) -> dict[str, str | click.Command]:
    """Commands of one wing that others bring; those of a missing lab say how to get it."""
    settings = {"allow_extra_args": True, "ignore_unknown_options": True}
    missing: dict[str, str | click.Command] = {
        name: click.Command(
            name, callback=_missing(f"{wing} {name}"), help=help_, context_settings=settings
        )
        for name, help_ in LAB[wing].items()
    }
    points = [point for point in _points() if point.name.startswith(f"{wing}.")]
    return missing | {point.name.partition(".")[2]: point.value for point in points}


def _points() -> tuple[Any, ...]:
    from importlib.metadata import entry_points

    return tuple(entry_points(group="placegraph.commands"))


def _missing(command: str) -> Callable[[], None]:
    def missing() -> None:
        raise MissingExtraError(
            f"`placegraph {command}` is part of placegraph-lab, which is not installed; "
            "`pip install placegraph-lab` brings it."
        )

    return missing
