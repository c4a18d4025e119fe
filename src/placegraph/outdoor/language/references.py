"""References: which words speak of the same thing."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from placegraph.language.text import Ignored
from placegraph.outdoor.language.chunks import LONGEST_NOUN
from placegraph.outdoor.language.description import LISTENER, SPEAKER, Mention, Sense
from placegraph.outdoor.language.words import Words, normalise, tokens

if TYPE_CHECKING:
    from placegraph.outdoor.language.grammar import NounPhrase
    from placegraph.outdoor.language.languages import Language

_NEW = frozenset(("A", "ANOTHER", "NO", "NUM"))
"""Determiners that introduce a thing; the others, and none, may speak of one already known."""
TYPING_ERROR = 0.8
"""Similarity from which an unknown word counts as a misspelt known one."""
GENERIC = 0.7
"""How surely a "sandwich place" is what "sandwich" alone stands for."""


class References:
    """The mentions of a text, in the order in which they are introduced.

    Parameters
    ----------
    vocabulary
        To mend misspelt words.
    """

    def __init__(self, text: str, language: Language, vocabulary: Words) -> None:
        self.text, self.language, self.vocabulary = text, language, vocabulary
        self.lists = language.lists
        self.mentions: list[Mention] = [Mention(SPEAKER, "I"), Mention(LISTENER, "you")]
        self.heads: list[str] = ["", ""]
        """Common noun of every mention, in the singular."""
        self.modifiers: list[frozenset[str]] = [frozenset(), frozenset()]
        """Words before the noun."""
        self.negative: set[int] = set()
        """Mentions of what is said not to be there."""
        self.kinds: set[int] = set()
        """Mentions by a label as a map has it, which stands for any thing of its kind."""
        self.topic: int | None = None
        """What "it" means."""
        self.street: int | None = None
        """The street that was spoken of last."""

    def resolve(self, thing: NounPhrase, *, other_than: Iterable[int] = ()) -> int | None:
        """Return the node of a thing; None for a part ("the corner") that is no thing itself."""
        if thing.kind in ("ME", "SPOT", "HERE"):
            return SPEAKER
        if thing.kind == "YOU":
            return LISTENER
        if thing.kind == "IT":
            return SPEAKER if self.topic is None else self.topic
        if thing.part and not thing.name:
            return None
        head, senses = _lemma(thing.head), thing.senses
        if not senses and not thing.name:
            head, senses = self._mend(thing.head)
            if not senses and not thing.determiner:
                return None  # an unknown word, and no sign that it is a noun
        known = None if thing.determiner in _NEW else self._find(thing, head, senses, other_than)
        return self._introduce(thing, head, senses) if known is None else known

    def _mend(self, words: str) -> tuple[str, tuple[Sense, ...]]:
        """Return noun and senses of unknown words: misspelt, or before a noun that says nothing."""
        if len(words) > LONGEST_NOUN:
            return words, ()
        whole = self.vocabulary.senses(words)
        if whole and " " in words:
            return _lemma(words), whole
        rest, _, last = words.rpartition(" ")
        found = self.vocabulary.closest(last, cutoff=TYPING_ERROR)
        if found is None and rest and last in self.lists["generic"]:
            found = (rest.rpartition(" ")[2], GENERIC)
        if found is None:
            return _lemma(last), ()
        senses = self.vocabulary.senses(found[0])
        return _lemma(found[0]), tuple([Sense(s.label, s.weight * found[1]) for s in senses])

    def _find(
        self, thing: NounPhrase, head: str, senses: tuple[Sense, ...], other_than: Iterable[int]
    ) -> int | None:
        """Return the mention that a name or a definite noun speaks of again, or None."""
        skipped = {*other_than, *self.negative}
        nodes = [n for n in range(len(self.mentions) - 1, LISTENER, -1) if n not in skipped]
        if thing.name:
            name = name_key(thing.name)
            return next((n for n in nodes if name_key(self.mentions[n].name) == name), None)
        modifiers = frozenset(thing.modifiers) - {"same"}
        for n in nodes:  # "the lot" is the parking lot
            longer = not thing.exact and self.heads[n].endswith(f" {head}")
            if (longer or self.heads[n] == head) and modifiers <= self.modifiers[n]:
                return n
        if thing.exact:
            return None
        if head in self.lists["roads"]:
            if self.street is not None and self.street not in skipped:
                return self.street
            return next((n for n in nodes if self.is_road(n)), None)
        labels = {sense.label for sense in senses[:2]}
        for n in nodes:
            mention = self.mentions[n]
            if mention.name and labels & {sense.label for sense in mention.senses[:2]}:
                return n
        return None

    def _introduce(self, thing: NounPhrase, head: str, senses: tuple[Sense, ...]) -> int:
        node = len(self.mentions)
        words = self.text[thing.start : thing.end]
        definite = thing.determiner in ("DET", "THIS", "MY", "YOUR", "ITS") or bool(thing.name)
        count = thing.count if thing.count is not None and thing.count >= 2 else None
        self.mentions.append(Mention(node, words, senses, thing.name, count, definite))
        self.heads.append(head)
        self.modifiers.append(frozenset(thing.modifiers) - {"same"})
        if thing.exact and not thing.name:
            self.kinds.add(node)
        if thing.determiner == "NO":
            self.negative.add(node)
        if self.is_road(node):
            self.street = node
        return node

    def list_unknown(self) -> list[Ignored]:
        """Return the things of which nothing is known, each with the reason."""
        return [
            Ignored(mention.words, self.vocabulary.unknown(self.heads[mention.id]))
            for mention in self.mentions
            if mention.id > LISTENER and not mention.senses and not mention.name
        ]

    def is_known(self, node: int) -> bool:
        """Tell whether a mention has a name, or a noun that a map knows."""
        return bool(self.mentions[node].senses or self.mentions[node].name)

    def is_road(self, node: int) -> bool:
        """Tell whether a mention is a street, by its name or its noun."""
        name = tokens(self.mentions[node].name)
        if len(name) > 2 and name[0].isdecimal():
            return False  # a house: "125 Main Street"
        return self.heads[node] in self.lists["roads"] or self.language.is_road(name)

    def is_line(self, node: int) -> bool:
        """Tell whether a mention is a road, a river or another line, on which one is along it."""
        if node <= LISTENER:
            return False
        key, value = self._first_label(node)
        lists = self.lists
        return self.is_road(node) or (key in lists["line_keys"] and value not in lists["no_lines"])

    def is_area(self, node: int) -> bool:
        """Tell whether a mention is a park, a square or another area, on which one is inside."""
        return self._first_label(node)[0] in self.lists["area_keys"]

    def _first_label(self, node: int) -> tuple[str, str]:
        senses = self.mentions[node].senses
        key, _, value = senses[0].label.partition("=") if senses else ("", "", "")
        return key, value


def name_key(name: str) -> str:
    """Return a name in normal form, without an article."""
    return normalise(name).removeprefix("the ")


def _lemma(noun: str) -> str:
    """Return the singular of a noun, by the rules that cover nearly all names of things."""
    if noun.endswith("ies") and len(noun) > 4:
        return noun[:-3] + "y"
    if noun.endswith(("ches", "shes", "xes", "sses")):
        return noun[:-2]
    if noun.endswith("s") and not noun.endswith(("ss", "us")):
        return noun[:-1]
    return noun
