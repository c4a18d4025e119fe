"""`placegraph scene diff` and `scene update`: what changed in a place, and a map that knows it."""

from __future__ import annotations

import json
from collections.abc import Callable
from math import radians
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from placegraph.cli.command import Argument, Fields, Option
from placegraph.cli.common import AsJson, console, numbers_of, progress_of, table
from placegraph.cli.scene_options import (
    Frames,
    MapFile,
    NoProgress,
    Seed,
    chosen_frames,
)
from placegraph.errors import OptionError
from placegraph.indoor.mapping.change.changes import DiffOptions, SceneDiff

if TYPE_CHECKING:
    from placegraph.core.geometry import Floats
    from placegraph.indoor.scene_map import SceneMap

MOST_IDS = 8
"""Unseen objects that are named; JSON names all."""
MAP_ENDING = ".scene"

Later = Annotated[Path, Argument(help="Later scene map (.scene) or capture of the same place.")]
Axes = Annotated[
    str | None,
    Option(
        "--b-from-a",
        help="X,Y,Z,YAW_DEG: pose of the first map's origin in the second map; estimated if not given.",
    ),
]


def diff(
    map_file: MapFile,
    later: Later,
    given: Annotated[dict[str, Any], Fields(DiffOptions)],
    frames: Frames = None,
    axes: Axes = None,
    as_json: AsJson = False,
    out: Annotated[
        Path | None, Option("--out", "-o", help="Write the diff as JSON, for scene update.")
    ] = None,
    png: Annotated[Path | None, Option(help="Write a plan of the changes.")] = None,
    quiet: NoProgress = False,
) -> None:
    """Report what moved, appeared or vanished between a map and a later map or capture of the place.

    A capture is localized first. If it is LOST, nothing is compared and the exit code is 3. Objects
    that the capture or the later map does not show are unseen, never vanished.

    Example: placegraph scene diff house.scene walk/ --png changes.png -o changes.json
    """
    from placegraph.maps import open_scene

    options = DiffOptions(b_from_a=_motion(axes), **given)
    scene = open_scene(map_file)
    with progress_of(hidden=quiet or as_json) as tell:
        differences = compute_diff(scene, later, frames, options, tell)
    if out is not None:
        differences.save(out)
    if png is not None:
        from placegraph.view.scene.change_plans import write_diff

        write_diff(scene, differences, png)
    if as_json:
        click.echo(json.dumps(differences.to_dict(), ensure_ascii=False))
    else:
        show(differences)


def update(
    map_file: MapFile,
    diff_file: Annotated[
        Path | None, Argument(help="JSON file that `placegraph scene diff -o` wrote.")
    ] = None,
    later: Annotated[
        Path | None,
        Option("--from", help="Later map or capture of the place, in place of a diff."),
    ] = None,
    out: Annotated[
        Path | None, Option("--out", "-o", help="Map file to write, such as new.scene.")
    ] = None,
    in_place: Annotated[
        bool, Option("--in-place", help="Replace the input map; the old one is kept as NAME.bak.")
    ] = False,
    take: Annotated[
        list[str] | None,
        Option(
            help="Kinds (moved, appeared, vanished, relabelled) or ids of changes to apply; may "
            "be repeated. All kinds if not given."
        ),
    ] = None,
    least_confidence: Annotated[
        float, Option(help="Minimum confidence of changes to apply.")
    ] = 0.5,
    when: Annotated[
        str, Option(help="Date of the change for the objects' history, such as 2026-11-21.")
    ] = "",
    frames: Frames = None,
    axes: Axes = None,
    seed: Seed = 0,
    as_json: AsJson = False,
    quiet: NoProgress = False,
) -> None:
    """Write a new map with the changes of a diff; the old map stays, unless --in-place is given.

    The attribute `history` of each changed object lists its changes; `placegraph scene view` shows it.

    Example: placegraph scene update house.scene changes.json -o house-now.scene
    """
    from placegraph.indoor.mapping.change.changes import KINDS, read_diff
    from placegraph.indoor.mapping.change.update import update_file
    from placegraph.indoor.scene_map import SceneMap

    if (diff_file is None) == (later is None):
        raise OptionError(
            "No change is given; name a diff's JSON file, or a later map or capture with --from."
        )
    if out is None and not in_place:
        raise OptionError(
            "No output is given; name a map with --out, or replace the input with --in-place."
        )
    if out is not None and in_place:
        raise OptionError("--out and --in-place exclude each other; give one.")
    if diff_file is not None:
        differences = read_diff(diff_file)
    else:
        scene = SceneMap.open(map_file)
        options = DiffOptions(b_from_a=_motion(axes), seed=seed)
        with progress_of(hidden=quiet or as_json) as tell:
            differences = compute_diff(scene, Path(str(later)), frames, options, tell)
    target = out or map_file
    new = update_file(
        map_file, differences, target, in_place=in_place, take=take or KINDS,
        least_confidence=least_confidence, when=when,
    )  # fmt: skip
    with_history = [
        id_ for id_, a in zip(new.graph.ids, new.attributes, strict=True) if "history" in a
    ]
    if as_json:
        facts = {
            "map": str(target),
            "objects": len(new),
            "changes": len(differences),
            "told": with_history,
        }
        click.echo(json.dumps(facts, ensure_ascii=False))
    elif not quiet:
        click.echo(f"{target}: {len(new):,} objects, {len(differences):,} changes in the diff.")
        if differences and not with_history:
            click.echo(f"No change was applied. Alignment: {differences.alignment}.")
        for id_, attributes in zip(new.graph.ids, new.attributes, strict=True):
            if id_ in with_history:
                label = new.graph.labels[new.row_of(id_)]
                click.echo(f"  {label} {id_!r}: {attributes['history']}")


def compute_diff(
    scene: SceneMap,
    later: Path,
    frames: str | None,
    options: DiffOptions,
    tell: Callable[[str, int, int], None],
) -> SceneDiff:
    """Diff of a map and a later look, which is a map file or a capture; raises as these do."""
    from placegraph.indoor.mapping.change.diff import diff as diff_of
    from placegraph.indoor.mapping.change.diff_capture import diff_capture
    from placegraph.maps import open_scene

    if later.suffix.lower() == MAP_ENDING:
        if frames is not None:
            raise OptionError(
                f"--frames applies only to captures, but {later} is a map; remove it."
            )
        return diff_of(scene, open_scene(later), options=options)
    if options.b_from_a is not None:
        raise OptionError("--b-from-a applies only to a second map, not to a capture; remove it.")
    from placegraph.io.capture.capture import open_capture

    capture = chosen_frames(open_capture(later), frames)
    estimate = scene.localize(capture, seed=options.seed, progress=tell)
    name = str(later)
    return diff_capture(scene, capture, estimate, options=options, name=name, progress=tell)


def show(differences: SceneDiff) -> None:
    """Print a diff so that a person can read it."""
    out = console()
    out.print(
        f"{differences.before or 'The map'} and {differences.after or 'a later look'}: {differences!r}"
    )
    out.print(f"Alignment: {differences.alignment}.")
    if len(differences):
        rows = table("change", "object", "by", "sure", "")
        for c in differences:
            thing = f"{c.label} {c.name or c.id or c.other}".strip()
            by = f"{c.shift_m:.2f} m, {c.turn_deg:.0f}°" if c.kind == "moved" else ""
            by = f"{c.new_label!r} now" if c.kind == "relabelled" else by
            rows.add_row(c.kind, thing, by, f"{c.confidence:.0%}", c.reason)
        out.print(rows)
    if differences.unseen:
        more = ", ..." if len(differences.unseen) > MOST_IDS else ""
        out.print(
            f"Not seen, so unknown: {len(differences.unseen)} objects "
            f"({', '.join(differences.unseen[:MOST_IDS])}{more})."
        )


def _motion(axes: str | None) -> Floats | None:
    """(4, 4) of a text X,Y,Z,YAW_DEG."""
    if axes is None:
        return None
    import numpy as np

    from placegraph.core.geometry import rotation_z
    from placegraph.indoor.mapping.change.align import make_rigid

    mend = "give x, y, z in metres and yaw in degrees, such as 1.5,2,0,90."
    numbers = numbers_of(axes, "--b-from-a", {4}, mend)
    return make_rigid(rotation_z(radians(numbers[3])), np.array(numbers[:3]))
