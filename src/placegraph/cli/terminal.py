"""What reaches the terminal: names of maps and files are shown, and steer nothing.

A name may hold what moves the cursor, colours what follows, or turns the direction of reading. All
that is printed goes through here, into pipes too, and such characters come out as escapes that JSON
reads back as what they were.
"""

from __future__ import annotations

import re
import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TextIO

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

_STEERING = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]"
)
"""Control characters but tab and end of line, what separates lines, marks of direction, and halves of a
character: bytes of a file's name that are no UTF-8."""


def harmless(text: str) -> str:
    """Text with characters that steer a terminal as escapes of JSON."""
    return _STEERING.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


class _Guarded:
    """A stream to which only harmless text is written; all else of it is the stream's own."""

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        """Write text; a carriage return before an end of line is part of that."""
        if not isinstance(text, str):
            raise TypeError(f"{type(text).__name__} is no text")
        self.stream.write(harmless(text.replace("\r\n", "\n")))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        """Write one after the other."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401  # the stream's
        return getattr(self.stream, name)


@contextmanager
def guarded() -> Iterator[None]:
    """Within it, what is written to stdout and stderr is harmless."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (_Guarded(stream) for stream in before)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before


def bare(stream: TextIO) -> TextIO:
    """The stream itself, for who steers the terminal on purpose and takes only `harmless` text."""
    return stream.stream if isinstance(stream, _Guarded) else stream
