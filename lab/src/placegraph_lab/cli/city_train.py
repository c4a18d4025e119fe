"""`placegraph city train`: a network of one's own, from one's own maps."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from placegraph.cli.command import Argument, Option
from placegraph.cli.common import AsJson, Quiet
from placegraph.errors import OptionError
from placegraph_lab.cli.training_shown import TrainingDevice, WorkFolder, training

if TYPE_CHECKING:
    from placegraph.outdoor.network.weights import Weights

NETWORK = "The network and its losses"


def train(
    maps: Annotated[list[Path], Argument(help="City maps (.city) to train on, one or several.")],
    out: Annotated[Path, Option("--out", "-o", help="Weights to write: mine.weights.")],
    work: WorkFolder,
    epochs: Annotated[int, Option(least=1, help="Rounds; each brings new descriptions.")] = 5,
    examples: Annotated[
        int, Option(least=1, help="New descriptions of a city in each epoch.")
    ] = 1200,
    steps: Annotated[int, Option(least=1, help="Batches an epoch.")] = 300,
    batch: Annotated[int, Option(least=1, help="Descriptions a batch.")] = 32,
    check: Annotated[
        int, Option(least=1, help="Descriptions of a city, never learned, for the curves.")
    ] = 500,
    rate: Annotated[float, Option(help="Largest learning rate.")] = 2e-3,
    losses: Annotated[
        str,
        Option(
            help="With commas: match, similarity, embedding, fusion; eq17, eq18 are the paper's "
            "as printed.",
            panel=NETWORK,
        ),
    ] = "match,similarity,embedding,fusion",
    layers: Annotated[int, Option(least=0, help="GPS layers of a side.", panel=NETWORK)] = 2,
    crossings: Annotated[
        int, Option(least=0, help="Layers of cross attention; 0 for none.", panel=NETWORK)
    ] = 2,
    heads: Annotated[int, Option(least=1, help="Of attention.", panel=NETWORK)] = 4,
    statements: Annotated[
        bool,
        Option(
            "--statements/--no-statements",
            help="Judge every statement by what its ends find; without, the paper's joint model.",
            panel=NETWORK,
        ),
    ] = True,
    seed: Annotated[
        int, Option(least=0, help="The same seed, the same descriptions and weights.")
    ] = 0,
    device: TrainingDevice = "auto",
    pools: Annotated[
        Path | None, Option(help="Folder of descriptions that several trainings share.")
    ] = None,
    word_vectors: Annotated[
        Path | None, Option(help="File of word2vec, text or binary, whose vectors stand for words.")
    ] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Train the matching network on city maps.

    Needs the extra `learn`. Interrupted, the same command goes on.

    Example: placegraph city train ulm.city bern.city -o mine.weights --work training/
    """
    from time import perf_counter

    from placegraph.core.mapfile import writing
    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.network.weights import Shape
    from placegraph_lab.cli.city_train_shown import Shown, draw
    from placegraph_learn.train.city.options import TrainOptions
    from placegraph_learn.train.city.train import train as learn

    options = TrainOptions(
        epochs=epochs,
        examples=examples,
        steps=steps,
        batch=batch,
        check=check,
        rate=rate,
        losses=tuple(name.strip() for name in losses.split(",")),
        seed=seed,
        shape=Shape(layers=layers, crossings=crossings, heads=heads, statements=statements),
        word_vectors=None if word_vectors is None else str(word_vectors),
    )
    names = _names(maps)
    with writing(out):
        pass  # a folder that cannot be written to is refused now, not after hours
    cities = {name: CityMap.open(path) for name, path in zip(names, maps, strict=True)}
    start = perf_counter()
    with training(work, hidden=quiet or as_json) as bars:
        shown = Shown(bars, work, options, table=not (quiet or as_json))
        weights = learn(
            cities,
            out,
            folder=work,
            pools=pools,
            options=options,
            device=device,
            progress=shown,
        )
    curves = draw(work)
    seconds = perf_counter() - start
    if as_json:
        click.echo(json.dumps(_facts(weights, out, curves, seconds)))
    elif not quiet:
        click.echo(
            f"{out}: {out.stat().st_size:,} bytes, {weights.fingerprint}, trained in {seconds:.0f} s. "
            f"Curves: {curves}"
        )


def _names(maps: Sequence[Path]) -> list[str]:
    names = [path.stem for path in maps]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise OptionError(
            f"Several maps are called {min(twice)}; rename one, examples are kept by name."
        )
    return names


def _facts(weights: Weights, out: Path, curves: Path, seconds: float) -> dict[str, object]:
    return {
        "weights": str(out),
        "bytes": out.stat().st_size,
        "fingerprint": weights.fingerprint,
        "curves": weights.training["curves"],
        "picture": str(curves),
        "seconds": round(seconds, 1),
    }
