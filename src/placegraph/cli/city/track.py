"""`placegraph city track`: follow a speaker sentence by sentence."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from placegraph.cli.city.options import MapFile, Near, Radius, Top, lonlat
from placegraph.cli.command import Option
from placegraph.cli.common import AsJson
from placegraph.errors import DescriptionError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from placegraph.core.estimate import CityEstimate

PROMPT = "> "


def track(
    map_file: MapFile,
    near: Near = None,
    radius: Radius = 1000.0,
    heading_deg: Annotated[
        float | None, Option(help="Where you look at first, clockwise from north.")
    ] = None,
    top: Top = 5,
    as_json: AsJson = False,
    html: Annotated[
        Path | None, Option(help="Write a page of the last estimate, without a network.")
    ] = None,
    png: Annotated[Path | None, Option(help="Write a picture of the last estimate.")] = None,
) -> None:
    """Follow you through a city, a sentence a line.

    Say what you see, or how you went: "A bakery is north of me.", "I walked 60 m east."
    `reset` starts anew; `quit`, or the end of the input, ends it.

    Example: placegraph city track monaco.city
    """
    from math import radians

    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.track.tracker import CityTracker

    city = CityMap.open(map_file)
    tracker = CityTracker(
        city,
        near=lonlat(near, "--near"),
        radius=radius,
        heading=None if heading_deg is None else radians(heading_deg),
        top=top,
    )
    asked = sys.stdin.isatty()
    for line in _lines(asked=asked):
        try:
            estimate = tracker.reset() if line.lower() == "reset" else tracker.tell(line)
        except DescriptionError as error:
            if not asked:
                raise
            click.echo(str(error), err=True)  # there is another line to come
            continue
        if as_json:
            said = {"said": line} | estimate.to_dict() | {"elsewhere": tracker.elsewhere}
            click.echo(json.dumps(said, ensure_ascii=False))
        else:
            click.echo(_told(estimate))
    if html is not None:
        from placegraph.view import write_page

        write_page(city, tracker.estimate, html)
    if png is not None:
        from placegraph.view import write_picture

        write_picture(city, tracker.estimate, png)


def _lines(*, asked: bool) -> Iterator[str]:
    """Lines of the input that say something, up to its end or "quit"."""
    while True:
        if asked:
            click.echo(PROMPT, nl=False, err=True)
        line = sys.stdin.readline()
        if not line or line.strip().lower() in ("quit", "exit"):
            return
        if line.strip():
            yield line.strip()


def _told(estimate: CityEstimate) -> str:
    """One line: status, the best place and its probability, or why there is none."""
    best = estimate.best
    if best is None:
        return f"{estimate.status.name}: {estimate.reason}"
    return (
        f"{estimate.status.name:9} {best.latitude:.5f}, {best.longitude:.5f} "
        f"{best.probability:6.1%}  ±{best.spread:.0f} m  {estimate.reason}"
    )
