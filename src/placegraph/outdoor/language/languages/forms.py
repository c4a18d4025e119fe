"""Forms of words: endings are cut, so that "kirkosta" meets "kirkko" and says that it is "from" it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any, NamedTuple

from placegraph.outdoor.language.vocabulary.text import folded

_SYLLABLES = "\u1100"
"""From here on a letter is a syllable or more, as in Korean."""
_FOLLOWING = 3
"""So many letters may stand behind a change of a stem: Kirch|e, Wald -> Wäld|er."""
_MEMORY = 1 << 14


class Form(NamedTuple):
    """A word of a text as what it may be a form of."""

    stem: str
    case: tuple[str, ...] = ()
    """Terminals that its ending stands for: ``("FROM",)``; none for a mere plural or accusative."""


class Forms:
    """Cuts the endings of a language, of its texts and of its dictionary alike.

    Parameters
    ----------
    table
        ``endings``: endings of a text's words, by the terminals that they stand for (``""`` for
        none); ``nominative``: endings of dictionary words; ``changes``: how a stem changes before an
        ending, as "kk>k"; ``irregular``: further stems of dictionary words, as "joki>joe".
    """

    def __init__(self, table: Mapping[str, Any]) -> None:
        self.endings = sorted(
            (
                (folded(ending), tuple(key.split()))
                for key, endings in table.get("endings", {}).items()
                for ending in endings
            ),
            key=lambda entry: len(entry[0]),
        )
        self._nominative = [folded(ending) for ending in table.get("nominative", ())]
        self._changes = [tuple(folded(change).split(">")) for change in table.get("changes", ())]
        self._irregular: dict[str, list[str]] = {}
        for pair in table.get("irregular", ()):
            word, _, stem = folded(pair).partition(">")
            self._irregular.setdefault(word, []).append(stem)
        self.of = lru_cache(_MEMORY)(self._of)
        self.stems = lru_cache(_MEMORY)(self._stems)

    def __bool__(self) -> bool:
        return bool(self.endings or self._nominative)

    def _of(self, word: str) -> tuple[Form, ...]:
        """What a word of a text, without diacritics, may be a form of; the word itself first."""
        found = [Form(word)]
        for ending, case in self.endings:
            stem = word[: -len(ending)]
            if _is_stem(stem) and word.endswith(ending):
                found.append(Form(stem, case))
        return tuple(found)

    def _stems(self, word: str) -> tuple[str, ...]:
        """Stems to which endings of a text are added to make forms of a dictionary word."""
        found = [word, *self._irregular.get(word, ())]
        found += [
            word[: -len(ending)]
            for ending in self._nominative
            if word.endswith(ending) and _is_stem(word[: -len(ending)])
        ]
        for old, new in self._changes:
            for stem in tuple(found):
                at = stem.rfind(old)
                if at > 0 and len(stem) - at - len(old) <= _FOLLOWING:
                    found.append(stem[:at] + new + stem[at + len(old) :])
        return tuple(dict.fromkeys(found))

    def dictionary(self, word: str) -> tuple[Form, ...]:
        """Words that a form may belong to, guessed without a dictionary: for names of a map."""
        found = []
        for stem, case in self.of(word):
            ends = ("", *self._nominative) if len(stem) < len(word) else ("",)
            found += [Form(stem + end, case) for end in ends]
            for old, new in self._changes:
                at = stem.rfind(new)
                if len(stem) < len(word) and at > 0 and len(stem) - at - len(new) <= _FOLLOWING:
                    found.append(Form(stem[:at] + old + stem[at + len(new) :], case))
        return tuple(dict.fromkeys(found))


def _is_stem(word: str) -> bool:
    """Tell whether letters may be a stem: two of them, or a syllable."""
    return len(word) > 1 or word >= _SYLLABLES
