"""Training: descriptions made on the fly, hard candidates, three losses; resumable and seeded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from typing import TYPE_CHECKING

import numpy as np

from placegraph.core.networks import digest
from placegraph.outdoor.city import CityMap
from placegraph.outdoor.language.vocabulary import Vocabulary
from placegraph.outdoor.network.labels import WordVectors, words_of
from placegraph.outdoor.network.weights import Weights, trained, write_weights
from placegraph_lab.datasets.word2vec import read_word2vec
from placegraph_learn.train.city.options import Progress, TrainOptions, check
from placegraph_learn.train.city.pool import fill
from placegraph_learn.train.city.sample import Speaker
from placegraph_learn.train.training import (
    add_row,
    device_named,
    rows_of,
    torch_or_what_installs_it,
)

if TYPE_CHECKING:
    from placegraph_learn.train.city.checkpoint import PoolFolder
    from placegraph_learn.train.city.torch_batches import Lessons


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

    Parameters
    ----------
    cities
        Maps by name. Every fourth square kilometre (`sample.held_out`) is left for evaluation.
    out
        Weights file to write.
    folder
        Holds what an interrupted training goes on from; the same call goes on.
    pools
        Folder of examples that several trainings may share; within `folder` if not given.
    options
        How to train.
    vocabulary
        Words of the speakers; the shipped one where not given.
    device
        ``cpu``, ``cuda`` or ``auto``.
    progress
        Is told how far the training is.

    Raises
    ------
    MissingExtraError
        PyTorch is not installed.
    OptionError
        An option is out of range, or the folder holds another training.
    InputError
        The file of word vectors cannot be read, or knows no word of the maps.

    """
    options, progress = options or TrainOptions(), progress or Progress()
    check(cities, options)
    torch = torch_or_what_installs_it()
    from placegraph.outdoor.language.vocabulary import Vocabulary as Shipped
    from placegraph_learn.train.city.checkpoint import Folder, PoolFolder, plan_of
    from placegraph_learn.train.city.recalls import best_prior, judge, recalls
    from placegraph_learn.train.city.trainer import Trainer

    device = device_named(device, cuda=torch.cuda.is_available())
    vocabulary = vocabulary or Shipped.default()
    known = _known(options, cities, vocabulary)
    plan = plan_of({n: len(c.objects) for n, c in cities.items()}, options)
    if known is not None:  # another file of the same name is another training
        plan["words"] = digest(known.words, {"vectors": known.vectors})[:16]
    kept = Folder(folder, plan)
    trainer = Trainer(options, device, progress, known.vectors.shape[1] if known else 0)
    begun = kept.read_state(trainer.module, trainer.optimizer)
    store = PoolFolder(pools or kept.path / "pools")
    school = School(cities, vocabulary, options, progress, store, known)
    held = school.held_out()
    past = [lessons for epoch in range(begun) for lessons in school.lessons(epoch)]
    for epoch in range(begun, options.epochs):
        fresh = school.lessons(epoch)
        past += fresh
        row = {"epoch": epoch + 1, **trainer.epoch(epoch, past)}
        judged = [judge(trainer.network, lessons, device) for lessons in held]
        row |= recalls(judged)
        add_row(kept.path, row)  # first: an epoch that is done again gives the same row
        kept.write_state(epoch + 1, trainer.module, trainer.optimizer)
        progress.epoch(row)
    state = {n: p.detach().cpu().numpy() for n, p in trainer.network.named_parameters()}
    scale = float(state["prior"][1])
    fitted = best_prior([judge(trainer.network, lessons, device) for lessons in held], scale)
    state["prior"] = np.array([state["prior"][0], *fitted], np.float32)
    training = {"plan": kept.plan, "curves": rows_of(kept.path)}
    weights = trained(options.shape, state, training, known)
    write_weights(out, weights)
    return weights


def _known(
    options: TrainOptions, cities: Mapping[str, CityMap], vocabulary: Vocabulary
) -> WordVectors | None:
    """Word vectors of the words in tags and in the names of these maps, where a file is named."""
    if options.word_vectors is None:
        return None
    labels = {*vocabulary.english, *(word for city in cities.values() for word in city.words)}
    return read_word2vec(options.word_vectors, {w for label in labels for w in words_of(label)})


@dataclass(frozen=True, eq=False)
class School:
    """Makes the examples of every epoch, or reads those that were made before."""

    cities: Mapping[str, CityMap]
    vocabulary: Vocabulary
    options: TrainOptions
    progress: Progress
    store: PoolFolder
    known: WordVectors | None = None

    def lessons(self, epoch: int) -> list[Lessons]:
        """Examples of an epoch, one pool a city."""
        return [
            self._made(name, f"{name}-{epoch}", epoch, self.options.examples, held=False)
            for name in self.cities
        ]

    def held_out(self) -> list[Lessons]:
        """Examples from the tiles that are never trained on."""
        return [
            self._made(name, f"{name}-check", 1 << 20, self.options.check, held=True)
            for name in self.cities
        ]

    def _made(self, name: str, file: str, epoch: int, n: int, *, held: bool) -> Lessons:
        from placegraph_learn.train.city.torch_batches import Lessons

        city, seed = self.cities[name], self.options.descriptions
        seed = self.options.seed if seed is None else seed
        file = f"{file}-{seed}-{n}-{city.fingerprint[:8]}"
        pool = self.store.read(file)
        if pool is None:
            rng = np.random.default_rng([seed, epoch, *name.encode()])
            done = 0

            def tick() -> None:
                nonlocal done
                done += 1
                self.progress.filling(epoch, name, done, n)

            pool = fill(Speaker(city, self.vocabulary, held=held), n, rng, tick)
            self.store.write(file, pool)
        return Lessons(city, pool, self.options.shape.subwords, self.known)
