"""`placegraph scene train`: the network of SceneGraphLoc, on one's own maps or on drawn homes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from placegraph.cli.command import Argument, Option
from placegraph.cli.common import AsJson, Quiet
from placegraph.errors import OptionError
from placegraph_lab.cli.training_shown import TrainingDevice, WorkFolder, training
from placegraph_learn.scenegraphloc.widths import Widths

if TYPE_CHECKING:
    from placegraph_learn.scenegraphloc.weights import Weights
    from placegraph_learn.train.scenegraphloc.lessons import Teacher, World


def train(
    out: Annotated[Path, Option("--out", "-o", help="Weights to write: mine.safetensors.")],
    work: WorkFolder,
    maps: Annotated[
        Path | None,
        Argument(
            help="Folder of scene maps: each NAME.scene with a capture, or several, in the folder "
            "NAME beside it, whose poses are in the map."
        ),
    ] = None,
    synthetic: Annotated[
        int | None,
        Option(least=3, help="Train on so many procedural homes instead of maps of your own."),
    ] = None,
    held: Annotated[
        int | None,
        Option(least=1, help="Places that are not learned but asked about; a fifth if not given."),
    ] = None,
    features: Annotated[
        str, Option(help="Image features: colour (no weights), or dinov2 as published.")
    ] = "colour",
    feature_weights: Annotated[
        Path | None, Option(help="File with DINOv2's weights; fetched if not given.")
    ] = None,
    attributes: Annotated[
        Path | None,
        Option(help="Attribute words, one a line; if not given attributes say nothing."),
    ] = None,
    width: Annotated[
        str, Option(help="Of the network: small, or published (34 million weights).")
    ] = "small",
    rotate: Annotated[
        bool | None,
        Option(
            "--rotate/--no-rotate",
            help="Turn all images clockwise, as 3RScan's; if not given each by its gravity.",
        ),
    ] = None,
    frames: Annotated[
        int, Option(least=1, help="Images of each walk through a procedural home.")
    ] = 16,
    epochs: Annotated[int, Option(least=1, help="Rounds over all pictures.")] = 30,
    batch: Annotated[int, Option(least=1, help="Pictures a step.")] = 16,
    others: Annotated[
        int, Option(least=0, help="Other places whose objects a patch is told from.")
    ] = 9,
    points: Annotated[
        int, Option(least=1, help="Points of each object that an epoch looks at.")
    ] = 512,
    rate: Annotated[float, Option(help="Learning rate of the first epoch.")] = 1.1e-3,
    seed: Annotated[int, Option(least=0, help="The same seed, the same homes and weights.")] = 0,
    device: TrainingDevice = "auto",
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Train the network of SceneGraphLoc, which tells what object of a map a patch of an image shows.

    Needs the extra `learn`. Interrupted, the same command goes on. After each epoch it is asked about
    places it never learned: `patch` is the share of patches told right, `changed` the same with the
    map of months before, `room` the share of images whose own place scores highest.

    Example: placegraph scene train --synthetic 40 -o mine.safetensors --work training/

    Example: placegraph scene train maps/ -o mine.safetensors --work training/ --features dinov2
    """
    from time import perf_counter

    from placegraph_lab.cli.scene_train_shown import Shown, draw
    from placegraph_learn.train.scenegraphloc.options import TrainOptions
    from placegraph_learn.train.scenegraphloc.train import train as learn

    options = TrainOptions(
        epochs=epochs, batch=batch, others=others, points=points, rate=rate, seed=seed
    )
    worlds = _worlds(maps, synthetic, frames, seed)
    teacher, widths = _teacher(features, feature_weights, attributes, width, rotate, device)
    start = perf_counter()
    with training(work, hidden=quiet or as_json) as bars:
        shown = Shown(bars, work, epochs, table=not (quiet or as_json))
        weights = learn(
            worlds,
            out,
            folder=work,
            held=held if held is not None else max(1, len(worlds) // 5),
            teacher=teacher,
            widths=widths,
            options=options,
            device=device,
            progress=shown,
        )
    picture = draw(work)
    facts = _facts(weights, out, work, picture, perf_counter() - start)
    if as_json:
        click.echo(json.dumps(facts))
    elif not quiet:
        click.echo(
            f"{out}: {facts['bytes']:,} bytes, {weights.digest}, trained in {facts['seconds']} s. "
            f"Curves: {picture}"
        )


def _worlds(maps: Path | None, synthetic: int | None, frames: int, seed: int) -> list[World]:
    from placegraph_learn.train.scenegraphloc.worlds import folder, homes

    if (maps is None) == (synthetic is None):
        raise OptionError("Give a folder of scene maps, or --synthetic with a number: one of both.")
    if maps is not None:
        return folder(maps)
    return homes(synthetic or 0, seed=seed, frames=frames)


def _teacher(
    features: str,
    feature_weights: Path | None,
    attributes: Path | None,
    width: str,
    rotate: bool | None,
    device: str,
) -> tuple[Teacher, Widths]:
    from placegraph_learn.scenegraphloc.features import features_named, read_attributes
    from placegraph_learn.scenegraphloc.widths import Widths
    from placegraph_learn.train.scenegraphloc.lessons import Teacher

    words = () if attributes is None else read_attributes(attributes)
    found = features_named(features, weights=feature_weights, device=device)
    teacher = Teacher(found, rotate=rotate, attributes=words)
    if width == "small":
        return teacher, Widths.small(found.dimension, teacher.attribute_count)
    if width != "published":
        raise OptionError(f"--width is {width!r}; it is small or published.")
    return teacher, Widths(feature=found.dimension, attributes=teacher.attribute_count)


def _facts(
    weights: Weights, out: Path, work: Path, picture: Path, seconds: float
) -> dict[str, object]:
    from placegraph_learn.train.training import rows_of

    return {
        "weights": str(out),
        "bytes": out.stat().st_size,
        "digest": weights.digest,
        "notes": weights.notes,
        "curves": rows_of(work),
        "picture": str(picture),
        "seconds": round(seconds, 1),
    }
