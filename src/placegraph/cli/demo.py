"""`placegraph demo`: both wings at work on what ships with placegraph."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import click

from placegraph.cli.command import Option
from placegraph.errors import InputError


def demo(
    out: Annotated[Path, Option(help="Folder for the pages and pictures.")] = Path("demo-out"),
) -> None:
    """Locate three sentences in a town that ships with placegraph, and a walk in a flat."""
    from placegraph.demo import run_demo

    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"The folder {out} cannot be created ({error.strerror}); choose another --out."
        ) from error
    run_demo(out, click.echo)
