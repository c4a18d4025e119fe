"""`placegraph city info` and `placegraph city check`: what a city map holds, and what is wrong."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from placegraph.cli.city.options import MapFile
from placegraph.cli.command import Option
from placegraph.cli.common import AsJson, show_facts

if TYPE_CHECKING:
    from placegraph.outdoor.city import CityMap


def info(
    map_file: MapFile,
    as_json: AsJson = False,
    png: Annotated[Path | None, Option(help="Write an overview picture.")] = None,
) -> None:
    """Say what a city map holds.

    Example: placegraph city info monaco.city
    """
    from placegraph.outdoor.city import CityMap

    city = CityMap.open(map_file)
    told = {**facts(city), "bytes": map_file.stat().st_size}
    if png is not None:
        from placegraph.view import draw_city

        draw_city(city, png)
    if as_json:
        click.echo(json.dumps(told, ensure_ascii=False))
        return
    show_facts(told)


def facts(city: CityMap) -> dict[str, object]:
    """What a city map holds, in plain numbers and strings."""
    from collections import Counter

    import numpy as np

    o = city.objects
    low, high = (city.plane.to_lonlat(f(o.points, axis=0)) for f in (np.min, np.max))
    first = Counter(o.labels[i] for i in o.label_values[o.label_starts[:-1]])
    return {
        "source": city.source,
        "objects": len(o),
        "named": int((np.diff(o.name_starts) > 0).sum()),
        "cells": len(city.cells),
        "cell_size": city.cells.size,
        "west_south_east_north_deg": [round(float(x), 5) for x in (*low, *high)],
        "labels": dict(first.most_common(12)),
        "left_out": city.left_out,
    }


def check(map_file: MapFile, as_json: AsJson = False) -> None:
    """Check a city map; each finding comes with a mend.

    Checksums, columns, and what may surprise.

    Example: placegraph city check monaco.city
    """
    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.map.check import findings

    found = findings(CityMap.open(map_file))
    if as_json:
        click.echo(json.dumps(found, ensure_ascii=False))
    else:
        click.echo("\n".join(f"- {line}" for line in found) if found else f"{map_file} is sound.")
