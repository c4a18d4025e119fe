"""Commands of the indoor wing: `placegraph scene ...`."""

from __future__ import annotations

import typer

from placegraph.cli.scene_build import build
from placegraph.cli.scene_check import check
from placegraph.cli.scene_diff import diff, update
from placegraph.cli.scene_encode import encode
from placegraph.cli.scene_export import export
from placegraph.cli.scene_facts import info
from placegraph.cli.scene_localize import localize
from placegraph.cli.scene_refine import refine
from placegraph.cli.scene_render import render
from placegraph.cli.scene_train import train
from placegraph.cli.scene_view import view

app = typer.Typer(
    help="Indoor: make maps of rooms, and find the pose of a few frames in them.",
    no_args_is_help=True,
)
for command in (
    build, info, check, diff, update, encode, export, view, localize, refine, render, train,
):  # fmt: skip
    app.command()(command)
