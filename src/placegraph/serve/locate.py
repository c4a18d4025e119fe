"""Sentences: what `POST /v1/locate` and `WS /v1/live` answer."""

from __future__ import annotations

from contextlib import suppress
from math import radians
from typing import TYPE_CHECKING, Any

from placegraph.errors import DescriptionError, OptionError, PlacegraphError

if TYPE_CHECKING:
    from placegraph.estimate import CityEstimate
    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.search.ask import Answer, Question
    from placegraph.serve.options import ServeOptions
    from placegraph.serve.places import Places


def warm(places: Places, options: ServeOptions, _asked: None) -> dict[str, Any]:
    """Open the cities and ask the first, so that the first who asks waits for neither."""
    names = [entry.name for entry in places.entries() if entry.kind == "city"]
    with suppress(PlacegraphError):  # it is told to who asks for that map
        for name in names:
            places.open(name)
        if names:
            asked = {"text": "A bakery is north of me. A church is east of me.", "map": names[0]}
            locate(places, options, asked)
    return {}


def locate(places: Places, options: ServeOptions, asked: dict[str, Any]) -> dict[str, Any]:
    """Where something was said; `asked` has the fields of `schema.Locate`."""
    text = asked["text"]
    if len(text) > options.text:
        raise DescriptionError(f"text: {len(text)} characters; say it in at most {options.text}.")
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
    """Where in all maps something was said, or in one scene."""
    heading = asked.get("heading_deg")
    estimate = places.world().locate(
        asked["text"],
        near=asked.get("near"),
        radius=asked.get("radius") or 1000.0,
        heading=None if heading is None else radians(heading),
    )
    return answered(name, estimate, None)


def answered(name: str | None, estimate: Any, question: Question | None) -> dict[str, Any]:  # noqa: ANN401
    """The body of an answer."""
    return {
        "map": name,
        "estimate": estimate.to_dict(),
        "question": None if question is None else told(question),
        "geojson": estimate.geojson() if hasattr(estimate, "geojson") else features(estimate),
    }


def features(estimate: Any) -> dict[str, Any]:  # noqa: ANN401
    """Modes as GeoJSON."""
    points = [
        {
            "type": "Feature",
            "geometry": {"type": "Point", "coordinates": [mode.longitude, mode.latitude]},
            "properties": {"kind": "mode", "rank": rank, "probability": mode.probability},
        }
        for rank, mode in enumerate(estimate.modes, 1)
        if hasattr(mode, "longitude")
    ]
    return {"type": "FeatureCollection", "features": points}


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
