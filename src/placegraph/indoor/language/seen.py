"""What the objects of a room look like and where in it they stand, as columns that words are held to."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from placegraph.core.graph import SceneGraph
from placegraph.indoor.language.colours import from_words
from placegraph.indoor.language.looks import COLOURS, looks
from placegraph.indoor.map.floor import is_floor, label_words

Floats = NDArray[np.float64]


MATERIALS = ("wooden", "metal", "stone", "ceramic", "leather", "fabric", "plastic", "glass",
             "wicker", "cardboard")  # fmt: skip
SHAPES = ("round", "angular", "l shaped")
PLACES = ("corner", "middle", "wall", "row")
COLUMNS = (
    *COLOURS, *MATERIALS, *SHAPES, "patterned", *PLACES, "longest", "height", "volume",
)  # fmt: skip
"""What is known of an object, NaN where nobody knows; the last three are logarithms [m], [m3]."""
AT = {name: i for i, name in enumerate(COLUMNS)}
_TOLD = {"materials": MATERIALS, "shapes": SHAPES, "patterns": ("patterned",)}
_SAID = ("material", "shape", "texture")
"""3DSSG's names of attributes that say so; "color" is read by `colours`."""
_NEAR = 0.6  # of a wall [m], so softly
_ALIGNED = 0.25  # things in a row are off it by less [m]
_LEAST = 0.02  # [m]


def seen(
    graph: SceneGraph, rows: Sequence[int], attributes: Sequence[Mapping[str, str]] = ()
) -> Floats:
    """Looks (n, C) of the objects in `rows`, which stand in one room; C `COLUMNS`."""
    out = np.full((len(rows), len(COLUMNS)), np.nan)
    for i, row in enumerate(rows):
        own = attributes[row] if attributes else {}
        out[i, : len(COLOURS)] = from_words(own)
        _told(out[i], graph.labels[row], own)
    if graph.extents is not None and graph.positions.shape[1] == 3 and graph.extents.any():
        at, size = graph.positions[rows], np.maximum(graph.extents[rows], _LEAST)
        out[:, AT["longest"]] = np.log(size[:, :2].max(axis=1, initial=_LEAST))
        out[:, AT["height"]] = np.log(size[:, 2])
        out[:, AT["volume"]] = np.log(size).sum(axis=1)
        labels = [graph.labels[row] for row in rows]
        out[:, [AT[p] for p in PLACES]] = _placed(at, size, labels)
    return out


def _told(looks_: Floats, label: str, attributes: Mapping[str, str]) -> None:
    """Fill in what the label and the attributes of an object say in words."""
    said = _says(label, *[attributes.get(key, "") for key in _SAID])
    for kind, names in _TOLD.items():
        if kind in said:
            looks_[[AT[name] for name in names]] = 0.0
            looks_[[AT[name] for name in said[kind]]] = 1.0
    if "colours" in said and np.isnan(looks_[0]):
        looks_[: len(COLOURS)] = 0.0
        looks_[[AT[name] for name in said["colours"]]] = 1.0 / len(said["colours"])


@lru_cache(maxsize=20_000)
def _says(label: str, *attributes: str) -> dict[str, tuple[str, ...]]:
    """What a label, and values of attributes ("wooden, metal"), say of looks."""
    values = [value.strip() for text in attributes for value in text.lower().split(",")]
    return looks().said([*label_words(label), *values])


def _placed(at: Floats, size: Floats, labels: Sequence[str]) -> Floats:
    """How well (n, 4) objects stand in a corner, in the middle, against a wall, and in a row."""
    low, high = at - size / 2, at + size / 2
    floors = [i for i, label in enumerate(labels) if is_floor(label)]
    inside = floors or list(range(len(labels)))
    begin, end = low[inside, :2].min(axis=0), high[inside, :2].max(axis=0)
    gaps = np.stack([low[:, :2] - begin, end - high[:, :2]]).clip(min=0.0)  # (2, n, axes)
    near = np.exp(-gaps.min(axis=0) / _NEAR)  # to the nearer wall of each axis
    half = np.maximum((end - begin) / 2, 0.5)
    off = np.abs(at[:, :2] - (begin + end) / 2) / half
    middle = np.exp(-np.square(off / 0.4).sum(axis=1))
    return np.stack([near.prod(axis=1), middle, near.max(axis=1), _rows(at, size, labels)], axis=1)


def _rows(at: Floats, size: Floats, labels: Sequence[str]) -> Floats:
    """Whether (n,) an object stands beside others of its label, along a line."""
    out = np.zeros(len(labels))
    for label, count in Counter(labels).items():
        if count == 1:
            continue
        own = np.array([i for i, x in enumerate(labels) if x == label])
        off = np.abs(at[own, None] - at[own])
        apart = off[:, :, :2]
        near = apart.max(axis=2) < 2.0 * size[own, None, :2].max(axis=2) + 0.5
        row = (apart.min(axis=2) < _ALIGNED) & near & (off[:, :, 2] < _ALIGNED)
        out[own] = np.minimum(row.sum(axis=1) - 1, 2) / 2
    return out


def room_seen(graph: SceneGraph, rows: Sequence[int]) -> Floats:
    """Looks (C,) of a room that holds these objects: its size, and nothing else."""
    out = np.full(len(COLUMNS), np.nan)
    if graph.extents is None or graph.positions.shape[1] != 3 or not len(rows):
        return out
    half = graph.extents[rows] / 2
    low = (graph.positions[rows] - half).min(axis=0)
    sides = np.maximum((graph.positions[rows] + half).max(axis=0) - low, _LEAST)
    if not graph.extents.any():
        return out
    out[AT["longest"]] = np.log(sides[:2].max() / sides[:2].min())  # how long for its width
    out[AT["volume"]] = np.log(sides[:2]).sum()
    out[AT["height"]] = -np.log(len(rows))  # how empty
    return out
