"""`placegraph-lab table`: every table of measurements, by name."""

from __future__ import annotations

from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from placegraph_lab.tables.runner import load, names


class Tables(TyperGroup):
    """Commands that are imported when they are asked for."""

    def list_commands(self, ctx: Any) -> list[str]:  # noqa: ANN401, ARG002  # click's, as Typer holds it
        """Names of all tables."""
        return names()

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ANN401, ARG002
        """Command of a table."""
        if cmd_name not in names():
            return None
        return typer.main.get_command(load(cmd_name).app())


app = typer.Typer(
    cls=Tables,
    help="Measure: print a table as Markdown, write its rows as JSON.",
    invoke_without_command=True,
)


@app.callback()
def table(
    context: typer.Context,
    listed: Annotated[bool, typer.Option("--list", help="What there is, and exit.")] = False,
) -> None:
    """Measure: print a table as Markdown, write its rows as JSON.

    Example: placegraph-lab table outdoor_recall --quick
    """
    if listed or context.invoked_subcommand is None:
        for name in names():
            one = load(name)
            typer.echo(f"{name:22} {one.asks}{f' [{one.paper}]' if one.paper else ''}")
        raise typer.Exit
