"""Commands `placegraph city train` and `placegraph scene train`."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated

import click
from rich import progress as rich
from rich.console import Console

from placegraph.cli.command import Argument, Option
from placegraph.cli.common import AsJson, Quiet, bare
from placegraph.core.plugins import load_plugin, plugins
from placegraph.errors import MissingExtraError, OptionError
from placegraph_learn.training import Progress, draw_curves, rows_of

if TYPE_CHECKING:
    from placegraph_learn.scenegraphloc.lessons import Teacher, World
    from placegraph_learn.scenegraphloc.network import Widths

INTERRUPTED = 130
"""Exit code of shells for a process that Ctrl-C ended."""
WORLDS, HOMES = "placegraph.training_worlds", "homes"
"""Entry point of another distribution that draws places to learn from."""
NETWORK = "The network and its losses"
HELD_OUT = "right, in places not learned"
"""Title of the curves of `scene train`."""

WorkFolder = Annotated[
    Path,
    Option(help="Folder for what an interrupted training goes on from, and its curves."),
]
TrainingDevice = Annotated[str, Option(help="cpu, cuda, or auto.")]


def train_city(  # options of a command
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
    from placegraph.core.mapfile import map_writer
    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.network.network import Shape
    from placegraph_learn.city.train import TrainOptions, train

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
    names = [path.stem for path in maps]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise OptionError(
            f"Several maps are called {min(twice)}; rename one, examples are kept by name."
        )
    with map_writer(out):
        pass  # a folder that cannot be written to is refused now, not after hours
    cities = {name: CityMap.open(path) for name, path in zip(names, maps, strict=True)}
    start = perf_counter()
    with show_training(work, epochs, table=not (quiet or as_json)) as progress:
        weights = train(
            cities,
            out,
            folder=work,
            pools=pools,
            options=options,
            device=device,
            progress=progress,
        )
    facts = {
        "weights": str(out),
        "bytes": out.stat().st_size,
        "fingerprint": weights.fingerprint,
        "curves": weights.training["curves"],
        "picture": str(progress.draw()),
        "seconds": round(perf_counter() - start, 1),
    }
    report(facts, weights.fingerprint, as_json=as_json, quiet=quiet)


def train_scene(
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
    from placegraph_learn.scenegraphloc.train import TrainOptions, train

    options = TrainOptions(
        epochs=epochs, batch=batch, others=others, points=points, rate=rate, seed=seed
    )
    worlds = choose_worlds(maps, synthetic, frames, seed)
    teacher, widths = _teacher(features, feature_weights, attributes, width, rotate, device)
    start = perf_counter()
    with show_training(work, epochs, table=not (quiet or as_json), title=HELD_OUT) as progress:
        weights = train(
            worlds,
            out,
            folder=work,
            held=held if held is not None else max(1, len(worlds) // 5),
            teacher=teacher,
            widths=widths,
            options=options,
            device=device,
            progress=progress,
        )
    facts = {
        "weights": str(out),
        "bytes": out.stat().st_size,
        "digest": weights.digest,
        "notes": weights.notes,
        "curves": rows_of(work),
        "picture": str(progress.draw()),
        "seconds": round(perf_counter() - start, 1),
    }
    report(facts, weights.digest, as_json=as_json, quiet=quiet)


def choose_worlds(maps: Path | None, synthetic: int | None, frames: int, seed: int) -> list[World]:
    """Return the places to learn from: a folder of scene maps, or procedural homes."""
    from placegraph_learn.scenegraphloc.lessons import folder

    if (maps is None) == (synthetic is None):
        raise OptionError("Give a folder of scene maps, or --synthetic with a number: one of both.")
    if maps is not None:
        return folder(maps)
    if HOMES not in plugins(WORLDS):
        raise MissingExtraError(
            "--synthetic draws homes with placegraph-lab, which is not installed; "
            "`pip install placegraph-lab` brings it."
        )
    worlds: list[World] = load_plugin(WORLDS, HOMES, "lab")(synthetic, seed=seed, frames=frames)
    return worlds


def _teacher(
    features: str,
    feature_weights: Path | None,
    attributes: Path | None,
    width: str,
    rotate: bool | None,
    device: str,
) -> tuple[Teacher, Widths]:
    from placegraph_learn.scenegraphloc.features import features_named, read_attributes
    from placegraph_learn.scenegraphloc.lessons import Teacher
    from placegraph_learn.scenegraphloc.network import Widths

    words = () if attributes is None else read_attributes(attributes)
    found = features_named(features, weights=feature_weights, device=device)
    teacher = Teacher(found, rotate=rotate, attributes=words)
    if width == "small":
        return teacher, Widths.small(found.dimension, teacher.attribute_count)
    if width != "published":
        raise OptionError(f"--width is {width!r}; it is small or published.")
    return teacher, Widths(feature=found.dimension, attributes=teacher.attribute_count)


def report(facts: Mapping[str, object], digest: str, *, as_json: bool, quiet: bool) -> None:
    """Print the facts about written weights, as JSON or as a sentence."""
    if as_json:
        click.echo(json.dumps(facts))
    elif not quiet:
        click.echo(
            f"{facts['weights']}: {facts['bytes']:,} bytes, {digest}, trained in "
            f"{facts['seconds']:.0f} s. Curves: {facts['picture']}"
        )


@contextmanager
def show_training(
    work: Path, epochs: int, *, table: bool, title: str | None = None
) -> Iterator[ShownProgress]:
    """Show bars on stderr and, with `table`, a line of figures an epoch.

    Ctrl-C prints how to go on, and exits as shells do.
    """
    console = Console(file=bare(sys.stderr))
    bars = rich.Progress(
        rich.TextColumn("{task.description}"), rich.BarColumn(),
        rich.TextColumn("{task.completed}/{task.total}"), rich.TimeElapsedColumn(),
        rich.TimeRemainingColumn(), rich.TextColumn("{task.fields[losses]}"),
        console=console, transient=True, disable=not (table and console.is_terminal),
        redirect_stdout=sys.stdout.isatty(),
    )  # fmt: skip
    with bars:
        try:
            yield ShownProgress(bars, work, epochs, table=table, title=title)
        except KeyboardInterrupt:
            bars.stop()
            done = len(rows_of(work))
            kept = f"{done} epochs are kept" if done != 1 else "1 epoch is kept"
            command = shlex.join(["placegraph", *sys.argv[1:]])
            click.echo(
                f"Interrupted; {kept} in {work}. The same command goes on from there:\n  {command}",
                err=True,
            )
            raise click.exceptions.Exit(INTERRUPTED) from None


class ShownProgress(Progress):
    """Progress of a training on a terminal: bars, figures of epochs, a picture of the curves."""

    def __init__(
        self, bars: rich.Progress, work: Path, epochs: int, *, table: bool, title: str | None = None
    ) -> None:
        self.bars, self.work, self.epochs, self.table, self.title = bars, work, epochs, table, title
        self.has_header = False
        self.preparation = bars.add_task("preparing", total=None, losses="", visible=False)
        self.learning = bars.add_task("learning", total=None, losses="", visible=False)

    def filling(self, epoch: int, city: str, done: int, total: int) -> None:
        """Show how many descriptions of a city are made."""
        when = f" for epoch {epoch + 1}" if epoch < self.epochs else ""
        self._update(self.preparation, f"describing {city}{when}", done, total)

    def preparing(self, name: str, done: int, total: int) -> None:
        """Show how many places were looked at."""
        self._update(self.preparation, f"looked at {name}", done, total)

    def step(self, epoch: int, done: int, total: int, losses: Mapping[str, float]) -> None:
        """Show how many batches were learned, and their mean losses."""
        text = ", ".join(f"{name} {value:.3f}" for name, value in losses.items())
        self._update(self.learning, f"epoch {epoch + 1} of {self.epochs}", done, total, text)

    def _update(
        self, task: rich.TaskID, text: str, done: int, total: int, losses: str = ""
    ) -> None:
        self.bars.update(
            task, description=text, completed=done, total=total, visible=done < total, losses=losses
        )

    def epoch(self, row: Mapping[str, float]) -> None:
        """Draw the curves and print the figures of an epoch, with their names above the first."""
        self.draw()
        if not self.table:
            return
        if not self.has_header:
            click.echo("  ".join(f"{name:>10}" for name in row))
            self.has_header = True
        cells = (
            f"{value:>{max(10, len(name))}.{0 if name == 'epoch' else 3}f}"
            for name, value in row.items()
        )
        click.echo("  ".join(cells))

    def draw(self) -> Path:
        """Draw the curves so far; returns the path of the picture."""
        return draw_curves(rows_of(self.work), self.work / "curves.png", title=self.title)
