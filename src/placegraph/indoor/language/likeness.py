"""Fit of labels to what somebody calls a thing, and the kinds of rooms that hold such things."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from functools import cache, lru_cache
from importlib.resources import files
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.encode.words import embed_label
from placegraph.indoor.map.floor import singular_forms, split_label
from placegraph.indoor.map.relations import matches_label

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]

LEAST = 0.5
"""Cosine of words that are no kin any more (`encode.words`: 0.64 of two kinds of a thing)."""
SYNONYM = 0.95
"""Fit of a synonym."""
GENERAL = 0.7
"""Fit of a label that says less than what was asked for: a "table" may be a "side table"."""
EXACT = 0.9
"""Fit from which a label is the thing itself."""
_MEMORY = 20_000  # words
_UNLISTED = 0.25  # of the mean of what is listed: how probably other rooms hold a thing
_ABSENT = 0.5  # weight of what is not there: a map does not hold all that a room does
_NAMED = 0.97  # a room is what it is called


def match_labels(query: str, labels: Sequence[str]) -> Floats32:
    """Return the similarity of labels (n,) to a query in [0, 1]: 1 the same kind, 0 unrelated.

    A "desk" is a "table" by half. Labels that name nothing fit nothing.
    """
    return _match_labels(query, tuple(labels))


@lru_cache(maxsize=1024)
def _match_labels(query: str, labels: tuple[str, ...]) -> Floats32:
    out = _match_by_tree(query, labels)
    for word, weight in everyday(query):
        out = np.maximum(out, weight * _match_by_tree(word, labels))
    out.flags.writeable = False
    return out


def _match_by_tree(query: str, labels: tuple[str, ...]) -> Floats32:
    """Return `match_labels` by the tree of things alone, without everyday words."""
    if not labels:
        return np.zeros(0, np.float32)
    cosines = _vectors(labels) @ _vector(query)
    out = SYNONYM * np.clip((cosines - LEAST) / (1.0 - LEAST), 0.0, 1.0)
    start = _start(query)
    for i, label in enumerate(labels):
        if _start(label) == start and start and matches_label(query, label):
            said, own = set(split_label(query)[:-1]), set(split_label(label)[:-1])
            out[i] = 1.0 if said <= own else max(out[i], GENERAL)
    return np.asarray(out, np.float32)


@lru_cache(maxsize=64)
def _vectors(labels: tuple[str, ...]) -> Floats32:
    return np.stack([_vector(label) for label in labels])


_vector = lru_cache(maxsize=_MEMORY)(embed_label)


@lru_cache(maxsize=_MEMORY)
def _start(label: str) -> str:
    """Return two letters that the last word of a label has in common with its plural."""
    words = split_label(label)
    return words[-1][:2] if words else ""


@lru_cache(maxsize=_MEMORY)
def everyday(query: str) -> tuple[tuple[str, np.float32], ...]:
    """Return labels of maps for everyday words, with similarities: those of the longest last words."""
    words = split_label(query)
    for first in range(len(words)):
        for last in singular_forms(words[-1]):
            found = _everyday().get(" ".join([*words[first:-1], last]))
            if found:
                return tuple(found.items())
    return ()


@cache
def _everyday() -> Mapping[str, Mapping[str, np.float32]]:
    """Read everyday.tsv: labels and their fits by word."""
    table: dict[str, dict[str, np.float32]] = {}
    text = files(__package__).joinpath("data", "everyday.tsv").read_text("utf-8")
    for line in text.splitlines():
        if line and not line.startswith("#"):
            words, labels, weight = line.split("\t")
            for word in words.split(", "):
                known = table.setdefault(word, {})
                for label in labels.split(", "):
                    known[label] = max(known.get(label, np.float32(0.0)), np.float32(weight))
    return table


class _RoomTable(NamedTuple):
    kind_of: Mapping[tuple[str, ...], str]
    """Kind of room that words name."""
    kinds: tuple[str, ...]
    share: Floats
    """(R,) shares of kinds among the rooms of homes; they sum to 1."""
    labels: tuple[str, ...]
    present: Floats
    """(R, T) log of how much more probably a kind of room holds a thing than the average room."""
    absent: Floats
    """(R, T) the same of not holding it."""
    average: Floats
    """(T,) how probably the average room holds a thing."""


@cache
def table() -> _RoomTable:
    """Return the kinds of rooms of rooms.toml, as arrays."""
    entries = tomllib.loads(files(__package__).joinpath("data", "rooms.toml").read_text("utf-8"))
    total = sum(entry["usual"] for entry in entries.values())
    things = tuple(dict.fromkeys(t for entry in entries.values() for t in entry["holds"]))
    usual = np.array([entry["usual"] / total for entry in entries.values()])
    held = np.array([[e["holds"].get(t, np.nan) for t in things] for e in entries.values()])
    held = np.where(np.isnan(held), _UNLISTED * np.nanmean(held, axis=0), held)
    average = usual @ held
    return _RoomTable(
        kind_of={
            tuple(name.split()): kind
            for kind, entry in entries.items()
            for name in (kind, *entry.get("names", []))
        },
        kinds=tuple(entries),
        share=usual,
        labels=things,
        present=np.log(held / average),
        absent=np.log((1 - held) / (1 - average)),
        average=average,
    )


def room_kind(label: str) -> str:
    """Return the kind of room that a label names: its last words do; empty if it names none."""
    words = split_label(label)
    for last in (words[-1:], [words[-1].removesuffix("s")] if words else []):
        for n in (3, 2, 1):
            kind = table().kind_of.get((*words[-n:-1], *last)) if len(words) >= n else None
            if kind:
                return kind
    return ""


def kind_by_name(name: str, else_: Floats) -> Floats:
    """Return the probability (R,) of each kind of room by a name; `else_` where it names none."""
    named = room_kind(name)
    if not named:
        return else_
    kinds = table().kinds
    return np.where(np.array(kinds) == named, _NAMED, (1.0 - _NAMED) / (len(kinds) - 1))


def kinds_of(contents: NDArray[np.floating], undivided: NDArray[np.bool_] | np.bool_) -> Floats:
    """Return the probability (U, R) of each kind of room by the objects in it.

    `contents`: (U, T) how well the things of the table are among what each holds.
    `undivided`: (U,) which may be homes whose rooms nobody told apart: they have a room of a kind
        as their most telling thing says, as where a stove is there is a kitchen.
    """
    known = table()
    # what is there, and to a lesser degree what is not
    telling = known.present - _ABSENT * known.absent
    logs = np.log(known.share) + _ABSENT * known.absent.sum(axis=1) + contents @ telling.T
    share = np.exp(logs - logs.max(axis=1, keepdims=True))
    share /= share.sum(axis=1, keepdims=True)
    of_thing = known.share[:, None] * np.exp(known.present)
    homes = np.flatnonzero(np.broadcast_to(undivided, len(contents)))
    for kind, of_it in enumerate(of_thing if len(homes) else ()):
        most = (contents[homes] * of_it).max(axis=1, initial=0.0)
        share[homes, kind] = np.maximum(share[homes, kind], most)
    return np.asarray(share)


def likenesses(labels: Sequence[str]) -> Floats32:
    """Return the similarity (L, T) of labels to the entries of the table; kin counts less than half."""
    if not labels:
        return np.zeros((0, len(table().labels)), np.float32)
    return np.stack([_likeness(label) for label in labels])


@cache
def _likeness(label: str) -> Floats32:
    fit = match_labels(label, table().labels)
    return np.where(fit >= EXACT, 1.0, np.where(fit >= 0.4, 0.3, 0.0)).astype(np.float32)


def base_rate(label: str) -> float:
    """Return the probability of a label in an average room; 0.1 where unknown."""
    likeness = _likeness(label)
    best = int(likeness.argmax())
    return float(table().average[best]) if likeness[best] > 0.0 else 0.1
