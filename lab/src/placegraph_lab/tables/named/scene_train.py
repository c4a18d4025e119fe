"""Table `scene_train`: a network trained on homes, evaluated in homes learned and held out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from time import perf_counter, process_time
from typing import Annotated

import numpy as np
import torch

from placegraph_lab.tables.runner import Column as Col
from placegraph_lab.tables.runner import Quick, Run, Seed, option, render, share, table
from placegraph_lab.worlds.home.lessons import homes as draw_homes
from placegraph_learn.scenegraphloc.lessons import Lesson, read_lesson, split
from placegraph_learn.scenegraphloc.train import Evaluation, Trainer, TrainOptions, evaluate, train
from placegraph_learn.training import Progress, rows_of


class EpochLines(Progress):
    """A line an epoch."""

    def __init__(self, report: Callable[[str], None]) -> None:
        self._report = report

    def report_place(self, name: str, done: int, total: int) -> None:
        self._report(f"looked at {name}, {done} of {total}")

    def epoch(self, row: Mapping[str, float]) -> None:
        self._report(", ".join(f"{name} {value:.3f}" for name, value in row.items()))


def by_chance(lessons: Sequence[Lesson]) -> Evaluation:
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
    return Evaluation(float(np.mean(now)), changed, 1 / len(lessons), 1.0)


class FeaturesOnly(torch.nn.Module):
    """No network: features of patches against the mean feature of an object's views."""

    def patches(self, features: torch.Tensor) -> torch.Tensor:
        """(B, H, W, f) as they are."""
        return features

    def objects(self, objects: object) -> torch.Tensor:
        """(N, f) means of the views; zeros of what was never seen."""
        owner, views = objects.owner, objects.views  # type: ignore[attr-defined]
        total = torch.zeros(int(owner.max()) + 1, views.shape[1])
        return total.index_add(0, owner, views)


COLUMNS = (
    Col("homes", "0"), Col("patch", "1.patch", share), Col("patch, map of before", "1.changed", share),
    Col("own home first", "1.room", share),
)  # fmt: skip


@table()
def scene_train(
    run: Run,
    *,
    homes: Annotated[int, option("Procedural homes, those held out too.")] = 60,
    held_out: Annotated[int, option("Homes that are not learned.")] = 8,
    frames: Annotated[int, option("Images of a walk through a home.")] = 10,
    epochs: Annotated[int, option("Rounds over all images.")] = 20,
    seed: Seed = 0,
    quick: Quick = False,
) -> None:
    """Training of SceneGraphLoc's network on procedural homes, evaluated in other homes."""
    if quick:
        homes, held_out, frames, epochs = 4, 1, 3, 1
    options = TrainOptions(epochs=epochs, batch=8, others=3, points=64, rate=4e-3, seed=seed)
    torch.set_num_threads(1)
    work = run.cache / run.name
    start, busy = perf_counter(), process_time()
    worlds = draw_homes(homes, seed=seed, frames=frames)
    weights = train(
        worlds, work / "trained.safetensors", folder=work, held_out=held_out, options=options,
        device="cpu", progress=EpochLines(run.log),
    )  # fmt: skip
    seconds = {"wall": perf_counter() - start, "processor": process_time() - busy}
    lessons = [read_lesson(work / f"places/{world.name}.lesson") for world in worlds]
    learned, asked = split(lessons, held_out)
    fresh = Trainer(learned, weights.network.widths, options, "cpu").network
    networks = {"features alone": FeaturesOnly(), "untrained": fresh, "trained": weights.network}
    found: list[tuple[str, Evaluation]] = []
    for where, places in (("learned", learned[: len(asked)]), ("held out", asked)):
        found.append((f"{where}: chance", by_chance(places)))
        for name, network in networks.items():
            score = evaluate(network, places, "cpu", points=options.points)  # type: ignore[arg-type]
            found.append((f"{where}: {name}", score))
    objects = float(np.mean([len(x.room) for x in asked]))
    print(
        f"{len(learned)} homes learned, {held_out} held out, {objects:.0f} objects each, "
        f"{seconds['processor']:.0f} s of one core in this run.\n\n{render(COLUMNS, found)}"
    )
    run.save({
        "train_options": options, "seconds": seconds, "objects": objects,
        "notes": weights.notes, "curves": rows_of(work), "found": dict(found),
    })  # fmt: skip
