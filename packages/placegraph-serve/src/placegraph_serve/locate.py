"""Locating sentences, and the questions to ask back."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from placegraph.core.estimate import CityEstimate
from placegraph.core.options import in_radians
from placegraph.errors import DescriptionError, GeoPoseError, OptionError, PlacegraphError
from placegraph_serve.photon import name_places

if TYPE_CHECKING:
    from placegraph.outdoor.search.ask import Answer, Question
    from placegraph.world.estimate import WorldEstimate
    from placegraph_serve.places import Dispatcher


def warm(dispatcher: Dispatcher, _request: None) -> dict[str, Any]:
    """Open all maps and ask something, so that the first who asks waits for neither."""
    places = dispatcher.places
    names = [entry.name for entry in places.entries() if entry.kind == "city"]
    said = {"text": "A bakery is north of me. A church is east of me. I am in the kitchen."}
    with suppress(PlacegraphError):  # it is told to who asks for that map
        for name in names:
            places.open(name)
        if names:
            locate(dispatcher, said | {"map": names[0]})
        if places.only is None:  # the world's scenes are compared with each other once
            locate(dispatcher, said)
    return {}


def locate(dispatcher: Dispatcher, request: dict[str, Any]) -> dict[str, Any]:
    """Locate a sentence; `request` has the fields of `requests.Locate`."""
    name, estimate, question = find(dispatcher, request)
    answer = describe_answer(name, estimate, question) | {"geojson": on_earth(estimate.geojson)}
    return name_places(dispatcher, answer)


def live(dispatcher: Dispatcher, request: dict[str, Any]) -> dict[str, Any]:
    """Locate a sentence while it is typed: as `locate`, without GeoJSON, and with a coarser posterior."""
    answer = name_places(dispatcher, describe_answer(*find(dispatcher, request)))
    if "support" in answer:
        answer["support"] = [
            [round(x, 5), round(y, 5), float(f"{p:.2g}")] for x, y, p in answer["support"]
        ]
    return answer


def find(
    dispatcher: Dispatcher, request: dict[str, Any]
) -> tuple[str | None, Any, Question | None]:
    """Return the name of the map that was asked (None: all), the estimate, and the question to ask back."""
    text = request["text"]
    most, places = dispatcher.options.text, dispatcher.places
    if len(text) > most:
        raise DescriptionError(f"text: {len(text)} characters; send at most {most}.")
    name = request.get("map") or places.only
    kind = "world" if name is None else places.entry(name).kind
    if kind == "library" and name is not None:
        found_in: Any = places.open(name)
        return name, found_in.search(text, most=request.get("top") or 5), None
    asked: Any = places.city(name) if kind == "city" and name is not None else places.world(name)
    estimate = asked.locate(text, answers=answers_in(request), **options_in(request))
    return name, estimate, estimate.next_question(asked)


def options_in(request: dict[str, Any]) -> dict[str, Any]:
    """Return arguments of `locate` in a body; those that are null or missing take their defaults."""
    names = ("top", "near", "radius", "heading_deg", "language")
    return in_radians({name: request.get(name) for name in names})


def describe_answer(name: str | None, estimate: Any, question: Question | None) -> dict[str, Any]:  # noqa: ANN401
    """The body of an answer."""
    from placegraph.view.city.page import page_estimate as as_drawn
    from placegraph.world.estimate import WorldEstimate

    of_city = isinstance(estimate, CityEstimate)
    return {
        "map": name,
        **(as_drawn(estimate) if of_city else {"estimate": estimate.to_dict()}),
        **({"support": support_points(estimate)} if isinstance(estimate, WorldEstimate) else {}),
        "question": None if question is None else describe_question(question),
    }


def support_points(estimate: WorldEstimate) -> list[list[float]]:
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
    """Return an estimate as GeoJSON or GeoPose; None if its map is not anchored."""
    try:
        return tell()
    except GeoPoseError:
        return None


def describe_question(question: Question) -> dict[str, Any]:
    """A question as JSON, which a client sends back with its answer."""
    things = [{"words": t.words, "label": t.label, "wind": t.wind} for t in question.subjects]
    return {
        "text": question.text,
        "options": list(question.choices),
        "things": things,
        "gain": question.gain,
    }


def answers_in(request: dict[str, Any]) -> list[Answer]:
    """Return the answers in a body to earlier questions."""
    return [read_answer(answer) for answer in request.get("answers") or ()]


def read_answer(answer: dict[str, Any]) -> Answer:
    """An answer ``{"question": ..., "option": ...}`` that a client sends back."""
    from placegraph.outdoor.language.languages import read_options
    from placegraph.outdoor.search.ask import COMPASS, NONE, UNKNOWN, Question, Subject

    request = answer["question"]
    things = tuple(Subject(t["words"], t["label"], t["wind"]) for t in request["things"])
    options = tuple(read_options().get(option, option) for option in request["options"])
    options = tuple(option for option in options if option != UNKNOWN)
    known = len(things) == 1 or options == (*(t.words for t in things), NONE)
    if not things or not known or any(t.wind and t.wind not in COMPASS for t in things):
        raise OptionError("answers: a question was changed; send it back as it was asked.")
    return Question(request["text"], options, things, 0.0).answer(
        read_options().get(answer["option"], answer["option"])
    )
