"""Words of what things look like: colours, materials, sizes, shapes, patterns, from `looks.toml`."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

COLOURS = (
    "red", "orange", "yellow", "green", "blue", "purple", "pink", "brown", "beige", "white", "grey",
    "black",
)  # fmt: skip
"""The basic colours, in the order of all columns of them."""
_LONGEST = 3  # words of an attribute


@dataclass(frozen=True, slots=True)
class Looks:
    """What words say of looks."""

    shown: Mapping[str, Sequence[str]]
    """sRGB codes of each basic colour."""
    alike: NDArray[np.float64]
    """(12, 12) how readily a colour (row) is called by the name of another (column)."""
    material_colours: Mapping[str, Sequence[str]]
    """By which colours a material is known."""
    classes: Mapping[str, Mapping[str, tuple[str, ...]]]
    """Of each class ("colours", "sizes" ...) the entries that a word stands under."""

    @property
    def colours(self) -> Mapping[str, tuple[str, ...]]:
        """Basic colours that a word names."""
        return self.classes["colours"]

    def said(self, words: Iterable[str]) -> dict[str, tuple[str, ...]]:
        """Entries that words stand under, by class; two colours of one thing are both its colours."""
        out: dict[str, tuple[str, ...]] = {}
        for word in words:
            for name, entries in self.classes.items():
                if word in entries:
                    out[name] = out.get(name, ()) + entries[word]
        return out


@cache
def looks() -> Looks:
    """The words that placegraph knows."""
    table = tomllib.loads(files(__package__).joinpath("data", "looks.toml").read_text("utf-8"))
    classes: dict[str, dict[str, tuple[str, ...]]] = {}
    for name, entries in table.items():
        known: dict[str, tuple[str, ...]] = classes.setdefault(name, {})
        for entry, value in entries.items() if name != "alike" else ():
            for word in value["words"] if isinstance(value, dict) else value:
                known[word] = (*known.get(word, ()), entry)
    alike = np.eye(len(COLOURS))
    for one, others in table["alike"].items():
        for other, share in others.items():
            i, j = COLOURS.index(one), COLOURS.index(other)
            alike[i, j] = alike[j, i] = share
    del classes["alike"]
    return Looks(
        shown={name: table["colours"][name]["shown"] for name in COLOURS},
        alike=alike,
        material_colours={name: e["colours"] for name, e in table["materials"].items()},
        classes=classes,
    )


@cache
def _words() -> frozenset[str]:
    return frozenset(
        w for kind, known in looks().classes.items() if kind != "places" for w in known
    )


def is_look(words: str) -> bool:
    """Whether words only say what a thing looks like."""
    return words in _words()


def leading(words: Sequence[str]) -> tuple[tuple[str, ...], int]:
    """Attributes that words begin with, and how many words they take; the last word is a thing."""
    found: list[str] = []
    at = 0
    while at < len(words) - 1:
        length = next(
            (
                n
                for n in range(min(_LONGEST, len(words) - 1 - at), 0, -1)
                if is_look(" ".join(words[at : at + n]))
            ),
            0,
        )
        if not length:
            break
        found.append(" ".join(words[at : at + length]))
        at += length
    return tuple(found), at


def trailing(words: Sequence[str]) -> tuple[tuple[str, ...], int]:
    """Colours that words end in ("sideboard pale green"), and how many words stand before them."""
    end = len(words)
    while end > 1 and words[end - 1] in looks().colours:
        end -= 1
    if end == len(words):
        return (), end
    while end > 1 and words[end - 1] in looks().classes["shades"]:
        end -= 1
    return tuple(words[end:]), end
