"""Pictures (PNG) of a city, and of an estimate in it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from placegraph.core.estimate import CityEstimate, Evidence, Place, Status
from placegraph.core.geometry import Floats
from placegraph.errors import OptionError
from placegraph.view.city.city_items import (
    city_bounds,
    competing_modes,
    draw_items,
    ellipse,
    evidence_marks,
    evidence_objects,
    label_words,
    mode_bounds,
    mode_position,
    posterior_layer,
)
from placegraph.view.draw.canvas import Disc, Face, Frame, Item, Stroke, Text, choose_face
from placegraph.view.draw.lettering import OccupiedPlaces, covering_discs, place_names
from placegraph.view.draw.painter import Sheet, paint_picture

if TYPE_CHECKING:
    from placegraph.outdoor.city import CityMap

HEAD, FOOT = 64, 30
"""Height of the strips above and below the map [px]."""
MOST_PANELS = 4
SMALLEST, LARGEST = 320, 6000
"""Sides of a picture [px]."""
STATUS_COLOR = {Status.OK: "for", Status.AMBIGUOUS: "amber", Status.LOST: "soft-ink"}
CREDIT = "© OpenStreetMap contributors"


def draw_city(
    city: CityMap,
    path: str | Path,
    *,
    size: tuple[int, int] = (1200, 900),
) -> Path:
    """Draw a city as a PNG.

    Raises `OptionError`: a side is outside `SMALLEST` to `LARGEST` px.

    `size`: width and height [px].
    """
    width, height = _check_map(size)
    frame = Frame.around(city_bounds(city.objects), width, height - FOOT)
    sheet = Sheet(width, height)
    sheet.paste(paint_picture(_map(city, frame), frame, reduce=False), (0, 0))
    _furniture(sheet, frame, (0, 0))
    sheet.text((12, height - FOOT / 2), city.source, 12, "soft-ink")
    sheet.text((width - 12, height - FOOT / 2), CREDIT, 12, "soft-ink", anchor="r")
    return sheet.save(path)


def write_picture(
    city: CityMap,
    estimate: CityEstimate,
    path: str | Path,
    *,
    size: tuple[int, int] = (1200, 900),
) -> Path:
    """Draw an estimate as a PNG: the best mode's surroundings, or the rivals where it is ambiguous.

    Raises `OptionError`: a side is outside `SMALLEST` to `LARGEST` px.

    `city`: the map the estimate was made on.
    `size`: width and height [px].
    """
    width, height = _check_map(size)
    sheet = Sheet(width, height)
    ambiguous = estimate.status is Status.AMBIGUOUS
    shown: list[Place | None] = list(competing_modes(estimate, MOST_PANELS if ambiguous else 1))
    if len(shown) in (0, 3):
        shown.append(None)  # a panel for the whole city
    room = height - HEAD - FOOT
    columns = 1 if len(shown) == 1 or (len(shown) == 2 and width < room) else 2
    rows = -(-len(shown) // columns)
    for k, mode in enumerate(shown):
        left, right = (round((k % columns + side) * width / columns) for side in (0, 1))
        top, bottom = (round((k // columns + side) * room / rows) for side in (0, 1))
        right, bottom = right - 2 * (right < width), bottom - 2 * (bottom < room)
        _panel(sheet, city, estimate, mode, (left, HEAD + top, right, HEAD + bottom))
    _head(sheet, estimate, width)
    _foot(sheet, height)
    return sheet.save(path)


def _check_map(size: tuple[int, int]) -> tuple[int, int]:
    if len(size) != 2 or not all(
        isinstance(side, int) and SMALLEST <= side <= LARGEST for side in size
    ):
        raise OptionError(f"size is {size}; give width and height from {SMALLEST} to {LARGEST} px.")
    return size


def _map(
    city: CityMap,
    frame: Frame,
    occupied: OccupiedPlaces | None = None,
    skip: frozenset[int] = frozenset(),
) -> list[Item]:
    """Map and its lettering."""
    items = draw_items(city, frame.bounds, frame.scale)
    face = choose_face(city.objects.name(item.row) for item in items if item.row >= 0)
    names = place_names(
        city.objects, items, frame.scale, face, occupied or OccupiedPlaces(), skip=skip
    )
    return [*items, *names]


def _panel(
    sheet: Sheet,
    city: CityMap,
    estimate: CityEstimate,
    mode: Place | None,
    box: tuple[int, int, int, int],
) -> None:
    """Draw a mode and its surroundings, or the whole city."""
    left, top, right, bottom = box
    bounds = mode_bounds(city, mode) if mode else city_bounds(city.objects)
    if mode and mode is estimate.best and len(estimate.way):
        ends = np.concatenate([city.plane.to_plane(estimate.way), np.reshape(bounds, (2, 2))])
        bounds = (*(ends.min(axis=0) - 20.0).tolist(), *(ends.max(axis=0) + 20.0).tolist())
    frame = Frame.around(bounds, right - left, bottom - top)
    marks, occupied = _marks(city, estimate, mode, frame)
    skip = frozenset(w.row for w in evidence_objects(city, mode)) if mode else frozenset[int]()
    items = [*_map(city, frame, occupied, skip), *marks]
    if heat := posterior_layer(city, estimate, frame.bounds, 2.0 / frame.scale):
        items.insert(0, heat)  # marks are laid in order: below the lettering
    sheet.paste(paint_picture(items, frame, reduce=False), (left, top))
    _furniture(sheet, frame, (left, top))
    if mode and estimate.status is Status.AMBIGUOUS:
        number = 1 + next(k for k, other in enumerate(estimate.modes) if other is mode)
        share = "" if estimate.ranked else f"   {mode.probability:.0%}"
        sheet.label((left + 12, top + 12), f"{number}{share}", 15)
    elif mode:
        _card(sheet, mode.evidence, (left + 12, top + 12), right - left)


def _marks(
    city: CityMap, estimate: CityEstimate, mode: Place | None, frame: Frame
) -> tuple[list[Item], OccupiedPlaces]:
    """Return marks of a mode's evidence and of all modes, and the space they take."""
    occupied = OccupiedPlaces()
    way = city.plane.to_plane(estimate.way) if mode is estimate.best else None
    marks: list[Item] = [*evidence_marks(city, mode, way)] if mode else []
    pins: list[Item] = []
    for number, other in enumerate(estimate.modes, 1):
        at = mode_position(city, other)
        best = other is mode
        pins.append(Stroke(ellipse(city, other), "mode", 2.0 if best else 1.2, (6.0, 4.0)))
        pins.append(Disc(at, 12.0 if best else 9.0, "mode", text=str(number)))
        x, y = at[0] * frame.scale, -at[1] * frame.scale
        occupied.claim([(x, y, 14.0)], force=True)
    return [
        *marks,
        *pins,
        *(_evidence_names(city, mode, frame, occupied) if mode else []),
    ], occupied


def _evidence_names(
    city: CityMap, mode: Place, frame: Frame, occupied: OccupiedPlaces
) -> list[Text]:
    """Return names beside the objects of the evidence."""
    seen = evidence_objects(city, mode)
    face = choose_face(w.words for w in seen)
    for witness in seen:
        x, y = witness.at[0] * frame.scale, -witness.at[1] * frame.scale
        occupied.claim([(x, y, 5.0)], force=True)
    here = mode_position(city, mode)
    places = [w.middle if np.hypot(*(w.at - here)) < 1.0 else w.at for w in seen]
    texts = [
        _place_beside(
            at, face.drawable(w.words) or label_words(w.ref.label), w.verdict, frame, face, occupied
        )
        for w, at in zip(seen, places, strict=True)
    ]
    return [text for text in texts if text]


def _place_beside(
    at: Floats,
    words: str,
    ink: str,
    frame: Frame,
    face: Face,
    occupied: OccupiedPlaces,
) -> Text | None:
    size = 14.0
    width = face.width(words, size)
    x, _ = frame.to_px(at)
    sides = [("l", (9.0, 0.0)), ("r", (-9.0, 0.0)), ("m", (0.0, -15.0)), ("m", (0.0, 15.0))]
    if x + width + 20.0 > frame.width:
        sides = [*sides[1:], sides[0]]
    for anchor, shift in sides:
        text = Text(at, words, size, ink, anchor=anchor, shift=shift)
        if occupied.claim(covering_discs(text, width + 4.0, frame.scale)):
            return text
    return None


def _furniture(sheet: Sheet, frame: Frame, corner: tuple[int, int]) -> None:
    """Draw the scale bar and north arrow of a map with its north-west corner at a corner [px]."""
    left, bottom = corner[0] + 14, corner[1] + frame.height - 14
    metres = round_length(0.2 * frame.width / frame.scale)
    sheet.bar((left, bottom), metres * frame.scale, length_words(metres))
    sheet.north((corner[0] + frame.width - 24, corner[1] + 30))


def round_length(most: float) -> float:
    """Return the largest of 1, 2, 5, 10, 20, 50 ... up to a limit [m]."""
    power = 10.0 ** np.floor(np.log10(max(most, 1e-3)))
    return float(max(step * power for step in (1.0, 2.0, 5.0) if step * power <= most * (1 + 1e-9)))


def length_words(metres: float) -> str:
    """Format a length: ``50 m``, ``2 km``."""
    return f"{metres / 1000:g} km" if metres >= 1000 else f"{metres:g} m"


def _card(
    sheet: Sheet, evidence: tuple[Evidence, ...], corner: tuple[int, int], width: int
) -> None:
    """Draw a card of statements and their verdicts."""
    lines = [(e.verdict, e.statement + (f" ({e.note})" if e.note else "")) for e in evidence[:8]]
    if len(evidence) > 8:
        lines.append(("", f"and {len(evidence) - 8} more"))
    if lines:
        sheet.card(corner, lines, min(340, width - 80))


def _head(sheet: Sheet, estimate: CityEstimate, width: int) -> None:
    color = STATUS_COLOR[estimate.status]
    end = sheet.chip((14, 12), estimate.status.name, color)
    sheet.text((end + 12, 22), estimate.reason, 14, "ink", room=width - end - 26)
    said = estimate.understood.text if estimate.understood else ""
    sheet.text((14, 47), " ".join(said.split()), 13, "soft-ink", room=width - 28)


def _foot(sheet: Sheet, height: int) -> None:
    x, y = 14.0, height - FOOT / 2
    x = sheet.key_disc((x, y), "mode", "place and its uncertainty")
    x = sheet.key_heat((x, y), "how probable")
    x = sheet.key_line((x, y), "for", "speaks for it")
    x = sheet.key_line((x, y), "against", "speaks against it", dashed=True)
    sheet.text((sheet.width - 12, y), CREDIT, 12, "soft-ink", anchor="r", room=sheet.width - x - 24)
