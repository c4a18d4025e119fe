"""Table II on KITTI360Pose: retrieval of the cell, and localization, for every matcher.

DATA is the published folder, or what `placegraph city convert-kitti360pose` made of it. Prints
Markdown tables with the published figures beside, writes every number as JSON. The transformer is
trained on the training drives first (`--train`), or its weights are given.
`docs/howto-kitti360pose.md` explains the protocol.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path  # Typer reads the annotations
from typing import Annotated, Any

import numpy as np
import typer

from placegraph.errors import PlacegraphError
from placegraph.outdoor.network.network import GraphTransformer
from placegraph_lab.datasets.kitti360pose import SPLITS, Kitti360Pose, convert_kitti360pose
from placegraph_lab.tables.kitti.kitti360pose import (
    MATCHERS,
    SLOW,
    TRANSFORMER,
    Result,
    Split,
    evaluate,
    localization_table,
    retrieval_table,
    size_table,
)
from placegraph_lab.tables.kitti.matchers import Relational
from placegraph_lab.tables.kitti.osm import REACH, SIGHT, TOLD, Crop, on_osm
from placegraph_lab.tables.kitti.train import LOSSES, PRINTED, train_on_drives
from placegraph_lab.tables.runner import Quick, Run, Seed, check_names, option, parts, table


def open_dataset(path: Path, run: Run) -> Kitti360Pose:
    """Data of a converted file, or of a folder, which is converted once."""
    if not path.is_dir():
        return Kitti360Pose.open(path)
    out = run.cache / f"{path.resolve().name}.k360"
    newest = max((p.stat().st_mtime for p in path.glob("*/*.pkl")), default=0.0)
    if not out.exists() or out.stat().st_mtime < newest:
        run.cache.mkdir(parents=True, exist_ok=True)
        with run.progress() as tick:
            task = tick.add_task("converting", total=None)
            convert_kitti360pose(
                path, out, progress=lambda step, n: tick.update(task, description=f"{step} {n:,}")
            )
    return Kitti360Pose.open(out)


@dataclass(frozen=True)
class MatcherRunner:
    """Which matchers are asked, and how often."""

    names: list[str]
    network: GraphTransformer | None  # of the transformer; the shipped one where None
    trained: str  # which weights the network has
    queries: int
    slow: int
    candidates: int
    seed: int

    def results(self, split: Split, run: Run) -> list[Result]:
        """Results of the matchers on a split; one that cannot run here is passed over, with a reason."""
        within = Relational.of(split.data, split.cells)
        results = []
        for name in self.names:
            rng = np.random.default_rng(self.seed)
            try:
                matcher, called = split.matcher(
                    name, rng, network=self.network, candidates=self.candidates
                )
            except (PlacegraphError, ImportError) as error:
                run.log(f"{name} is left out: {error}")
                continue
            most = self.slow if name in SLOW else self.queries
            poses = split.poses
            if most and most < len(poses):
                poses = np.sort(rng.choice(poses, most, replace=False))
            matcher.scores(split.pairs(called)[0][0])  # warm
            with run.progress() as tick:
                task = tick.add_task(f"{split.name}, {split.reading}, {name}", total=len(poses))
                found = evaluate(
                    split, name, matcher, called, poses=poses.tolist(), within=within,
                    progress=lambda n, task=task: tick.update(task, completed=n),  # type: ignore[misc]
                )  # fmt: skip
            title = f"GOTLoc as printed, {self.trained}"
            results.append(replace(found, matcher=title) if name == TRANSFORMER else found)
        return results


def train_options(epochs: int, seed: int) -> Any:  # `TrainOptions` needs PyTorch
    """Options of the training that the table does itself."""
    from placegraph_learn.city.train import TrainOptions

    return TrainOptions(epochs=epochs, seed=seed, losses=LOSSES, shape=PRINTED)


def train_network(
    run: Run, data: Kitti360Pose, crop: Crop | None, edge_distance: float, epochs: int, seed: int
) -> GraphTransformer:
    """Train the network of GOTLoc on the training drives, once; the cache keeps it."""
    from placegraph_learn.cli import show_training

    options = train_options(epochs, seed)
    plan = f"{data.source}, {len(data.cells.ids)}, {crop}, {edge_distance}, {options}"
    folder = run.cache / "kitti360pose" / hashlib.sha256(plan.encode()).hexdigest()[:12]
    weights = folder / "network.weights"
    if not weights.exists():
        with show_training(folder, epochs, table=False) as progress:
            train_on_drives(
                data, weights, folder=folder, options=options, edge_distance=edge_distance,
                progress=progress,
            )  # fmt: skip
    return GraphTransformer.open(weights)


@table("GOTLoc, Tables II, V")
def outdoor_kitti360pose(
    run: Run,
    dataset: Annotated[Path, typer.Argument(help="Published folder, or a converted file.")],
    splits: Annotated[str, option("With commas; a drive does too.")] = "validation,test",
    matchers: Annotated[str, option("With commas; all where not given.")] = "",
    readings: Annotated[
        str, option("honest: only what the text says; paper: positions known.")
    ] = "honest,paper",
    *,
    queries: Annotated[int, option("Poses a split at most; 0 for all.")] = 0,
    slow: Annotated[int, option("Poses for edit distance at most.")] = 200,
    candidates: Annotated[int, option("Cells that edit distance looks at.")] = 20,
    edge_distance: Annotated[float, option("Objects nearer are joined [m].")] = 15.0,
    seed: Seed = 0,
    train: Annotated[
        int, option("Epochs to train the transformer on the training drives first, once a map.")
    ] = 0,
    weights: Annotated[Path | None, option("Of the transformer, trained before.")] = None,
    osm: Annotated[Path | None, option("Extract of Karlsruhe: the rows on OSM as well.")] = None,
    osm_weights: Annotated[Path | None, option("The same for the rows on OSM.")] = None,
    reach: Annotated[
        float, option("On OSM: things this near to a centre are in a cell [m].")
    ] = REACH,
    sight: Annotated[float, option("On OSM: things this near to a pose are told [m].")] = SIGHT,
    quick: Quick = False,
) -> None:
    """Retrieval of the cell, and localization, on KITTI360Pose, for every matcher."""
    if quick:
        queries, slow = 50, 5
    names = check_names(parts(matchers), MATCHERS, "matcher")
    chosen = check_names(parts(readings), ("honest", "paper"), "reading")
    kitti = open_dataset(dataset, run)
    sets: list[tuple[Kitti360Pose, Crop | None, Path | None]] = [(kitti, None, weights)]
    if osm is not None:
        mapped = on_osm(kitti, osm, Crop(reach, sight))
        sets.append((mapped, Crop(reach, sight), osm_weights))
        told, every = (f"{len(d.poses.cells):,}" for d in (mapped, kitti))
        run.log(f"On OSM, {told} of {every} poses have {TOLD} things within {sight:g} m.")
    networks: list[tuple[GraphTransformer | None, str]] = []
    for data, crop, given in sets:
        if given is not None:
            networks.append((GraphTransformer.open(given), given.name))
        elif train and TRANSFORMER in names:
            learned = train_network(run, data, crop, edge_distance, train, seed)
            networks.append((learned, "trained on its drives"))
        else:
            networks.append((None, "trained on OpenStreetMap of other cities"))
    run.one_core()
    results: list[Result] = []
    for (data, _, _), (network, trained) in zip(sets, networks, strict=True):
        asking = MatcherRunner(names, network, trained, queries, slow, candidates, seed)
        for name, reading in product(splits.split(","), chosen):
            split = Split.of(data, name, reading, edge_distance=edge_distance)  # type: ignore[arg-type]
            results += asking.results(split, run)
    print(f"### Retrieval of the exact cell (Table II)\n\n{retrieval_table(results)}\n")
    for name in splits.split(","):
        print(f"### Localization within 5/10/15 m, {name}\n\n{localization_table(results, name)}\n")
    scene = SPLITS["test"][0] if SPLITS["test"][0] in kitti.scenes else kitti.scenes[0]
    print(f"### Size of the map (Table V)\n\n{size_table(kitti, scene)}\n")
    run.save({"data": sets[-1][0].source, "results": results})
