"""Languages: one table each of the words that say where things stand."""

from placegraph.outdoor.language.languages.language import Language, codes, english, language

__all__ = ["Language", "codes", "english", "language"]
