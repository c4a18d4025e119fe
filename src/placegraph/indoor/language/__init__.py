"""Sentences about places indoors: where one is, and what a room holds.

`read` turns English into a `Sentence`: statements about things, and what was left unread. On a scene
map it is a log prior over positions and headings (`Sentence.prior`); of scene graphs it says how well
they answer it (`Sentence.score`, `rank`, and for many of them `TextIndex`).
"""

from __future__ import annotations

from placegraph.indoor.language.index import TextIndex, rank
from placegraph.indoor.language.read import read
from placegraph.indoor.language.score import Score
from placegraph.indoor.language.sentence import ME, Kind, Mention, Sentence, Statement

__all__ = ["ME", "Kind", "Mention", "Score", "Sentence", "Statement", "TextIndex", "rank", "read"]
