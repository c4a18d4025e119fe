"""Normal forms of words: one spelling for what people write in many ways."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Sequence

from placegraph.language.words import spelt

# fmt: off
ARTICLES = frozenset((
    "a", "an", "the", "some", "any", "der", "die", "das", "den", "dem", "des", "ein", "eine",
    "einen", "einem", "le", "la", "les", "l", "un", "une", "du", "el", "los", "las", "una", "unos",
    "unas", "il", "lo", "gli", "i", "uno", "o", "os", "as", "um", "uma", "de", "het", "een", "en",
    "et", "det", "els",
))
# fmt: on
"""Articles that may stand before a noun; English first, then languages quoted in English text."""

_POSSESSIVE = re.compile(r"'s\b|(?<=s)'(?!\w)")
_SEPARATORS = re.compile(
    r"[^\w\u0300-\u036f\u0591-\u05c7\u0610-\u061a\u064b-\u0670\u0900-\u109f\u1780-\u17ff]+|_"
)
"""What stands between words; marks that combine with Hebrew, Arabic, Indic, Thai letters do not."""
_LETTERS = str.maketrans(
    {
        "ı": "i",
        "ς": "σ",
        "ł": "l",
        "ø": "o",
        "đ": "d",
        "ð": "d",
        "þ": "th",
        "æ": "ae",
        "œ": "oe",
        "ß": "ss",
    }
)
_SPELLING = {
    "center": "centre",
    "centers": "centres",
    "theater": "theatre",
    "theaters": "theatres",
    "amphitheater": "amphitheatre",
    "jewellery": "jewelry",
    "jeweller": "jeweler",
    "jewellers": "jewelers",
    "tire": "tyre",
    "tires": "tyres",
    "curb": "kerb",
    "curbs": "kerbs",
    "neighborhood": "neighbourhood",
    "neighborhoods": "neighbourhoods",
    "harbor": "harbour",
    "harbors": "harbours",
    "parlour": "parlor",
    "gray": "grey",
    "catalog": "catalogue",
    "storey": "story",
    "multistorey": "multi story",
    "yoghurt": "yogurt",
    "doughnut": "donut",
    "doughnuts": "donuts",
    "labor": "labour",
    "organisation": "organization",
    "traveler": "traveller",
    "counseling": "counselling",
    "pediatrician": "paediatrician",
    "licence": "license",
    "bike": "bicycle",
    "bikes": "bicycles",
}
"""Words with two spellings or an everyday short form, so that "bike rental" needs no entry."""

_IRREGULAR = {
    "people": "person",
    "children": "child",
    "men": "man",
    "women": "woman",
    "feet": "foot",
    "teeth": "tooth",
    "leaves": "leaf",
    "shelves": "shelf",
    "buses": "bus",
    "busses": "bus",
    "gases": "gas",
    "heroes": "hero",
    "potatoes": "potato",
    "quizzes": "quiz",
    "mice": "mouse",
    "geese": "goose",
}
# fmt: off
_UNCHANGED = frozenset((
    "news", "series", "species", "swiss", "chess", "canvas", "christmas", "lens", "perhaps",
    "always", "across", "texas", "kansas", "les", "paris", "reis", "mars", "gross",
))
# fmt: on


def normal(phrase: str) -> str:
    """Return the normal form: case, punctuation, possessives and spelling variants removed.

    Applying it twice changes nothing.
    """
    phrase = phrase.replace("İ", "i").lower()
    if not phrase.isascii():
        phrase = unicodedata.normalize("NFKC", phrase).replace("’", "'").lower()
    if "'" in phrase:
        phrase = _POSSESSIVE.sub("", phrase)
    if "&" in phrase or "+" in phrase:
        phrase = phrase.replace("&", " and ").replace("+", " and ")
    words = _SEPARATORS.sub(" ", phrase).split()
    return " ".join([_SPELLING.get(word, word) for word in words])


def singular(phrase: str) -> str:
    """Return a normal form with every word in the singular, by the rules of English."""
    return " ".join([_singular(word) for word in phrase.split(" ")])


def _singular(word: str) -> str:
    if not word.endswith("s"):
        return _IRREGULAR.get(word, word)
    if word in _IRREGULAR:
        return _IRREGULAR[word]
    if len(word) < 4 or word.endswith(("ss", "us", "is")) or word in _UNCHANGED:
        return word
    if word.endswith("ies") and len(word) > 4:
        return word[:-3] + "y"
    if word.endswith(("ches", "shes", "sses", "xes", "zzes")):
        return word[:-2]
    return word[:-1]


def folded(phrase: str) -> str:
    """Return a normal form without diacritics: "café" -> "cafe", "kırtasiye" -> "kirtasiye"."""
    if phrase.isascii():
        return phrase
    parts = unicodedata.normalize("NFKD", spelt(phrase).translate(_LETTERS))
    bare = "".join([letter for letter in parts if not unicodedata.combining(letter)])
    return unicodedata.normalize("NFC", bare)


_ENDINGS = ("ed", "ing", "ly", "er", "est", "es", "s", "al", "ive")
ALIKE = 0.85
"""Similarity (Jaro-Winkler) from which a known word is worth suggesting."""
LONG = 8
"""Letters of words in which two letters may differ."""


def corrected(form: str, choices: Sequence[str]) -> tuple[str, float] | None:
    """The choice that a word is a misspelling of, and how near it is (Jaro-Winkler)."""
    from rapidfuzz import process
    from rapidfuzz.distance import OSA, JaroWinkler

    near = process.extract(
        form,
        choices,
        scorer=OSA.distance,
        score_cutoff=2 if len(form) >= LONG else 1,
        limit=None,
    )
    return max(
        ((word, JaroWinkler.similarity(form, word)) for word, *_ in near if _slip(form, word)),
        key=lambda found: found[1],
        default=None,
    )


def similar(form: str, choices: Sequence[str]) -> list[str]:
    """At most two choices that a word looks like, the likest first."""
    from rapidfuzz import process
    from rapidfuzz.distance import JaroWinkler

    scorer = JaroWinkler.similarity
    near = process.extract(form, choices, scorer=scorer, score_cutoff=ALIKE, limit=8)
    return list(dict.fromkeys(word for word, *_ in near))[:2]


def _slip(typed: str, meant: str) -> bool:
    """Tell whether one word may be a misspelling of another.

    In a short word a letter replaced is another word more often than a slip ("like", "line"), and
    so is another ending ("poster", "posted").
    """
    from rapidfuzz.distance import Prefix

    if typed[0] != meant[0] or singular(typed) == singular(meant):
        return False
    replaced = len(typed) == len(meant) and sorted(typed) != sorted(meant)
    if replaced and len(typed) < LONG - 1:
        return False
    stem = Prefix.similarity(typed, meant)
    return not any(typed[stem:].endswith(ending) and len(typed) - stem <= 4 for ending in _ENDINGS)


def beginnings(phrases: Iterable[str]) -> frozenset[str]:
    """All proper beginnings of phrases, word by word."""
    found = set()
    for phrase in phrases:
        at = phrase.find(" ")
        while at > 0:
            found.add(phrase[:at])
            at = phrase.find(" ", at + 1)
    return frozenset(found)
