"""Pages of the site that are made while it is built: commands, contributing, changelog."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from mkdocs.structure.files import File, Files

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig

ROOT = Path(__file__).resolve().parents[1]

COMMANDS = """# Commands

Every command with its options, as `--help` prints them. A command ends with 0 where it could
answer, even where the answer is `LOST`; the [exit codes](conventions.md#errors-and-exit-codes) say
what went wrong otherwise. `--json` prints what programs need.

"""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the made pages to those that lie in the folder."""
    made = {
        "commands.md": COMMANDS + _commands(),
        "contributing.md": (ROOT / "CONTRIBUTING.md").read_text("utf-8").replace("](docs/", "]("),
        "changelog.md": (ROOT / "CHANGELOG.md").read_text("utf-8").replace("](docs/", "]("),
    }
    for name, text in made.items():
        files.append(File.generated(config, name, content=text))
    return files


def _commands() -> str:
    """Options of all commands, placegraph-lab's among them."""
    import typer
    from typer.cli import get_docs_for_click

    from placegraph.cli import app

    command = typer.main.get_command(app)
    with command.make_context("placegraph", ["--version"], resilient_parsing=True) as context:
        text = get_docs_for_click(obj=command, ctx=context, name="placegraph")
    text = re.sub(r"^# .*\n", "", text)
    return re.sub(r"^\* ", "- ", text, flags=re.MULTILINE)
