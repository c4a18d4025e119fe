"""Training of the network of SceneGraphLoc: loss, distortion of points, optimisation, evaluation."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from io import BytesIO
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from placegraph.core.files import write_file
from placegraph.core.options import check_options, option
from placegraph.errors import InputError, OptionError
from placegraph_learn.scenegraphloc.features import ColourFeatures
from placegraph_learn.scenegraphloc.inputs import POINTS, Room, batch_rooms
from placegraph_learn.scenegraphloc.lessons import Lesson, Teacher, World, kept_lesson, split
from placegraph_learn.scenegraphloc.network import SceneGraphLoc, Widths, unit
from placegraph_learn.scenegraphloc.weights import (
    Weights,
    digest_of,
    network_of,
    read_snapshot,
    write_weights,
)
from placegraph_learn.torch_files import select_device
from placegraph_learn.training import Progress, open_folder, refuse_twins, run_epochs


@dataclass(frozen=True)
class TrainOptions:
    """Options of a training; the defaults are the published ones.

    Raises `OptionError` where a number is out of its range.
    """

    epochs: int = option(30, "Number of epochs over all images.", minimum=1, flag="--epochs")
    batch: int = option(16, "Images per step.", minimum=1, flag="--batch")
    others: int = option(
        9, "Other places whose objects are wrong answers for a patch.", flag="--others"
    )
    points: int = option(
        512,
        "Points per object, sampled again in each epoch; the encoder then uses the same number.",
        minimum=1,
        flag="--points",
    )
    rate: float = option(
        1.1e-3, "Learning rate of the first epoch.", above=0, maximum=1, flag="--rate"
    )
    weight_decay: float = option(1e-6, "Weight decay.")
    decay: float = option(0.97, "Decay of the rate per epoch.", above=0, maximum=1)
    elastic: bool = option(True, "Distort the points of each object (see `distort`).")
    seed: int = option(0, "The same seed gives the same homes and weights.", flag="--seed")

    def __post_init__(self) -> None:
        check_options(self)


TEMPERATURE = 0.1
PATCH_SHARE = 0.5
"""Share of the loss of the patch side; the rest is that of the object side."""
EPSILON = 1e-8


@dataclass(frozen=True, eq=False)
class Truth:
    """Right answers for P patches of an image and M candidate objects."""

    marks: Tensor
    """(P,) int64 number of what each patch shows, be it a candidate or not; 0: nothing."""
    target: Tensor
    """(P,) int64 row of the candidate that it is; -1: none."""
    categories: Tensor
    """(M,) int64 category of each candidate."""


def losses(patches: Tensor, objects: Tensor, truth: Truth) -> Tensor:
    """Return the loss of each patch that shows a candidate, in their order.

    `patches`: (P, E) unit vectors of one image.
    `objects`: (M, E) unit vectors of the candidates: the objects of the image's room and of others.
    `truth`: what the patches show.
    """
    right = truth.target[:, None] == torch.arange(len(objects), device=truth.target.device)
    other_patches = (truth.marks[:, None] != truth.marks[None]) & (truth.marks[None] != 0)
    other_categories = truth.categories[:, None] != truth.categories[None]
    near = torch.exp(patches @ objects.T / TEMPERATURE)  # (P, M)
    rows = truth.target >= 0
    target = truth.target[rows]
    own = near[rows, target]
    alike = torch.exp(patches[rows] @ patches.T / TEMPERATURE) * other_patches[rows]
    others = (near * ~right)[rows].sum(dim=1)
    patch_side = own / (own + alike.sum(dim=1) + others + EPSILON)
    kin = torch.exp(objects @ objects.T / TEMPERATURE) * other_categories
    elsewhere = (near * ~right).sum(dim=0)  # (M,) over all patches that do not show it
    object_side = own / (own + kin.sum(dim=1)[target] + elsewhere[target] + EPSILON)
    return -(
        PATCH_SHARE * torch.log(patch_side + EPSILON)
        + (1.0 - PATCH_SHARE) * torch.log(object_side + EPSILON)
    )


SCALES = ((0.05, 0.2), (0.2, 0.4), (0.4, 0.4))
"""Granularity, the distance [m] over which the pull changes, and magnitude [m]."""
SHARE = 0.95
"""Share of clouds that are augmented."""
_MOST = 48
"""Cells along an axis: clouds too large for a granularity are pulled more coarsely."""


def distort(points: NDArray[np.floating], rng: np.random.Generator) -> NDArray[np.float32]:
    """Distort points (..., 3) [m] smoothly (Simard et al. 2003), with the probability `SHARE`."""
    out = np.asarray(points, np.float64).reshape(-1, 3)
    if rng.random() < SHARE:
        for granularity, magnitude in SCALES:
            out = out + magnitude * _pull(out, granularity, rng)
    return out.reshape(points.shape).astype(np.float32)


def _pull(
    points: NDArray[np.float64], granularity: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Return smooth noise (n, 3) at points (n, 3)."""
    low = points.min(axis=0)
    step = np.maximum(np.ptp(points, axis=0) / (_MOST - 3), granularity)
    shape = (np.ptp(points, axis=0) / step).astype(np.int64) + 3
    noise = rng.standard_normal((*shape, 3), np.float32)
    for axis in (0, 1, 2) * 2:
        noise = _blurred(noise, axis)
    at = (points - low) / step + 1.0
    base = np.minimum(at.astype(np.int64), shape - 2)
    part = at - base
    out = np.zeros_like(points)
    for corner in np.ndindex(2, 2, 2):
        x, y, z = (base + corner).T
        weight = np.where(corner, part, 1.0 - part).prod(axis=1)
        out += weight[:, None] * noise[x, y, z]
    return out


def _blurred(noise: NDArray[np.float32], axis: int) -> NDArray[np.float32]:
    """Return mean of each node and its two neighbours along an axis; beyond the edge is nothing."""
    lines = np.moveaxis(noise, axis, 0)
    total = lines.copy()
    total[1:] += lines[:-1]
    total[:-1] += lines[1:]
    total *= np.float32(1.0 / 3.0)
    return np.moveaxis(total, 0, axis)


@dataclass(frozen=True)
class Picture:
    """One picture of a batch, and the places whose objects it might show."""

    lesson: int
    """Row of its place."""
    index: int
    """Which of the place's pictures."""
    negatives: tuple[int, ...]
    """Rows of other places."""


class Trainer:
    """Network in training, with the state that an interrupted training goes on from."""

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

    def epoch(self, progress: Progress) -> float:
        """Learn all pictures once; returns the mean loss."""
        # all rooms, their points fewer and pulled to and fro, anew in each epoch
        rooms = {}
        for row, lesson in enumerate(self.lessons):
            for earlier, room in enumerate(_rooms(lesson)):
                kept = self.rng.permutation(room.points.shape[1])[: self.options.points]
                points = room.points[:, kept]
                if self.options.elastic:
                    points = distort(points, self.rng)
                rooms[row, bool(earlier)] = replace(room, points=points)
        batches = self._batches()
        devices = [torch.cuda.current_device()] if self.device == "cuda" else []
        total = 0.0
        self.network.train()
        with torch.random.fork_rng(devices=devices):  # what dropout forgets comes from our own seed
            torch.manual_seed(int(self.rng.integers(1 << 62)))
            for step, batch in enumerate(batches, start=1):
                total += self._step(batch, rooms)
                progress.step(self.epochs, step, len(batches), {"loss": total / step})
        self.network.eval()
        self.scheduler.step()
        self.epochs += 1
        return total / len(batches)

    def _batches(self) -> list[list[Picture]]:
        """Return all pictures that show anything, or as many as the options say, in a new order."""
        pictures = [
            (row, index)
            for row, lesson in enumerate(self.lessons)
            for index, marks in enumerate(lesson.marks)
            if marks.any()
        ]
        order = self.rng.permutation(len(pictures))
        drawn = []
        for row, index in (pictures[k] for k in order.tolist()):
            apart = np.delete(np.arange(len(self.lessons)), row)
            others = self.rng.permutation(apart)[: self.options.others]
            drawn.append(Picture(row, index, tuple(others.tolist())))
        size = self.options.batch
        return [drawn[k : k + size] for k in range(0, len(drawn), size)]

    def _step(self, batch: Sequence[Picture], rooms: dict[tuple[int, bool], Room]) -> float:
        wanted = dict.fromkeys((row, False) for p in batch for row in (p.lesson, *p.negatives))
        wanted |= dict.fromkeys(key for p in batch if (key := (p.lesson, True)) in rooms)
        asked = [rooms[key] for key in wanted]
        vectors = unit(self.network.objects(batch_rooms(asked, device=self.device)))
        encoded = dict(zip(wanted, vectors.split([len(room) for room in asked]), strict=True))
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
        """Return unit vectors (P, E) of each picture; those of one grid are encoded together."""
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
        encoded: dict[tuple[int, bool], Tensor],
        rooms: dict[tuple[int, bool], Room],
        *,
        earlier: bool,
    ) -> Tensor:
        """Return loss of each valid patch against its room, now or earlier, and others."""
        lesson = self.lessons[picture.lesson]
        keys = [(picture.lesson, earlier), *((row, False) for row in picture.negatives)]
        objects = torch.cat([encoded[key] for key in keys])
        labels = [label for key in keys for label in rooms[key].labels]
        truth = Truth(
            torch.tensor(lesson.marks[picture.index], device=self.device),
            torch.tensor(lesson.targets(picture.index, earlier=earlier), device=self.device),
            torch.tensor([self._category[label] for label in labels], device=self.device),
        )
        return losses(vectors, objects, truth)

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
                f"{path} is not a snapshot to resume from ({str(error)[:100]}); delete it to start "
                "again."
            ) from error


def _rooms(lesson: Lesson) -> list[Room]:
    return [lesson.room] if lesson.earlier is None else [lesson.room, lesson.earlier]


@dataclass(frozen=True)
class Evaluation:
    """Accuracy of a network in places it never learned."""

    patch: float
    """Share of patches whose nearest object of their room is the one they show."""
    changed: float | None
    """The same with the room as it was earlier; None where no place is known earlier."""
    room: float
    """Share of pictures whose own room, of all these, has the highest score."""
    temperature: float
    """Cosine that counts one nat, at which what is believed of patches is most probable."""

    def row(self) -> dict[str, float]:
        """Return figures for curves."""
        told = {"patch": self.patch, "room": self.room}
        return told if self.changed is None else told | {"changed": self.changed}


def evaluate(
    network: SceneGraphLoc, lessons: Sequence[Lesson], device: str, *, points: int = POINTS
) -> Evaluation:
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
            key: unit(network.objects(batch_rooms([room], device=device))).cpu().numpy()
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
    return Evaluation(patch or 0.0, changed, float(np.mean(found)), _temperature(cosines))


def _temperature(cosines: Sequence[tuple[NDArray[np.float32], NDArray[np.int64]]]) -> float:
    """Return temperature (of 41 from 0.01 to 1) at which the right objects are most probable."""
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


SNAPSHOT = "snapshot.pth"


def train(
    worlds: Sequence[World],
    out: str | PathLike[str],
    *,
    folder: str | PathLike[str],
    held_out: int = 1,
    teacher: Teacher | None = None,
    widths: Widths | None = None,
    options: TrainOptions | None = None,
    device: str = "auto",
    progress: Progress | None = None,
) -> Weights:
    """Train the network and write its weights.

    Raises `OptionError`: there are too few places, an option is out of range, or the folder holds
    another training; `InputError`: a map, a capture or the snapshot is damaged; `MapError`: the
    weights cannot be written.

    `worlds`: places to learn from (`lessons.homes`, `lessons.folder`).
    `out`: file to write, .safetensors; `SceneGraphLocEncoder` reads it.
    `folder`: holds places once looked at, a snapshot of the last epoch and the curves: an
        interrupted training goes on by the same call, and ends with the very same weights.
    `held_out`: places, spread evenly, that are not learned but asked about after each epoch; the
        temperature is calibrated on them.
    `teacher`: how places are looked at: image features, attribute words, and so on; features of
        colour if not given.
    `widths`: of the network's layers; `Widths.small` of the features if not given.
    `options`: how to train.
    `device`: ``cpu``, ``cuda`` or ``auto``.
    `progress`: is told how far the training is.
    """
    options, progress = options or TrainOptions(), progress or Progress()
    teacher = teacher or Teacher(ColourFeatures())
    widths = widths or Widths.small(teacher.features.dimension, teacher.attribute_count)
    device = str(select_device(torch, device))
    _check(worlds, Path(out), held_out, teacher, widths)
    at = Path(folder)
    plan = {
        "places": [world.name for world in worlds],
        "held": held_out,
        "features": teacher.features.key,
        "rotate": teacher.rotate,
        "points_from": teacher.points,
        "attributes": list(teacher.attributes),
        "widths": asdict(widths),
        "options": asdict(options),
    }
    open_folder(at, plan)
    learned, asked = split(_lessons(worlds, at, teacher, progress), held_out)
    trainer = Trainer(learned, widths, options, device)
    trainer.read(at / SNAPSHOT)

    def learn(_epoch: int) -> dict[str, float]:
        loss = trainer.epoch(progress)
        figures = evaluate(trainer.network, asked, device, points=options.points).row()
        return {"loss": loss} | figures

    run_epochs(trainer, options.epochs, learn, at / SNAPSHOT, progress)
    network = trainer.network.cpu()
    judged = evaluate(network, asked, "cpu", points=options.points)
    notes = {
        "features": teacher.features.key,
        "temperature": f"{judged.temperature:.4g}",
        "points": str(options.points),
        "epochs": str(options.epochs),
        "seed": str(options.seed),
        "places": str(len(learned)),
    }
    write_weights(out, network, notes)
    return Weights(network, notes, digest_of(network))


def _lessons(
    worlds: Sequence[World], at: Path, teacher: Teacher, progress: Progress
) -> list[Lesson]:
    """Return all places, looked at now or in an earlier run."""
    kept = at / "places"
    try:
        kept.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{kept} cannot be used as a folder for places ({error}); name another."
        ) from error
    lessons = []
    for done, world in enumerate(worlds, start=1):
        path = kept / f"{world.name}.lesson"
        lessons.append(kept_lesson(path, lambda w=world: teacher.lesson(w)))  # type: ignore[misc]
        progress.report_place(world.name, done, len(worlds))
    return lessons


def _check(
    worlds: Sequence[World], out: Path, held_out: int, teacher: Teacher, widths: Widths
) -> None:
    if held_out < 1 or len(worlds) - held_out < 2:
        raise OptionError(
            f"There are {len(worlds)} places, and {held_out} are held out; at least two must be "
            "for training and one held out."
        )
    refuse_twins([world.name for world in worlds])
    if widths.feature != teacher.features.dimension:
        raise OptionError(
            f"widths: they are for features of {widths.feature} numbers, but "
            f"{teacher.features.key} has {teacher.features.dimension}; make them equal."
        )
    if widths.attributes != teacher.attribute_count:
        raise OptionError(
            f"widths: they are for {widths.attributes} attribute words, but the data has "
            f"{teacher.attribute_count}; make them equal."
        )
    if out.suffix != ".safetensors":
        raise OptionError(
            f"{out}: weights are written as .safetensors; choose a file with this ending."
        )
