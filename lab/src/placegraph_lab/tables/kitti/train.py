"""Training of the network that GOTLoc prints on the training drives of KITTI360Pose (Eq. 17-19).

A batch holds texts of poses and their best cells; the other cells of a batch are wrong. Both halves of
Table II are trained alike: the point cloud's cells and those made from OpenStreetMap (`on_osm`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from placegraph.errors import OptionError
from placegraph.outdoor.network.label_graphs import LabelGraphs
from placegraph.outdoor.network.weights import Shape, Weights, round_weights, write_weights
from placegraph_lab.datasets.kitti360pose import SPLITS, Kitti360Pose
from placegraph_lab.tables.kitti.graphs import EDGE_DISTANCE, Names, Reading
from placegraph_lab.tables.kitti.kitti360pose import Split

if TYPE_CHECKING:
    from placegraph_learn.city.train import Loss

LOSSES: tuple[Loss, ...] = ("eq17", "eq18")
"""Losses of GOTLoc as printed."""
PRINTED = Shape(printed=True, layers=1, crossings=1, heads=2)
"""Its network, as deep as the published one and the one that ships."""


def lessons_of(split: Split) -> Any:  # `CellLessons`, which needs PyTorch
    """Graphs of all texts and cells of a split, and the cell that each text belongs to."""
    from placegraph_learn.city.cell_lessons import CellLessons

    names = Names(split.data, osm=True)
    descriptions, truth = split.pairs(names)
    cells = LabelGraphs.of_graphs(split.graphs(names))
    return CellLessons(LabelGraphs.of_texts(descriptions), cells, truth)


def train_on_drives(
    data: Kitti360Pose,
    out: str | PathLike[str],
    *,
    folder: str | PathLike[str],
    options: Any = None,  # `TrainOptions`, which needs PyTorch
    readings: Sequence[Reading] = ("paper",),
    edge_distance: float = EDGE_DISTANCE,
    device: str = "auto",
    progress: Any = None,  # `Progress`
) -> Weights:
    """Train on the texts and cells of the training drives, and write a weights file.

    `folder` holds what an interrupted training goes on from; `options`: of `placegraph city train`, with
    the shape `printed`; `readings`: how hints become texts. Recall on the validation drives is measured
    after every epoch, where the data have any.

    Raises `OptionError` where there are no training drives, or the folder holds another training.
    """
    import torch

    from placegraph_learn.city.cell_lessons import cell_recalls
    from placegraph_learn.city.train import Trainer, TrainOptions
    from placegraph_learn.torch_files import select_device
    from placegraph_learn.training import Progress, open_folder, rows_of, run_epochs

    options = options or TrainOptions(losses=LOSSES, shape=PRINTED)
    progress = progress or Progress()
    if not set(data.scenes) & set(SPLITS["train"]):
        raise OptionError(
            f"{data.source} has none of the training drives {', '.join(SPLITS['train'])}; "
            "convert the whole folder."
        )
    plan: dict[str, Any] = {
        "data": data.source, "drives": list(data.scenes), "cells": len(data.cells.ids),
        "readings": list(readings), "edge_distance": edge_distance, "options": asdict(options),
    }  # fmt: skip
    at = Path(folder)
    plan = open_folder(at, plan)
    splits = {
        name: [
            lessons_of(Split.of(data, name, reading, edge_distance=edge_distance))
            for reading in readings
        ]
        for name in ("train", "validation")
        if set(data.scenes) & set(SPLITS[name])
    }
    trainer = Trainer(options, str(select_device(torch, device)), progress)
    trainer.read(at / "state")

    def learn(epoch: int) -> dict[str, float]:
        means = trainer.epoch(epoch, splits["train"])
        held_out = splits.get("validation", [])
        return means | (cell_recalls(trainer.network, held_out) if held_out else {})

    run_epochs(trainer, options.epochs, learn, at / "state", progress)
    state = {n: p.detach().cpu().numpy() for n, p in trainer.network.named_parameters()}
    weights = round_weights(options.shape, state, {"plan": plan, "curves": rows_of(at)}, None)
    write_weights(out, weights)
    return weights
