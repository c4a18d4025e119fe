"""`placegraph scene check`: what is wrong with a scene map, and how to mend it."""

from __future__ import annotations

import json
from time import perf_counter
from typing import TYPE_CHECKING, Annotated

import click

from placegraph.cli.command import Option
from placegraph.cli.common import AsJson, console
from placegraph.cli.scene.query import MapFile
from placegraph.errors import MapError

if TYPE_CHECKING:
    from placegraph.indoor.mapping.check import Finding

MOST_IDS = 6
"""Objects of a finding that are named; JSON names more."""


def check(
    map_file: MapFile,
    height: Annotated[
        list[float] | None,
        Option(
            help="Height above the floor at which cameras will be [m], 1.5 to 1.8 if not given; may be "
            "repeated."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Say what is wrong with a scene map: units, floor, gravity, holes, objects; each with a mend.

    Ends with 0 where nothing makes localizing fail, with 4 where something does.

    Example: placegraph scene check house.scene
    """
    from placegraph.indoor.mapping.check import check as findings_of
    from placegraph.indoor.options import FilterOptions
    from placegraph.indoor.scene_map import SceneMap

    begun = perf_counter()
    scene = SceneMap.open(map_file)
    opened = perf_counter() - begun
    options = FilterOptions(heights=tuple(height)) if height else FilterOptions()
    size = map_file.stat().st_size
    findings = findings_of(scene, options=options, size=size, seconds=opened)
    errors = sum(f.severity == "error" for f in findings)
    if as_json:
        told = {
            "map": str(map_file),
            "bytes": size,
            "opened_s": round(opened, 3),
            "errors": errors,
            "findings": [f.to_dict() for f in findings],
        }
        click.echo(json.dumps(told, ensure_ascii=False))
    else:
        _show(findings)
        click.echo(
            f"{map_file}: {len(scene):,} objects, {len(scene.mesh):,} triangles, "
            f"{size / 1e3:,.0f} kB, opened in {opened:.2f} s; "
            + (f"{errors} error{'s' * (errors != 1)}." if errors else "nothing to fail by.")
        )
    if errors:
        raise click.exceptions.Exit(MapError.exit_code)


def _show(findings: list[Finding]) -> None:
    out = console()
    for f in findings:
        out.print(f"{f.severity}: {f.what}")
        if f.objects:
            more = " ..." if len(f.objects) > MOST_IDS else ""
            out.print(f"    objects: {', '.join(f.objects[:MOST_IDS])}{more}")
        if f.mend:
            out.print(f"    mend: {f.mend}")
