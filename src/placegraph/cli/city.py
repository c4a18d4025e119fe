"""Commands `placegraph city ...`."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from placegraph.cli.command import Argument, Fields, Option
from placegraph.cli.common import (
    AsJson,
    Quiet,
    console,
    evidence_cells,
    numbers_of,
    print_remainder,
    progress_of,
    show_facts,
    table,
)
from placegraph.core.options import in_radians
from placegraph.core.plugins import load_module
from placegraph.errors import DescriptionError, OptionError
from placegraph.outdoor.options import JUDGED, KNOWN, CellOptions, LocateOptions, RankingOptions

if TYPE_CHECKING:
    from placegraph.core.estimate import CityEstimate
    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.network.network import EncodedCity
    from placegraph.outdoor.search.ask import Answer, Question

WRITTEN = "Output"

MapFile = Annotated[Path, Argument(help="City map (.city), made by `placegraph city build`.")]
Near = Annotated[
    str | None, Option(help="Prior position LON,LAT (longitude first); see --radius.", panel=KNOWN)
]
Preset = Annotated[
    str,
    Option(
        help="default; paper (GOTLoc as printed: graphs of labels and four directions, embeddings "
        "propose 10 cells, cross attention ranks them by cosine); or published (embeddings alone, as "
        "in the paper's code). The options below override it.",
        panel=JUDGED,
    ),
]
Store = Annotated[
    str | None,
    Option(
        help="Vectors made by `placegraph city embed`: a file, or a Milvus server: "
        "http://[user:password@]host:port.",
        panel=JUDGED,
    ),
]
Weights = Annotated[
    Path | None,
    Option(
        help="Network weights from `placegraph city train`, or printed: those of the paper's network; "
        "the shipped ones if not given.",
        panel=JUDGED,
    ),
]


@contextmanager
def matching(
    city: CityMap, store: str | None, weights: Path | None, arguments: dict[str, Any]
) -> Iterator[dict[str, Any]]:
    """Add the store and the network to arguments of `CityMap.locate`; close the store at the end.

    Raises `StoreError` where the store is of another map or of other weights.
    """
    from placegraph.outdoor.search.request import Matching

    named = {"matcher": arguments["matcher"]} if "matcher" in arguments else {}
    preset = arguments.get("preset", "default")
    printed = weights is None and Matching.preset(preset, **named).printed
    encoded = encode(city, Path(PRINTED) if printed else weights)
    if encoded is not None:
        arguments["encoded"] = encoded
    if store is None:
        yield arguments
        return
    from placegraph.vectors import open_store

    with open_store(store, origin=(encoded or city.encoded).origin) as opened:
        yield arguments | {"store": opened}


PRINTED = "printed"
"""Weights of the network that the paper prints, which come with placegraph."""


def encode(city: CityMap, weights: Path | None) -> EncodedCity | None:
    """Encode a city by the network of a weights file; None where none is given."""
    if weights is None:
        return None
    if str(weights) == PRINTED:
        return city.encoded_as_printed
    from placegraph.outdoor.network.network import EncodedCity, GraphTransformer

    return EncodedCity(city, GraphTransformer.open(weights))


def lonlat(value: str | None, option: str) -> tuple[float, float] | None:
    """Longitude and latitude of an option's text [deg]; raises `OptionError` where it is none."""
    if value is None:
        return None
    mend = "give longitude and latitude, such as 7.42,43.73."
    longitude, latitude = numbers_of(value, option, {2}, mend)
    return longitude, latitude


def location_prior(near: str | None, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return `near` and the options of a prior as arguments of `locate`, with angles in radians.

    Raises `OptionError` if `near` is not a longitude and latitude, or a radius is given without it.
    """
    if near is None and "radius" in options:
        raise OptionError("--radius applies only to --near; give both, or remove --radius.")
    return in_radians(options) | {"near": lonlat(near, "--near")}


VocabularyFolder = Annotated[Path | None, Option(help="Folder with edited vocabulary tables.")]
OVERTURE = "Overture options"
EDGES = "give west,south,east,north in degrees, such as 7.41,43.72,7.44,43.75."


def build(
    file: Annotated[
        list[str],
        Argument(
            help="OpenStreetMap extract or its URL (.osm.pbf, .osm, .osm.gz or .osm.bz2), or "
            "Overture GeoParquet files, folders or URLs."
        ),
    ],
    out: Annotated[
        str,
        Option(
            "--out",
            "-o",
            help="Map file to write, such as monaco.city. An extract above 64 MB becomes a world "
            "in shards (a folder), as by `world build`.",
        ),
    ],
    cells: Annotated[dict[str, Any], Fields(CellOptions)],
    bbox: Annotated[
        str | None,
        Option(
            help="West,south,east,north [deg]: read only objects that touch this box.",
            panel=OVERTURE,
        ),
    ] = None,
    confidence: Annotated[
        float, Option(help="Minimum existence confidence of an Overture place.", panel=OVERTURE)
    ] = 0.5,
    vocabulary: VocabularyFolder = None,
    no_index: Annotated[
        bool,
        Option(
            "--no-index",
            help="Write no search index: the file is smaller, but the first query after opening "
            "it is slow.",
        ),
    ] = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Build a city map from an OpenStreetMap extract, or from Overture.

    Example: placegraph city build monaco.osm.pbf -o monaco.city
    """
    from time import perf_counter

    from placegraph.io.osm.urls import is_large, is_url
    from placegraph.outdoor.city import build_city
    from placegraph.outdoor.language.vocabulary import Vocabulary

    if is_url(out):
        raise OptionError(
            f"{out} is a URL, but a single map can only be written to a local file. To "
            f"write a world in shards to the URL: placegraph world build {file[0]} -o {out} "
            "--work FOLDER"
        )
    source = _source(file, bbox, confidence)
    if isinstance(source, str) and is_large(source):
        if no_index:
            raise OptionError(
                "--no-index applies only to a single map, but this extract is large and "
                "becomes a world in shards; remove it."
            )
        options = load_module("placegraph_scale.options", "scale").BuildOptions(
            **cells, vocabulary=vocabulary
        )
        run_build = load_module("placegraph_scale.cli", "scale").run_build
        run_build([source], out, options, as_json=as_json, quiet=quiet)
        return
    words = Vocabulary.load(vocabulary) if vocabulary else None
    start = perf_counter()
    with progress_of(hidden=quiet or as_json) as tell:
        tell("reading")
        city = build_city(
            source, out, **cells, vocabulary=words,
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


def _source(given: list[str], bbox: str | None, confidence: float) -> Any:  # noqa: ANN401
    """Return the path of one extract, or an `Overture` source of all that is given."""
    from placegraph.core.plugins import load_module
    from placegraph.io.osm.urls import is_osm_url

    if not any(map(is_osm_url, given)):
        overture = load_module("placegraph_io.overture", "overture")
        if all(map(overture.is_overture, given)):
            box = None if bbox is None else overture.Box.of(numbers_of(bbox, "--bbox", (4,), EDGES))
            return overture.Overture(tuple(given), box, confidence)
    if len(given) > 1:
        raise OptionError(
            f"{len(given)} files are given, but a map is built from one OpenStreetMap "
            "extract or from Overture files only. Merge extracts with `osmium merge`."
        )
    if bbox is not None:
        raise OptionError(
            "--bbox applies only to Overture files; clip an OpenStreetMap extract with `osmium "
            "extract`."
        )
    return given[0]


def fetch(
    place: Annotated[str, Argument(help="Name of a place, such as 'Vaduz, Liechtenstein'.")],
    out: Annotated[
        Path, Option("--out", "-o", help="OpenStreetMap file to write: .osm or .osm.pbf.")
    ],
    overpass_url: Annotated[
        str | None, Option(help="URL of an Overpass server. [default: that of OSMnx]")
    ] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Download a place's OpenStreetMap data.

    Asks Overpass through OSMnx (extra `osmnx`).

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


def info(
    map_file: MapFile,
    as_json: AsJson = False,
    png: Annotated[Path | None, Option(help="Write an overview picture.")] = None,
) -> None:
    """Show the contents of a city map.

    Example: placegraph city info monaco.city
    """
    from placegraph.outdoor.city import CityMap

    city = CityMap.open(map_file)
    result = {**facts(city), "bytes": map_file.stat().st_size}
    if png is not None:
        from placegraph.view import draw_city

        draw_city(city, png)
    if as_json:
        click.echo(json.dumps(result, ensure_ascii=False))
        return
    show_facts(result)


def facts(city: CityMap) -> dict[str, object]:
    """Summarize a city map in plain numbers and strings."""
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
    """Check a city map; print each finding with its remedy.

    Checks checksums and columns, and reports surprises.

    Example: placegraph city check monaco.city
    """
    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.map.city import find_oddities

    found = find_oddities(CityMap.open(map_file))
    if as_json:
        click.echo(json.dumps(found, ensure_ascii=False))
    else:
        click.echo("\n".join(f"- {line}" for line in found) if found else f"{map_file} is sound.")


def locate(
    map_file: MapFile,
    text: Annotated[
        str, Argument(help="Description of your surroundings; - reads standard input.")
    ],
    prior: Annotated[dict[str, Any], Fields(LocateOptions)],
    ranking: Annotated[dict[str, Any], Fields(RankingOptions)],
    near: Near = None,
    listener: Annotated[
        str | None,
        Option(help="LON,LAT of the listener ('you' in the text), if known.", panel=KNOWN),
    ] = None,
    language: Annotated[
        str | None,
        Option(help="Language code of the text, such as de; detected if not given.", panel=KNOWN),
    ] = None,
    preset: Preset = "default",
    store: Store = None,
    weights: Weights = None,
    ask: Annotated[
        bool, Option("--ask", help="Ask questions until the place is unambiguous.")
    ] = False,
    as_json: AsJson = False,
    html: Annotated[
        Path | None, Option(help="Write a page that works offline.", panel=WRITTEN)
    ] = None,
    png: Annotated[Path | None, Option(help="Write a picture.", panel=WRITTEN)] = None,
) -> None:
    """Find the place that a text describes.

    Example: placegraph city locate monaco.city "A bakery is north of me. The church is east of the bakery."
    """
    from placegraph.outdoor.city import CityMap

    city = CityMap.open(map_file)
    text = sys.stdin.read() if text == "-" else text
    answers: list[Answer] = []
    ranking |= {"language": language, "preset": preset} | location_prior(near, prior)
    with matching(city, store, weights, ranking) as how:

        def estimated() -> CityEstimate:
            return city.locate(
                text,
                listener=lonlat(listener, "--listener"),
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
        result = estimate.to_dict() | {"question": question.text if question else None}
        click.echo(json.dumps(result, ensure_ascii=False))
    else:
        _show(estimate, question)


def _prompt(question: Question) -> Answer | None:
    """Ask on stderr, stdout is for the estimate; None where nobody answers any more."""
    options = " / ".join(question.choices)
    while True:
        try:
            return question.answer(click.prompt(f"{question.text} [{options}]", err=True))
        except OptionError as error:
            click.echo(str(error), err=True)
        except click.Abort:
            click.echo(err=True)
            return None


def _show(estimate: CityEstimate, question: Question | None) -> None:
    out = console()
    out.print(f"{estimate.status.name}: {estimate.reason}")
    for rank, mode in enumerate(estimate.modes, 1):
        share = "" if estimate.ranked else f"{mode.probability:6.1%}  "
        out.print(
            f"{rank}. {mode.latitude:.5f}, {mode.longitude:.5f}  {share}±{mode.spread:.0f} m  "
            f"cell {mode.cell}"
        )
    print_remainder(out, estimate, len(estimate.modes))
    if estimate.evidence:
        rows = table("", "statement", "log-likelihood ratio", "matched objects")
        for e in estimate.evidence:
            things = ", ".join(f"{o.name or o.label} ({o.id})" for o in e.objects)
            rows.add_row(*evidence_cells(e), "; ".join(x for x in (things, e.note) if x))
        out.print(rows)
    if estimate.understood and estimate.understood.ignored:
        ignored = "; ".join(f"“{i.text.strip()}” ({i.reason})" for i in estimate.understood.ignored)
        out.print(f"Ignored: {ignored}")
    if question is not None:
        out.print(f"Open question: {question.text} (run again with --ask to answer it)")


def embed(
    map_file: MapFile,
    out: Annotated[
        Path | None, Option("--out", "-o", help="File to write, such as monaco.vectors.")
    ] = None,
    store: Annotated[
        str | None,
        Option(help="Milvus server to load instead: http://[user:password@]host:port."),
    ] = None,
    name: Annotated[
        str | None, Option(help="Name of the store on the server; the map's name if not given.")
    ] = None,
    bits: Annotated[int, Option(help="Bits of a number in a file: 8, 16 or 32.")] = 16,
    resume: Annotated[
        bool, Option("--resume", help="Resume an interrupted load into a server.")
    ] = False,
    weights: Weights = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Compute the embeddings of a map's cells and store them in a file or on a Milvus server.

    `placegraph city locate --store` searches them. A server needs the extra `milvus`.

    Example: placegraph city embed monaco.city -o monaco.vectors
    """
    from time import perf_counter

    from placegraph.outdoor.city import CityMap

    if (out is None) == (store is None):
        raise OptionError(
            "The destination is missing; give a file with --out, or a server with --store."
        )
    if resume and out is not None:
        raise OptionError("--resume applies only to --store; remove it.")
    if store is not None:
        load_module("placegraph_scale.milvus", "scale").check_uri(store)
    city = CityMap.open(map_file)
    start = perf_counter()
    with progress_of(hidden=quiet or as_json) as tell:
        tell("embedding")
        made = (encode(city, weights) or city.encoded).save_embeddings(
            store or out or "", name=name or map_file.stem, bits=bits, resume=resume,
            progress=lambda step, done, total: tell(f"{step} {done:,} of {total:,} cells"),
        )  # fmt: skip
    seconds = perf_counter() - start
    with made:
        result = {
            "store": load_module("placegraph_scale.milvus", "scale").hide_password(store)
            if store
            else str(out),
            "cells": len(made),
            "dimension": made.dimension,
            "version": made.origin.version,
            "bytes": out.stat().st_size if out else None,
            "seconds": round(seconds, 3),
        }
    if as_json:
        click.echo(json.dumps(result))
    elif not quiet:
        size = f", {result['bytes']:,} bytes" if out else ""
        click.echo(
            f"{result['store']}: {result['cells']:,} cells, {result['dimension']} numbers each, version "
            f"{result['version']}{size}, in {seconds:.1f} s."
        )


def stores(
    uri: Annotated[str, Argument(help="Milvus server: http://[user:password@]host:port.")],
    drop: Annotated[str | None, Option(help="Remove this store, complete or not.")] = None,
    as_json: AsJson = False,
) -> None:
    """List the stores on a Milvus server, or drop one.

    Needs the extra `milvus`.

    Example: placegraph city stores http://localhost:19530
    """
    from placegraph.vectors import drop_store, list_stores

    if drop is not None:
        dropped = drop_store(uri, drop)
        click.echo(json.dumps(asdict(dropped)) if as_json else f"{dropped.collection} is dropped.")
        return
    found = list_stores(uri)
    if as_json:
        click.echo(json.dumps([asdict(info) for info in found]))
        return
    for info in found:
        state = (
            ""
            if info.complete
            else ("  (incomplete: finish it with `embed --resume`, or remove it with --drop)")
        )
        click.echo(f"{info.collection}  {info.rows:,} cells of {info.name}{state}")
    if not found:
        click.echo("The server has no placegraph stores.")


PROMPT = "> "


def track(
    map_file: MapFile,
    prior: Annotated[dict[str, Any], Fields(LocateOptions)],
    near: Near = None,
    as_json: AsJson = False,
    html: Annotated[
        Path | None, Option(help="Write a page of the last estimate that works offline.")
    ] = None,
    png: Annotated[Path | None, Option(help="Write a picture of the last estimate.")] = None,
) -> None:
    """Follow a speaker through a city; one sentence per line.

    Enter what you see or how you moved: "A bakery is north of me.", "I walked 60 m east."
    `reset` starts again; `quit`, or the end of the input, ends.

    Example: placegraph city track monaco.city
    """
    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.track.tracker import CityTracker

    city = CityMap.open(map_file)
    tracker = CityTracker(city, **location_prior(near, prior))
    is_interactive = sys.stdin.isatty()
    for line in _lines(is_interactive=is_interactive):
        try:
            estimate = tracker.reset() if line.lower() == "reset" else tracker.tell(line)
        except DescriptionError as error:
            if not is_interactive:
                raise
            click.echo(str(error), err=True)  # there is another line to come
            continue
        if as_json:
            answer_line = {"said": line} | estimate.to_dict() | {"elsewhere": tracker.elsewhere}
            click.echo(json.dumps(answer_line, ensure_ascii=False))
        else:
            click.echo(_summarize(estimate))
    if html is not None:
        from placegraph.view import write_page

        write_page(city, tracker.estimate, html)
    if png is not None:
        from placegraph.view import write_picture

        write_picture(city, tracker.estimate, png)


def _lines(*, is_interactive: bool) -> Iterator[str]:
    """Lines of the input that say something, up to its end or "quit"."""
    while True:
        if is_interactive:
            click.echo(PROMPT, nl=False, err=True)
        line = sys.stdin.readline()
        if not line or line.strip().lower() in ("quit", "exit"):
            return
        if line.strip():
            yield line.strip()


def _summarize(estimate: CityEstimate) -> str:
    """One line: status, the best place and its probability, or why there is none."""
    best = estimate.best
    if best is None:
        return f"{estimate.status.name}: {estimate.reason}"
    return (
        f"{estimate.status.name:9} {best.latitude:.5f}, {best.longitude:.5f} "
        f"{best.probability:6.1%}  ±{best.spread:.0f} m  {estimate.reason}"
    )
