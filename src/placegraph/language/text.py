"""Text as both wings read it: what can be read at all, sentences of words, and phrases of a language."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from placegraph.errors import DescriptionError
from placegraph.language.measures import MEASURE, may_measure, metres

LONGEST_TEXT = 20_000
"""Characters."""
_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f\x80-\x84\x86-\x9f\ud800-\udfff]")


@dataclass(frozen=True, slots=True)
class Ignored:
    """A stretch of the text that was not used, and why."""

    text: str
    reason: str


def check_text(text: str, example: str = "A bakery is north of me.") -> None:
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


class Word(NamedTuple):
    """A word, a distance or a mark of a text."""

    kind: str
    """``word``, ``label`` (``amenity=bench``, ``bicycle_parking``), ``measure`` or ``comma``."""
    lower: str
    """Lower-case, apostrophes straight."""
    capital: bool
    """Whether it starts with a capital letter."""
    start: int
    end: int
    metres: float = 0.0
    """Of a measure."""


_UNMEASURED = r"""
    (?P<label>[^\W\d]\w*=[\w*][\w:;-]* | [^\W_][^\s_]*_\S*[^\s.,;:!?])
  | (?P<word>[^\W_]+(?:['’`´][^\W_]+)*|&)
  | (?P<comma>[,:()\[\]–—/]|\s--?\s)
  | (?P<stop>[.!?;…]+|\n\s*\n)
"""
_PLAIN, _SCAN = (
    re.compile(pattern, re.VERBOSE | re.IGNORECASE)
    for pattern in (_UNMEASURED, f"(?P<measure>{MEASURE}) | {_UNMEASURED}")
)
_OPENS = re.compile(
    r"\s*(?:$|\n|(?:It|The|There|This|That|You|Your|I|If|When|We|They|On|In|At|Go|Head|Meet|Cross"
    r"|An?|Across|To|My|From|Turn|Walk|Look|Next|Its|Theres|After|Before|Once|Then"
    r"|Keep|Continue|Follow|Pass|Take|Stop|Come|Get|And|But|So|Our)\b(?!\s+[A-Z])"
    r"|(?:It|I|There|You|Let|That|We|They)['’])"
)
"""What opens a new sentence even after a word that a full stop may shorten."""


_MIXED = str.maketrans("أإآٱىیةک", "ااااييهك")
"""Letters of Arabic that people write for each other."""


def fold_case(word: str) -> str:
    """Return a word in lower case, with one apostrophe and one of the letters that Arabic mixes up."""
    word = word.lower()
    return word if word.isascii() else word.replace("’", "'").translate(_MIXED)


def scan_text(
    text: str,
    labels: Iterable[tuple[int, int]] = (),
    *,
    shortened: Collection[str] = (),
    begin: int = 0,
) -> list[list[Word]]:
    """Cut a text into sentences of words, distances and marks.

    Parameters
    ----------
    labels
        (start, end) of stretches that are one label each, in order.
    shortened
        Words that a full stop may shorten without ending the sentence: "St. Mary's".
    """
    sentences: list[list[Word]] = [[]]
    at = begin
    for start, end in (*labels, (len(text), len(text))):
        _scan_between(text, at, start, sentences, shortened)
        if end > start:
            label = text[start:end]
            sentences[-1].append(Word("label", label.lower(), label[0].isupper(), start, end))
        at = end
    return [sentence for sentence in sentences if sentence]


def _scan_between(
    text: str, begin: int, stop: int, sentences: list[list[Word]], shortened: Collection[str]
) -> None:
    pattern = _SCAN if may_measure(text[begin:stop]) else _PLAIN
    for match in pattern.finditer(text, begin, stop):
        kind, written = match.lastgroup or "", match.group()
        start, end = match.span()
        if kind == "stop":
            if _ends_sentence(text, end, written, sentences[-1], shortened):
                sentences.append([])
            continue
        length = metres(written, match["number"]) if kind == "measure" else 0.0
        lower = fold_case(written)
        sentences[-1].append(Word(kind, lower, written[0].isupper(), start, end, length))


def _ends_sentence(
    text: str, end: int, mark: str, sentence: list[Word], shortened: Collection[str]
) -> bool:
    if mark != ".":
        return True
    if end < len(text) and not text[end].isspace() and text[end] not in "\"')”’":
        return False
    return not (sentence and sentence[-1].lower in shortened and not _OPENS.match(text, end))


class Terminal(NamedTuple):
    """Terminal of the grammar that a phrase stands for, and what it carries."""

    type: str
    value: Any = None


class Phrases:
    """Phrases by their first word, longest first.

    Parameters
    ----------
    known
        Terminals of each phrase, by its words in lower case.
    """

    def __init__(self, known: Mapping[tuple[str, ...], tuple[Terminal, ...]]) -> None:
        first: dict[str, list[tuple[tuple[str, ...], tuple[Terminal, ...]]]] = {}
        for words in sorted(known, key=len, reverse=True):
            first.setdefault(words[0], []).append((words, known[words]))
        self.by_word = {word: tuple(entries) for word, entries in first.items()}
        self._known = known
        self._lengths = {
            word: sorted({len(words) for words, _ in entries}, reverse=True)
            for word, entries in first.items()
        }

    def longest(self, words: Sequence[str], start: int) -> tuple[int, tuple[Terminal, ...]] | None:
        """Return the number of words of the longest phrase that begins at `start`, and its terminals."""
        for n in self._lengths.get(words[start], ()):
            phrase = tuple(words[start : start + n])
            if phrase in self._known:
                return len(phrase), self._known[phrase]
        return None
