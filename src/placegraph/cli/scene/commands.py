"""Commands of the indoor wing: `placegraph scene ...`."""

from __future__ import annotations

import typer

from placegraph.cli.extensions import add_extensions
from placegraph.cli.scene.build import build
from placegraph.cli.scene.check import check
from placegraph.cli.scene.diff import diff, update
from placegraph.cli.scene.encode import encode
from placegraph.cli.scene.export import export
from placegraph.cli.scene.facts import info
from placegraph.cli.scene.localize import localize
from placegraph.cli.scene.refine import refine
from placegraph.cli.scene.render import render
from placegraph.cli.scene.view import view

app = typer.Typer(
    help="Indoor: make maps of rooms, and find the pose of a few frames in them.",
    no_args_is_help=True,
)
for command in (
    build, info, check, diff, update, encode, export, view, localize, refine, render,
):  # fmt: skip
    app.command()(command)
add_extensions(app, "scene")
