"""The demo: a town that ships with placegraph, and three sentences said in it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from placegraph.synthetic.towns import Town

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

TOWN = "hafenstadt"
SENTENCES = {
    "clear": "I'm on Lange Straße. A bakery is north of me, a tram stop is south of me, "
    "and the church is to the southeast.",
    "ambiguous": "I am standing on a square. There is a fountain north of me and a café to my east.",
    "impossible": "A lighthouse is north of me and a zoo is to the south.",
}


def run_demo(out: Path, say: Callable[[str], None]) -> None:
    """Build the town, locate the sentences, and leave pages and pictures in `out`."""
    from placegraph.outdoor.build import build_city
    from placegraph.view import draw_city, write_page, write_picture

    osm = Town.load(TOWN).write_osm(out / f"{TOWN}.osm")
    city = build_city(osm, out / f"{TOWN}.city")
    draw_city(city, out / f"{TOWN}.png")
    say(f"Built {city} from a town drawn in ASCII.")
    for name, text in SENTENCES.items():
        estimate = city.locate(text)
        question = estimate.next_question(city) if estimate.status.name == "AMBIGUOUS" else None
        write_page(
            city,
            estimate,
            out / f"{name}.html",
            title=text,
            question=question.text if question else None,
        )
        write_picture(city, estimate, out / f"{name}.png")
        say(f"\n“{text}”\n{estimate.status.name}: {estimate.reason}")
        for mode in estimate.modes[:3]:
            say(f"  {mode.latitude:.5f}, {mode.longitude:.5f}  {mode.probability:.0%}")
        for e in estimate.evidence:
            things = ", ".join(o.name or o.label for o in e.objects)
            say(f"    {e.verdict:7} {e.statement}  [{things or e.note}]")
        if question:
            say(f"  To be sure: {question.text}")
    say(f"\nLook at {out}/clear.html, {out}/ambiguous.html and the pictures beside them.")
