"""Command `placegraph bag info`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from placegraph.cli.command import Argument
from placegraph.cli.common import AsJson, console, echo_json

BagFile = Annotated[Path, Argument(help="Bag of ROS: .mcap, .db3, .bag, or a folder of rosbag2.")]


def info(bag: BagFile, as_json: AsJson = False) -> None:
    """Say what a bag holds, what of it is used, and what is missing for which use.

    Topics are found by type. Others are named, and what was not recorded is written, in a file beside
    the bag, BAG.json: {"colour": "/cam/image_raw", "frame": "odom"}.

    Example: placegraph bag info walk.mcap
    """
    from placegraph_io.info import bag_facts

    told = bag_facts(bag)
    if as_json:
        echo_json(told)
    else:
        _show(told)


def _show(told: dict[str, Any]) -> None:
    out = console()
    out.print(f"{told['bag']}: {told['duration_s']:.1f} s, {told['messages']:,} messages")
    rows = [("topic", "messages", "Hz", "type", "used as"), *(_row(t) for t in told["topics"])]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        cells = [cell.ljust(width) for cell, width in zip(row, widths, strict=True)]
        out.print("  ".join(cells).rstrip())
    for t in told["topics"]:
        if "problem" in t:
            out.print(f"Not read: {t['problem']}")
    for note in told["notes"]:
        out.print(f"Note: {note}")
    for reason, count in told["left_out"].items():
        out.print(f"Left out: {count:,}: {reason}")
    for use, lacks in told["uses"].items():
        if not lacks:
            out.print(f"{use}: yes, {told['frames']:,} frames")
        for sentence in lacks:
            out.print(f"{use}: no. {sentence}")


def _row(t: dict[str, Any]) -> tuple[str, ...]:
    shows = f", {t['encoding']} {t['size'][0]} x {t['size'][1]}" if t.get("encoding") else ""
    rate = "" if t["rate_hz"] is None else f"{t['rate_hz']:.1f}"
    used = ", ".join(word.replace("_", " ") for word in t["used"])
    return t["topic"], f"{t['messages']:,}", rate, t["type"] + shows, used
