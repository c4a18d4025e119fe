"""Locating sentences, and search of names as Photon answers."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.core.estimate import CityEstimate
from placegraph.core.options import in_radians
from placegraph.errors import (
    DescriptionError,
    GeoPoseError,
    OptionError,
    PlacegraphError,
    RequestError,
)
from placegraph.outdoor.language.words import tokens

if TYPE_CHECKING:
    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.search.ask import Answer, Question
    from placegraph.world.estimate import WorldEstimate
    from placegraph_serve.places import Dispatcher, Places


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
    text = request["text"]
    most, places = dispatcher.options.text, dispatcher.places
    if len(text) > most:
        raise DescriptionError(f"text: {len(text)} characters; send at most {most}.")
    name = request.get("map") or places.only
    if name is not None and places.entry(name).kind == "city":
        return in_city(places.city(name), name, request)
    if name is not None and places.entry(name).kind == "library":
        found = places.open(name).search(text, most=request.get("top") or 5)  # type: ignore[union-attr]
        return describe_answer(name, found, None)
    return in_world(places, name, request)


def in_city(city: CityMap, name: str, request: dict[str, Any]) -> dict[str, Any]:
    """Locate a sentence in a city, and return the question to ask back."""
    estimate: CityEstimate = city.locate(
        request["text"], answers=answers_in(request), **options_in(request)
    )
    return describe_answer(name, estimate, estimate.next_question(city))


def in_world(places: Places, name: str | None, request: dict[str, Any]) -> dict[str, Any]:
    """Locate a sentence in all maps, or in one scene alone."""
    world = places.world(name)
    estimate = world.locate(request["text"], answers=answers_in(request), **options_in(request))
    return describe_answer(name, estimate, estimate.next_question(world))


def options_in(request: dict[str, Any]) -> dict[str, Any]:
    """Return arguments of `locate` in a body; those that are null or missing take their defaults."""
    names = ("top", "near", "radius", "heading_deg", "language")
    return in_radians({name: request.get(name) for name in names})


def describe_answer(name: str | None, estimate: Any, question: Question | None) -> dict[str, Any]:  # noqa: ANN401
    """The body of an answer."""
    from placegraph.core.estimate import CityEstimate
    from placegraph.view.city.page import page_estimate as as_drawn
    from placegraph.world.estimate import WorldEstimate

    of_city = isinstance(estimate, CityEstimate)
    return {
        "map": name,
        **(as_drawn(estimate) if of_city else {"estimate": estimate.to_dict()}),
        **({"support": support_points(estimate)} if isinstance(estimate, WorldEstimate) else {}),
        "question": None if question is None else describe_question(question),
        "geojson": on_earth(estimate.geojson),
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
        "options": list(question.choices[:-1]),
        "things": things,
        "gain": question.gain,
    }


def answers_in(request: dict[str, Any]) -> list[Answer]:
    """Return the answers in a body to earlier questions."""
    return [read_answer(answer) for answer in request.get("answers") or ()]


def read_answer(answer: dict[str, Any]) -> Answer:
    """An answer ``{"question": ..., "option": ...}`` that a client sends back."""
    from placegraph.outdoor.search.ask import COMPASS, NONE, Question, Subject

    request = answer["question"]
    things = tuple(Subject(t["words"], t["label"], t["wind"]) for t in request["things"])
    options = tuple(request["options"])
    known = len(things) == 1 or options == (*(t.words for t in things), NONE)
    if not things or not known or any(t.wind and t.wind not in COMPASS for t in things):
        raise OptionError("answers: a question was changed; send it back as it was asked.")
    return Question(request["text"], options, things, 0.0).answer(answer["option"])


CLOSE = 80.0
"""Similarity, of 100, from which a misspelt name is found."""
NEAR = 2000.0
"""Distance from the point that was given after which a name counts half [m]."""
_MOST = 400
"""Names looked at."""
_TYPES = {"highway": "street", "railway": "street", "waterway": "locality", "natural": "locality"}
_PLACES = {"city": "city", "town": "city", "village": "city", "suburb": "district",
           "neighbourhood": "locality", "quarter": "district"}  # fmt: skip
"""Photon's types of a place; all else is a house."""


def search(dispatcher: Dispatcher, request: dict[str, Any]) -> dict[str, Any]:
    """Features of names that begin so or nearly so, of kinds of things, or of what a sentence describes."""
    near = (
        None
        if request["lat"] is None or request["lon"] is None
        else (request["lon"], request["lat"])
    )
    found: list[tuple[float, dict[str, Any]]] = []
    cities = [e.name for e in dispatcher.places.entries() if e.kind == "city"]
    if not cities:
        raise RequestError(
            "This server has no city map; start it with one.", status=404, code="map_unknown"
        )
    for name in cities:
        city = dispatcher.places.city(name)
        found += [
            (score, feature(city, row)) for row, score in rows_of(city, request["q"], near).items()
        ]
    found.sort(key=lambda pair: -pair[0])
    features = [feature for _, feature in found[: request["limit"]]]
    if not features:
        features = [
            feature
            for name in cities
            for feature in find_described(dispatcher, name, request, near)
        ]
    return {"type": "FeatureCollection", "features": features[: request["limit"]]}


def rows_of(city: CityMap, text: str, near: tuple[float, float] | None) -> dict[int, float]:
    """Objects that a text names, or else is the kind of, and how well."""
    words = " ".join(tokens(text))
    if not words:
        return {}
    rows = _objects(city, _names(city, words), len(city.objects.labels))
    rows = rows or _objects(city, _labels(city, text), 0)
    at = None if near is None else city.plane.to_plane(near)
    scores: dict[int, float] = {}
    one_of: dict[str, int] = {}
    for row, fit in rows.items():
        score = fit
        if at is not None:
            score /= 1.0 + float(np.hypot(*(city.objects.center[row] - at))) / NEAR
        name = city.objects.name(row)
        other = one_of.get(name)
        if name and city.objects.label(row).startswith("highway=") and other is not None:
            if scores[other] >= score:  # a street is many ways
                continue
            del scores[other]
        one_of[name] = row
        scores[row] = score
    return scores


def _names(city: CityMap, words: str) -> dict[int, float]:
    """Rows of the city's names by how well they fit."""
    from rapidfuzz import fuzz, process

    known = city.name_index.by_words
    last = words.rsplit(maxsplit=1)[-1]
    fits: dict[str, float] = {}
    for name in known:
        if name.startswith(words):
            fits[name] = 1.0 if len(name) == len(words) else 0.9
        elif f" {words}" in name:
            fits[name] = 0.7
    if not fits and len(last) > 2:
        near = process.extract(words, known.keys(), scorer=fuzz.ratio, score_cutoff=CLOSE, limit=20)
        fits = {name: 0.6 * score / 100.0 for name, score, _ in near}
    best = sorted(fits, key=lambda name: (-fits[name], len(name), name))[:_MOST]
    return {row: fits[name] for name in best for row in known[name]}


def _labels(city: CityMap, text: str) -> dict[int, float]:
    """Rows of the city's labels that a word of the vocabulary means: "bakery", "Bäckerei"."""
    from placegraph.outdoor.search.request import parse

    try:
        mentions = [m for m in parse(city, text).mentions if m.senses]
    except PlacegraphError:
        return {}
    if len(mentions) != 1 or len(tokens(text)) > 3:  # a sentence is for `locate`
        return {}
    return {
        row: 0.5 * sense.weight
        for sense in mentions[0].senses
        if sense.weight >= 0.7
        for row in city.label_index.get(sense.label, ())
    }


def _objects(city: CityMap, tokens_of: dict[int, float], first: int) -> dict[int, float]:
    """Objects that bear tokens (rows counted from `first`), and the best fit of each."""
    starts, rows = city.token_objects
    found: dict[int, float] = {}
    for token, fit in tokens_of.items():
        for row in rows[starts[first + token] : starts[first + token + 1]].tolist():
            found[row] = max(fit, found.get(row, 0.0))
    return found


def find_described(
    dispatcher: Dispatcher, name: str, request: dict[str, Any], near: tuple[float, float] | None
) -> Iterable[dict[str, Any]]:
    """Places that a sentence describes, as features."""
    try:
        estimate = dispatcher.places.city(name).locate(
            request["q"], near=near, top=request["limit"]
        )
    except PlacegraphError:
        return
    for mode in estimate.modes:
        if estimate.status.name == "LOST":
            return
        properties = {
            "osm_type": "N", "osm_id": 0, "osm_key": "placegraph", "osm_value": "described",
            "type": "house", "name": request["q"], "probability": mode.probability,
        }  # fmt: skip
        yield _feature([mode.longitude, mode.latitude], properties)


def feature(city: CityMap, row: int) -> dict[str, Any]:
    """An object with Photon's properties."""
    objects = city.objects
    key, _, value = objects.label(row).partition("=")
    kind, _, number = objects.osm(row).partition("/")
    properties: dict[str, Any] = {
        "osm_type": kind[0].upper(),
        "osm_id": int(number),
        "osm_key": key,
        "osm_value": value,
        "type": _PLACES.get(value, "house") if key == "place" else _TYPES.get(key, "house"),
    }
    if name := objects.name(row):
        properties["name"] = name
    parts = objects.parts(row)
    if parts and sum(map(len, parts)) > 1:
        points = np.concatenate(parts)
        (west, south), (east, north) = city.plane.to_lonlat(
            [points.min(axis=0), points.max(axis=0)]
        ).tolist()
        properties["extent"] = [west, north, east, south]  # Photon's order
    return _feature(city.plane.to_lonlat(objects.center[row]).tolist(), properties)


def _feature(at: list[float], properties: dict[str, Any]) -> dict[str, Any]:
    geometry = {"type": "Point", "coordinates": at}
    return {"type": "Feature", "geometry": geometry, "properties": properties}
