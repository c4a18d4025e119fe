"""`placegraph-lab compact`: train the compact encoder's weights (`docs/compact-encoder.md`)."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from placegraph.indoor.scene_map import SceneMap
    from placegraph_lab.train.compact.worlds import World

HOME, FLAT, MAP = range(3)
"""Kinds of worlds, in their seeds."""
app = typer.Typer(
    help="Train the compact encoder, on pictures that are rendered first.",
    no_args_is_help=True,
)


@app.command("render")
def render(
    worlds: Annotated[Path, typer.Argument(help="Folder for the pictures, a file a scene.")],
    homes: Annotated[int, typer.Option(help="Procedural homes.")] = 220,
    flat: Annotated[list[str] | None, typer.Option(help="A flat that ships.")] = None,
    map_: Annotated[list[Path] | None, typer.Option("--map", help="A map's mesh.")] = None,
    map_worlds: Annotated[int, typer.Option(help="Lightings of each map.")] = 14,
    pictures: Annotated[int, typer.Option(help="Of a home.")] = 10,
    seed: Annotated[int, typer.Option(help="Of everything drawn.")] = 0,
) -> None:
    """Make pictures to learn from; files that are there are not made again.

    Example: placegraph-lab compact render WORLDS --homes 220 --map HOUSE.GLB --flat altbau
    """
    worlds.mkdir(parents=True, exist_ok=True)
    drawing = Drawing(pictures, seed)
    for name, make in drawing.plans(homes, flat or (), map_ or (), map_worlds):
        path = worlds / f"{name}.npz"
        if not path.exists():
            make().save(path)
            typer.echo(name)


@app.command("train")
def train(
    worlds: Annotated[Path, typer.Argument(help="Folder of `render`.")],
    folder: Annotated[Path, typer.Argument(help="Folder for state and curves, to go on from.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Weights file: the best so far.")],
    steps: Annotated[int, typer.Option(help="Batches.")] = 6000,
    batch: Annotated[int, typer.Option(help="Pictures of a step.")] = 16,
    seed: Annotated[int, typer.Option(help="The same seed, the same weights.")] = 0,
) -> None:
    """Train on rendered pictures, or go on where it was cut.

    Example: placegraph-lab compact train WORLDS FOLDER -o compact.weights --steps 3000
    """
    from placegraph_lab.train.training import torch_or_what_installs_it

    torch_or_what_installs_it()
    from placegraph_lab.train.compact.train import Plan, train_on

    train_on(worlds, folder, output, Plan(steps=steps, batch=batch, seed=seed), tell=typer.echo)


@dataclass(frozen=True)
class Drawing:
    """How worlds to learn from are drawn."""

    pictures: int
    seed: int

    def plans(
        self, homes: int, flats: Sequence[str], maps: Sequence[Path], map_worlds: int
    ) -> Iterator[tuple[str, Callable[[], World]]]:
        """Names of worlds, and what makes them."""
        from placegraph.indoor.build import build_scene

        for number in range(homes):
            yield f"home_{number:04d}", partial(self.of_home, number)
        for name in flats:
            for number in range(4):
                yield f"flat_{name}_{number:04d}", partial(self.of_flat, name, number)
        for source in maps:
            with tempfile.TemporaryDirectory() as folder:
                scene = build_scene(source, Path(folder) / "map.scene", detail="full")
            for number in range(map_worlds):
                yield f"map_{source.stem}_{number:04d}", partial(self.of_map, scene, number)

    def of_home(self, number: int) -> World:
        """Pictures of a procedural home."""
        from placegraph_lab.train.compact import worlds
        from placegraph_lab.worlds.home.home import home, scene_of

        rng = np.random.default_rng([self.seed, HOME, number])
        interior = home(rng).furnish(rng)
        grid = worlds.SHAPES[number % len(worlds.SHAPES)]
        return worlds.of_home(interior, scene_of(interior), self.pictures, grid, rng)

    def of_flat(self, name: str, number: int) -> World:
        """Pictures of a flat that ships, furnished anew."""
        from placegraph_lab.train.compact import worlds
        from placegraph_lab.worlds.flat.flat import Flat
        from placegraph_lab.worlds.home.home import scene_of

        rng = np.random.default_rng([self.seed, FLAT, number])
        interior = Flat.load(name).furnish(rng)
        grid = worlds.SHAPES[number % len(worlds.SHAPES)]
        return worlds.of_home(interior, scene_of(interior), 2 * self.pictures, grid, rng)

    def of_map(self, scene: SceneMap, number: int) -> World:
        """Pictures of a map in a light of its own."""
        from placegraph_lab.train.compact import worlds

        rng = np.random.default_rng([self.seed, MAP, number])
        grid = worlds.SHAPES[number % len(worlds.SHAPES)]
        return worlds.of_map(scene, 2 * self.pictures, grid, rng)
