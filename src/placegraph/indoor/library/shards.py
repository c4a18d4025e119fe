"""A library too large to be read: shards that are mapped, and few scenes looked at closely.

An inverted index over labels and relations ranks all scenes by a text; what the labels of frames say
is summed over all scenes, and their looks over the mean vector of each. The best by either are
then compared with the frames in every direction, beside the same homes that no library has.
"""

from __future__ import annotations

import itertools
import json
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.earth import EarthPose
from placegraph.errors import InputError, MapError, OptionError
from placegraph.estimate import SceneEstimate, SceneMode
from placegraph.indoor.encode import encoder
from placegraph.indoor.language import read, score
from placegraph.indoor.language.score import compared, of_scenes
from placegraph.indoor.library.answer import UNKNOWN, judge, posterior
from placegraph.indoor.library.library import SceneLibrary
from placegraph.indoor.library.options import SearchOptions
from placegraph.indoor.library.query import encode
from placegraph.indoor.library.scenes import digest_of
from placegraph.indoor.library.search import Scores, scores
from placegraph.indoor.library.shard import Shard, Usual, together
from placegraph.indoor.library.shard_file import BESIDE, HEAD, USUAL, map_shard, unpacked
from placegraph.indoor.likelihood.observe import spread
from placegraph.indoor.pose.query import chosen_frames
from placegraph.indoor.scene_map import SceneMap

if TYPE_CHECKING:
    import os
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from placegraph.estimate import Evidence, PoseEstimate
    from placegraph.formats.capture.capture import Capture
    from placegraph.formats.capture.frame import Frame
    from placegraph.indoor.encode import Encoder
    from placegraph.indoor.language import Sentence
    from placegraph.indoor.library.query import Query

CLOSELY = 500
"""Scenes compared with frames in every direction, of each way to find them."""


def is_shards(path: str | os.PathLike[str]) -> bool:
    """Whether a folder is one that `write_shards` wrote."""
    return (Path(path) / USUAL / HEAD).is_file()


@dataclass(frozen=True, eq=False)
class SceneShards:
    """Scenes in shards, searched by a capture or a text; `shard_columns.write_shards` makes them."""

    folder: Path
    encoders: tuple[Encoder, ...]
    usual: Usual
    shards: tuple[Shard, ...]
    beside: Shard
    """Homes that no library has."""

    @classmethod
    def open(
        cls, folder: str | os.PathLike[str], *, encoders: Sequence[Encoder] = ()
    ) -> SceneShards:
        """Map the shards of a folder; nothing but their heads is read.

        `encoders`: those that cannot be made by name alone.

        Raises
        ------
        InputError
            The folder is none of shards.
        MapError
            A shard is damaged, or of other encoders.

        """
        folder = Path(folder)
        meta, arrays = map_shard(folder / USUAL)
        made = {e.key: e for e in encoders}
        try:
            told = [(str(e["name"]), str(e["key"])) for e in meta["encoders"]]
        except (LookupError, TypeError) as error:
            raise MapError(f"{folder} names no encoders; make the shards again.") from error
        known = tuple(made.get(key) or encoder(name) for name, key in told)
        if [e.key for e in known] != [key for _, key in told]:
            raise MapError(
                f"{folder} was encoded by others; open it with encoders=..., or make it again."
            )
        keys = [key for _, key in told]
        found = sorted(p for p in folder.iterdir() if p.is_dir() and p.name.isdigit())
        count = meta.get(
            "shards", len(found)
        )  # more are of another library, which lay there before
        if not (isinstance(count, int) and 0 < count <= len(found)):
            raise InputError(f"{folder} holds {len(found)} shards of {count}; make it again.")
        usual = Usual(meta, arrays, keys)
        of = partial(Shard, usual=usual)
        return cls(
            folder, known, usual, tuple(of(*map_shard(p)) for p in found[:count]),
            of(*map_shard(folder / BESIDE)),
        )  # fmt: skip

    @cached_property
    def starts(self) -> NDArray[np.int64]:
        """(H + 1,) first scene of each shard."""
        return np.concatenate([[0], np.cumsum([len(s) for s in self.shards])])

    def __len__(self) -> int:
        return int(self.starts[-1])

    def __repr__(self) -> str:
        return f"SceneShards({len(self):,} scenes in {len(self.shards)} shards)"

    def name(self, row: int) -> str:
        """Name of a scene."""
        return self._string(row, "names")

    def path(self, row: int) -> Path | None:
        """Map file of a scene, None where there is none."""
        told = self._string(row, "paths")
        return (self.folder / told).resolve() if told else None

    def library(self, rows: Iterable[int]) -> SceneLibrary:
        """Library of some scenes, of their map files: to find a pose in those that a search named."""
        out = SceneLibrary(self.encoders)
        for row in rows:
            path = self.path(row)
            if path is None:
                raise InputError(f"{self.name(row)}: the shards know no map file of it.")
            if digest_of(path) != self._string(row, "digests"):
                raise MapError(f"{path} is another map than was added; make the shards again.")
            out.add(self.name(row), path)
        return out

    def localize(
        self,
        capture: Capture | Sequence[Frame],
        *,
        most: int = 8,
        **options: Any,  # noqa: ANN401
    ) -> PoseEstimate:
        """Scene and pose of a capture: the likeliest scenes as a library, and a pose in these.

        Options and errors: `SceneLibrary.localize`, and those of `library`.
        """
        found = self.search(capture, frames=options.get("frames"), most=most)
        return self.library(found.stats["rows"]).localize(capture, most=most, **options)

    def search(
        self,
        query: str | Capture | Sequence[Frame],
        *,
        frames: slice | Sequence[int] | None = None,
        options: SearchOptions | None = None,
        most: int = 10,
        closely: int = CLOSELY,
    ) -> SceneEstimate:
        """Which scenes a capture was taken in, or a text describes, likeliest first.

        Parameters and errors as of `SceneLibrary.search`; `closely`: of so many scenes by labels, and
        as many by looks, frames are compared with what lies in every direction.
        """
        if most < 1:
            raise OptionError(f"most is {most}; ask for at least one scene.")
        if isinstance(query, str):
            return self._by_text(query, most)
        options = options or SearchOptions()
        chosen = chosen_frames(query, frames)
        chosen = [chosen[i] for i in spread(len(chosen), options.looks)]
        return self.by_query(encode(chosen, self.encoders), options, most, closely)

    def by_query(
        self, query: Query, options: SearchOptions, most: int = 10, closely: int = CLOSELY
    ) -> SceneEstimate:
        """`search` of frames that have been encoded."""
        start = perf_counter()
        rows = self._candidates(query, options, closely)
        found_in = perf_counter() - start
        index = together([*self._picked(rows), (self.beside, np.arange(len(self.beside)))])
        near = scores(index, query, replace(options, shortlist=len(index)))
        total = np.full(len(self) + len(self.beside), near.total.min())
        total[np.append(rows, np.arange(len(self), len(total)))] = near.total
        share, elsewhere = posterior(Scores(total, near.heat, {}), np.zeros(len(self)))
        seconds = {"candidates": found_in} | near.seconds
        return self._estimate(share, total, elsewhere, most, seconds, None)

    def _candidates(self, query: Query, options: SearchOptions, closely: int) -> NDArray[np.int64]:
        """Rows of the scenes that are looked at: the best by labels, and the best by looks."""
        ways = [
            np.concatenate(found)
            for found in zip(*(s.promising(query, options) for s in self.shards), strict=True)
            if found[0] is not None
        ]
        best = [np.argpartition(-w, min(closely, len(w)) - 1)[:closely] for w in ways]
        return np.unique(np.concatenate(best))

    def _picked(self, rows: NDArray[np.int64]) -> list[tuple[Shard, NDArray[np.int64]]]:
        at = np.searchsorted(rows, self.starts)
        return [
            (shard, rows[first:last] - self.starts[i])
            for i, (shard, (first, last)) in enumerate(
                zip(self.shards, itertools.pairwise(at.tolist()), strict=True)
            )
            if last > first
        ]

    def _by_text(self, text: str, most: int) -> SceneEstimate:
        start = perf_counter()
        sentence = read(text)
        if not sentence.statements:
            raise OptionError(
                f"{text!r} says nothing of a place; name a room, things in it, how many, or how they "
                "stand to each other."
            )
        total = self.text_scores(sentence)
        logs = np.append(total, np.log(UNKNOWN / (1.0 - UNKNOWN) * len(total)))
        share = np.exp(logs - logs.max())
        share /= share.sum()
        seconds = {"text": perf_counter() - start}
        return self._estimate(share[:-1], total, float(share[-1]), most, seconds, sentence)

    def text_scores(self, sentence: Sentence) -> NDArray[np.float64]:
        """Log-likelihood ratio (n,) of each scene against what is usual [nat]."""
        usual = self.usual.columns
        parts = [
            of_scenes(sentence, s.columns, compared(sentence, s.columns, usual).sum(axis=0))[0]
            for s in self.shards
        ]
        return np.concatenate(parts)

    def _estimate(
        self,
        share: NDArray[np.float64],
        total: NDArray[np.float64],
        elsewhere: float,
        most: int,
        seconds: dict[str, float],
        sentence: Sentence | None,
    ) -> SceneEstimate:
        few = min(most, len(share))
        best = np.argpartition(-share, few - 1)[:few]
        best = best[np.lexsort((best, -share[best]))]
        modes = tuple(
            self._mode(int(row), float(share[row]), float(total[row]), sentence) for row in best
        )
        status, reason = judge(modes, elsewhere)
        stats: dict[str, Any] = {
            "seconds": {k: round(v, 5) for k, v in seconds.items()},
            "rows": [int(row) for row in best],
        }
        return SceneEstimate(status, modes, reason, elsewhere, stats)

    def _mode(self, row: int, share: float, total: float, sentence: Sentence | None) -> SceneMode:
        poses = [EarthPose.from_dict(p) for p in json.loads(self._string(row, "earth") or "[]")]
        earth = tuple(replace(p, probability=p.probability * share) for p in poses)
        explain = partial(self._told, row, sentence)
        return SceneMode(self.name(row), share, total, earth, explain=explain)

    def _told(self, row: int, sentence: Sentence | None) -> tuple[Evidence, ...]:
        """What each statement says of a scene, by its map, where that is there."""
        path = self.path(row)
        if sentence is None or path is None or not path.exists():
            return ()
        return score(sentence, SceneMap.open(path)).evidence

    def _string(self, row: int, column: str) -> str:
        shard = int(np.searchsorted(self.starts, row, "right")) - 1
        if not 0 <= row < len(self):
            raise OptionError(f"row is {row}; there are {len(self)} scenes.")
        arrays = self.shards[shard].arrays
        return unpacked(arrays[column], arrays[f"{column}_starts"], row - int(self.starts[shard]))
