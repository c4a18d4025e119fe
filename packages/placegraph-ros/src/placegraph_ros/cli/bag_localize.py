"""`placegraph bag localize`: every frame of a bag finds its pose, and a bag is written of them."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from placegraph.cli.command import Option
from placegraph.cli.common import AsJson, Quiet, progress_of
from placegraph.cli.scene_options import Device, Seed
from placegraph_io.info import BagFile
from placegraph_ros.cli.following import RerunFile, RoomsFile, carriers, show_summary

if TYPE_CHECKING:
    from placegraph_ros.localizer import Localizer


def localize(
    bag: BagFile,
    map_file: RoomsFile,
    out: Annotated[
        Path,
        Option("--out", "-o", help="Bag to write: .mcap, .db3, .bag, or a folder of rosbag2."),
    ],
    rerun: RerunFile = None,
    seed: Seed = 0,
    device: Device = "auto",
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Localize all frames of a bag, one after the other, and write what is known as a bag.

    It holds the pose of the robot's base with its covariance, odometry in the map, the transforms, a
    particle cloud, the other places that fit, the status with reason and evidence, the objects that
    agreed and disagreed, the map and the images. `placegraph bag layout OUT` makes a layout for Foxglove.

    Example: placegraph bag localize walk.mcap house.scene -o out.mcap
    """
    from placegraph.maps import open_rooms
    from placegraph_ros.localizer import Localizer
    from placegraph_ros.loop import run
    from placegraph_ros.options import LiveOptions
    from placegraph_ros.sources import bag_source

    source = bag_source(bag)
    options = LiveOptions(background=False, seed=seed)
    with ExitStack() as stack:
        sinks = carriers(stack, out, rerun)
        localizer = Localizer(open_rooms(map_file), options, plan=source.plan, device=device)
        tell = stack.enter_context(progress_of(hidden=quiet or as_json))

        def told(localizer: Localizer) -> None:
            tell("localizing", localizer.frames, source.frames)

        summary = run(source.happenings, localizer, sinks, told)
    written = {"out": str(out)} | ({"rerun": str(rerun)} if rerun else {})
    if as_json or not quiet:
        show_summary(summary, written, as_json=as_json)
