"""Languages: one table each of the words that say where things stand."""

from placegraph.outdoor.language.languages.language import Language, english, language, shipped

__all__ = ["Language", "english", "language", "shipped"]
