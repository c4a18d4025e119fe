"""The optimisation itself: batches of pictures against the objects of their room and of others."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from placegraph.core.files import write_file
from placegraph.errors import InputError
from placegraph_learn.scenegraphloc.inputs import POINTS, Room, together
from placegraph_learn.scenegraphloc.network import SceneGraphLoc, unit
from placegraph_learn.scenegraphloc.weights import network_of, read_snapshot
from placegraph_learn.scenegraphloc.widths import Widths
from placegraph_learn.train.scenegraphloc.elastic import distorted
from placegraph_learn.train.scenegraphloc.lessons import Lesson
from placegraph_learn.train.scenegraphloc.objective import Truth, losses
from placegraph_learn.train.scenegraphloc.options import TrainOptions


@dataclass(frozen=True)
class Picture:
    """One picture of a batch, and the places whose objects it might show."""

    lesson: int
    """Row of its place."""
    index: int
    """Which of the place's pictures."""
    others: tuple[int, ...]
    """Rows of other places."""


class Encoded:
    """Unit vectors of the objects of rooms, by room."""

    def __init__(
        self, network: SceneGraphLoc, rooms: dict[tuple[int, bool], Room], device: str
    ) -> None:
        vectors = unit(network.objects(together(list(rooms.values()), device=device)))
        parts = vectors.split([len(room) for room in rooms.values()])
        self.vectors = dict(zip(rooms, parts, strict=True))


class Trainer:
    """A network in training, with all that an interrupted training goes on from."""

    def __init__(
        self, lessons: Sequence[Lesson], widths: Widths, options: TrainOptions, device: str
    ) -> None:
        self.lessons, self.options, self.device = lessons, options, device
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(options.seed)
            self.network = SceneGraphLoc(widths).to(device).eval()
        self.optimizer = torch.optim.Adam(
            self.network.parameters(), lr=options.rate, weight_decay=options.weight_decay
        )
        self.scheduler = torch.optim.lr_scheduler.StepLR(self.optimizer, 1, options.decay)
        self.rng = np.random.default_rng([options.seed, 1])
        self.epochs = self.steps = 0
        words = sorted({label for x in lessons for r in _rooms(x) for label in r.labels})
        self._category = {word: k for k, word in enumerate(words)}

    def epoch(self, told: Callable[[int, int, float], None]) -> float:
        """Learn all pictures once; returns the mean loss. `told`: step, of how many, mean so far."""
        rooms = self._distorted()
        batches = self._batches()
        devices = [torch.cuda.current_device()] if self.device == "cuda" else []
        total = 0.0
        self.network.train()
        with torch.random.fork_rng(devices=devices):  # what dropout forgets comes from our own seed
            torch.manual_seed(int(self.rng.integers(1 << 62)))
            for step, batch in enumerate(batches, start=1):
                total += self._step(batch, rooms)
                told(step, len(batches), total / step)
        self.network.eval()
        self.scheduler.step()
        self.epochs += 1
        return total / len(batches)

    def _distorted(self) -> dict[tuple[int, bool], Room]:
        """All rooms, their points fewer and pulled to and fro, anew in each epoch."""
        out = {}
        for row, lesson in enumerate(self.lessons):
            for earlier, room in enumerate(_rooms(lesson)):
                kept = self.rng.permutation(room.points.shape[1])[: self.options.points]
                points = room.points[:, kept]
                if self.options.elastic:
                    points = distorted(points, self.rng)
                out[row, bool(earlier)] = replace(room, points=points)
        return out

    def _batches(self) -> list[list[Picture]]:
        """All pictures that show anything, or as many as the options say, in a new order."""
        pictures = [
            (row, index)
            for row, lesson in enumerate(self.lessons)
            for index, marks in enumerate(lesson.marks)
            if marks.any()
        ]
        order = self.rng.permutation(len(pictures))[: self.options.pictures or None]
        drawn = []
        for row, index in (pictures[k] for k in order.tolist()):
            apart = np.delete(np.arange(len(self.lessons)), row)
            others = self.rng.permutation(apart)[: self.options.others]
            drawn.append(Picture(row, index, tuple(others.tolist())))
        size = self.options.batch
        return [drawn[k : k + size] for k in range(0, len(drawn), size)]

    def _step(self, batch: Sequence[Picture], rooms: dict[tuple[int, bool], Room]) -> float:
        wanted = dict.fromkeys((row, False) for p in batch for row in (p.lesson, *p.others))
        wanted |= dict.fromkeys(key for p in batch if (key := (p.lesson, True)) in rooms)
        encoded = Encoded(self.network, {key: rooms[key] for key in wanted}, self.device)
        patches = self._patches(batch)
        means = []
        for earlier in (False, True):
            found = [
                self._losses(vectors, picture, encoded, rooms, earlier=earlier)
                for picture, vectors in zip(batch, patches, strict=True)
                if (picture.lesson, earlier) in rooms
            ]
            joined = torch.cat([x for x in found if len(x)]) if any(map(len, found)) else None
            if joined is not None:
                means.append(joined.mean())
        if not means:
            return 0.0
        loss = torch.stack(means).mean()
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        self.steps += 1
        return float(loss.detach())

    def _patches(self, batch: Sequence[Picture]) -> list[Tensor]:
        """Unit vectors (P, E) of each picture; those of one grid are encoded together."""
        features = [self.lessons[p.lesson].features[p.index] for p in batch]
        out: list[Tensor] = [torch.empty(0)] * len(batch)
        for shape in dict.fromkeys(f.shape for f in features):
            rows = [k for k, f in enumerate(features) if f.shape == shape]
            stack = torch.from_numpy(np.stack([features[k] for k in rows])).to(self.device)
            vectors = unit(self.network.patches(stack).flatten(1, 2))
            for k, row in enumerate(rows):
                out[row] = vectors[k]
        return out

    def _losses(
        self,
        vectors: Tensor,
        picture: Picture,
        encoded: Encoded,
        rooms: dict[tuple[int, bool], Room],
        *,
        earlier: bool,
    ) -> Tensor:
        """Loss of each valid patch against its room, now or earlier, and others."""
        lesson = self.lessons[picture.lesson]
        keys = [(picture.lesson, earlier), *((row, False) for row in picture.others)]
        objects = torch.cat([encoded.vectors[key] for key in keys])
        labels = [label for key in keys for label in rooms[key].labels]
        truth = Truth(
            torch.tensor(lesson.marks[picture.index], device=self.device),
            torch.tensor(lesson.targets(picture.index, earlier=earlier), device=self.device),
            torch.tensor([self._category[label] for label in labels], device=self.device),
        )
        return losses(vectors, objects, truth)

    # ----------------------------------------------------------------------- to go on from

    def write(self, path: Path) -> None:
        """Write a snapshot in one go, laid out as the authors', with the generator's state."""
        file = BytesIO()
        torch.save(
            {
                "epoch": self.epochs,
                "iteration": self.steps,
                "model": self.network.state_dict(),
                "optimizer": self.optimizer.state_dict(),
                "scheduler": self.scheduler.state_dict(),
                "generator": json.dumps(self.rng.bit_generator.state),
            },
            file,
        )
        write_file(path, [file.getvalue()])

    def read(self, path: Path) -> None:
        """Go on from a snapshot, where there is one; `InputError` where it is damaged."""
        if not path.exists():
            return
        found = read_snapshot(path)
        try:
            state: dict[str, Any] = found["model"]
            self.network.load_state_dict(network_of(state, str(path)).state_dict())
            self.optimizer.load_state_dict(found["optimizer"])
            self.scheduler.load_state_dict(found["scheduler"])
            self.rng.bit_generator.state = json.loads(found["generator"])
            self.epochs, self.steps = int(found["epoch"]), int(found["iteration"])
        except (KeyError, TypeError, ValueError, RuntimeError, AttributeError) as error:
            raise InputError(
                f"{path}: no snapshot to go on from ({str(error)[:100]}); delete it to begin anew."
            ) from error


def _rooms(lesson: Lesson) -> list[Room]:
    return [lesson.room] if lesson.earlier is None else [lesson.room, lesson.earlier]


# ------------------------------------------------------------------------------------- judging


@dataclass(frozen=True)
class Judged:
    """How well a network tells what patches show, in places it never learned."""

    patch: float
    """Share of patches whose nearest object of their room is the one they show."""
    changed: float | None
    """The same with the room as it was earlier; None where no place is known earlier."""
    room: float
    """Share of pictures whose own room, of all these, has the highest score."""
    temperature: float
    """Cosine that counts one nat, at which what is believed of patches is most probable."""

    def row(self) -> dict[str, float]:
        """Figures for curves."""
        told = {"patch": self.patch, "room": self.room}
        return told if self.changed is None else told | {"changed": self.changed}


def judge(
    network: SceneGraphLoc, lessons: Sequence[Lesson], device: str, *, points: int = POINTS
) -> Judged:
    """Ask a network about places; it must be in the state for inference.

    `points`: of each object, as many as it was trained with.
    """
    with torch.inference_mode():
        rooms = {
            (k, bool(e)): room.with_points(points)
            for k, lesson in enumerate(lessons)
            for e, room in enumerate(_rooms(lesson))
        }
        encoded = {
            key: unit(network.objects(together([room], device=device))).cpu().numpy()
            for key, room in rooms.items()
        }
        right: dict[bool, list[NDArray[np.bool_]]] = {False: [], True: []}
        cosines, found = [], []
        for row, lesson in enumerate(lessons):
            for index, features in enumerate(lesson.features):
                grid = torch.tensor(features[None], device=device)
                patches = unit(network.patches(grid)[0].flatten(0, 1)).cpu().numpy()
                scores = [
                    float((patches @ encoded[k, False].T).max(axis=1).sum())
                    for k in range(len(lessons))
                ]
                found.append(int(np.argmax(scores)) == row)
                for earlier in (False, True):
                    if (row, earlier) in encoded:
                        target = lesson.targets(index, earlier=earlier)
                        near = patches[target >= 0] @ encoded[row, earlier].T
                        right[earlier].append(near.argmax(axis=1) == target[target >= 0])
                        cosines.append((near, target[target >= 0]))
    patch, changed = (
        float(np.concatenate(told).mean()) if sum(map(len, told)) else None
        for told in (right[False], right[True])
    )
    return Judged(patch or 0.0, changed, float(np.mean(found)), _temperature(cosines))


def _temperature(cosines: Sequence[tuple[NDArray[np.float32], NDArray[np.int64]]]) -> float:
    """Temperature (of 41 from 0.01 to 1) at which the right objects are most probable."""
    tried = np.geomspace(0.01, 1.0, 41)
    costs = []
    for temperature in tried.tolist():
        cost = 0.0
        for near, target in cosines:
            logits = near.astype(np.float64) / temperature
            top = logits.max(axis=1, initial=-np.inf)
            whole = top + np.log(np.exp(logits - top[:, None]).sum(axis=1))
            cost += float((whole - logits[np.arange(len(target)), target]).sum())
        costs.append(cost)
    return float(tried[int(np.argmin(costs))])
