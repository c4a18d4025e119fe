"""The vocabulary: what on a map is worth naming, and which words name it."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

from placegraph.outdoor.vocabulary.objects import ObjectTable, read_objects
from placegraph.outdoor.vocabulary.tables import user_folder

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["Vocabulary"]


class Vocabulary:
    """What on a map is worth naming, and which words name it."""

    def __init__(self, objects: ObjectTable) -> None:
        self._objects = objects
        self.keys = objects.keys
        self.detail_keys = objects.detail_keys
        self.labels_of = objects.labels_of

    @staticmethod
    @lru_cache(maxsize=1)
    def default() -> Vocabulary:
        """Return the vocabulary that comes with placegraph."""
        return Vocabulary(read_objects())

    @staticmethod
    def load(path: str | Path) -> Vocabulary:
        """Read a user's folder of edited tables; tables missing there are taken as shipped."""
        return Vocabulary(read_objects(user_folder(path)))
