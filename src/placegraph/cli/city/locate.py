"""`placegraph city locate`: a description finds the place that it was spoken at."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from placegraph.cli.city.options import (
    KNOWN,
    WRITTEN,
    Candidates,
    CandidatesBy,
    MapFile,
    Matcher,
    Near,
    Preset,
    Radius,
    Score,
    Store,
    Top,
    Weights,
    lonlat,
    matching,
)
from placegraph.cli.command import Argument, Option
from placegraph.cli.common import AsJson, console, table
from placegraph.errors import OptionError

if TYPE_CHECKING:
    from placegraph.core.estimate import CityEstimate
    from placegraph.outdoor.search.ask import Answer, Question


def locate(
    map_file: MapFile,
    text: Annotated[
        str, Argument(help="What stands around you, in words; - reads standard input.")
    ],
    top: Top = 5,
    near: Near = None,
    radius: Radius = 1000.0,
    heading_deg: Annotated[
        float | None,
        Option(
            help="Where you look, clockwise from north: gives 'left of me' a meaning.", panel=KNOWN
        ),
    ] = None,
    listener: Annotated[
        str | None, Option(help="LON,LAT of 'you' in the text, where that is known.", panel=KNOWN)
    ] = None,
    language: Annotated[
        str | None,
        Option(
            help="Language of the text, as de; told from its words if nothing is said.", panel=KNOWN
        ),
    ] = None,
    preset: Preset = "default",
    matcher: Matcher = None,
    score: Score = None,
    candidates_by: CandidatesBy = None,
    candidates: Candidates = None,
    store: Store = None,
    weights: Weights = None,
    ask: Annotated[bool, Option("--ask", help="Ask back until the place is clear.")] = False,
    as_json: AsJson = False,
    html: Annotated[
        Path | None, Option(help="Write a page that opens without a network.", panel=WRITTEN)
    ] = None,
    png: Annotated[Path | None, Option(help="Write a picture.", panel=WRITTEN)] = None,
) -> None:
    """Find the place that a description was spoken at.

    Example: placegraph city locate monaco.city "A bakery is north of me. The church is east of the bakery."
    """
    from math import radians

    from placegraph.outdoor.city import CityMap

    city = CityMap.open(map_file)
    text = sys.stdin.read() if text == "-" else text
    answers: list[Answer] = []
    how_judged = {"language": language, "preset": preset, "matcher": matcher, "score": score}
    how_found = {"by": candidates_by, "candidates": candidates}
    with matching(city, store, weights, **how_judged, **how_found) as how:

        def estimated() -> CityEstimate:
            return city.locate(
                text,
                top=top,
                near=lonlat(near, "--near"),
                radius=radius,
                heading=None if heading_deg is None else radians(heading_deg),
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
        told = estimate.to_dict() | {"question": question.text if question else None}
        click.echo(json.dumps(told, ensure_ascii=False))
    else:
        _show(estimate, question)


def _prompt(question: Question) -> Answer | None:
    """Ask on stderr, stdout is for the estimate; None where nobody answers any more."""
    options = " / ".join((*question.options, "don't know"))
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
    if estimate.evidence:
        rows = table("", "statement", "nat", "served by")
        for e in estimate.evidence:
            things = ", ".join(f"{o.name or o.label} ({o.id})" for o in e.objects)
            sign = {"for": "+", "against": "-"}.get(e.verdict, " ")
            rows.add_row(
                sign, e.statement, f"{e.weight:+.1f}", "; ".join(x for x in (things, e.note) if x)
            )
        out.print(rows)
    if estimate.understood and estimate.understood.ignored:
        ignored = "; ".join(f"“{i.text.strip()}” ({i.reason})" for i in estimate.understood.ignored)
        out.print(f"Ignored: {ignored}")
    if question is not None:
        out.print(f"To be sure: {question.text}  (run again with --ask to answer)")
