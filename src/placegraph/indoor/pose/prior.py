"""Location priors of a pose: a Gaussian, a description, and shares of merged scenes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.estimate import Evidence
from placegraph.core.geometry import Floats
from placegraph.errors import OptionError
from placegraph.indoor.likelihood.visibility import VisibilityTable
from placegraph.indoor.map.map_kernels import AZIMUTHS, STEP
from placegraph.indoor.map.scene import Scene

if TYPE_CHECKING:
    from placegraph.indoor.language import Sentence


@dataclass(frozen=True, slots=True)
class Prior:
    """Gaussian location prior of the first frame."""

    x: float
    y: float
    z: float | None = None
    """[m, map]; None: one of the camera heights."""
    yaw: float | None = None
    """[rad]; None: any."""
    spread: float = 1.0
    """Standard deviation of the position [m]."""
    turn: float = 0.3
    """Standard deviation of the yaw [rad]."""

    def __post_init__(self) -> None:
        numbers = (self.x, self.y, self.z or 0.0, self.yaw or 0.0, self.spread, self.turn)
        if not np.isfinite(numbers).all() or self.spread <= 0 or self.turn <= 0:
            raise OptionError(
                "prior: position, spread and turn must be finite, and spread and turn greater "
                "than 0."
            )

    @property
    def is_wide(self) -> bool:
        """Whether poses drawn around the prior would lie too far apart to find the right one."""
        return self.spread > _WIDE

    def log(self, positions: NDArray[Any], yaws: NDArray[Any]) -> Floats:
        """Return the log density (K, A) [nat, 0 at the prior] of positions (K, 3) and yaws (A,).

        A share of `_OUTLIERS` is spread evenly, since compasses and fixes err indoors. A prior far off
        all positions therefore prefers none of them. Heights count relative to the nearest one.
        """
        offset = positions - (self.x, self.y, self.z or 0.0)
        height = np.zeros(len(offset)) if self.z is None else np.abs(offset[:, 2])
        squares = np.square(offset[:, :2]).sum(axis=1) + np.square(height - height.min())
        turn = np.zeros(len(yaws)) if self.yaw is None else (np.cos(yaws - self.yaw) - 1.0)
        logs = turn / self.turn**2 - squares[:, None] / (2.0 * self.spread**2)
        mixed: Floats = np.log(_OUTLIERS + (1.0 - _OUTLIERS) * np.exp(logs))
        return mixed


_OUTLIERS = 0.05
"""Share of wide priors that are wrong."""
_WIDE = 1.0
"""Spread above which a prior weights all places of the map [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class LogPrior:
    """Log prior over the poses of a visibility table, and shares of its merged scenes."""

    scene: Scene
    table: VisibilityTable
    sentence: Sentence | None
    logs: NDArray[np.float32]
    """(K, A) log prior of every position and heading [nat]."""
    parts: tuple[tuple[NDArray[np.int64], float], ...]
    """Rows of positions that are searched together, and their share of the first particles."""

    @classmethod
    def of(
        cls,
        scene: Scene,
        table: VisibilityTable,
        description: str | Sentence | None,
        shares: ArrayLike | None,
        near: Prior | None = None,
    ) -> LogPrior:
        """Return the log prior of a description, shares (S,) of the merged scenes, and a wide prior.

        Raises
        ------
        OptionError
            The description says nothing that this map could serve; shares are no probabilities.

        """
        sentence = _read(description, scene)
        logs = np.zeros((len(table), AZIMUTHS), np.float32)
        if near is not None:
            logs += near.log(table.positions, np.arange(AZIMUTHS) * STEP)
        if sentence is not None:
            from placegraph.indoor.language.prior import prior

            logs += prior(sentence, scene, table)
        return cls(scene, table, sentence, logs, _parts(scene, table, shares))

    def at(self, poses: Floats) -> Floats:
        """Return the log prior (N,) of poses (N, 4), at the nearest position and heading of the table."""
        rows = [int(np.square(self.table.positions - p[:3]).sum(axis=1).argmin()) for p in poses]
        headings = np.round(poses[:, 3] / STEP).astype(np.int64) % AZIMUTHS
        return self.logs[rows, headings].astype(np.float64)

    def evidence(self, pose: Floats) -> tuple[Evidence, ...]:
        """Return the evidence of each statement of the description at a pose (4,)."""
        if self.sentence is None:
            return ()
        from placegraph.indoor.language.prior import evidence

        return evidence(self.sentence, self.scene, self.table, pose)

    def find_contradictions(self, pose: Floats) -> str:
        """Return the statements that a pose (4,) contradicts, if they outweigh the others; else empty."""
        told = self.evidence(pose)
        if sum(e.weight for e in told) >= 0:
            return ""
        return ", ".join(repr(e.statement) for e in told if e.verdict == "against")


def _read(description: str | Sentence | None, scene: Scene) -> Sentence | None:
    if description is None:
        return None
    from placegraph.indoor.language import read
    from placegraph.indoor.language.prior import find_unused

    sentence = read(description) if isinstance(description, str) else description
    ignored = [*sentence.ignored, *find_unused(sentence, scene)]
    if len(find_unused(sentence, scene)) == len(sentence.statements):
        reasons = "; ".join(f"{i.text!r}: {i.reason}" for i in ignored)
        raise OptionError(
            f"description {sentence.text!r} mentions nothing on this "
            f"map{(f' ({reasons})' if reasons else '')}; mention objects or rooms of the "
            "map."
        )
    return sentence


def _parts(
    scene: Scene, table: VisibilityTable, shares: ArrayLike | None
) -> tuple[tuple[NDArray[np.int64], float], ...]:
    if shares is None:
        return ((np.arange(len(table)), 1.0),)
    share = np.asarray(shares, np.float64)
    if share.shape != (len(scene.scenes),) or not (share >= 0).all() or not share.sum() > 0:
        raise OptionError(
            f"shares: {share.tolist()}; give one non-negative number for each of the map's "
            f"{len(scene.scenes)} scenes."
        )
    part = np.array([scene.scene_at(p[:2]) for p in table.positions])
    rows = [np.flatnonzero(part == s) for s in range(len(share))]
    return tuple(
        (r, float(s / share.sum())) for r, s in zip(rows, share, strict=True) if len(r) and s > 0
    )
