"""Sentences: what `POST /v1/locate` and `WS /v1/live` answer."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from math import radians
from typing import TYPE_CHECKING, Any

from placegraph.core.estimate import CityEstimate
from placegraph.errors import DescriptionError, GeoPoseError, OptionError, PlacegraphError

if TYPE_CHECKING:
    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.search.ask import Answer, Question
    from placegraph.world.estimate import WorldEstimate
    from placegraph_serve.places import Desk, Places


def warm(desk: Desk, _asked: None) -> dict[str, Any]:
    """Open all maps and ask something, so that the first who asks waits for neither."""
    places = desk.places
    names = [entry.name for entry in places.entries() if entry.kind == "city"]
    said = {"text": "A bakery is north of me. A church is east of me. I am in the kitchen."}
    with suppress(PlacegraphError):  # it is told to who asks for that map
        for name in names:
            places.open(name)
        if names:
            locate(desk, said | {"map": names[0]})
        if places.only is None:  # the world's scenes are compared with each other once
            locate(desk, said)
    return {}


def locate(desk: Desk, asked: dict[str, Any]) -> dict[str, Any]:
    """Where something was said; `asked` has the fields of `schema.Locate`."""
    text = asked["text"]
    most, places = desk.options.text, desk.places
    if len(text) > most:
        raise DescriptionError(f"text: {len(text)} characters; say it in at most {most}.")
    name = asked.get("map") or places.only
    if name is not None and places.entry(name).kind == "city":
        return in_city(places.city(name), name, asked)
    if name is not None and places.entry(name).kind == "library":
        found = places.open(name).search(text, most=asked.get("top") or 5)  # type: ignore[union-attr]
        return answered(name, found, None)
    return in_world(places, name, asked)


def in_city(city: CityMap, name: str, asked: dict[str, Any]) -> dict[str, Any]:
    """Where in a city something was said, and what to ask back."""
    heading = asked.get("heading_deg")
    estimate: CityEstimate = city.locate(
        asked["text"],
        top=asked.get("top") or 5,
        near=asked.get("near"),
        radius=asked.get("radius") or 1000.0,
        heading=None if heading is None else radians(heading),
        answers=[given(answer) for answer in asked.get("answers") or ()],
        language=asked.get("language"),
    )
    return answered(name, estimate, estimate.next_question(city))


def in_world(places: Places, name: str | None, asked: dict[str, Any]) -> dict[str, Any]:
    """Where in all maps something was said, or in one scene alone."""
    heading = asked.get("heading_deg")
    world = places.world(name)
    estimate = world.locate(
        asked["text"],
        near=asked.get("near"),
        radius=asked.get("radius") or 1000.0,
        heading=None if heading is None else radians(heading),
        top=asked.get("top") or 5,
        answers=[given(answer) for answer in asked.get("answers") or ()],
        language=asked.get("language"),
    )
    return answered(name, estimate, estimate.next_question(world))


def answered(name: str | None, estimate: Any, question: Question | None) -> dict[str, Any]:  # noqa: ANN401
    """The body of an answer."""
    from placegraph.core.estimate import CityEstimate
    from placegraph.view.city.page import told as as_drawn
    from placegraph.world.estimate import WorldEstimate

    of_city = isinstance(estimate, CityEstimate)
    return {
        "map": name,
        **(as_drawn(estimate) if of_city else {"estimate": estimate.to_dict()}),
        **({"support": heat(estimate)} if isinstance(estimate, WorldEstimate) else {}),
        "question": None if question is None else told(question),
        "geojson": on_earth(estimate.geojson),
    }


def heat(estimate: WorldEstimate) -> list[list[float]]:
    """Longitude, latitude [deg], probability: heaviest points of the towns, each by its town's share."""
    points = []
    for city in estimate.cities.values():
        of_city = (m for m in estimate.modes if m.place in city.modes and m.place is not None)
        best = next(of_city, None)
        if best is None or best.place is None:  # the town holds next to nothing
            continue
        share = best.probability / best.place.probability if best.place.probability > 0 else 0.0
        points += [[round(x, 6), round(y, 6), round(share * p, 6)]
                   for x, y, p in city.support.tolist()]  # fmt: skip
    return points


def on_earth(tell: Callable[[], dict[str, Any]]) -> dict[str, Any] | None:
    """What an estimate says of Earth; None where its map stands nowhere on it."""
    try:
        return tell()
    except GeoPoseError:
        return None


def told(question: Question) -> dict[str, Any]:
    """A question as JSON, which a client sends back with its answer."""
    things = [{"words": t.words, "label": t.label, "wind": t.wind} for t in question.things]
    return {
        "text": question.text,
        "options": list(question.options),
        "things": things,
        "gain": question.gain,
    }


def given(answer: dict[str, Any]) -> Answer:
    """An answer ``{"question": ..., "option": ...}`` that a client sends back."""
    from placegraph.outdoor.search.ask import NONE, WINDS, Question, Thing

    asked = answer["question"]
    things = tuple(Thing(t["words"], t["label"], t["wind"]) for t in asked["things"])
    options = tuple(asked["options"])
    known = len(things) == 1 or options == (*(t.words for t in things), NONE)
    if not things or not known or any(t.wind and t.wind not in WINDS for t in things):
        raise OptionError("answers: a question is not as it was asked; send it back unchanged.")
    return Question(asked["text"], options, things, 0.0).answer(answer["option"])
