"""Training of the network: on scene maps with captures, or on procedural homes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from placegraph.errors import InputError, OptionError
from placegraph_learn.scenegraphloc.features import ColourFeatures
from placegraph_learn.scenegraphloc.widths import Widths
from placegraph_learn.train.scenegraphloc.lessons import (
    Lesson,
    Teacher,
    World,
    kept_lesson,
    split,
)
from placegraph_learn.train.scenegraphloc.options import Progress, TrainOptions
from placegraph_learn.train.training import (
    add_row,
    device_named,
    planned,
    torch_or_what_installs_it,
)

if TYPE_CHECKING:
    from placegraph_learn.scenegraphloc.weights import Weights

SNAPSHOT = "snapshot.pth"


def train(
    worlds: Sequence[World],
    out: str | PathLike[str],
    *,
    folder: str | PathLike[str],
    held: int = 1,
    teacher: Teacher | None = None,
    widths: Widths | None = None,
    options: TrainOptions | None = None,
    device: str = "auto",
    progress: Progress | None = None,
) -> Weights:
    """Train the network and write its weights.

    Parameters
    ----------
    worlds
        Places to learn from (`worlds.homes`, `worlds.folder`).
    out
        File to write, .safetensors; `SceneGraphLocEncoder` reads it.
    folder
        Holds places once looked at, a snapshot of the last epoch and the curves: an interrupted
        training goes on by the same call, and ends with the very same weights.
    held
        Places, spread evenly, that are not learned but asked about after each epoch; the
        temperature is calibrated on them.
    teacher
        How places are looked at: image features, attribute words, and so on; features of colour if
        not given.
    widths
        Of the network's layers; `Widths.small` of the features if not given.
    options
        How to train.
    device
        ``cpu``, ``cuda`` or ``auto``.
    progress
        Is told how far the training is.

    Raises
    ------
    MissingExtraError
        PyTorch or safetensors is not installed.
    OptionError
        There are too few places, an option is out of range, or the folder holds another training.
    InputError
        A map, a capture or the snapshot is damaged.
    MapError
        The weights cannot be written.

    """
    torch = torch_or_what_installs_it()
    from placegraph_learn.scenegraphloc.weights import Weights, digest_of, write_weights
    from placegraph_learn.train.scenegraphloc.trainer import Trainer, judge

    options, progress = options or TrainOptions(), progress or Progress()
    teacher = teacher or Teacher(ColourFeatures())
    widths = widths or Widths.small(teacher.features.dimension, teacher.attribute_count)
    device = device_named(device, cuda=torch.cuda.is_available())
    _check(worlds, Path(out), held, teacher, widths)
    at = Path(folder)
    planned(at, _plan(worlds, held, teacher, widths, options))
    learned, asked = split(_lessons(worlds, at, teacher, progress), held)
    trainer = Trainer(learned, widths, options, device)
    trainer.read(at / SNAPSHOT)
    while trainer.epochs < options.epochs:
        epoch = trainer.epochs

        def told(done: int, total: int, loss: float, epoch: int = epoch) -> None:
            progress.step(epoch, done, total, loss)

        loss = trainer.epoch(told)
        row = {"epoch": float(epoch + 1), "loss": loss}
        row |= judge(trainer.network, asked, device, points=options.points).row()
        add_row(at, row)  # first: an epoch that is done again gives the same row
        trainer.write(at / SNAPSHOT)
        progress.epoch(row)
    network = trainer.network.cpu()
    judged = judge(network, asked, "cpu", points=options.points)
    notes = {
        "features": teacher.features.key,
        "temperature": f"{judged.temperature:.4g}",
        "points": str(options.points),
        "epochs": str(options.epochs),
        "seed": str(options.seed),
        "places": str(len(learned)),
    }
    write_weights(out, network, notes)
    return Weights(network, notes, digest_of(network))


def _lessons(
    worlds: Sequence[World], at: Path, teacher: Teacher, progress: Progress
) -> list[Lesson]:
    """All places, looked at now or in an earlier run."""
    kept = at / "places"
    try:
        kept.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(f"{kept}: no folder for places ({error}); name another.") from error
    lessons = []
    for done, world in enumerate(worlds, start=1):
        path = kept / f"{world.name}.lesson"
        lessons.append(kept_lesson(path, lambda w=world: teacher.lesson(w)))  # type: ignore[misc]
        progress.preparing(world.name, done, len(worlds))
    return lessons


def _plan(
    worlds: Sequence[World], held: int, teacher: Teacher, widths: Widths, options: TrainOptions
) -> dict[str, Any]:
    """What a training is: with another plan it is another one."""
    return {
        "places": [world.name for world in worlds],
        "held": held,
        "features": teacher.features.key,
        "rotate": teacher.rotate,
        "points_from": teacher.points,
        "attributes": list(teacher.attributes),
        "widths": asdict(widths),
        "options": asdict(options),
    }


def _check(worlds: Sequence[World], out: Path, held: int, teacher: Teacher, widths: Widths) -> None:
    if held < 1 or len(worlds) - held < 2:
        raise OptionError(
            f"{len(worlds)} places, {held} held out: at least two are learned and one is held out."
        )
    names = [world.name for world in worlds]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise OptionError(f"Several places are called {min(twice)}; rename one.")
    if widths.feature != teacher.features.dimension:
        raise OptionError(
            f"widths: made for {widths.feature} numbers a feature, {teacher.features.key} has "
            f"{teacher.features.dimension}."
        )
    if widths.attributes != teacher.attribute_count:
        raise OptionError(
            f"widths: made for {widths.attributes} attribute words, the teacher counts "
            f"{teacher.attribute_count}."
        )
    if out.suffix != ".safetensors":
        raise OptionError(f"{out}: weights are written as .safetensors; name such a file.")
