"""Commands `placegraph city train` and `placegraph scene train`."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any

import click
from rich import progress as rich
from rich.console import Console

from placegraph.cli.command import Argument, Fields, Option
from placegraph.cli.common import INTERRUPTED, AsJson, Quiet, bare
from placegraph.core.plugins import load_plugin, plugins
from placegraph.errors import MissingExtraError, OptionError
from placegraph_learn.training import Progress, draw_curves, refuse_twins, rows_of

if TYPE_CHECKING:
    from placegraph_learn.scenegraphloc.lessons import Teacher, World
    from placegraph_learn.scenegraphloc.network import Widths

WORLDS, HOMES = "placegraph.training_worlds", "homes"
"""Entry point of another distribution that draws places to learn from."""
HELD_OUT = "correct, in held-out places"
"""Title of the curves of `scene train`."""

WorkFolder = Annotated[
    Path,
    Option(help="Folder for checkpoints and training curves."),
]
TrainingDevice = Annotated[str, Option(help="auto, cpu or cuda.")]


def train_city(  # options of a command
    maps: Annotated[list[Path], Argument(help="City maps (.city) to train on, one or several.")],
    out: Annotated[Path, Option("--out", "-o", help="Weights to write: mine.weights.")],
    work: WorkFolder,
    options: Annotated[dict[str, Any], Fields("placegraph_learn.city.train:TrainOptions")],
    shape: Annotated[dict[str, Any], Fields("placegraph.outdoor.network.weights:Shape")],
    device: TrainingDevice = "auto",
    pools: Annotated[
        Path | None, Option(help="Folder of descriptions, shared by several trainings.")
    ] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Train the matching network on city maps.

    Needs the extra `learn`. Run the same command again to resume an interrupted training.

    Example: placegraph city train ulm.city bern.city -o mine.weights --work training/
    """
    from placegraph.core.mapfile import map_writer
    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.network.weights import Shape
    from placegraph_learn.city.train import TrainOptions, train

    chosen = TrainOptions(**options, shape=Shape(**shape))
    refuse_twins([path.stem for path in maps])
    with map_writer(out):
        pass  # a folder that cannot be written to is refused now, not after hours
    cities = {path.stem: CityMap.open(path) for path in maps}
    with show_training(work, chosen.epochs, table=not (quiet or as_json)) as progress:
        weights = train(
            cities, out, folder=work, pools=pools, options=chosen, device=device, progress=progress
        )
    progress.report(out, {"fingerprint": weights.digest}, as_json=as_json, quiet=quiet)


def train_scene(
    out: Annotated[Path, Option("--out", "-o", help="Weights to write: mine.safetensors.")],
    work: WorkFolder,
    options: Annotated[dict[str, Any], Fields("placegraph_learn.scenegraphloc.train:TrainOptions")],
    maps: Annotated[
        Path | None,
        Argument(
            help="Folder of scene maps NAME.scene, each with one or more captures in a folder NAME, "
            "with poses in the map's frame."
        ),
    ] = None,
    synthetic: Annotated[
        int | None,
        Option(least=3, help="Number of procedural homes to train on, instead of your own maps."),
    ] = None,
    held_out: Annotated[
        int | None,
        Option(
            "--held",
            least=1,
            help="Number of places held out for validation; a fifth if not given.",
        ),
    ] = None,
    features: Annotated[
        str, Option(help="Image features: colour (no weights), or dinov2 as published.")
    ] = "colour",
    feature_weights: Annotated[
        Path | None, Option(help="File with DINOv2's weights; fetched if not given.")
    ] = None,
    attributes: Annotated[
        Path | None,
        Option(help="Attribute words, one per line; if not given, attributes are ignored."),
    ] = None,
    width: Annotated[
        str, Option(help="Width of the network: small, or published (34 million weights).")
    ] = "small",
    rotate: Annotated[
        bool | None,
        Option(
            "--rotate/--no-rotate",
            help="Rotate all images clockwise (3RScan's as stored); if not given, each by its gravity.",
        ),
    ] = None,
    frames: Annotated[
        int, Option(least=1, help="Images of each walk through a procedural home.")
    ] = 16,
    device: TrainingDevice = "auto",
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Train the network of SceneGraphLoc, which matches image patches with objects of a map.

    Needs the extra `learn`. Run the same command again to resume an interrupted training. After each
    epoch it is evaluated in held-out places: `patch` is the share of patches matched correctly,
    `changed` the same with a map of months before, `room` the share of images whose place is first.

    Example: placegraph scene train --synthetic 40 -o mine.safetensors --work training/

    Example: placegraph scene train maps/ -o mine.safetensors --work training/ --features dinov2
    """
    from placegraph_learn.scenegraphloc.train import TrainOptions, train

    chosen = TrainOptions(**options)
    worlds = choose_worlds(maps, synthetic, frames, chosen.seed)
    teacher, widths = _teacher(features, feature_weights, attributes, width, rotate, device)
    with show_training(
        work, chosen.epochs, table=not (quiet or as_json), title=HELD_OUT
    ) as progress:
        weights = train(
            worlds,
            out,
            folder=work,
            held_out=held_out if held_out is not None else max(1, len(worlds) // 5),
            teacher=teacher,
            widths=widths,
            options=chosen,
            device=device,
            progress=progress,
        )
    facts = {"digest": weights.digest, "notes": weights.notes}
    progress.report(out, facts, as_json=as_json, quiet=quiet)


def choose_worlds(maps: Path | None, synthetic: int | None, frames: int, seed: int) -> list[World]:
    """Return the places to learn from: a folder of scene maps, or procedural homes."""
    from placegraph_learn.scenegraphloc.lessons import folder

    if (maps is None) == (synthetic is None):
        raise OptionError("Give either a folder of scene maps, or --synthetic with a number.")
    if maps is not None:
        return folder(maps)
    if HOMES not in plugins(WORLDS):
        raise MissingExtraError(
            "--synthetic needs placegraph-lab, which is not installed; run `pip install "
            "placegraph-lab`."
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
        raise OptionError(f"--width is {width!r}; choose small or published.")
    return teacher, Widths(feature=found.dimension, attributes=teacher.attribute_count)


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
            kept = f"{done} epochs are saved" if done != 1 else "1 epoch is saved"
            command = shlex.join(["placegraph", *sys.argv[1:]])
            click.echo(
                f"Interrupted; {kept} in {work}. Resume with the same command: {command}",
                err=True,
            )
            raise click.exceptions.Exit(INTERRUPTED) from None


class ShownProgress(Progress):
    """Progress of a training on a terminal: bars, figures of epochs, a picture of the curves."""

    def __init__(
        self, bars: rich.Progress, work: Path, epochs: int, *, table: bool, title: str | None = None
    ) -> None:
        self.bars, self.work, self.epochs, self.table, self.title = bars, work, epochs, table, title
        self.start = perf_counter()
        self.has_header = False
        self.preparation = bars.add_task("preparing", total=None, losses="", visible=False)
        self.learning = bars.add_task("learning", total=None, losses="", visible=False)

    def report_descriptions(self, epoch: int, city: str, done: int, total: int) -> None:
        """Show how many descriptions of a city are made."""
        when = f" for epoch {epoch + 1}" if epoch < self.epochs else ""
        self._update(self.preparation, f"describing {city}{when}", done, total)

    def report_place(self, name: str, done: int, total: int) -> None:
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

    def report(
        self, weights: Path, facts: Mapping[str, object], *, as_json: bool, quiet: bool
    ) -> None:
        """Print the facts about written weights, whose digest comes first, as JSON or as a sentence."""
        size, picture = weights.stat().st_size, self.draw()
        seconds = round(perf_counter() - self.start, 1)
        if as_json:
            told = {"weights": str(weights), "bytes": size} | dict(facts)
            told |= {"curves": rows_of(self.work), "picture": str(picture), "seconds": seconds}
            click.echo(json.dumps(told))
        elif not quiet:
            digest = next(iter(facts.values()))
            click.echo(
                f"{weights}: {size:,} bytes, {digest}, trained in {seconds:.0f} s. Curves: {picture}"
            )
