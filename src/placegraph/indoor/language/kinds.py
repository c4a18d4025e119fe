"""Which kind of room a room is, by its name or by what is in it."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from placegraph.indoor.language.kin import EXACT, fits
from placegraph.indoor.language.lexicon import room_kind, rooms

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

_UNLISTED = 0.25  # of the mean of what is listed: how probably other rooms hold a thing
_ABSENT = 0.5  # weight of what is not there: a map does not hold all that a room does
_NAMED = 0.97  # a room is what it is called


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
