"""Words of relations and attributes that the network counts: those of 3DSSG (SPEC, 9)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from placegraph.errors import InputError
from placegraph.indoor.map.relations import ABOVE, NEXT_TO

if TYPE_CHECKING:
    from os import PathLike

NONE = "none"
RELATIONS = (
    NONE, "supported by", "left", "right", "front", "behind", "close by", "inside", "bigger than",
    "smaller than", "higher than", "lower than", "same symmetry as", "same as", "attached to",
    "standing on", "lying on", "hanging on", "connected to", "leaning against", "part of",
    "belonging to", "build in", "standing in", "cover", "lying in", "hanging in", "same color",
    "same material", "same texture", "same shape", "same state", "same object type", "messier than",
    "cleaner than", "fuller than", "more closed", "more open", "brighter than", "darker than",
    "more comfortable than",
)  # fmt: skip
"""3DSSG's relations, in the order of its `relationships.txt`."""

_ROW = {word: row for row, word in enumerate(RELATIONS)} | {
    # ours that 3DSSG says otherwise; "same room" it does not say
    NEXT_TO: RELATIONS.index("close by"),
    ABOVE: RELATIONS.index("higher than"),
}


def relation_row(relation: str) -> int | None:
    """Row of an edge's name in `RELATIONS`; None where 3DSSG has nothing like it."""
    return _ROW.get(relation.strip().lower())


def read_attributes(path: str | PathLike[str]) -> tuple[str, ...]:
    """Attribute words in their order: a JSON list, or a text file with one a line.

    The published network counts the 164 of `obj_attr.pkl`, which comes with SGAligner's data:
    write its words in such a file. Raises `InputError` where the file is missing, empty, no text,
    or names a word twice.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
        listed = json.loads(text) if text.lstrip().startswith("[") else text.splitlines()
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: no list of attributes ({str(error)[:100]}); give a text file, a word a line."
        ) from error
    if not all(isinstance(word, str) for word in listed):
        raise InputError(f"{path}: an attribute is no word; give a list of words.")
    words = tuple(word.strip().lower() for word in listed if word.strip())
    if not words or len(set(words)) < len(words):
        what = "holds no words" if not words else "names a word twice"
        raise InputError(f"{path}: {what}; give every attribute once, in their order.")
    return words
