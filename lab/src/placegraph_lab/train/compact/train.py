"""Training of the compact encoder; needs PyTorch.

Every patch is to find its object, among those of its scene and of others (InfoNCE). How much of a
scene is seen of each object is told to the softmax: what is left to learn is how much likelier an
object is than anywhere in the scene, which is what a particle filter asks for.
Folder and weights file are written as it goes on, so that a cut leaves the best network so far and
`train_on` continues where it was. Worlds that are held out choose that network, and its temperature.
"""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch.nn import functional as F  # noqa: N812  # PyTorch's own name for it

from placegraph.errors import InputError
from placegraph.indoor.encode.compact import picture
from placegraph.indoor.encode.compact.network import Network, Shape
from placegraph.indoor.encode.compact.things import features
from placegraph.indoor.encode.compact.weights import trained, write_weights
from placegraph.indoor.encode.words import vector
from placegraph.store import read_map, write_map
from placegraph_lab.train.compact import vary
from placegraph_lab.train.compact.torch_network import TorchNetwork
from placegraph_lab.train.compact.worlds import World
from placegraph_lab.train.training import add_row, planned

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from os import PathLike
    from pathlib import Path

    from numpy.typing import NDArray
    from torch import Tensor

    Floats = NDArray[np.float32]

STATE, VERSION = "compact-training", 1
EVERY = 25
"""Steps between rows of the curves."""
CHECK = 1 << 20
"""A number beyond all steps, in the seeds of what is held out."""
PROBES = ("bed", "ceiling", "chair", "floor", "lamp", "sofa", "table", "wall")
"""Labels whose vectors are kept with the weights, which know no others."""
HELD_OUT = 14
"""Every so manieth world of a kind is not trained on."""


@dataclass(frozen=True, slots=True)
class Plan:
    """How to train."""

    steps: int = 6000
    batch: int = 16
    """Pictures of a step, each of another scene where there are so many."""
    rate: float = 2e-3
    """Of learning, at its highest."""
    decay: float = 0.02
    balance: float = 0.25
    """An object that n patches of a picture show weighs n^(1 - balance)."""
    elsewhere: float = 0.25
    """Weight of finding an object among those of all scenes, beside those of its own."""
    average: float = 0.998
    """The network kept is a running mean of what was trained."""
    check: int = 100
    """Steps between validations."""
    seed: int = 0


class Batch(NamedTuple):
    """B pictures, and the N objects of their scenes."""

    cells: Floats
    """(B, 2 rows, 2 columns, INPUTS)"""
    features: Floats
    """(N, FEATURES)"""
    true: NDArray[np.int64]
    """(B, rows * columns) row of the object of each patch; -1: none."""
    scene: NDArray[np.int64]
    """(N,) picture whose scene an object is of."""
    shares: Floats
    """(N,) share of each object among all that is seen of its scene."""


def train_on(
    worlds: Path,
    folder: Path,
    output: str | PathLike[str],
    plan: Plan,
    shape: Shape | None = None,
    *,
    tell: Callable[[str], None] = lambda _: None,
) -> None:
    """Train on the worlds of a folder, or go on; the best weights lie in `output`.

    Raises
    ------
    InputError
        There are no worlds, or one is broken.
    OptionError
        `folder` holds a training with another plan.

    """
    known, held = split(worlds)
    state = State.begun(folder, plan, known, shape or Shape())
    asked = [(world, i) for world in held for i in range(0, len(world.light), 2)]
    checks = [  # as varied as what is trained on: of the real world we know no more
        batch_of([world], [i], np.random.default_rng([plan.seed, CHECK, k]))
        for k, (world, i) in enumerate(asked)
    ]
    began = time.perf_counter()
    while state.step < plan.steps:
        group = known[state.step % len(known)]
        loss = state.learn(group)
        row = {"epoch": state.step, "loss": loss, "minutes": (time.perf_counter() - began) / 60.0}
        if state.step % plan.check == 0 or state.step == plan.steps:
            nats, right, temperature = judge(state.network(), checks)
            row |= {"nats": nats, "right": right, "temperature": temperature}
            if nats > state.best:
                state.best = nats
                told = {
                    "plan": asdict(plan), "step": state.step, "nats": nats, "right": right,
                    "words": {label: vector(label).tolist() for label in PROBES},
                }  # fmt: skip
                arrays = {n: t.detach().numpy() for n, t in state.mean.items()}
                write_weights(output, trained(state.model.shape, arrays, temperature, told))
            state.write()
        if state.step % EVERY == 0 or "nats" in row:
            add_row(folder, row)
            tell(", ".join(f"{name} {value:.4g}" for name, value in row.items()))


def split(folder: Path) -> tuple[list[list[World]], list[World]]:
    """Worlds to train on, by their grids, and those held out; raises `InputError` if none."""
    paths = sorted(folder.glob("*.npz"))
    kinds: dict[str, list[Path]] = {}
    for path in paths:
        kinds.setdefault(path.stem.rpartition("_")[0], []).append(path)
    held = [p for of in kinds.values() for p in of[HELD_OUT - 1 :: HELD_OUT]]
    known: dict[tuple[int, int], list[World]] = {}
    for path in sorted(set(paths) - set(held)):
        world = World.open(path)
        known.setdefault(world.grid, []).append(world)
    if not known or not held:
        raise InputError(f"{folder}: {len(paths)} worlds; render more of them.")
    return list(known.values()), [World.open(path) for path in held]


class State:
    """A training under way."""

    def __init__(self, folder: Path, plan: Plan, shape: Shape) -> None:
        torch.manual_seed(plan.seed)
        self.folder, self.plan = folder, plan
        self.model = TorchNetwork(shape)
        self.scale = torch.nn.Parameter(torch.tensor(math.log(10.0)))
        self.parameters = dict(self.model.named_parameters()) | {"scale": self.scale}
        flat = [p for p in self.parameters.values() if p.ndim < 2]
        deep = [p for p in self.parameters.values() if p.ndim > 1]
        self.optimizer = torch.optim.AdamW(
            [{"params": deep, "weight_decay": plan.decay}, {"params": flat, "weight_decay": 0.0}],
            lr=plan.rate,
            betas=(0.9, 0.98),
        )
        self.mean = {n: t.detach().clone() for n, t in self.model.state_dict().items()}
        self.step, self.best = 0, -1e9

    @classmethod
    def begun(
        cls, folder: Path, plan: Plan, known: Sequence[Sequence[World]], shape: Shape
    ) -> State:
        """A new training, or the one of the folder."""
        planned(folder, asdict(plan) | {"shape": shape.to_dict()})
        state = cls(folder, plan, shape)
        if (folder / "state").exists():
            state.read()
        else:
            state.usual(known)
        return state

    def usual(self, known: Sequence[Sequence[World]]) -> None:
        """Learn what is usual of objects' features, and how far they spread."""
        rng = np.random.default_rng(self.plan.seed)
        few = [w for group in known for w in group][:: max(1, sum(map(len, known)) // 100)]
        told = np.concatenate([facts(w, vary.paint(len(w.area), rng), rng) for w in few])
        with torch.no_grad():
            self.model.usual.copy_(torch.from_numpy(told.mean(axis=0)))
            self.model.spread.copy_(torch.from_numpy(np.maximum(told.std(axis=0), 0.05)))
        self.mean = {n: t.detach().clone() for n, t in self.model.state_dict().items()}

    def learn(self, group: Sequence[World]) -> float:
        """One step on worlds of one grid; returns the loss."""
        plan = self.plan
        rng = np.random.default_rng([plan.seed, self.step])
        which = rng.choice(len(group), plan.batch, replace=len(group) < plan.batch)
        worlds = [group[i] for i in which.tolist()]
        batch = batch_of(worlds, [int(rng.integers(len(w.light))) for w in worlds], rng)
        for part in self.optimizer.param_groups:
            part["lr"] = plan.rate * pace(self.step, plan.steps)
        loss = self.loss(batch)
        self.optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.parameters.values(), 1.0)
        self.optimizer.step()
        self.step += 1
        share = 1.0 - min(plan.average, self.step / (self.step + 10.0))
        with torch.no_grad():
            for name, value in self.model.state_dict().items():
                self.mean[name].lerp_(value, share)
        return float(loss.detach())

    def loss(self, batch: Batch) -> Tensor:
        """InfoNCE of patches against objects of their own scene, and of all scenes."""
        seen = self.model.see(torch.from_numpy(batch.cells))
        b, d = len(seen), seen.shape[-1]
        known = self.model.know(torch.from_numpy(batch.features))
        logits = seen.reshape(b, -1, d) @ known.T * self.scale.clamp(max=math.log(50.0)).exp()
        own = torch.from_numpy(batch.scene[None] == np.arange(b)[:, None])[:, None]
        logits = logits + torch.from_numpy(np.log(batch.shares))
        flat = logits.reshape(-1, logits.shape[-1])
        true = torch.from_numpy(batch.true.reshape(-1))
        weights = torch.from_numpy(weights_of(batch.true, self.plan.balance).reshape(-1))
        inside = logits.masked_fill(~own, -math.inf).reshape(flat.shape)
        each = F.cross_entropy(inside, true, ignore_index=-1, reduction="none")
        far = F.cross_entropy(flat, true, ignore_index=-1, reduction="none")
        total = (1.0 - self.plan.elsewhere) * each + self.plan.elsewhere * far
        return (total * weights).sum() / weights.sum()

    def network(self) -> Network:
        """The running mean, as it will be shipped."""
        arrays = {n: t.numpy().astype(np.float16).astype(np.float32) for n, t in self.mean.items()}
        return Network(self.model.shape, arrays)

    def write(self) -> None:
        """Keep all that going on needs."""
        arrays = {f"weight:{n}": t.detach().numpy() for n, t in self.parameters.items()}
        arrays |= {f"mean:{n}": t.numpy() for n, t in self.mean.items()}
        arrays |= {f"buffer:{n}": t.numpy() for n, t in self.model.named_buffers()}
        for name, parameter in self.parameters.items():
            for moment in ("exp_avg", "exp_avg_sq"):
                arrays[f"{moment}:{name}"] = self.optimizer.state[parameter][moment].numpy()
        arrays = {n: np.atleast_1d(a) for n, a in arrays.items()}
        write_map(
            self.folder / "state", STATE, VERSION, {"step": self.step, "best": self.best}, arrays
        )

    def read(self) -> None:
        """Restore it; raises `MapError` where the file is damaged."""
        file = read_map(self.folder / "state", STATE, VERSION)
        self.step, self.best = int(file.meta["step"]), float(file.meta["best"])

        def held(name: str, like: Tensor) -> Tensor:
            return torch.from_numpy(file.arrays[name].copy()).reshape(like.shape)

        with torch.no_grad():
            for name, buffer in self.model.named_buffers():
                buffer.copy_(held(f"buffer:{name}", buffer))
            for name, parameter in self.parameters.items():
                parameter.copy_(held(f"weight:{name}", parameter))
                self.optimizer.state[parameter] = {
                    "step": torch.tensor(float(self.step)),
                    "exp_avg": held(f"exp_avg:{name}", parameter),
                    "exp_avg_sq": held(f"exp_avg_sq:{name}", parameter),
                }
        self.mean = {n: held(f"mean:{n}", t) for n, t in self.mean.items()}


def pace(step: int, steps: int) -> float:
    """Share of the highest rate: up over 200 steps, then down along a cosine."""
    return min(1.0, (step + 1) / 200) * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * step / steps)))


def facts(world: World, factors: Floats, rng: np.random.Generator) -> Floats:
    """Features (N, FEATURES) of a world's objects, as some map may tell them."""
    words = words_of(tuple(world.labels.tolist()))
    return features(vary.mapped(world.things, factors, rng), vary.labelled(words, rng))


@lru_cache(maxsize=1024)
def words_of(labels: tuple[str, ...]) -> Floats:
    """Vectors (N, d) of labels."""
    return np.stack([vector(label) for label in labels])


def batch_of(worlds: Sequence[World], pictures: Sequence[int], rng: np.random.Generator) -> Batch:
    """Pictures of worlds of one grid, each as some camera may see it."""
    cells, told, true, scene, shares = [], [], [], [], []
    first = 0
    for b, (world, i) in enumerate(zip(worlds, pictures, strict=True)):
        rise, patches = world.rises[i], world.patches[i].reshape(world.grid)
        factors = vary.paint(len(world.area), rng)
        painted = np.concatenate([factors, np.ones((1, 3), np.float32)])[world.objects[i]]
        log = vary.photographed(world.light[i].astype(np.float32) * painted, rng)
        patches = vary.strewn(log, patches, picture.PIXELS, rng)
        if rng.random() < 0.5:  # in a mirror
            log, rise, patches = log[:, ::-1], rise[:, ::-1], patches[:, ::-1]
        cells.append(picture.inputs(log, rise, float(world.spans[i])))
        told.append(facts(world, factors, rng))
        true.append(np.where(patches >= 0, patches.astype(np.int64) + first, -1).reshape(-1))
        scene.append(np.full(len(factors), b))
        shares.append(world.shares)
        first += len(factors)
    return Batch(
        np.stack(cells),
        np.concatenate(told),
        np.stack(true),
        np.concatenate(scene),
        np.concatenate(shares),
    )


def weights_of(true: NDArray[np.int64], balance: float) -> Floats:
    """Weight of each patch (B, P): the more patches of its picture show its object, the less."""
    out = np.zeros(true.shape, np.float32)
    for b, row in enumerate(true):
        objects, at, counts = np.unique(row, return_inverse=True, return_counts=True)
        out[b] = (objects >= 0)[at] * counts[at] ** -balance
    return out


def judge(network: Network, checks: Sequence[Batch]) -> tuple[float, float, float]:
    """What patches tell of their objects, against anywhere in the scene.

    Returns nats a patch, the share of patches whose best object is the true one, and the
    temperature at which the nats are most.
    """
    rows = list(_cosines(network, checks))
    found = [(told(rows, tau), tau) for tau in np.geomspace(0.02, 0.5, 25).tolist()]
    nats, temperature = max(found)
    right = np.concatenate([cosines.argmax(axis=1) == true for cosines, true, _ in rows])
    return nats, float(right.mean()), temperature


def _cosines(
    network: Network, checks: Sequence[Batch]
) -> Iterator[tuple[Floats, NDArray[Any], Floats]]:
    for batch in checks:
        seen = network.see(batch.cells[0]).reshape(-1, network.shape.dimension)
        true = batch.true[0]
        there = true >= 0
        yield (seen @ network.know(batch.features).T)[there], true[there], batch.shares


def told(rows: Sequence[tuple[Floats, NDArray[Any], Floats]], temperature: float) -> float:
    """Mean log-likelihood ratio of the true object against what is seen anywhere [nats].

    `rows`: cosines (P, N) of patches, their true objects (P,), and shares (N,) of what is seen.
    """
    gains = []
    for cosines, true, shares in rows:
        logits = cosines / np.float32(temperature)
        logits -= logits.max(axis=1, keepdims=True)
        gains.append(logits[np.arange(len(true)), true] - np.log(np.exp(logits) @ shares))
    return float(np.concatenate(gains).mean())
