"""Descriptions of places in free text: from words to a query graph (Eq. 3-4)."""

from placegraph.outdoor.language.build import describe
from placegraph.outdoor.language.language_model import LanguageModelDescriber
from placegraph.outdoor.language.words import NameFinder, normalise, tokens

__all__ = [
    "LanguageModelDescriber",
    "NameFinder",
    "describe",
    "normalise",
    "tokens",
]
