"""How well looks fit the words for them, as a ratio to what is usual of such things."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.language.looks import COLOURS, looks
from placegraph.indoor.language.seen import AT, MATERIALS, PLACES, SHAPES

Floats = NDArray[np.float64]
Looks = NDArray[np.floating]


MISNAMED = {"colours": 0.25, "places": 0.4}
"""Share of words of a class that are wrong, or a matter of taste;"""
TASTE = 0.6
"""of all others."""
_LIGHT = np.array([0.35, 0.5, 0.7, 0.4, 0.35, 0.35, 0.65, 0.25, 0.85, 1.0, 0.5, 0.0])
"""How light the basic colours are."""
_OF_ROOMS = {
    "large": ("volume", 1.0), "small": ("volume", -1.0), "long": ("longest", 1.0),
    "narrow": ("longest", 1.0), "empty": ("height", 1.0), "full": ("height", -1.0),
}  # fmt: skip
"""What `seen.room_seen` says where words are of rooms."""
_FAINT = 0.02
_MEASURED = {"tall": "height", "low": "height", "long": "longest", "short": "longest"}
_STEEP = 2.5  # of sizes: e-fold of what is usual
_KNOWN = 2.0  # things by which what is usual of all things is outweighed


def ratios(words: Iterable[str], seen: Looks, usual: Looks, like: Floats) -> Floats:
    """How much better (n,) than usual things look as words say.

    Parameters
    ----------
    words
        Attributes of one thing: "dark", "blue", "in the corner".
    seen
        (n, C) looks of the things (`seen.COLUMNS`).
    usual, like
        (m, C) looks of all that is known, and (m,) how well each is the thing that is spoken of:
        what is usual is usual of these.

    """
    out = np.ones(len(seen))
    for kind, entries in looks().said(words).items():
        fit = _fit(kind, entries, seen, usual, like)
        every = None if fit is None else _fit(kind, entries, usual, usual, like)
        if fit is None or every is None or np.isnan(every).all():
            continue
        known = ~np.isnan(every)
        mean = ((like * every)[known].sum() + _KNOWN * every[known].mean()) / (
            like[known].sum() + _KNOWN
        )
        wrong = MISNAMED.get(kind, TASTE)
        told = (1.0 - wrong) * fit / max(mean, _FAINT) + wrong
        out *= np.where(np.isnan(fit), 1.0, told)
    return out


def room_ratios(words: Iterable[str], seen: Looks, usual: Looks) -> Floats:
    """How much better (n,) than usual rooms (m, C) the rooms (n, C) fit words for their size."""
    out = np.ones(len(seen))
    for entries in looks().said(words).values():
        for entry in dict.fromkeys(entries):
            if entry not in _OF_ROOMS:
                continue
            column, sign = _OF_ROOMS[entry]
            size = usual[:, AT[column]]
            known = size[~np.isnan(size)]
            if not len(known):
                continue
            fit, mean = (
                1.0 / (1.0 + np.exp(-sign * _STEEP * (x - known.mean())))
                for x in (seen[:, AT[column]], known)
            )
            told = (1.0 - TASTE) * fit / mean.mean() + TASTE
            out *= np.where(np.isnan(fit), 1.0, told)
    return out


def _fit(
    kind: str, entries: tuple[str, ...], seen: Looks, usual: Looks, like: Floats
) -> Floats | None:
    """How well (n,) looks are what entries of a class say; NaN where nobody knows."""
    match kind:
        case "colours":
            return _coloured(entries, seen)
        case "shades":
            light = seen[:, : len(COLOURS)] @ _LIGHT
            return light if "light" in entries else 1.0 - light
        case "materials":
            return _made(entries, seen)
        case "shapes":
            return np.asarray(seen[:, [AT[e] for e in entries if e in SHAPES]].max(axis=1))
        case "patterns":
            return np.asarray(seen[:, AT["patterned"]])
        case "places":
            return np.asarray(seen[:, [AT[e] for e in entries if e in PLACES]].max(axis=1))
        case "sizes":
            return _sized(entries, seen, usual, like)
        case _:
            return None


def _coloured(entries: tuple[str, ...], seen: Looks) -> Floats:
    shares = seen[:, : len(COLOURS)]
    named = looks().alike[[COLOURS.index(e) for e in entries]].max(axis=0)
    return np.asarray(shares @ named)


def _made(entries: tuple[str, ...], seen: Looks) -> Floats:
    """By the material where it is known, else by the colours that it has."""
    told = seen[:, [AT[e] for e in entries if e in MATERIALS]].max(axis=1)
    colours = sum((tuple(looks().material_colours[e]) for e in entries), ())
    if not colours:
        return np.asarray(told)
    return np.asarray(np.where(np.isnan(told), _coloured(colours, seen), told))


def _sized(entries: tuple[str, ...], seen: Looks, usual: Looks, like: Floats) -> Floats:
    """Against the mean of things that are alike."""
    out = np.ones(len(seen))
    for entry in dict.fromkeys(entries):
        column = AT[_MEASURED.get(entry, "volume")]
        known = ~np.isnan(usual[:, column])
        weight = like[known].sum()
        if weight <= 0.0:
            return np.full(len(seen), np.nan)
        over = seen[:, column] - float((like * usual[:, column])[known].sum() / weight)
        over = -over if entry in ("small", "narrow", "low", "short") else over
        out *= 1.0 / (1.0 + np.exp(-_STEEP * over))
    return out
