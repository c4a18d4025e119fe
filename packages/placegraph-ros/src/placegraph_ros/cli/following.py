"""What `bag localize` and `live` share: who carries the messages, and what is said in the end."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from placegraph.cli.command import Argument, Option
from placegraph.cli.common import console, echo_json

if TYPE_CHECKING:
    from placegraph_ros.loop import Sink
    from placegraph_ros.options import Summary

RoomsFile = Annotated[
    Path, Argument(help="Scene map (.scene), or library of several.", metavar="MAP")
]
RerunFile = Annotated[
    Path | None, Option(help="Write a recording for Rerun (.rrd) as well; extra `rerun`.")
]


def carriers(stack: ExitStack, out: Path | None, rerun: Path | None) -> list[Sink]:
    """Who writes the messages; errors as of `BagWriter` and `RerunWriter`."""
    sinks: list[Sink] = []
    if out is not None:
        from placegraph_ros.bag import BagWriter

        sinks.append(stack.enter_context(BagWriter(out)))
    if rerun is not None:
        from placegraph_ros.rerun import RerunWriter

        sinks.append(stack.enter_context(RerunWriter(rerun)))
    return sinks


def show_summary(summary: Summary, written: dict[str, Any], *, as_json: bool) -> None:
    """Say what became of the frames, what is missing, and what was written."""
    told = summary.to_dict()
    if as_json:
        echo_json(told | written)
        return
    out = console()
    looked = sum(summary.told.values())
    shares = ", ".join(f"{n:,} {name} ({n / looked:.0%})" for name, n in summary.told.most_common())
    out.print(
        f"{summary.frames:,} frames: {shares or 'nothing was told'}; {summary.dropped:,} dropped"
    )
    for sentence in summary.notes:
        out.print(f"Note: {sentence}")
    for sentence in summary.lacks:
        out.print(f"Missing: {sentence}")
    for reason, count in summary.left_out.items():
        out.print(f"Left out: {count:,}: {reason}")
    for name, value in written.items():
        out.print(f"{name}: {value}")
