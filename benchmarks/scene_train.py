"""Does the network of SceneGraphLoc learn? Procedural homes, and others that it never saw.

    python benchmarks/scene_train.py
    python benchmarks/scene_train.py --homes 20 --epochs 4 --work /tmp/short

Trains the small network on features of colour and prints, as Markdown, how often the nearest object
of a home's map is the one that a patch shows: by chance, by the features alone, by the network
untrained and trained, in homes learned and in homes held out. Writes every figure as JSON. Run it
again and it goes on where it was cut.
"""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from time import perf_counter, process_time
from typing import TYPE_CHECKING, Annotated

import numpy as np
import torch
import typer

from placegraph_lab.tables.machine import machine
from placegraph_lab.tables.tables import markdown, share
from placegraph_lab.train.scenegraphloc.lessons import Lesson, read_lesson, split
from placegraph_lab.train.scenegraphloc.train import Progress, TrainOptions, train
from placegraph_lab.train.scenegraphloc.trainer import Judged, Trainer, judge
from placegraph_lab.train.scenegraphloc.worlds import homes
from placegraph_lab.train.training import rows_of

if TYPE_CHECKING:
    from collections.abc import Sequence

ROOT = Path(__file__).parents[1]
OUT = ROOT / "benchmarks/results/scene_train.json"


class Told(Progress):
    """A line an epoch, on stderr."""

    def preparing(self, name: str, done: int, total: int) -> None:
        """As `Progress.preparing`."""
        typer.echo(f"looked at {name}, {done} of {total}", err=True)

    def epoch(self, row: dict[str, float]) -> None:
        """As `Progress.epoch`."""
        typer.echo(", ".join(f"{name} {value:.3f}" for name, value in row.items()), err=True)


def by_chance(lessons: Sequence[Lesson]) -> Judged:
    """Any object of the map, each as likely as another."""
    now = [1 / len(x.room) for x in lessons for marks in x.marks for _ in marks[marks > 0]]
    then = [
        1 / len(x.earlier)
        for x in lessons
        if x.earlier is not None
        for k in range(len(x.marks))
        for _ in range(int((x.targets(k, earlier=True) >= 0).sum()))
    ]
    changed = float(np.mean(then)) if then else None
    return Judged(float(np.mean(now)), changed, 1 / len(lessons), 1.0)


class Alone(torch.nn.Module):
    """No network: features of patches against the mean feature of an object's views."""

    def patches(self, features: torch.Tensor) -> torch.Tensor:
        """(B, H, W, f) as they are."""
        return features

    def objects(self, objects: object) -> torch.Tensor:
        """(N, f) means of the views; zeros of what was never seen."""
        owner, views = objects.owner, objects.views  # type: ignore[attr-defined]
        total = torch.zeros(int(owner.max()) + 1, views.shape[1])
        return total.index_add(0, owner, views)


def main(
    *,
    count: Annotated[
        int, typer.Option("--homes", help="Procedural homes, those held out too.")
    ] = 60,
    held: Annotated[int, typer.Option(help="Homes that are not learned.")] = 8,
    frames: Annotated[int, typer.Option(help="Images of a walk through a home.")] = 10,
    epochs: Annotated[int, typer.Option(help="Rounds over all images.")] = 20,
    batch: Annotated[int, typer.Option(help="Images a step.")] = 8,
    others: Annotated[int, typer.Option(help="Other homes a patch is told from.")] = 3,
    points: Annotated[int, typer.Option(help="Points of an object.")] = 64,
    rate: Annotated[float, typer.Option(help="Learning rate of the first epoch.")] = 4e-3,
    seed: Annotated[int, typer.Option(help="Of homes and training.")] = 0,
    work: Annotated[Path, typer.Option(help="Folder to go on from.")] = (
        ROOT / ".benchmark-cache/scene_train"
    ),
    out: Annotated[Path, typer.Option(help="JSON file.")] = OUT,
) -> None:
    """Train on procedural homes and print Markdown."""
    torch.set_num_threads(1)
    options = TrainOptions(
        epochs=epochs, batch=batch, others=others, points=points, rate=rate, seed=seed
    )
    start, busy = perf_counter(), process_time()
    worlds = homes(count, seed=seed, frames=frames)
    weights = train(
        worlds, work / "trained.safetensors", folder=work, held=held, options=options,
        device="cpu", progress=Told(),
    )  # fmt: skip
    seconds = {"wall": perf_counter() - start, "processor": process_time() - busy}
    lessons = [read_lesson(work / f"places/{world.name}.lesson") for world in worlds]
    learned, asked = split(lessons, held)
    fresh = Trainer(learned, weights.network.widths, replace(options, seed=seed), "cpu").network
    found: dict[str, dict[str, Judged]] = {}
    for where, places in (("learned", learned[: len(asked)]), ("held out", asked)):
        found[where] = {
            "chance": by_chance(places),
            "features alone": judge(Alone(), places, "cpu", points=points),  # type: ignore[arg-type]
            "untrained": judge(fresh, places, "cpu", points=points),
            "trained": judge(weights.network, places, "cpu", points=points),
        }
    rows = [
        [f"{where}: {name}", share(j.patch), share(j.changed), share(j.room)]
        for where, of in found.items()
        for name, j in of.items()
    ]
    objects = float(np.mean([len(x.room) for x in asked]))
    print(f"{len(learned)} homes learned, {held} held out, {objects:.0f} objects each, "
          f"{seconds['processor']:.0f} s of one core in this run.\n")  # fmt: skip
    print(markdown(["homes", "patch", "patch, map of before", "own home first"], rows))
    out.parent.mkdir(parents=True, exist_ok=True)
    record = {
        "machine": machine(),
        "options": asdict(options) | {"homes": count, "held": held, "frames": frames},
        "seconds": seconds,
        "objects": objects,
        "notes": weights.notes,
        "curves": rows_of(work),
        "found": {where: {n: asdict(j) for n, j in of.items()} for where, of in found.items()},
    }
    out.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
