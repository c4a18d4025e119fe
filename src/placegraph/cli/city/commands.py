"""Commands of the outdoor wing: `placegraph city ...`."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from placegraph.cli.city import store as stores
from placegraph.cli.city import track as walks
from placegraph.cli.city.matching import CandidatesBy, Matcher, Store, Weights, matching
from placegraph.cli.common import AsJson, Quiet, progress_bar, show_facts
from placegraph.cli.extensions import add_extensions
from placegraph.errors import OptionError

if TYPE_CHECKING:
    from placegraph.estimate import CityEstimate
    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.search.ask import Answer, Question

app = typer.Typer(
    help="Outdoor: a sentence finds its place in a city cut from OpenStreetMap.\n\n"
    "First `build` a map from an extract, then `locate` descriptions in it, or `track` a walk. "
    "`embed` is for large maps, `train` for weights of your own, `evaluate` for texts of your own.",
    no_args_is_help=True,
)


MapFile = Annotated[Path, typer.Argument(help="City map (.city), made by `placegraph city build`.")]


@app.command("build")
def build(
    file: Annotated[
        Path, typer.Argument(help="OpenStreetMap extract: .osm.pbf, .osm, .osm.gz or .osm.bz2.")
    ],
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Map file to write, such as monaco.city.")
    ],
    cell_size: Annotated[float, typer.Option(help="Edge of a cell [m].")] = 50.0,
    stride: Annotated[
        float | None, typer.Option(help="Distance of cell centres [m]; the cell size if not given.")
    ] = None,
    edge_distance: Annotated[
        float | None,
        typer.Option(help="Objects nearer than this are joined [m]; the cell size if not given."),
    ] = None,
    vocabulary: Annotated[
        Path | None, typer.Option(help="Folder with edited vocabulary tables.")
    ] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Build a city map from an OpenStreetMap extract.

    Example: placegraph city build monaco.osm.pbf -o monaco.city
    """
    from time import perf_counter

    from placegraph.outdoor.city import build_city
    from placegraph.outdoor.language.vocabulary import Vocabulary

    words = Vocabulary.load(vocabulary) if vocabulary else None
    start = perf_counter()
    with progress_bar(hidden=quiet or as_json) as progress:
        task = progress.add_task("reading")
        city = build_city(
            file, out, cell_size=cell_size, stride=stride, edge_distance=edge_distance, vocabulary=words,
            progress=lambda step, n: progress.update(task, description=f"{step} {n:,} elements"),
        )  # fmt: skip
    seconds = perf_counter() - start
    size = out.stat().st_size
    summary = {**facts(city), "bytes": size, "seconds": round(seconds, 3)}
    if as_json:
        typer.echo(json.dumps(summary))
    elif not quiet:
        typer.echo(
            f"{out}: {len(city.objects):,} objects in {len(city.cells):,} cells, "
            f"{size / 1e3:,.0f} kB ({size / max(1, len(city.cells)):.0f} bytes a cell), "
            f"built in {seconds:.1f} s."
        )
        if city.left_out:
            typer.echo(
                "Left out: " + ", ".join(f"{n:,} {why}" for why, n in city.left_out.items()) + "."
            )


@app.command("locate")
def locate(
    map_file: MapFile,
    text: Annotated[
        str, typer.Argument(help="What stands around you, in words; - reads standard input.")
    ],
    top: Annotated[int, typer.Option(help="How many places at most.")] = 5,
    near: Annotated[
        str | None, typer.Option(help="LON,LAT you are known to be near, with --radius.")
    ] = None,
    radius: Annotated[
        float, typer.Option(help="Radius of --near [m]: half of the prior lies within.")
    ] = 1000.0,
    heading_deg: Annotated[
        float | None,
        typer.Option(help="Where you look, clockwise from north: gives 'left of me' a meaning."),
    ] = None,
    listener: Annotated[
        str | None, typer.Option(help="LON,LAT of 'you' in the text, where that is known.")
    ] = None,
    matcher: Matcher = "relational",
    candidates_by: CandidatesBy = "auto",
    store: Store = None,
    weights: Weights = None,
    ask: Annotated[bool, typer.Option("--ask", help="Ask back until the place is clear.")] = False,
    as_json: AsJson = False,
    html: Annotated[
        Path | None, typer.Option(help="Write a page that opens without a network.")
    ] = None,
    png: Annotated[Path | None, typer.Option(help="Write a picture.")] = None,
) -> None:
    """Find the place that a description was spoken at.

    Example: placegraph city locate monaco.city "A bakery is north of me. The church is east of the bakery."
    """
    from math import radians

    from placegraph.outdoor.city import CityMap

    city = CityMap.open(map_file)
    text = sys.stdin.read() if text == "-" else text
    answers: list[Answer] = []
    with matching(city, matcher, candidates_by, store, weights) as how:

        def estimated() -> CityEstimate:
            return city.locate(
                text,
                top=top,
                near=_lonlat(near, "--near"),
                radius=radius,
                heading=None if heading_deg is None else radians(heading_deg),
                listener=_lonlat(listener, "--listener"),
                answers=answers,
                **how,
            )

        estimate = estimated()
        while ask and estimate.status.name == "AMBIGUOUS" and len(answers) < 20:
            question = estimate.next_question(city)
            answer = None if question is None else _prompt(question)
            if answer is None:
                break
            answers.append(answer)
            estimate = estimated()
    question = estimate.next_question(city) if estimate.status.name == "AMBIGUOUS" else None
    if html is not None:
        from placegraph.view import write_page

        write_page(
            city, estimate, html, title=text[:80], question=question.text if question else None
        )
    if png is not None:
        from placegraph.view import write_picture

        write_picture(city, estimate, png)
    if as_json:
        told = estimate.to_dict() | {"question": question.text if question else None}
        typer.echo(json.dumps(told, ensure_ascii=False))
    else:
        _show(estimate, question)


def _prompt(question: Question) -> Answer | None:
    """Ask on stderr, stdout is for the estimate; None where nobody answers any more."""
    options = " / ".join((*question.options, "don't know"))
    while True:
        try:
            return question.answer(typer.prompt(f"{question.text} [{options}]", err=True))
        except OptionError as error:
            typer.echo(str(error), err=True)
        except typer.Abort:
            typer.echo(err=True)
            return None


def _lonlat(value: str | None, option: str) -> tuple[float, float] | None:
    if value is None:
        return None
    try:
        longitude, latitude = (float(part) for part in value.split(","))
    except ValueError as error:
        raise OptionError(
            f"{option} is {value!r}; give longitude and latitude as 7.42,43.73."
        ) from error
    return longitude, latitude


def _show(estimate: CityEstimate, question: Question | None) -> None:
    console = Console(soft_wrap=True, highlight=False, markup=False, emoji=False)
    console.print(f"{estimate.status.name}: {estimate.reason}")
    for rank, mode in enumerate(estimate.modes, 1):
        sigma = max(mode.covariance[0, 0], mode.covariance[1, 1]) ** 0.5
        console.print(
            f"{rank}. {mode.latitude:.5f}, {mode.longitude:.5f}  {mode.probability:6.1%}  "
            f"±{sigma:.0f} m  cell {mode.cell}"
        )
    if estimate.evidence:
        table = Table("", "statement", "nat", "served by", box=None, pad_edge=False)
        for e in estimate.evidence:
            things = ", ".join(f"{o.name or o.label} ({o.id})" for o in e.objects)
            sign = {"for": "+", "against": "-"}.get(e.verdict, " ")
            table.add_row(
                sign, e.statement, f"{e.weight:+.1f}", "; ".join(x for x in (things, e.note) if x)
            )
        console.print(table)
    if estimate.understood and estimate.understood.ignored:
        ignored = "; ".join(f"“{i.text.strip()}” ({i.reason})" for i in estimate.understood.ignored)
        console.print(f"Ignored: {ignored}")
    if question is not None:
        console.print(f"To be sure: {question.text}  (run again with --ask to answer)")


@app.command("info")
def info(
    map_file: MapFile,
    as_json: AsJson = False,
    png: Annotated[Path | None, typer.Option(help="Write an overview picture.")] = None,
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
        typer.echo(json.dumps(told, ensure_ascii=False))
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


@app.command("check")
def check(map_file: MapFile, as_json: AsJson = False) -> None:
    """Check a city map; each finding comes with a mend.

    Checksums, columns, and what may surprise.

    Example: placegraph city check monaco.city
    """
    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.map.check import findings

    found = findings(CityMap.open(map_file))
    if as_json:
        typer.echo(json.dumps(found, ensure_ascii=False))
    else:
        typer.echo("\n".join(f"- {line}" for line in found) if found else f"{map_file} is sound.")


@app.command("fetch")
def fetch(
    place: Annotated[str, typer.Argument(help="Name of a place, such as 'Vaduz, Liechtenstein'.")],
    out: Annotated[
        Path, typer.Option("--out", "-o", help="OpenStreetMap file to write: .osm or .osm.pbf.")
    ],
    overpass_url: Annotated[
        str | None, typer.Option(help="Another Overpass server than OSMnx's own.")
    ] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Download a place's OpenStreetMap data.

    From Overpass, by OSMnx (extra `osmnx`).

    Example: placegraph city fetch "Vaduz, Liechtenstein" -o vaduz.osm
    """
    from dataclasses import asdict

    from placegraph.formats.place.overpass import fetch_osm
    from placegraph.outdoor.map.extract import keys_read

    with progress_bar(hidden=quiet or as_json) as progress:
        task = progress.add_task("finding")
        summary = fetch_osm(
            place,
            out,
            keys=keys_read(),
            overpass_url=overpass_url,
            progress=lambda step, n: progress.update(task, description=f"{step} {n:,}"),
        )
    if as_json:
        typer.echo(json.dumps(asdict(summary), ensure_ascii=False))
    elif not quiet:
        typer.echo(str(summary))


# after its own commands: --help lists them in this order
walks.register(app)
stores.register(app)
add_extensions(app, "city")
