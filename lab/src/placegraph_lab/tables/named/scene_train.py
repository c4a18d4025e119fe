"""Does the network of SceneGraphLoc learn? Procedural homes, and others that it never saw.

    placegraph-lab table scene_train
    placegraph-lab table scene_train --homes 20 --epochs 4

Trains the small network on features of colour and prints, as Markdown, how often the nearest object
of a home's map is the one that a patch shows: by chance, by the features alone, by the network
untrained and trained, in homes learned and in homes held out. Writes every figure as JSON. Run it
again and it goes on where it was cut.
"""

from __future__ import annotations

from typing import Annotated

from placegraph_lab.tables.runner import Quick, Run, Seed, option, table


@table()
def scene_train(
    run: Run,
    *,
    homes: Annotated[int, option("Procedural homes, those held out too.")] = 60,
    held: Annotated[int, option("Homes that are not learned.")] = 8,
    frames: Annotated[int, option("Images of a walk through a home.")] = 10,
    epochs: Annotated[int, option("Rounds over all images.")] = 20,
    batch: Annotated[int, option("Images a step.")] = 8,
    others: Annotated[int, option("Other homes a patch is told from.")] = 3,
    points: Annotated[int, option("Points of an object.")] = 64,
    rate: Annotated[float, option("Learning rate of the first epoch.")] = 4e-3,
    seed: Seed = 0,
    quick: Quick = False,
) -> None:
    """Does the network of SceneGraphLoc learn? Procedural homes, and others it never saw."""
    from placegraph_lab.tables.scene.train import learn_and_ask
    from placegraph_learn.scenegraphloc.train import TrainOptions

    if quick:
        homes, held, frames, epochs = 4, 1, 3, 1
    options = TrainOptions(
        epochs=epochs, batch=batch, others=others, points=points, rate=rate, seed=seed
    )
    text, record = learn_and_ask(run, options, count=homes, held=held, frames=frames)
    print(text)
    run.save(record)
