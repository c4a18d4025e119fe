"""Commands that other distributions add, by entry points of the group `placegraph.commands`.

An entry point is named after its place in the command line, such as ``city.train``.
"""

from __future__ import annotations

from collections.abc import Callable

import click

from placegraph.core.plugins import COMMANDS, missing, plugins
from placegraph.errors import MissingExtraError

KNOWN = {
    "bag.info": ("io", "What a bag holds, and what it can be used for."),
    "bag.localize": ("ros", "Localize a bag, and write what was found as a bag."),
    "bag.layout": ("ros", "Print a layout for Foxglove."),
    "world.build": ("scale", "Build a world in shards of extracts of any size."),
    "library.shard": ("scale", "Put the scenes of libraries into shards."),
    "live": ("ros", "Localize as if live: a recording, a folder that fills, a pipe."),
    "serve": ("serve", "Serve maps over HTTP, and a page."),
    "city.train": ("learn", "Train the matching network on city maps."),
    "city.convert-kitti360pose": ("lab", "Convert KITTI360Pose from its pickles."),
    "city.evaluate": ("lab", "How well texts of your own find their places."),
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
                f"{command} is part of placegraph-lab, which is not installed; "
                "`pip install placegraph-lab` brings it."
            )
        raise missing(command, extra)

    return refuse
