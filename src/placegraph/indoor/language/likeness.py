"""How well a label fits what somebody calls a thing, and which kind of room holds such things."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib.resources import files
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.encode.words import vector
from placegraph.indoor.map.floor import label_words
from placegraph.indoor.map.relations import forms, same_thing

LEAST = 0.5
"""Cosine of words that are no kin any more (`encode.words`: 0.64 of two kinds of a thing)."""
SYNONYM = 0.95
"""How well a synonym fits."""
GENERAL = 0.7
"""How well a label fits that says less than what was asked for: a "table" may be a "side table"."""
EXACT = 0.9
"""What fits this well is the thing itself."""
_MANY = 20_000  # words kept
_UNLISTED = 0.25  # of the mean of what is listed: how probably other rooms hold a thing
_ABSENT = 0.5  # weight of what is not there: a map does not hold all that a room does
_NAMED = 0.97  # a room is what it is called


def fits(asked: str, labels: Sequence[str]) -> NDArray[np.float32]:
    """How well labels (n,) fit what is asked for, in [0, 1]: 1 the same thing, 0 no kin of it.

    A "desk" is a "table" by half. Labels that name nothing fit nothing.
    """
    return _fits(asked, tuple(labels))


@lru_cache(maxsize=1024)
def _fits(asked: str, labels: tuple[str, ...]) -> NDArray[np.float32]:
    out = _alike(asked, labels)
    for word, weight in everyday(asked):
        out = np.maximum(out, weight * _alike(word, labels))
    out.flags.writeable = False
    return out


def _alike(asked: str, labels: tuple[str, ...]) -> NDArray[np.float32]:
    """`fits` by the tree of things alone."""
    if not labels:
        return np.zeros(0, np.float32)
    cosines = _vectors(labels) @ _vector(asked)
    out = SYNONYM * np.clip((cosines - LEAST) / (1.0 - LEAST), 0.0, 1.0)
    start = _start(asked)
    for i, label in enumerate(labels):
        if _start(label) == start and start and same_thing(asked, label):
            said, own = set(label_words(asked)[:-1]), set(label_words(label)[:-1])
            out[i] = 1.0 if said <= own else max(out[i], GENERAL)
    return np.asarray(out, np.float32)


@lru_cache(maxsize=64)
def _vectors(labels: tuple[str, ...]) -> NDArray[np.float32]:
    return np.stack([_vector(label) for label in labels])


@lru_cache(maxsize=_MANY)
def everyday(asked: str) -> tuple[tuple[str, np.float32], ...]:
    """What maps may call a thing by everyday words for it, and how well: the longest last words."""
    words = label_words(asked)
    for first in range(len(words)):
        for last in forms(words[-1]):
            found = _everyday().get(" ".join([*words[first:-1], last]))
            if found:
                return tuple(found.items())
    return ()


@cache
def _everyday() -> Mapping[str, Mapping[str, np.float32]]:
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


@lru_cache(maxsize=_MANY)
def _vector(label: str) -> NDArray[np.float32]:
    return vector(label)


@lru_cache(maxsize=_MANY)
def _start(label: str) -> str:
    """Two letters that the last word of a label has in common with its plural."""
    words = label_words(label)
    return words[-1][:2] if words else ""


@dataclass(frozen=True, slots=True)
class RoomKinds:
    """Kinds of rooms."""

    kind_of: Mapping[tuple[str, ...], str]
    """Kind that words name."""
    usual: Mapping[str, float]
    """Share of each kind among the rooms of homes; they sum to 1."""
    holds: Mapping[str, Mapping[str, float]]
    """How probably a room of a kind holds such a thing, by what it is called."""


@cache
def rooms() -> RoomKinds:
    """The kinds of rooms that placegraph knows."""
    table = tomllib.loads(files(__package__).joinpath("data", "rooms.toml").read_text("utf-8"))
    names = {kind: [kind, *entry.get("names", [])] for kind, entry in table.items()}
    total = sum(entry["usual"] for entry in table.values())
    return RoomKinds(
        kind_of={tuple(name.split()): kind for kind, all_ in names.items() for name in all_},
        usual={kind: entry["usual"] / total for kind, entry in table.items()},
        holds={kind: entry["holds"] for kind, entry in table.items()},
    )


def room_kind(label: str) -> str:
    """Kind of room that a label names: its last words do; empty if it names none."""
    words = label_words(label)
    for last in (words[-1:], [words[-1].removesuffix("s")] if words else []):
        for n in (3, 2, 1):
            kind = rooms().kind_of.get((*words[-n:-1], *last)) if len(words) >= n else None
            if kind:
                return kind
    return ""


class _Table(NamedTuple):
    kinds: tuple[str, ...]
    usual: NDArray[np.float64]
    """(R,) shares of kinds."""
    things: tuple[str, ...]
    present: NDArray[np.float64]
    """(R, T) log of how much more probably a kind of room holds a thing than the average room."""
    absent: NDArray[np.float64]
    """(R, T) the same of not holding it."""
    average: NDArray[np.float64]
    """(T,) how probably the average room holds a thing."""


@cache
def table() -> _Table:
    """The kinds of rooms as arrays, from rooms.toml."""
    known = rooms()
    kinds = tuple(known.holds)
    things = tuple(dict.fromkeys(t for holds in known.holds.values() for t in holds))
    usual = np.array([known.usual[kind] for kind in kinds])
    held = np.array([[known.holds[kind].get(t, np.nan) for t in things] for kind in kinds])
    held = np.where(np.isnan(held), _UNLISTED * np.nanmean(held, axis=0), held)
    average = usual @ held
    return _Table(
        kinds, usual, things, np.log(held / average), np.log((1 - held) / (1 - average)), average
    )


def kind_by_name(name: str, else_: NDArray[np.float64]) -> NDArray[np.float64]:
    """How probably (R,) a room is of each kind by its name; `else_` where the name names none."""
    known = table()
    named = room_kind(name)
    if not named:
        return else_
    rest = (1.0 - _NAMED) / (len(known.kinds) - 1)
    return np.where(np.array(known.kinds) == named, _NAMED, rest)


def kinds_of(
    held: NDArray[np.floating], undivided: NDArray[np.bool_] | np.bool_
) -> NDArray[np.float64]:
    """How probably (U, R) rooms are of each kind by what is in them.

    Parameters
    ----------
    held
        (U, T) how well the things of the table are among what each holds.
    undivided
        (U,) which may be homes whose rooms nobody told apart: they have a room of a kind as their
        most telling thing says, as where a stove is there is a kitchen.

    """
    known = table()
    # what is there, and to a lesser degree what is not
    telling = known.present - _ABSENT * known.absent
    logs = np.log(known.usual) + _ABSENT * known.absent.sum(axis=1) + held @ telling.T
    share = np.exp(logs - logs.max(axis=1, keepdims=True))
    share /= share.sum(axis=1, keepdims=True)
    of_thing = known.usual[:, None] * np.exp(known.present)
    homes = np.flatnonzero(np.broadcast_to(undivided, len(held)))
    for kind, of_it in enumerate(of_thing if len(homes) else ()):
        most = (held[homes] * of_it).max(axis=1, initial=0.0)
        share[homes, kind] = np.maximum(share[homes, kind], most)
    return np.asarray(share)


def likenesses(labels: Sequence[str]) -> NDArray[np.float32]:
    """How well (L, T) labels fit the things of the table; kin counts for less than by half."""
    if not labels:
        return np.zeros((0, len(table().things)), np.float32)
    return np.stack([_held_by(label) for label in labels])


def usual(label: str) -> float:
    """How probably an average room holds what is called so; a tenth where nobody told."""
    likeness = _held_by(label)
    best = int(likeness.argmax())
    return float(table().average[best]) if likeness[best] > 0.0 else 0.1


@cache
def _held_by(label: str) -> NDArray[np.float32]:
    likeness = fits(label, table().things)
    return np.where(likeness >= EXACT, 1.0, np.where(likeness >= 0.4, 0.3, 0.0)).astype(np.float32)
