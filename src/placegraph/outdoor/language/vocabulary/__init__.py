"""The vocabulary: what on a map is worth naming, and which words name it."""

from placegraph.outdoor.language.vocabulary.vocabulary import LONGEST, Vocabulary

__all__ = ["LONGEST", "Vocabulary"]
