"""`placegraph city build` and `placegraph city fetch`: OpenStreetMap becomes a map."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import click

from placegraph.cli.city.facts import facts
from placegraph.cli.command import Argument, Option
from placegraph.cli.common import AsJson, Quiet, numbers_of, progress_of
from placegraph.errors import OptionError
from placegraph.io.osm.urls import is_url
from placegraph_io.overture.overture import CONFIDENCE, Box, Overture, is_overture

OVERTURE = "What of Overture is read"
EDGES = "give west,south,east,north in degrees, such as 7.41,43.72,7.44,43.75."


def build(
    file: Annotated[
        list[str],
        Argument(
            help="OpenStreetMap extract, or URL of one: .osm.pbf, .osm, .osm.gz or .osm.bz2; or files, "
            "folders or URLs of Overture's GeoParquet."
        ),
    ],
    out: Annotated[
        str,
        Option(
            "--out",
            "-o",
            help="Map file to write, such as monaco.city. Of an extract above 64 MB it becomes a folder "
            "of maps, as by `world build`.",
        ),
    ],
    cell_size: Annotated[float, Option(help="Edge of a cell [m].")] = 50.0,
    stride: Annotated[
        float | None, Option(help="Distance of cell centres [m]; the cell size if not given.")
    ] = None,
    edge_distance: Annotated[
        float | None,
        Option(help="Objects nearer than this are joined [m]; the cell size if not given."),
    ] = None,
    bbox: Annotated[
        str | None, Option(help="W,S,E,N [deg]: only what touches this box.", panel=OVERTURE)
    ] = None,
    confidence: Annotated[
        float,
        Option(help="Least probability of a place to exist.", panel=OVERTURE),
    ] = CONFIDENCE,
    vocabulary: Annotated[Path | None, Option(help="Folder with edited vocabulary tables.")] = None,
    no_index: Annotated[
        bool,
        Option(
            "--no-index",
            help="A small file, though the map is large: the index of places is derived anew for the first "
            "question each time.",
        ),
    ] = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Build a city map from an OpenStreetMap extract, or from Overture.

    Example: placegraph city build monaco.osm.pbf -o monaco.city
    """
    from time import perf_counter

    from placegraph.outdoor.city import build_city
    from placegraph.outdoor.language.vocabulary import Vocabulary
    from placegraph_scale.build.split import is_large

    if is_url(out):
        raise OptionError(
            f"{out} is a URL, and a map is written to this machine. A world in shards may be brought there: "
            f"placegraph world build {file[0]} -o {out} --work FOLDER"
        )
    source = _source(file, bbox, confidence)
    if isinstance(source, str) and is_large(source):
        if no_index:
            raise OptionError(
                "--no-index is of one map; of an extract this large a world in shards is made, each with "
                "its index. Leave it out."
            )
        from placegraph_scale.build.build import BuildOptions
        from placegraph_scale.cli.world_build import made_of

        options = BuildOptions(
            cell_size=cell_size, stride=stride, edge_distance=edge_distance, vocabulary=vocabulary
        )
        made_of([source], out, options, as_json=as_json, quiet=quiet)
        return
    words = Vocabulary.load(vocabulary) if vocabulary else None
    start = perf_counter()
    with progress_of(hidden=quiet or as_json) as tell:
        tell("reading")
        city = build_city(
            source, out, cell_size=cell_size, stride=stride, edge_distance=edge_distance, vocabulary=words,
            index=False if no_index else None,
            progress=lambda step, n: tell(f"{step} {n:,}" + " elements" * (step == "reading")),
        )  # fmt: skip
    seconds = perf_counter() - start
    size = Path(out).stat().st_size
    summary = {**facts(city), "bytes": size, "seconds": round(seconds, 3)}
    if as_json:
        click.echo(json.dumps(summary))
    elif not quiet:
        click.echo(
            f"{out}: {len(city.objects):,} objects in {len(city.cells):,} cells, "
            f"{size / 1e3:,.0f} kB ({size / max(1, len(city.cells)):.0f} bytes a cell), "
            f"built in {seconds:.1f} s."
        )
        if city.left_out:
            click.echo(
                "Left out: " + ", ".join(f"{n:,} {why}" for why, n in city.left_out.items()) + "."
            )


def _source(given: list[str], bbox: str | None, confidence: float) -> str | Overture:
    """One extract, or all that is given of Overture."""
    if all(map(is_overture, given)):
        box = None if bbox is None else Box.of(numbers_of(bbox, "--bbox", (4,), EDGES))
        return Overture(tuple(given), box, confidence)
    if len(given) > 1:
        raise OptionError(
            f"{len(given)} files are given: a map is built from one OpenStreetMap extract, or from files "
            "of Overture alone. Merge extracts with osmium."
        )
    if bbox is not None:
        raise OptionError("--bbox is for Overture; cut an OpenStreetMap extract with osmium.")
    return given[0]


def fetch(
    place: Annotated[str, Argument(help="Name of a place, such as 'Vaduz, Liechtenstein'.")],
    out: Annotated[
        Path, Option("--out", "-o", help="OpenStreetMap file to write: .osm or .osm.pbf.")
    ],
    overpass_url: Annotated[
        str | None, Option(help="Another Overpass server than OSMnx's own.")
    ] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Download a place's OpenStreetMap data.

    From Overpass, by OSMnx (extra `osmnx`).

    Example: placegraph city fetch "Vaduz, Liechtenstein" -o vaduz.osm
    """
    from dataclasses import asdict

    from placegraph.io.osm.overpass import fetch_osm
    from placegraph.outdoor.map.extract import keys_read

    with progress_of(hidden=quiet or as_json) as tell:
        tell("finding")
        summary = fetch_osm(
            place,
            out,
            keys=keys_read(),
            overpass_url=overpass_url,
            progress=lambda step, n: tell(f"{step} {n:,}"),
        )
    if as_json:
        click.echo(json.dumps(asdict(summary), ensure_ascii=False))
    elif not quiet:
        click.echo(str(summary))
