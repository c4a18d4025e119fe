"""Colours, materials, sizes and shapes: words for them, and how well objects fit the words.

Points on an object's triangles, spread evenly over their area, are named by the nearest colours that
`looks.toml` shows, in CIE L*a*b*. A map says them of its objects as an attribute, "brown 7 beige 3" in
tenths, so that libraries know them without a mesh.
"""

from __future__ import annotations

import tomllib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from placegraph.core.graph import SceneGraph
from placegraph.indoor.map.floor import is_floor, split_label
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.map.textures import linear_from_srgb

Floats = NDArray[np.float64]
Table = NDArray[np.floating]

COLOURS = (
    "red", "orange", "yellow", "green", "blue", "purple", "pink", "brown", "beige", "white", "grey",
    "black",
)  # fmt: skip
"""The basic colours, in the order of all columns of them."""
MATERIALS = ("wooden", "metal", "stone", "ceramic", "leather", "fabric", "plastic", "glass",
             "wicker", "cardboard")  # fmt: skip
SHAPES = ("round", "angular", "l shaped")
PLACES = ("corner", "middle", "wall", "row")
COLUMNS = (
    *COLOURS, *MATERIALS, *SHAPES, "patterned", *PLACES, "longest", "height", "volume",
)  # fmt: skip
"""Known properties of an object, NaN where unknown; the last three are logarithms [m], [m3]."""
AT = {name: i for i, name in enumerate(COLUMNS)}
KEY = "colours"
"""Attribute of an object's colours."""
POINTS = 64
"""Points on each object."""
MISNAMED = {"colours": 0.25, "places": 0.4}
"""Share of words of a class that are wrong, or a matter of taste;"""
TASTE = 0.6
"""of all others."""
_LONGEST = 3  # words of an attribute
_SOFT = 9.0
"""Difference of colours (CIE76) at which a name is given up for the next."""
_LEAST = 0.08
"""A colour that covers less is not spoken of."""
_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
_D65 = np.array([0.9505, 1.0, 1.089])
_NAMED_LOOKS = {"materials": MATERIALS, "shapes": SHAPES, "patterns": ("patterned",)}
_ATTRIBUTES = ("material", "shape", "texture")
"""3DSSG's names of attributes that say so; "color" is read by `from_words`."""
_NEAR = 0.6  # of a wall [m], so softly
_ALIGNED = 0.25  # things in a row are off it by less [m]
_SMALLEST = 0.02  # [m]
_LIGHT = np.array([0.35, 0.5, 0.7, 0.4, 0.35, 0.35, 0.65, 0.25, 0.85, 1.0, 0.5, 0.0])
"""Lightness of the basic colours."""
_OF_ROOMS = {
    "large": ("volume", 1.0), "small": ("volume", -1.0), "long": ("longest", 1.0),
    "narrow": ("longest", 1.0), "empty": ("height", 1.0), "full": ("height", -1.0),
}  # fmt: skip
"""Column of `describe_room` and its sign, where words are of rooms."""
_FAINT = 0.02
_MEASURED = {"tall": "height", "low": "height", "long": "longest", "short": "longest"}
_STEEP = 2.5  # of sizes: e-fold of what is usual
_KNOWN = 2.0  # things by which what is usual of all things is outweighed


# words


@dataclass(frozen=True, slots=True)
class AppearanceWords:
    """Words for looks."""

    swatches: Mapping[str, Sequence[str]]
    """sRGB codes of each basic colour."""
    alike: Floats
    """(12, 12) how readily a colour (row) is called by the name of another (column)."""
    material_colours: Mapping[str, Sequence[str]]
    """Colours by which a material is known."""
    classes: Mapping[str, Mapping[str, tuple[str, ...]]]
    """Entries that each word means, by class ("colours", "sizes" ...)."""

    @property
    def colours(self) -> Mapping[str, tuple[str, ...]]:
        """Basic colours that a word names."""
        return self.classes["colours"]

    def classify(self, words: Iterable[str]) -> dict[str, tuple[str, ...]]:
        """Return the entries that words stand under, by class; two colours of one thing are both its."""
        out: dict[str, tuple[str, ...]] = {}
        for word in words:
            for name, entries in self.classes.items():
                if word in entries:
                    out[name] = out.get(name, ()) + entries[word]
        return out


@cache
def appearance_words() -> AppearanceWords:
    """Read the words for looks that placegraph knows, from looks.toml."""
    table = tomllib.loads(files(__package__).joinpath("data", "looks.toml").read_text("utf-8"))
    alike = np.eye(len(COLOURS))
    for one, others in table.pop("alike").items():
        for other, share in others.items():
            i, j = COLOURS.index(one), COLOURS.index(other)
            alike[i, j] = alike[j, i] = share
    classes: dict[str, dict[str, tuple[str, ...]]] = {}
    for name, entries in table.items():
        known: dict[str, tuple[str, ...]] = classes.setdefault(name, {})
        for entry, value in entries.items():
            for word in value["words"] if isinstance(value, dict) else value:
                known[word] = (*known.get(word, ()), entry)
    return AppearanceWords(
        swatches={name: table["colours"][name]["shown"] for name in COLOURS},
        alike=alike,
        material_colours={name: e["colours"] for name, e in table["materials"].items()},
        classes=classes,
    )


@cache
def _words() -> frozenset[str]:
    classes = [known for kind, known in appearance_words().classes.items() if kind != "places"]
    return frozenset(word for known in classes for word in known)


def is_look(words: str) -> bool:
    """Tell whether words only say what a thing looks like."""
    return words in _words()


def parse_attributes(words: Sequence[str]) -> tuple[tuple[str, ...], int]:
    """Return attributes that words begin with, and how many words they take; the last word is a thing."""
    found: list[str] = []
    at = 0
    while at < len(words) - 1:
        lengths = range(min(_LONGEST, len(words) - 1 - at), 0, -1)
        length = next((n for n in lengths if is_look(" ".join(words[at : at + n]))), 0)
        if not length:
            break
        found.append(" ".join(words[at : at + length]))
        at += length
    return tuple(found), at


def parse_trailing_colours(words: Sequence[str]) -> tuple[tuple[str, ...], int]:
    """Return colours that words end in ("sideboard pale green"), and how many words stand before."""
    end = len(words)
    while end > 1 and words[end - 1] in appearance_words().colours:
        end -= 1
    if end == len(words):
        return (), end
    while end > 1 and words[end - 1] in appearance_words().classes["shades"]:
        end -= 1
    return tuple(words[end:]), end


# colours of a map's objects


def with_colours(scene: Scene) -> tuple[dict[str, str], ...]:
    """Return attributes (N,) of a map's objects, with their colours where its surfaces have some."""
    if not scene.has_colours:
        return scene.attributes
    shares = scene.compute_once("colours", colours_of)
    return tuple(
        {**own, KEY: words} if (words := in_words(share)) and KEY not in own else own
        for own, share in zip(scene.attributes, shares, strict=True)
    )


def colours_of(scene: Scene) -> Floats:
    """Return shares (N, 12) of the basic colours on the surface of each object."""
    mesh = scene.mesh
    areas = np.linalg.norm(mesh.normals(), axis=1) + 1e-12
    order = np.argsort(mesh.object_of, kind="stable")
    total = np.cumsum(areas[order])
    starts = np.searchsorted(mesh.object_of[order], np.arange(len(scene) + 1))
    ends = np.append(0.0, total)[starts]
    steps = (np.arange(POINTS) + 0.5) / POINTS
    at = ends[:-1, None] + steps * np.diff(ends)[:, None]
    rows = np.searchsorted(total, at.ravel()).clip(max=len(order) - 1)
    # a sequence of low discrepancy, folded into the triangle
    k = np.arange(at.size)
    u, v = (k * 0.7548776662) % 1.0, (k * 0.5698402910) % 1.0
    over = u + v > 1.0
    u, v = np.where(over, 1.0 - u, u).astype("f4"), np.where(over, 1.0 - v, v).astype("f4")
    colours = mesh.colour_at(order[rows].astype(np.int32), u, v)
    return np.asarray(name_colours(colours).reshape(len(scene), POINTS, -1).mean(axis=1))


def name_colours(colours: NDArray[np.uint8]) -> Floats:
    """Return the probability (n, 12) of each basic name for colours (n, 3) uint8 sRGB; rows sum to 1."""
    shown, names = _swatches()
    distance = np.linalg.norm(_lab(colours)[:, None] - shown, axis=2)
    nearest = np.stack([distance[:, names == i].min(axis=1) for i in range(len(COLOURS))], axis=1)
    share = np.exp(-(nearest - nearest.min(axis=1, keepdims=True)) / _SOFT)
    return np.asarray(share / share.sum(axis=1, keepdims=True))


@cache
def _swatches() -> tuple[Floats, NDArray[np.int64]]:
    """Return L*a*b* (n, 3) of the colours that looks.toml shows, and the basic colour (n,) of each."""
    entries = [
        (i, code) for i, name in enumerate(COLOURS) for code in appearance_words().swatches[name]
    ]
    rgb = np.array([list(bytes.fromhex(code[1:])) for _, code in entries], np.uint8)
    return _lab(rgb), np.array([i for i, _ in entries])


def _lab(colours: NDArray[np.uint8]) -> Floats:
    """Return CIE L*a*b* (n, 3) of colours (n, 3) uint8 sRGB, under D65."""
    xyz = linear_from_srgb(colours / 255.0) @ _XYZ.T / _D65
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16.0 / 116.0)
    x, y, z = f.T
    return np.stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], axis=1)


def in_words(share: Floats) -> str:
    """Write shares (12,) as "brown 7 beige 3", the largest first."""
    order = [i for i in np.argsort(-share, kind="stable").tolist() if share[i] >= _LEAST]
    return " ".join([f"{COLOURS[i]} {max(round(10 * share[i]), 1)}" for i in order])


def from_words(attributes: Mapping[str, str]) -> Floats:
    """Read shares (12,) from attributes: what `in_words` wrote, or words of people ("white, grey").

    NaN where they say none.
    """
    out = np.zeros(len(COLOURS))
    words = attributes.get(KEY, "").split()
    for name, tenths in zip(words[::2], words[1::2], strict=False):
        if name in COLOURS and tenths.isdecimal() and len(tenths) < 4:
            out[COLOURS.index(name)] += int(tenths)
    for word in attributes.get("color", "").lower().replace(",", " ").split():
        for name in appearance_words().colours.get(word, ()):
            out[COLOURS.index(name)] += 10.0
    return out / out.sum() if out.any() else np.full(len(COLOURS), np.nan)


# looks of objects, as columns that words are held to


def describe_objects(
    graph: SceneGraph, rows: Sequence[int], attributes: Sequence[Mapping[str, str]] = ()
) -> Floats:
    """Return looks (n, C) of the objects in `rows`, which stand in one room; C `COLUMNS`."""
    out = np.full((len(rows), len(COLUMNS)), np.nan)
    for i, row in enumerate(rows):
        own = attributes[row] if attributes else {}
        out[i, : len(COLOURS)] = from_words(own)
        said = _read_looks(graph.labels[row], *[own.get(key, "") for key in _ATTRIBUTES])
        for kind, names in _NAMED_LOOKS.items():
            if kind in said:
                out[i, [AT[name] for name in names]] = 0.0
                out[i, [AT[name] for name in said[kind]]] = 1.0
        if "colours" in said and np.isnan(out[i, 0]):
            out[i, : len(COLOURS)] = 0.0
            out[i, [AT[name] for name in said["colours"]]] = 1.0 / len(said["colours"])
    if graph.extents is not None and graph.positions.shape[1] == 3 and graph.extents.any():
        at, size = graph.positions[rows], np.maximum(graph.extents[rows], _SMALLEST)
        out[:, AT["longest"]] = np.log(size[:, :2].max(axis=1, initial=_SMALLEST))
        out[:, AT["height"]] = np.log(size[:, 2])
        out[:, AT["volume"]] = np.log(size).sum(axis=1)
        labels = [graph.labels[row] for row in rows]
        out[:, [AT[p] for p in PLACES]] = _places(at, size, labels)
    return out


@lru_cache(maxsize=20_000)
def _read_looks(label: str, *attributes: str) -> dict[str, tuple[str, ...]]:
    """Return the look that a label, and values of attributes ("wooden, metal"), state."""
    values = [value.strip() for text in attributes for value in text.lower().split(",")]
    return appearance_words().classify([*split_label(label), *values])


def _places(at: Floats, size: Floats, labels: Sequence[str]) -> Floats:
    """Return the agreement (n, 4) of objects with: in a corner, in the middle, against a wall, in a row."""
    low, high = at - size / 2, at + size / 2
    floors = [i for i, label in enumerate(labels) if is_floor(label)]
    inside = floors or list(range(len(labels)))
    begin, end = low[inside, :2].min(axis=0), high[inside, :2].max(axis=0)
    gaps = np.stack([low[:, :2] - begin, end - high[:, :2]]).clip(min=0.0)  # (2, n, axes)
    near = np.exp(-gaps.min(axis=0) / _NEAR)  # to the nearer wall of each axis
    half = np.maximum((end - begin) / 2, 0.5)
    off = np.abs(at[:, :2] - (begin + end) / 2) / half
    middle = np.exp(-np.square(off / 0.4).sum(axis=1))
    rows = np.zeros(len(labels))  # beside others of the label, along a line
    for label, count in Counter(labels).items():
        if count == 1:
            continue
        own = np.array([i for i, x in enumerate(labels) if x == label])
        off = np.abs(at[own, None] - at[own])
        apart = off[:, :, :2]
        close = apart.max(axis=2) < 2.0 * size[own, None, :2].max(axis=2) + 0.5
        row = (apart.min(axis=2) < _ALIGNED) & close & (off[:, :, 2] < _ALIGNED)
        rows[own] = np.minimum(row.sum(axis=1) - 1, 2) / 2
    return np.stack([near.prod(axis=1), middle, near.max(axis=1), rows], axis=1)


def describe_room(graph: SceneGraph, rows: Sequence[int]) -> Floats:
    """Return looks (C,) of a room that holds these objects: its size, and nothing else."""
    out = np.full(len(COLUMNS), np.nan)
    extents, positions = graph.extents, graph.positions
    if extents is None or not extents.any() or positions.shape[1] != 3 or not len(rows):
        return out
    half = extents[rows] / 2
    low = (positions[rows] - half).min(axis=0)
    sides = np.maximum((positions[rows] + half).max(axis=0) - low, _SMALLEST)
    out[AT["longest"]] = np.log(sides[:2].max() / sides[:2].min())  # how long for its width
    out[AT["volume"]] = np.log(sides[:2]).sum()
    out[AT["height"]] = -np.log(len(rows))  # how empty
    return out


# fit of looks to words, as a ratio to what is usual


def ratios(words: Iterable[str], rows: Table, library: Table, like: Floats) -> Floats:
    """Return the likelihood ratio (n,) of the looks that words state, against usual objects.

    `words`: attributes of one thing: "dark", "blue", "in the corner".
    `rows`: (n, C) looks of the things (`COLUMNS`).
    `library`, `like`: (m, C) looks of all that is known, and (m,) how well each is the thing that
        is spoken of: what is usual is usual of these.
    """
    out = np.ones(len(rows))
    for kind, entries in appearance_words().classify(words).items():
        fit = _fit(kind, entries, rows, library, like)
        every = None if fit is None else _fit(kind, entries, library, library, like)
        if fit is None or every is None or np.isnan(every).all():
            continue
        known = ~np.isnan(every)
        mean = ((like * every)[known].sum() + _KNOWN * every[known].mean()) / (
            like[known].sum() + _KNOWN
        )
        wrong = MISNAMED.get(kind, TASTE)
        ratio = (1.0 - wrong) * fit / max(mean, _FAINT) + wrong
        out *= np.where(np.isnan(fit), 1.0, ratio)
    return out


def room_ratios(words: Iterable[str], rows: Table, library: Table) -> Floats:
    """Return the likelihood ratio (n,) of words for the size of rooms (n, C), against rooms (m, C)."""
    out = np.ones(len(rows))
    for entries in appearance_words().classify(words).values():
        for entry in dict.fromkeys(entries):
            if entry not in _OF_ROOMS:
                continue
            column, sign = _OF_ROOMS[entry]
            size = library[:, AT[column]]
            known = size[~np.isnan(size)]
            if not len(known):
                continue
            fit, mean = (
                1.0 / (1.0 + np.exp(-sign * _STEEP * (x - known.mean())))
                for x in (rows[:, AT[column]], known)
            )
            ratio = (1.0 - TASTE) * fit / mean.mean() + TASTE
            out *= np.where(np.isnan(fit), 1.0, ratio)
    return out


def _fit(
    kind: str, entries: tuple[str, ...], rows: Table, library: Table, like: Floats
) -> Floats | None:
    """Return the agreement (n,) of looks with the entries of a class; NaN where unknown."""
    match kind:
        case "colours":
            return _fit_colours(entries, rows)
        case "shades":
            light = rows[:, : len(COLOURS)] @ _LIGHT
            return light if "light" in entries else 1.0 - light
        case "materials":  # by the material where it is known, else by the colours that it has
            fit = rows[:, [AT[e] for e in entries if e in MATERIALS]].max(axis=1)
            colours = sum((tuple(appearance_words().material_colours[e]) for e in entries), ())
            if not colours:
                return np.asarray(fit)
            return np.asarray(np.where(np.isnan(fit), _fit_colours(colours, rows), fit))
        case "shapes":
            return np.asarray(rows[:, [AT[e] for e in entries if e in SHAPES]].max(axis=1))
        case "patterns":
            return np.asarray(rows[:, AT["patterned"]])
        case "places":
            return np.asarray(rows[:, [AT[e] for e in entries if e in PLACES]].max(axis=1))
        case "sizes":
            return _fit_sizes(entries, rows, library, like)
    return None


def _fit_colours(entries: tuple[str, ...], rows: Table) -> Floats:
    alike = appearance_words().alike[[COLOURS.index(e) for e in entries]].max(axis=0)
    return np.asarray(rows[:, : len(COLOURS)] @ alike)


def _fit_sizes(entries: tuple[str, ...], rows: Table, library: Table, like: Floats) -> Floats:
    """Return the agreement (n,) of sizes, against the mean of similar objects."""
    out = np.ones(len(rows))
    for entry in dict.fromkeys(entries):
        column = AT[_MEASURED.get(entry, "volume")]
        known = ~np.isnan(library[:, column])
        weight = like[known].sum()
        if weight <= 0.0:
            return np.full(len(rows), np.nan)
        over = rows[:, column] - float((like * library[:, column])[known].sum() / weight)
        over = -over if entry in ("small", "narrow", "low", "short") else over
        out *= 1.0 / (1.0 + np.exp(-_STEEP * over))
    return out
