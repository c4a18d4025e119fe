"""Commands made of functions, and imported when they are asked for."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import click
import pytest

from placegraph.cli.command import Argument, Fields, Group, Option, command_of
from placegraph.core.options import option

HEAVY = {
    "numpy",
    "numba",
    "rich",
    "PIL",
    "lark",
    "placegraph.outdoor.city",
    "placegraph.indoor.scene_map",
}


def tell(
    words: Annotated[list[str], Argument(help="What is said.")],
    out_file: Annotated[Path | None, Option("--out", "-o", help="Where.", panel="Written")] = None,
    times: Annotated[int, Option(help="How often.", least=1)] = 1,
    by: Annotated[list[float] | None, Option(help="By what; may be repeated.")] = None,
    loud: Annotated[bool, Option("--loud", help="Loudly.")] = False,
    segment: Annotated[bool | None, Option("--segment/--no-segment", help="Cut it.")] = None,
) -> None:
    """Say something."""
    click.echo(repr((words, out_file, times, by, loud, segment)))


def call(capsys, line):
    with command_of(tell, "tell").make_context("tell", line.split()) as context:
        context.command.invoke(context)
    return capsys.readouterr().out.strip()


def test_types_and_defaults_are_those_of_the_function(capsys):
    assert call(capsys, "a") == repr((["a"], None, 1, None, False, None))
    given = "a b -o x --times 2 --by 1 --by 2.5 --loud --no-segment"
    assert call(capsys, given) == repr((["a", "b"], Path("x"), 2, [1.0, 2.5], True, False))


@pytest.mark.parametrize(
    ("line", "message"),
    [("", "Missing argument"), ("a --times 0", "not in the range"), ("a --by x", "float")],
)
def test_what_does_not_fit_is_refused(capsys, line, message):
    with pytest.raises(click.UsageError) as refused:
        call(capsys, line)
    assert message in refused.value.format_message()


def test_the_help_has_a_heading_for_each_panel():
    with pytest.raises(click.exceptions.Exit):
        command_of(tell, "tell").make_context("tell", ["--help"])
    text = click.Context(command_of(tell, "tell")).get_help()
    assert [line for line in text.splitlines() if line.endswith(":") and line[0] != " "] == [
        "Arguments:", "Written:", "Options:",
    ]  # fmt: skip
    assert "WORDS..." in text
    assert "[required]" in text


def test_a_group_imports_what_is_asked_for_and_names_what_is_near():
    group = Group(
        "g", "Of commands.", {"tell": f"{__name__}:tell"}, lambda: {"more": "no.such:one"}
    )
    context = click.Context(group)
    assert group.list_commands(context) == ["tell", "more"]
    assert group.get_command(context, "none") is None
    with pytest.raises(ModuleNotFoundError):
        group.get_command(context, "more")
    with pytest.raises(click.UsageError, match="Did you mean 'more'"):
        group.resolve_command(context, ["moer"])


@pytest.mark.parametrize("words", [["--help"], ["--version"], ["city", "locate", "--help"]])
def test_help_is_light(words):
    code = f"from placegraph.cli import _run; import sys; _run({words}); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)  # noqa: S603
    assert not HEAVY & set(done.stdout.split())


@dataclass(frozen=True)
class Settings:
    share: float = option(0.5, "Share.", unit="1", below=1, flag="--share")
    count: int | None = option(None, "Count.", flag="--count")
    heights: tuple[float, ...] = option((1.5,), "Height.", unit="m", flag="--height")
    words: tuple[str, ...] = option(("a", "b"), "Words.", flag="--words", commas=True)
    kind: Literal["x", "y"] | None = option(None, "Kind.", flag="--kind", panel="Kinds")
    loud: bool = option(True, "Loud.", flag="--loud/--quiet")
    hidden: int = option(3, "No flag.")


NAMES = ("share", "heights", "words", "kind", "loud", "hidden")


def configure(
    settings: Annotated[dict[str, Any], Fields(f"{__name__}:Settings", *NAMES)],
    few: Annotated[dict[str, Any], Fields(Settings, "count")],
) -> None:
    """Print the options given."""
    click.echo(repr((settings, few)))


def test_options_of_a_dataclass_are_those_given(capsys):
    with command_of(configure, "configure").make_context("configure", []) as context:
        text = context.command.get_help(context)
    assert "Share. [1]" in text.replace("\n", " ")
    assert "[default: a,b]" in text
    assert "hidden" not in text
    given = ["--height", "1", "--height", "2", "--words", "c, d", "--quiet", "--kind", "x"]
    with command_of(configure, "configure").make_context("configure", given) as context:
        context.command.invoke(context)
    settings = {"heights": (1.0, 2.0), "words": ("c", "d"), "kind": "x", "loud": False}
    assert capsys.readouterr().out.strip() == repr((settings, {}))
