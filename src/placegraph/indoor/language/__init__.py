"""Sentences about places indoors: where one is, and what a room holds.

`read` turns English into a `Sentence`: statements about things, and what was left unread. On a scene
map it is a log prior over positions and headings (`prior`); of scene graphs `score` says how well
they answer it, and for many of them `rank_scenes` and `TextIndex`.
"""

from __future__ import annotations

from placegraph.indoor.language.reader import read
from placegraph.indoor.language.score import Score, TextIndex, rank_scenes, score
from placegraph.indoor.language.sentence import ME, Kind, Mention, Sentence, Statement

__all__ = [
    "ME", "Kind", "Mention", "Score", "Sentence", "Statement", "TextIndex", "rank_scenes", "read",
    "score",
]  # fmt: skip
