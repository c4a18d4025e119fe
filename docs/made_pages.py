"""Parts of the site made during the build: commands, examples, contributing, changelog, tables of options."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from mkdocs.structure.files import File, Files

if TYPE_CHECKING:
    from collections.abc import Iterator

    from mkdocs.config.defaults import MkDocsConfig

ROOT = Path(__file__).resolve().parents[1]

COMMANDS = """# Commands

Every command with its options, as `--help` prints them. A command ends with 0 where it could
answer, even where the answer is `LOST`; the [exit codes](conventions.md#errors-and-exit-codes) say
what went wrong otherwise. `--json` prints what programs need.

"""

EXAMPLES = """# Examples

This page shows eleven programs of at most forty lines that use public names only. They are in
`examples/` of the repository and run on `demo-out/world/` of `placegraph demo`, or on another such
folder, their only argument: `python examples/01_sentence_to_place.py`. Programs 1 and 4 build the
maps that the others open.

"""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the made pages to those that lie in the folder."""
    made = {
        "commands.md": COMMANDS + _commands(),
        "examples.md": EXAMPLES + "\n".join(map(_example, sorted(ROOT.glob("examples/*.py")))),
        "contributing.md": (ROOT / "CONTRIBUTING.md").read_text("utf-8").replace("](docs/", "]("),
        "changelog.md": (ROOT / "CHANGELOG.md").read_text("utf-8").replace("](docs/", "]("),
    }
    for name, text in made.items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, **_: object) -> str:
    """Put the table of a dataclass of options where a comment names it."""
    return re.sub(r"<!-- options: (\S+) -->", lambda found: _table(found[1]), markdown)


def _table(place: str) -> str:
    from placegraph.core.options import write_table

    module, _, name = place.rpartition(".")
    return write_table(getattr(import_module(module), name))


def _example(path: Path) -> str:
    """Return a program under the first clause of its docstring."""
    text = path.read_text("utf-8")
    title = re.split(r'[:,.](?=\s|""")|(?<=\?) ', text.removeprefix('"""'), maxsplit=1)[0]
    fence = f'```python title="examples/{path.name}"'
    return f"## {int(path.name[:2])}. {title}\n\n{fence}\n{text}```\n"


def _commands() -> str:
    """Help of all commands, those that placegraph-lab brings among them."""
    import click

    from placegraph.cli import APP

    def told(command: click.Command, context: click.Context, depth: int) -> Iterator[str]:
        yield f"{'#' * depth} {context.command_path}\n\n```text\n{command.get_help(context)}\n```\n"
        if isinstance(command, click.Group):
            for name in command.list_commands(context):
                below = command.get_command(context, name)
                if below is not None and not below.hidden:
                    with click.Context(below, info_name=name, parent=context) as inner:
                        yield from told(below, inner, depth + 1)

    with click.Context(APP, info_name="placegraph", terminal_width=110) as context:
        return "\n".join(told(APP, context, 2))
