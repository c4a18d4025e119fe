"""What can be read as a description at all, and what was left unread."""

from __future__ import annotations

import re
from dataclasses import dataclass

from placegraph.errors import DescriptionError

LONGEST_TEXT = 20_000
"""Characters."""
_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f\x80-\x84\x86-\x9f\ud800-\udfff]")


@dataclass(frozen=True, slots=True)
class Ignored:
    """A stretch of the text that was not used, and why."""

    text: str
    reason: str


def check(text: str, example: str = "A bakery is north of me.") -> None:
    """Refuse what is no readable text.

    `example`: what a description is like, for the message to somebody who gave none.

    Raises
    ------
    DescriptionError
        If it is empty, longer than `LONGEST_TEXT`, or no text; says how to mend it.
    """
    if not isinstance(text, str):
        raise DescriptionError(
            f"The description is of type {type(text).__name__}, not text; pass a str."
        )
    if len(text) > LONGEST_TEXT:
        raise DescriptionError(
            f"The description has {len(text):,} characters, more than {LONGEST_TEXT:,};"
            " keep what describes the place."
        )
    if not text.strip():
        raise DescriptionError(
            f'The description is empty; say what stands around you, as in "{example}"'
        )
    control = _CONTROL.search(text)
    if control is not None:
        raise DescriptionError(
            f"The description contains {control[0]!r}, which is no character of a text, at position"
            f" {control.start()}; is it a file of another kind? Remove it."
        )
