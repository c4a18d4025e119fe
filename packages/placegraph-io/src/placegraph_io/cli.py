"""Command `placegraph bag info`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from placegraph.cli.command import Argument
from placegraph.cli.common import AsJson, console, echo_json

BagFile = Annotated[Path, Argument(help="ROS bag: .mcap, .db3, .bag, or a folder of rosbag2.")]


def info(bag: BagFile, as_json: AsJson = False) -> None:
    """Show the topics of a bag, their roles, and what each use lacks.

    Topics are chosen by type. A file beside the bag, BAG.json, chooses other topics and adds
    what was not recorded: {"colour": "/cam/image_raw", "frame": "odom"}.

    Example: placegraph bag info walk.mcap
    """
    from placegraph_io.info import describe_bag

    facts = describe_bag(bag)
    if as_json:
        echo_json(facts)
        return
    out = console()
    out.print(f"{facts['bag']}: {facts['duration_s']:.1f} s, {facts['messages']:,} messages")
    rows = [("topic", "messages", "Hz", "type", "used as"), *(_row(t) for t in facts["topics"])]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        cells = [cell.ljust(width) for cell, width in zip(row, widths, strict=True)]
        out.print("  ".join(cells).rstrip())
    for t in facts["topics"]:
        if "problem" in t:
            out.print(f"Not read: {t['problem']}")
    for note in facts["notes"]:
        out.print(f"Note: {note}")
    for reason, count in facts["left_out"].items():
        out.print(f"Left out: {count:,}: {reason}")
    uses_of: dict[str, list[str]] = {}
    for use, lacks in facts["uses"].items():
        for verdict in [f"no. {s}" for s in lacks] or [f"yes, {facts['frames']:,} frames"]:
            uses_of.setdefault(verdict, []).append(use)
    for verdict, uses in uses_of.items():
        out.print(f"{', '.join(uses)}: {verdict}")


def _row(t: dict[str, Any]) -> tuple[str, ...]:
    shows = f", {t['encoding']} {t['size'][0]} x {t['size'][1]}" if t.get("encoding") else ""
    rate = "" if t["rate_hz"] is None else f"{t['rate_hz']:.1f}"
    used = ", ".join(word.replace("_", " ") for word in t["used"])
    return t["topic"], f"{t['messages']:,}", rate, t["type"] + shows, used
