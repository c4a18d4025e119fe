"""Training of the matching network: losses (Eq. 17-19), optimisation, recalls, and what it goes on from."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from itertools import count
from os import PathLike
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from placegraph.core.mapfile import pack_strings, read_map, write_map
from placegraph.core.options import check_options, option
from placegraph.core.weights import hash_weights
from placegraph.errors import InputError, OptionError
from placegraph.outdoor.city import CityMap
from placegraph.outdoor.language.vocabulary import Vocabulary
from placegraph.outdoor.network.graphs import TextGraphs, WordVectors, WordWeights
from placegraph.outdoor.network.graphs import split_label as words_of
from placegraph.outdoor.network.label_graphs import LabelGraphs
from placegraph.outdoor.network.weights import NETWORK, Shape, Weights, round_weights, write_weights
from placegraph.outdoor.search.posterior import NUM_RERANKED
from placegraph_learn.city.batches import Lessons, forward
from placegraph_learn.city.cell_lessons import CellLessons, cell_recalls, make_cell_lessons
from placegraph_learn.city.descriptions import ExamplePool, Speaker, make_pool
from placegraph_learn.city.network import Network, Scores, Truth
from placegraph_learn.city.word2vec import read_word2vec
from placegraph_learn.torch_files import select_device
from placegraph_learn.training import Progress, open_folder, rows_of, run_epochs

Loss = Literal["match", "similarity", "embedding", "fusion", "eq17", "eq18"]
"""Losses (`losses`); ``eq17`` and ``eq18`` are the paper's as printed (Eq. 17-18)."""
LOSSES: tuple[Loss, ...] = ("match", "similarity", "embedding", "fusion")


@dataclass(frozen=True)
class TrainOptions:
    """Options of a training; raises `OptionError` where one is out of range."""

    epochs: int = option(
        5, "Number of epochs, each with new descriptions.", minimum=1, flag="--epochs"
    )
    examples: int = option(
        1200,
        "New descriptions of a city in each epoch; those of earlier epochs are used again.",
        minimum=1,
        flag="--examples",
    )
    steps: int = option(300, "Batches per epoch.", minimum=1, flag="--steps")
    batch: int = option(32, "Descriptions per batch.", minimum=1, flag="--batch")
    share: float = option(
        0.4, "Share of a description's candidates in a batch.", above=0, maximum=1
    )
    rate: float = option(
        2e-3, "Largest learning rate, of a cosine schedule.", above=0, maximum=1, flag="--rate"
    )
    decay: float = option(1e-3, "Weight decay.")
    losses: tuple[Loss, ...] = option(
        LOSSES,
        "Losses, separated by commas: match, similarity, embedding, fusion; eq17, eq18 are the paper's "
        "as printed.",
        flag="--losses",
        panel=NETWORK,
        commas=True,
    )
    seed: int = option(0, "The same seed gives the same descriptions and weights.", flag="--seed")
    descriptions: int | None = option(
        None, "Seed of the descriptions, to share them among trainings; `seed` if not given."
    )
    check: int = option(
        500,
        "Descriptions of a city, from tiles not trained on, for the curves and the last two weights.",
        minimum=1,
        flag="--check",
    )
    shape: Shape = option(Shape(), "Widths and depths of the network.")
    word_vectors: str | None = option(
        None,
        "word2vec file (text or binary) with vectors for the words it contains, as in the paper.",
        flag="--word-vectors",
    )

    def __post_init__(self) -> None:
        check_options(self)
        if not self.losses:
            raise OptionError("losses is empty; name at least one.")
        if self.shape.printed and "fusion" in self.losses:
            raise OptionError(
                "losses contains 'fusion', which needs statements that the printed network does not "
                "read; give eq17,eq18."
            )


NEVER = -1e9


class Temperatures(NamedTuple):
    """Learned scales of cosines (logs of inverse temperatures) and of relational matching."""

    similarity: Tensor
    embedding: Tensor
    relational: Tensor


def contrastive(scores: Tensor, right: Tensor) -> Tensor:
    """Return minus log share of what is right (Q, P: 1, 0 or -1) among what is right or wrong."""
    known = scores.masked_fill(right < 0, NEVER)
    good = scores.masked_fill(right != 1, NEVER)
    told = (right == 1).any(1) & (right == 0).any(1)
    loss = torch.logsumexp(known, 1) - torch.logsumexp(good, 1)
    return (loss * told).sum() / told.sum().clamp(min=1)


def matching_loss(logit: Tensor, belong: Tensor) -> Tensor:
    """Return the cross-entropy of the matching probability (Eq. 17) of pairs (P,)."""
    return F.binary_cross_entropy_with_logits(logit, belong)


def cosine_loss(cosine: Tensor, belong: Tensor) -> Tensor:
    """Return the mean cosine of wrong pairs plus one minus that of right pairs (Eq. 18), of pairs (P,)."""
    wrong = (cosine * (1 - belong)).sum() / (1 - belong).sum().clamp(min=1)
    return wrong + ((1 - cosine) * belong).sum() / belong.sum().clamp(min=1)


def losses(
    scores: Scores, truth: Truth, scales: Temperatures, wanted: Collection[str] = LOSSES
) -> dict[str, Tensor]:
    """Return the losses asked for, by name; their sum is minimized (Eq. 19)."""
    found: dict[str, Tensor] = {}
    q = len(scores.embedding)
    own = torch.arange(q)[:, None].to(truth.text) == truth.text[None]  # (Q, P)
    right = torch.where(own, truth.right[None], -1)
    known = truth.right >= 0
    belong = (truth.right[known] == 1).float()
    if "match" in wanted or "eq17" in wanted:
        entropy = matching_loss(scores.logit[known], belong)
        if "eq17" in wanted:
            found["eq17"] = entropy
        if "match" in wanted:
            found["match"] = entropy + contrastive(scores.logit[None].expand(q, -1), right)
    if "eq18" in wanted:
        found["eq18"] = cosine_loss(scores.cosine[known], belong)
    if "similarity" in wanted:
        cosine = scores.cosine * scales.similarity.exp()
        found["similarity"] = contrastive(cosine[None].expand(q, -1), right)
    if "embedding" in wanted:
        found["embedding"] = contrastive(
            scores.embedding * scales.embedding.exp(), truth.everywhere
        )
    if "fusion" in wanted:
        asked = truth.relational.isfinite()
        fused = scales.relational * truth.relational.nan_to_num() + scores.residual
        found["fusion"] = contrastive(
            fused[None].expand(q, -1), torch.where(asked[None], right, -1)
        )
    return found


WITHIN = 50.0
"""A viewpoint this near to the truth is right [m]."""
TOGETHER = 40.0
"""Probability of viewpoints this near to each other is added up, as in `posterior.modes` [m]."""


class ViewpointScores(NamedTuple):
    """Scores of the viewpoints that relational matching finds best; -inf where there is none."""

    relational: NDArray[np.float64]
    """(Q, K)"""
    logit: NDArray[np.float64]
    """(Q, K)"""
    cosine: NDArray[np.float64]
    """(Q, K) of the graph embeddings."""
    fused: NDArray[np.float64]
    """(Q, K) relational matching and what the network adds."""
    near: NDArray[np.bool_]
    """(Q, K) whether it is within 50 m of the truth."""
    together: NDArray[np.bool_]
    """(Q, K, K) which of them stand close to each other."""


def score_viewpoints(network: Network, lessons: Lessons, device: str) -> ViewpointScores:
    """Let the network judge the viewpoints that relational matching found best."""
    pool, views = lessons.pool, lessons.city.views
    relational = np.where(np.isfinite(pool.scores), pool.scores, -np.inf)
    best = np.argsort(np.argsort(-relational, axis=1), axis=1) < NUM_RERANKED
    asked = best & np.isfinite(relational)
    relational = np.where(asked, relational, -np.inf)
    logit, cosine, fused = (np.full(asked.shape, -np.inf) for _ in range(3))
    prior: Any = network.prior
    scale, weight = prior[1:].tolist()
    with torch.no_grad():
        for at in range(0, len(pool), 64):
            rows = np.arange(at, min(at + 64, len(pool)))
            batch = lessons.batch(rows, asked[rows])
            scores = forward(network, lessons, batch, device)
            text = batch.pairs.text
            logit[rows[text], batch.slots] = scores.logit.cpu().numpy()
            added = scores.residual.cpu().numpy()
            fused[rows[text], batch.slots] = scale * batch.relational + weight * added
            dense = scores.embedding.cpu().numpy()
            cosine[rows[text], batch.slots] = dense[text, np.arange(len(text))]
    places = views.positions[pool.views]
    off = np.hypot(*(places - pool.positions[:, None]).transpose(2, 0, 1))
    apart = np.hypot(*(places[:, :, None] - places[:, None]).transpose(3, 0, 1, 2))
    return ViewpointScores(
        relational, logit, cosine, fused, (off <= WITHIN) & asked, apart <= TOGETHER
    )


def mean_recalls(scored: Sequence[ViewpointScores]) -> dict[str, float]:
    """Return Recall@1 within 50 m among what relational matching finds, mean over cities."""
    found: dict[str, list[float]] = {}
    for j in scored:
        asked = np.isfinite(j.relational)
        for name, scores in (
            ("relational", j.relational),
            ("network", j.logit),
            ("dense", 15.0 * j.cosine),
            ("fused", j.fused),
        ):
            found.setdefault(name, []).append(recall(np.where(asked, scores, NEVER), j))
    return {name: float(np.mean(values)) for name, values in found.items()}


def recall(scores: NDArray[np.float64], scored: ViewpointScores) -> float:
    """Return share of texts whose best place, of summed probability, is near the truth."""
    p = np.exp(scores - scores.max(axis=1, keepdims=True))
    summed = (scored.together @ p[..., None])[..., 0] * (scores > NEVER) + 1e-3 * p
    return float(scored.near[np.arange(len(p)), summed.argmax(axis=1)].mean())


SCALES, WEIGHTS = (0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.15), (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
"""Grid of the scale of relational matching and the weight of the network."""


def fit_prior(scored: Sequence[ViewpointScores], scale: float) -> tuple[float, float]:
    """Return scale of relational matching, and weight of what the network adds, of greatest likelihood.

    `scored` are texts from where nothing was trained, with the weight still 1 and this `scale`.
    """
    best, found = -np.inf, (1.0, 0.0)  # nothing told: as relational matching has it
    if not any(j.near.any() for j in scored):
        return found
    for new in SCALES:
        for weight in WEIGHTS:
            likelihood = np.mean([_likelihood(j, scale, new, weight) for j in scored])
            if likelihood > best:
                best, found = float(likelihood), (new, weight)
    return found


def _likelihood(scored: ViewpointScores, scale: float, new: float, weight: float) -> float:
    """Return mean log probability of being near the truth, where anything is."""
    asked = np.isfinite(scored.relational)
    relational = np.where(asked, scored.relational, 0.0)
    added = np.where(asked, scored.fused, 0.0) - scale * relational
    scores = np.where(asked, new * relational + weight * added, NEVER)
    near = scored.near.any(axis=1)
    right = np.where(scored.near, scores, NEVER)
    log_p = np.logaddexp.reduce(right, axis=1) - np.logaddexp.reduce(scores, axis=1)
    return float(log_p[near].mean()) if near.any() else 0.0


VERSION = 1
WARM = 100
"""Steps until the learning rate is full."""


class Trainer:
    """Network in training, with the scales of its losses and the optimizer."""

    def __init__(
        self, options: TrainOptions, device: str, progress: Progress, word_vectors: int = 0
    ) -> None:
        self.options, self.device, self.progress = options, device, progress
        self.epochs = 0
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(options.seed)
            self.network = Network(options.shape, word_vectors)
        self.network.eval()
        self.module = torch.nn.Module()
        self.module.network = self.network
        self.similarity = torch.nn.Parameter(torch.full((1,), 2.0))
        self.embedding = torch.nn.Parameter(torch.full((1,), 2.5))
        self.module.register_parameter("similarity", self.similarity)
        self.module.register_parameter("embedding", self.embedding)
        self.module.to(device)
        self.optimizer = torch.optim.AdamW(
            self.module.parameters(), lr=options.rate, weight_decay=options.decay
        )

    def epoch(self, epoch: int, lessons: Sequence[Lessons | CellLessons]) -> dict[str, float]:
        """Learn `options.steps` batches; returns mean losses."""
        seeds = np.random.SeedSequence([self.options.seed, epoch, 1 << 22])
        devices = [torch.cuda.current_device()] if self.device == "cuda" else []
        self.network.train()
        with torch.random.fork_rng(devices=devices):  # dropout draws anew each epoch
            torch.manual_seed(int(seeds.generate_state(1)[0]))
            total = self._steps(epoch, lessons)
        self.network.eval()
        return total

    def _steps(self, epoch: int, lessons: Sequence[Lessons | CellLessons]) -> dict[str, float]:
        options = self.options
        rng = np.random.default_rng([options.seed, epoch, 1 << 21])
        total: dict[str, float] = {}
        for step in range(options.steps):
            lesson: Any = lessons[int(rng.integers(len(lessons)))]
            batch = lesson.batch(*lesson.draw(options.batch, options.share, rng))
            done = (epoch * options.steps + step) / (options.epochs * options.steps)
            rate = options.rate * (0.5 + 0.5 * np.cos(np.pi * done)) + 1e-5
            for group in self.optimizer.param_groups:  # warm up, then a cosine
                group["lr"] = float(rate * min(1.0, (epoch * options.steps + step + 1) / WARM))
            scores = forward(self.network, lesson, batch, self.device)
            prior = self.network.prior
            relational = self.similarity if prior is None else prior[1]
            scales = Temperatures(self.similarity, self.embedding, relational)
            found = losses(scores, batch.truth(self.device), scales, options.losses)
            self.optimizer.zero_grad()
            torch.stack(list(found.values())).sum().backward()
            for p in self.module.parameters():  # every weight keeps a state, used or not
                p.grad = torch.zeros_like(p) if p.grad is None else p.grad
            torch.nn.utils.clip_grad_norm_(self.module.parameters(), 5.0)
            self.optimizer.step()
            for name, loss in found.items():
                total[name] = total.get(name, 0.0) + float(loss.detach()) / options.steps
            now = {name: value * options.steps / (step + 1) for name, value in total.items()}
            self.progress.step(epoch, step + 1, options.steps, now)
        return total

    def write(self, path: Path) -> None:
        """Write the network and the optimizer after an epoch."""
        arrays: dict[str, NDArray[Any]] = {}
        for name, p in self.module.named_parameters():
            state = self.optimizer.state[p]
            arrays[f"weight:{name}"] = p.detach().cpu().numpy()
            for moment in ("exp_avg", "exp_avg_sq"):
                arrays[f"{moment}:{name}"] = state[moment].cpu().numpy()
            steps = int(state["step"])
        write_map(path, "training", VERSION, {"epoch": self.epochs, "steps": steps}, arrays)

    def read(self, path: Path) -> None:
        """Restore the network, the optimizer and the number of finished epochs, if there is a file."""
        if not path.exists():
            return
        file = read_map(path, "training", VERSION)

        def tensor(key: str, p: Tensor) -> Tensor:
            return torch.from_numpy(file.array(key, "<f4", p.ndim).copy()).to(p.device)

        with torch.no_grad():
            for name, p in self.module.named_parameters():
                p.copy_(tensor(f"weight:{name}", p))
                moments = {m: tensor(f"{m}:{name}", p) for m in ("exp_avg", "exp_avg_sq")}
                steps = torch.tensor(float(file.meta["steps"]))
                self.optimizer.state[p] = {"step": steps, **moments}
        self.epochs = int(file.meta["epoch"])


def train(
    cities: Mapping[str, CityMap],
    out: str | PathLike[str],
    *,
    folder: str | PathLike[str],
    pools: str | PathLike[str] | None = None,
    options: TrainOptions | None = None,
    vocabulary: Vocabulary | None = None,
    device: str = "auto",
    progress: Progress | None = None,
) -> Weights:
    """Train the network on cities and write a weights file (Eq. 17-19).

    Raises `OptionError`: there are no cities, or the folder holds another training; `InputError`:
    the file of word vectors cannot be read, or knows no word of the maps.

    `cities`: maps by name. Every fourth square kilometre (`descriptions.held_out`) is left for
        evaluation.
    `out`: weights file to write.
    `folder`: holds what an interrupted training goes on from; the same call goes on.
    `pools`: folder of examples that several trainings may share; within `folder` if not given.
    `options`: how to train.
    `vocabulary`: words of the speakers; the shipped one where not given.
    `device`: ``cpu``, ``cuda`` or ``auto``.
    `progress`: is told how far the training is.
    """
    options, progress = options or TrainOptions(), progress or Progress()
    if not cities:
        raise OptionError("No city map is given to train on; name at least one.")
    device = str(select_device(torch, device))
    vocabulary = vocabulary or Vocabulary.default()
    word_vectors = None
    if options.word_vectors is not None:
        labels = {*vocabulary.english, *(word for city in cities.values() for word in city.words)}
        wanted = {word for label in labels for word in words_of(label)}
        word_vectors = read_word2vec(options.word_vectors, wanted)
    plan: dict[str, Any] = {
        "cities": {name: len(city.objects) for name, city in cities.items()},
        "options": asdict(options),
    }
    if word_vectors is not None:  # another file of the same name is another training
        plan["words"] = hash_weights(word_vectors.words, {"vectors": word_vectors.vectors})[:16]
    at = Path(folder)
    plan = open_folder(at, plan)
    trainer = Trainer(
        options, device, progress, word_vectors.vectors.shape[1] if word_vectors else 0
    )
    trainer.read(at / "state")
    examples = Examples(
        cities, vocabulary, options, progress, Path(pools or at / "pools"), word_vectors
    )
    held_out: Any = examples.held_out()
    past = [lessons for epoch in range(trainer.epochs) for lessons in examples.lessons(epoch)]

    def measure() -> list[ViewpointScores]:
        return [score_viewpoints(trainer.network, lessons, device) for lessons in held_out]

    def learn(epoch: int) -> dict[str, float]:
        past.extend(examples.lessons(epoch))
        means = trainer.epoch(epoch, past)
        if options.shape.printed:
            return means | cell_recalls(trainer.network, held_out)
        return means | mean_recalls(measure())

    run_epochs(trainer, options.epochs, learn, at / "state", progress)
    state = {n: p.detach().cpu().numpy() for n, p in trainer.network.named_parameters()}
    if not options.shape.printed:
        fitted = fit_prior(measure(), float(state["prior"][1]))
        state["prior"] = np.array([state["prior"][0], *fitted], np.float32)
    training = {"plan": plan, "curves": rows_of(at)}
    weights = round_weights(options.shape, state, training, word_vectors)
    write_weights(out, weights)
    return weights


@dataclass(frozen=True, eq=False)
class Examples:
    """Examples of every epoch; those of our network are made once and then kept in a folder."""

    cities: Mapping[str, CityMap]
    vocabulary: Vocabulary
    options: TrainOptions
    progress: Progress
    folder: Path
    word_vectors: WordVectors | None = None

    @cached_property
    def cells(self) -> dict[str, LabelGraphs]:
        """Graphs of all cells as printed, by city."""
        return {name: LabelGraphs.of_cells(city) for name, city in self.cities.items()}

    def lessons(self, epoch: int) -> list[Lessons | CellLessons]:
        """Return examples of an epoch, one pool a city."""
        return [
            self._made(name, f"{name}-{epoch}", epoch, self.options.examples, held_out=False)
            for name in self.cities
        ]

    def held_out(self) -> list[Lessons | CellLessons]:
        """Return examples from the tiles that are never trained on."""
        return [
            self._made(name, f"{name}-check", 1 << 20, self.options.check, held_out=True)
            for name in self.cities
        ]

    def _made(
        self, name: str, file: str, epoch: int, n: int, *, held_out: bool
    ) -> Lessons | CellLessons:
        city, seed, shape = self.cities[name], self.options.descriptions, self.options.shape
        seed = self.options.seed if seed is None else seed
        rng, done = np.random.default_rng([seed, epoch, *name.encode()]), count(1)
        speaker = Speaker(city, self.vocabulary, held_out=held_out, plain=shape.printed)

        def tick() -> None:
            self.progress.report_descriptions(epoch, name, next(done), n)

        if shape.printed:
            lessons = make_cell_lessons(speaker, self.cells[name], n, rng, tick)
            return replace(lessons, subwords=shape.subwords, word_vectors=self.word_vectors)
        path = self.folder / f"{file}-{seed}-{n}-{city.digest[:8]}.pool"
        if path.exists():
            pool = read_pool(path)
        else:
            pool = make_pool(speaker, n, rng, tick)
            try:
                self.folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise InputError(
                    f"{self.folder} cannot be used as a folder for examples ({error}); name "
                    "another."
                ) from error
            write_pool(path, pool)
        return Lessons(city, pool, shape.subwords, self.word_vectors)


def write_pool(path: Path, pool: ExamplePool) -> None:
    """Write examples to a file."""
    arrays = {f"text:{f.name}": getattr(pool.texts, f.name) for f in fields(TextGraphs)}
    arrays["text:vocabulary"] = pack_strings(pool.texts.vocabulary)
    arrays |= {f"fit:{name}": column for name, column in pool.word_weights._asdict().items()}
    arrays |= {n: getattr(pool, n) for n in ("positions", "views", "scores", "right")}
    write_map(path, "pool", VERSION, {}, arrays)


def read_pool(path: Path) -> ExamplePool:
    """Read examples from a file."""
    file = read_map(path, "pool", VERSION)
    arrays = dict(file.arrays)
    texts: dict[str, Any] = {f.name: arrays[f"text:{f.name}"] for f in fields(TextGraphs)}
    texts["vocabulary"] = file.strings("text:vocabulary")
    fits = WordWeights(*(arrays[f"fit:{name}"] for name in WordWeights._fields))
    rest = {n: arrays[n] for n in ("positions", "views", "scores", "right")}
    return ExamplePool(TextGraphs(**texts), fits, **rest)
