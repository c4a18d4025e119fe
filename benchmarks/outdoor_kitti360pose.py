"""Table II on KITTI360Pose: retrieval of the cell, and localization, for every matcher.

    python benchmarks/outdoor_kitti360pose.py k360_30-10_scG_pd10_pc4_spY_all

DATA is the published folder, or what `placegraph city convert-kitti360pose` made of it. Prints
Markdown tables with the published figures beside, writes every number as JSON.
`docs/howto-kitti360pose.md` explains the protocol.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import Progress

from placegraph.errors import OptionError, PlacegraphError
from placegraph_lab.datasets.kitti360pose import SPLITS, Kitti360Pose
from placegraph_lab.datasets.kitti360pose_convert import convert_kitti360pose
from placegraph_lab.tables.kitti.kitti360pose import (
    MATCHERS,
    SLOW,
    Result,
    Split,
    evaluate,
    localization_table,
    retrieval_table,
    size_table,
)
from placegraph_lab.tables.kitti.relational import Relational
from placegraph_lab.tables.machine import machine

if TYPE_CHECKING:
    from placegraph_lab.tables.kitti.graphs import Reading

ROOT = Path(__file__).parents[1]


def opened(path: Path, cache: Path) -> Kitti360Pose:
    """Data of a converted file, or of a folder, which is converted once."""
    if not path.is_dir():
        return Kitti360Pose.open(path)
    out = cache / f"{path.resolve().name}.k360"
    newest = max((p.stat().st_mtime for p in path.glob("*/*.pkl")), default=0.0)
    if not out.exists() or out.stat().st_mtime < newest:
        cache.mkdir(parents=True, exist_ok=True)
        with Progress(console=Console(stderr=True), transient=True) as tick:
            task = tick.add_task("converting", total=None)
            convert_kitti360pose(
                path, out, progress=lambda step, n: tick.update(task, description=f"{step} {n:,}")
            )
    return Kitti360Pose.open(out)


def split_results(
    split: Split, names: list[str], *, network: Any, queries: int, slow: int,  # noqa: ANN401
    candidates: int, seed: int, tick: Progress,
) -> list[Result]:  # fmt: skip
    """Results of the matchers on a split; one that cannot run here is passed over, with a reason."""
    within = Relational.of(split.data, split.cells)
    results = []
    for name in names:
        rng = np.random.default_rng(seed)
        try:
            matcher, called = split.matcher(name, rng, network=network, candidates=candidates)
        except (PlacegraphError, ImportError) as error:
            typer.echo(f"{name} is left out: {error}", err=True)
            continue
        most = slow if name in SLOW else queries
        poses = split.poses
        if most and most < len(poses):
            poses = np.sort(rng.choice(poses, most, replace=False))
        title = f"{split.name}, {split.reading}, {name}"
        task = tick.add_task(title, total=len(poses))
        matcher.scores(split.pairs(called)[0][0])  # warm
        results.append(
            evaluate(
                split, name, matcher, called, poses=poses.tolist(), within=within,
                progress=lambda n, task=task: tick.update(task, completed=n),  # type: ignore[misc]
            )
        )  # fmt: skip
        tick.remove_task(task)
    return results


def main(
    data: Annotated[Path, typer.Argument(help="Published folder, or a converted file.")],
    splits: Annotated[str, typer.Option(help="With commas; a drive does too.")] = "validation,test",
    matchers: Annotated[str, typer.Option(help="With commas; all where not given.")] = "",
    readings: Annotated[
        str, typer.Option(help="honest: only what the text says; paper: positions known.")
    ] = "honest,paper",
    *,
    queries: Annotated[int, typer.Option(help="Poses a split at most; 0 for all.")] = 0,
    slow: Annotated[int, typer.Option(help="Poses for edit distance at most.")] = 200,
    candidates: Annotated[int, typer.Option(help="Cells that edit distance looks at.")] = 20,
    edge_distance: Annotated[float, typer.Option(help="Objects nearer are joined [m].")] = 15.0,
    seed: Annotated[int, typer.Option(help="Seed of the choice of poses, and of ties.")] = 0,
    weights: Annotated[
        Path | None, typer.Option(help="Weights of the network, instead of the shipped ones.")
    ] = None,
    cache: Annotated[Path, typer.Option(help="Folder for the conversion.")] = (
        ROOT / ".benchmark-cache"
    ),
    out: Annotated[Path, typer.Option(help="JSON file.")] = (
        ROOT / "benchmarks/results/outdoor_kitti360pose.json"
    ),
) -> None:
    """Measure every matcher on KITTI360Pose and print Markdown."""
    network = None
    if weights is not None:
        from placegraph.outdoor.network.network import GraphTransformer

        network = GraphTransformer.open(weights)
    names = [name.strip() for name in matchers.split(",")] if matchers else list(MATCHERS)
    if unknown := [name for name in names if name not in MATCHERS]:
        raise OptionError(f"There is no matcher {unknown[0]!r}; choose of {', '.join(MATCHERS)}.")
    chosen: list[Reading] = []
    for reading in readings.split(","):
        if reading not in ("honest", "paper"):
            raise OptionError(f"There is no reading {reading!r}; choose honest, paper or both.")
        chosen.append(reading)  # type: ignore[arg-type]
    kitti = opened(data, cache)
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # from here on: one core
    results: list[Result] = []
    with Progress(console=Console(stderr=True), transient=True) as tick:
        for name in splits.split(","):
            for reading in chosen:
                split = Split.of(kitti, name, reading, edge_distance=edge_distance)
                results += split_results(
                    split, names, network=network, queries=queries, slow=slow,
                    candidates=candidates, seed=seed, tick=tick,
                )  # fmt: skip
    print(f"### Retrieval of the exact cell (Table II)\n\n{retrieval_table(results)}\n")
    for name in splits.split(","):
        print(f"### Localization within 5/10/15 m, {name}\n\n{localization_table(results, name)}\n")
    scene = SPLITS["test"][0] if SPLITS["test"][0] in kitti.scenes else kitti.scenes[0]
    print(f"### Size of the map (Table V)\n\n{size_table(kitti, scene)}\n")
    out.parent.mkdir(parents=True, exist_ok=True)
    record = {
        "machine": machine(),
        "data": kitti.source,
        "edge_distance": edge_distance,
        "seed": seed,
        "results": [r.to_dict() for r in results],
    }
    out.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
