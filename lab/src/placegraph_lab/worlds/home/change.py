"""A home months later: things moved and taken away, others brought in.

What is built in stays. What stood at a wall stands at a wall again, and what stood on a thing goes
with it; nothing comes to stand in another thing, or in a door.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import rotation_z
from placegraph.errors import OptionError
from placegraph_lab.worlds.flat.furniture import MODELS, Body, joined
from placegraph_lab.worlds.flat.interior import Interior, Surface, Thing
from placegraph_lab.worlds.flat.legend import look
from placegraph_lab.worlds.flat.textures import paint
from placegraph_lab.worlds.home.catalogue import KINDS, STYLES, SYNONYMS

Floats = NDArray[np.float64]

SHELL = frozenset({"floor", "ceiling", "wall", "window", "door", "doorway"})
"""Labels of what is no furniture."""
BUILT_IN = SHELL.union(
    *(
        {plain, *SYNONYMS.get(plain, ())}
        for plain in ("bathtub", "ceiling lamp", "counter", "radiator", "shower", "sink", "toilet",
                      "wall cupboard", "washbasin")
    )
)  # fmt: skip
"""Labels of what stays where it is."""
BROUGHT = ("box", "plant", "stool", "basket", "floor lamp", "bin", "chair", "armchair")
TRIES = 50
STANDS = 0.03  # what begins this near to a thing's top, or to the floor, stands on it [m]
AT_WALL = 0.12  # [m]
DOORSTEP = 0.6  # stays free before doors [m]
SILL = 0.85  # higher things do not stand before windows [m]
_TURNS = np.pi / 2 * np.array([0, 0, 0, 1, 2, 3])


def changed(
    interior: Interior,
    rng: np.random.Generator,
    *,
    moved: float = 0.3,
    removed: float = 0.1,
    added: int = 2,
) -> Interior:
    """Home as it is after months; what is still there keeps its id.

    `interior`: the home as it was; `rng`: draws what happens; `moved`, `removed`: probability of a
    piece of furniture to be moved, or taken away; `added`: most things that are brought in.

    Raises `OptionError`: A probability is none, or `added` is less than 0.
    """
    if not (0 <= moved <= 1 and 0 <= removed <= 1 and added >= 0):
        raise OptionError(
            f"moved={moved}, removed={removed}, added={added}: the first two are probabilities, "
            "the last a number of things."
        )
    later = interior
    for thing in interior.things:
        if thing.label in BUILT_IN or thing.id not in {t.id for t in later.things}:
            continue
        fate = rng.random()
        if fate < removed:
            later = _without(later, thing)
        elif fate < removed + moved:
            later = _moved(later, thing, rng)
    for _ in range(int(rng.integers(added + 1))):
        later = _with_another(later, interior, rng)
    return later


def on(things: Iterable[Thing], host: Thing) -> list[Thing]:
    """What stands on a thing, and on what stands on it."""
    low, high = host.bounds
    found = []
    for thing in things:
        at, top = thing.bounds
        within = (at[:2] > low[:2] - STANDS).all() and (top[:2] < high[:2] + STANDS).all()
        # taps reach over the top that something else stands on, legs of tables stand in rugs
        if thing.id != host.id and within and low[2] + 0.005 < at[2] <= high[2] + STANDS:
            found.append(thing)
    return found


def _without(interior: Interior, thing: Thing) -> Interior:
    gone = {thing.id, *(t.id for t in on(interior.things, thing))}
    lamps = tuple(
        lamp
        for lamp in interior.lamps
        if lamp.is_window or thing.glow == 0.0 or not _over(lamp.position, thing.bounds)
    )
    return Interior(tuple(t for t in interior.things if t.id not in gone), lamps)


def _moved(interior: Interior, thing: Thing, rng: np.random.Generator) -> Interior:
    """Interior with a thing, and what stands on it, elsewhere; as it was, if there is no room."""
    floor = _floor(interior, thing.room)
    if floor is None or thing.bounds[0, 2] > STANDS:  # hangs, or stands on something
        return interior
    cargo = on(interior.things, thing)
    away = {thing.id, *(t.id for t in cargo)}
    others = [t for t in interior.things if t.id not in away]
    middle = thing.bounds.mean(axis=0)
    for _ in range(TRIES):
        shift, yaw = _somewhere(thing.bounds, floor, rng)
        there = thing.moved((float(shift[0]), float(shift[1])), yaw)
        if _fits(there, others, floor):
            carried = {thing.id: there}
            for load in cargo:
                arm = load.bounds.mean(axis=0) - middle
                step = (rotation_z(yaw) @ arm - arm)[:2] + shift
                carried[load.id] = load.moved((float(step[0]), float(step[1])), yaw)
            lamps = tuple(
                replace(lamp, position=(*(np.array(lamp.position[:2]) + shift).tolist(),
                                        lamp.position[2]))
                if not lamp.is_window and any(t.glow > 0.0 and _over(lamp.position, t.bounds)
                                              for t in (thing, *cargo))
                else lamp
                for lamp in interior.lamps
            )  # fmt: skip
            return Interior(tuple(carried.get(t.id, t) for t in interior.things), lamps)
    return interior


def _somewhere(bounds: Floats, floor: Floats, rng: np.random.Generator) -> tuple[Floats, float]:
    """Shift (2,) [m] and turn [rad]: along the walls, if it stands at one, or to and fro."""
    middle, half = bounds.mean(axis=0)[:2], (bounds[1] - bounds[0])[:2] / 2
    gaps = np.concatenate([bounds[0, :2] - floor[0], floor[1] - bounds[1, :2]])
    wall = int(gaps.argmin())  # west, south, east, north
    if gaps[wall] > AT_WALL:
        small = float(rng.uniform(-0.5, 0.5))
        return rng.normal(0.0, 0.7, 2), float(rng.choice([0.0, small, np.pi / 2]))
    turn = int(rng.choice([0, 0, 0, 1, 2, 3]))
    there = (wall + turn) % 4
    half = half[::-1] if turn % 2 else half
    room = floor + np.stack([half, -half])
    if (room[1] < room[0]).any():
        return np.zeros(2), 0.0
    target = rng.uniform(room[0], room[1])
    axis = there % 2
    target[axis] = room[0, axis] + gaps[wall] if there < 2 else room[1, axis] - gaps[wall]
    return target - middle, turn * np.pi / 2


def _fits(there: Thing, others: list[Thing], floor: Floats) -> bool:
    low, high = there.bounds
    if (low[:2] < floor[0] - 1e-6).any() or (high[:2] > floor[1] + 1e-6).any():
        return False
    return all(_apart(other, low, high) for other in others)


def _apart(other: Thing, low: Floats, high: Floats) -> bool:
    at, top = other.bounds
    margin = 0.0
    if other.label in {"floor", "ceiling", "wall"} or top[2] < STANDS:  # or a rug
        return True
    if other.label in {"door", "doorway"}:
        margin = DOORSTEP
    elif other.label == "window" and high[2] <= SILL:
        return True
    overlap = np.minimum(top + margin, high) - np.maximum(at - margin, low)
    return bool((overlap <= 1e-6).any())


def _with_another(interior: Interior, before: Interior, rng: np.random.Generator) -> Interior:
    """Interior with one thing more; as it was, if there is no room."""
    plain = str(rng.choice(BROUGHT))
    rooms = [thing.room for thing in interior.things if thing.label == "floor"]
    room = str(rng.choice(rooms))
    floor = _floor(interior, room)
    here = {thing.label for thing in interior.things}
    words = [word for word in SYNONYMS.get(plain, (plain,)) if word in here] or [plain]
    number = max(thing.id for thing in (*interior.things, *before.things)) + 1
    label = words[0]
    kind, model = KINDS[plain], MODELS[KINDS[plain].model]
    width, depth, height = (
        float(rng.uniform(*sizes)) for sizes in (kind.width, kind.depth, kind.height)
    )
    looks = STYLES[str(rng.choice(list(STYLES)))].looks
    body = Body(
        width,
        depth,
        height,
        look(looks.get(kind.look, kind.look), plain),
        look(looks.get(kind.trim, kind.trim), plain),
    )
    surfaces = tuple(
        Surface(part.vertices, part.triangles, part.uv, paint(part.look, part.size, rng))
        for part in joined(model.made(body))
    )
    fresh = Thing(number, f"{label} {number}", label, room, surfaces, model.glow)
    others = [t for t in interior.things if t.label != words[0]] + [
        t for t in interior.things if t.label == words[0]
    ]
    for _ in range(TRIES):
        if floor is None:
            break
        half = (fresh.bounds[1] - fresh.bounds[0])[:2] / 2
        to = rng.uniform(floor[0] + half, np.maximum(floor[1] - half, floor[0] + half))
        shift = to - fresh.bounds.mean(axis=0)[:2]
        there = fresh.moved((float(shift[0]), float(shift[1])), float(rng.choice(_TURNS)))
        if _fits(there, others, floor):
            return replace(interior, things=(*interior.things, there))
    return interior


def _floor(interior: Interior, room: str) -> Floats | None:
    """Lowest and highest corner (2, 2) of a room's floor [m]; None: no such room."""
    for thing in interior.things:
        if thing.label == "floor" and thing.room == room:
            return thing.bounds[:, :2]
    return None


def _over(position: tuple[float, float, float], bounds: Floats) -> bool:
    at = np.array(position[:2])
    return bool((at >= bounds[0, :2]).all() and (at <= bounds[1, :2]).all())
