"""`placegraph city convert-kitti360pose` and `placegraph city evaluate`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import click

from placegraph.cli.command import Argument, Fields, Option
from placegraph.cli.common import AsJson, Quiet, progress_of
from placegraph.outdoor.options import RankingOptions


def convert_kitti360pose(
    folder: Annotated[Path, Argument(help="Published folder with cells/ and poses/, of pickles.")],
    out: Annotated[Path, Option("--out", "-o", help="File to write: kitti360pose.k360.")],
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Convert KITTI360Pose from its pickles.

    The pickles are read, never run. `placegraph-lab table outdoor_kitti360pose` prints the tables.

    Example: placegraph city convert-kitti360pose k360_30-10_scG_pd10_pc4_spY_all -o kitti.k360
    """
    from dataclasses import asdict

    from placegraph_lab.datasets.kitti360pose import convert_kitti360pose as convert

    with progress_of(hidden=quiet or as_json) as tell:
        tell("reading")
        done = convert(folder, out, progress=lambda step, n: tell(f"{step} {n:,} cells"))
    if as_json:
        click.echo(json.dumps(asdict(done)))
    elif not quiet:
        click.echo(
            f"{out}: {done.cells:,} cells with {done.objects:,} objects and {done.poses:,} poses of "
            f"the drives {', '.join(done.scenes)}.\n"
            f"{done.points:,} points, {done.source_bytes / 1e6:,.1f} MB of pickles, became "
            f"{done.bytes / 1e6:,.2f} MB. {done.unmatched:,} of {done.hints:,} hints are about "
            f"things their cell does not hold; {done.padding:,} objects of padding left out."
        )


def evaluate(
    folder: Annotated[
        Path, Argument(help="Folder with descriptions.jsonl, and map.osm.pbf or a *.city.")
    ],
    ranking: Annotated[dict[str, Any], Fields(RankingOptions, "matcher")],
    out: Annotated[
        Path | None, Option("--out", "-o", help="Write every answer as JSON to this file.")
    ] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Measure how well your own descriptions are located.

    A line of descriptions.jsonl: {"id": "1", "text": "A bakery is north of me.", "longitude": 7.42,
    "latitude": 43.73}

    Example: placegraph city evaluate pairs/
    """
    from placegraph_lab.tables.kitti.own_pairs import evaluate_folder

    with progress_of(hidden=quiet or as_json) as tell:
        tell("opening")
        found = evaluate_folder(
            folder,
            **ranking,
            progress=lambda step, n: tell(f"{step} {n:,}"),
        )
    if out is not None:
        text = json.dumps(found.to_dict(answers=True), ensure_ascii=False, indent=1)
        out.write_text(text + "\n", encoding="utf-8")
    if as_json:
        click.echo(json.dumps(found.to_dict(), ensure_ascii=False))
    elif not quiet:
        click.echo(found.table())
