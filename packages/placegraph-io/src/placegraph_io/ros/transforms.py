"""The tree of frames of a bag: transforms between any two of them at any time.

An edge leads from a parent to a child, as a `geometry_msgs/TransformStamped` says it:
parent_from_child. Between two samples it is interpolated; in longer gaps there is none.
"""

from __future__ import annotations

from collections import defaultdict, deque
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import rotation_from_quaternion

LONGEST = 0.5
"""Between samples of a transform [s], beyond which nothing is said of what happened between them."""
BEYOND = 0.05
"""Time before the first and after the last sample [s] for which it still holds."""
_STILL = 1e-9
_UNIT = 1e-2  # quaternions are written with few digits

Samples = dict[tuple[str, str], list[NDArray[np.float64]]]
"""By parent and child: rows (N, 8) of stamp [s], x, y, z [m], qx, qy, qz, qw."""


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """Samples of one transform, parent_from_child."""

    stamps: NDArray[np.float64]
    """(N,) strictly ascending [s]."""
    position: NDArray[np.float64]
    """(N, 3) [m]"""
    xyzw: NDArray[np.float64]
    """(N, 4) of unit length."""
    fixed: bool
    """Whether it never changes."""

    @classmethod
    def of(cls, stamps: NDArray[np.float64], values: NDArray[np.float64], *, static: bool) -> Edge:
        """Edge of samples in any order, with x y z qx qy qz qw (N, 7)."""
        stamps, first = np.unique(
            stamps[::-1], return_index=True
        )  # of equal stamps the last counts
        values = values[::-1][first]
        xyzw = values[:, 3:] / np.linalg.norm(values[:, 3:], axis=1, keepdims=True)
        flip = np.cumprod(np.where((xyzw[1:] * xyzw[:-1]).sum(axis=1) < 0, -1.0, 1.0))
        xyzw[1:] *= flip[:, None]
        same = bool((np.ptp(np.c_[values[:, :3], xyzw], axis=0) <= _STILL).all())
        return cls(stamps, values[:, :3], xyzw, static or same)

    def joined(self, newer: Edge, since: float) -> Edge:
        """Samples of this one after a time [s], and newer ones; where those are older, all in order."""
        first = int(np.searchsorted(self.stamps, since, "right"))
        same = 1.0 if (self.xyzw[-1] * newer.xyzw[0]).sum() >= 0 else -1.0
        stamps = np.concatenate([self.stamps[first:], newer.stamps])
        position = np.concatenate([self.position[first:], newer.position])
        xyzw = np.concatenate([self.xyzw[first:], same * newer.xyzw])
        if newer.stamps[0] > self.stamps[-1]:
            return Edge(stamps, position, xyzw, fixed=False)
        return replace(Edge.of(stamps, np.c_[position, xyzw], static=False), fixed=False)

    def at(self, stamps: NDArray[np.float64]) -> NDArray[np.float64]:
        """parent_from_child (T, 4, 4) at stamps (T,); NaN where it is not known."""
        poses = np.tile(np.eye(4), (len(stamps), 1, 1))
        if self.fixed:
            poses[:, :3, :3] = rotation_from_quaternion(self.xyzw[-1])
            poses[:, :3, 3] = self.position[-1]
            return poses
        if len(self.stamps) == 1:
            poses[:] = replace(self, fixed=True).at(stamps)
            poses[np.abs(stamps - self.stamps[0]) > BEYOND] = np.nan
            return poses
        after = np.clip(np.searchsorted(self.stamps, stamps), 1, len(self.stamps) - 1)
        before = after - 1
        gap = self.stamps[after] - self.stamps[before]
        part = np.clip((stamps - self.stamps[before]) / gap, 0.0, 1.0)[:, None]
        poses[:, :3, 3] = self.position[before] * (1 - part) + self.position[after] * part
        # samples are so near to each other that the chord, made a unit again, is the arc
        xyzw = self.xyzw[before] * (1 - part) + self.xyzw[after] * part
        poses[:, :3, :3] = rotation_from_quaternion(xyzw)
        outside = np.maximum(self.stamps[0] - stamps, stamps - self.stamps[-1])
        on = np.minimum(np.abs(stamps - self.stamps[before]), np.abs(stamps - self.stamps[after]))
        unknown = (outside > BEYOND) | ((gap > LONGEST) & (outside < 0) & (on > BEYOND))
        poses[unknown] = np.nan
        return poses


@dataclass(slots=True, eq=False)
class Tree:
    """Frames and the edges between them; a child that has two parents keeps both."""

    edges: dict[tuple[str, str], Edge] = field(default_factory=dict)
    """By parent and child."""
    broken: int = 0
    """Samples that were no transform: a number that is not finite, a quaternion of no length."""

    def add(self, samples: Samples, *, static: bool = False) -> None:
        """Take in samples, in order of their recording."""
        for key, held in samples.items():
            table = np.concatenate(held)
            with np.errstate(over="ignore", invalid="ignore"):
                length = np.linalg.norm(table[:, 4:], axis=1)
                good = np.isfinite(table).all(axis=1) & (np.abs(length - 1.0) < _UNIT)
            good &= key[0] != key[1]
            self.broken += int((~good).sum())
            if good.any():
                self.edges[key] = Edge.of(table[good, 0], table[good, 1:], static=static)

    def extend(self, key: tuple[str, str], rows: NDArray[np.float64], keep: float) -> None:
        """Take in newer samples (N, 8) of a transform of a stream, and forget those `keep` [s] before.

        It may change at any time, however long it stood still. Where stamps go back by more than
        `LONGEST`, the clock was set: what was known is forgotten.
        """
        edge = self.edges.pop(key, None)
        self.add({key: [rows]})
        newer = self.edges.get(key)
        if newer is None:
            if edge is not None:
                self.edges[key] = edge
            return
        newer = replace(newer, fixed=False)
        if edge is not None and newer.stamps[0] > edge.stamps[-1] - LONGEST:
            newer = edge.joined(newer, newer.stamps[-1] - keep)
        self.edges[key] = newer

    @property
    def names(self) -> list[str]:
        """Of all frames."""
        return sorted({name for edge in self.edges for name in edge})

    def parents(self) -> dict[str, list[str]]:
        """Parents of each child."""
        out: dict[str, list[str]] = defaultdict(list)
        for parent, child in self.edges:
            out[child].append(parent)
        return dict(out)

    def above(self, frame: str) -> dict[str, bool]:
        """Ancestors of a frame, nearest first, and whether it moves in them."""
        parents = self.parents()
        out: dict[str, bool] = {}
        todo = deque([(frame, False)])
        while todo:
            child, moves = todo.popleft()
            for parent in parents.get(child, []):
                if parent not in out and parent != frame:
                    out[parent] = moves or not self.edges[parent, child].fixed
                    todo.append((parent, out[parent]))
        return out

    def path(self, target: str, source: str) -> list[tuple[str, str]] | None:
        """Frames in pairs (nearer to the target, nearer to the source) that lead there; None: none."""
        near: dict[str, list[str]] = defaultdict(list)
        for parent, child in self.edges:
            near[parent].append(child)
            near[child].append(parent)
        came: dict[str, str] = {target: ""}
        todo = deque([target])
        while todo and source not in came:
            here = todo.popleft()
            for there in near[here]:
                if there not in came:
                    came[there] = here
                    todo.append(there)
        if source not in came:
            return None
        steps = []
        while source != target:
            steps.append((came[source], source))
            source = came[source]
        return steps[::-1]

    def between(
        self, target: str, source: str, stamps: NDArray[np.float64]
    ) -> NDArray[np.float64] | None:
        """target_from_source (T, 4, 4) at stamps (T,), NaN in gaps; None where nothing joins them."""
        steps = self.path(target, source)
        if steps is None:
            return None
        out = np.tile(np.eye(4), (len(stamps), 1, 1))
        for near, far in steps:
            down = (near, far) in self.edges
            edge = self.edges[(near, far) if down else (far, near)].at(stamps)
            out = out @ (edge if down else inverse(edge))
        return out


def inverse(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverses (T, 4, 4) of rigid transforms."""
    out = np.tile(np.eye(4), (len(poses), 1, 1))
    out[:, :3, :3] = poses[:, :3, :3].swapaxes(1, 2)
    out[:, :3, 3] = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    return out
