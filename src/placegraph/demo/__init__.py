"""The demo: a town, a flat and some homes that ship with placegraph, and someone lost in them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from placegraph.demo.flat import locate_in_flat, locate_in_world
from placegraph.demo.town import locate_in_town, unpack

PAGES = ("clear.html", "ambiguous.html", "walk.png", "walk.gif", "overlay.png", "changes.png")


def run_demo(out: Path, report: Callable[[str], None]) -> None:
    """Locate sentences and a way in the town, a film in the flat, and both in one world.

    Leaves maps and pictures in `out`. What is built and localized is copied to `out/world` first:
    ordinary files, as a user's own; at the end it holds a world for `open_world`.
    """
    world = unpack(out / "world")
    commands = locate_in_town(world, out, report) + locate_in_flat(world, out, report)
    commands += locate_in_world(world, out, report)
    report(f"\nLook at {', '.join(f'{out}/{page}' for page in PAGES)}.")
    report("\nThe same with commands:")
    for command in commands:
        report(f"  placegraph {command}")
