"""`placegraph bag layout`: how Foxglove shows a bag."""

from __future__ import annotations

import click

from placegraph_io.info import BagFile


def layout(bag: BagFile) -> None:
    """Write BAG.layout.json: a layout for Foxglove or Lichtblick, to be imported there.

    It shows the map, the pose with its covariance, the modes, the objects that agreed and disagreed,
    the camera's images where BAG holds some, and the status with reason and evidence.

    Example: placegraph bag layout out.mcap
    """
    from placegraph_ros.layout import write_layout

    click.echo(f"wrote {write_layout(bag)}")
