"""Train the compact encoder's weights (`docs/compact-encoder.md` says what on, and how well it does).

    python scripts/train_compact.py render WORLDS --homes 220 --map HOUSE.GLB --flat altbau
    python scripts/train_compact.py train WORLDS FOLDER -o compact.weights --steps 6000

`render` makes pictures, a file a scene; files that are there are not made again. `train` goes on
where it was cut; the best weights so far always lie in the file named. The same seed on the same
machine gives the same weights.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from placegraph.errors import PlacegraphError
from placegraph.indoor.build import build_scene
from placegraph_lab.train.compact import worlds
from placegraph_lab.train.training import torch_or_what_installs_it
from placegraph_lab.worlds.flat.flat import Flat
from placegraph_lab.worlds.home.home import home, scene_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from placegraph.indoor.scene_map import SceneMap
    from placegraph_lab.train.compact.worlds import World

HOME, FLAT, MAP = range(3)
"""Kinds of worlds, in their seeds."""


def plans(given: argparse.Namespace) -> Iterator[tuple[str, Callable[[], World]]]:
    """Names of worlds, and what makes them."""

    def of_home(number: int) -> World:
        rng = np.random.default_rng([given.seed, HOME, number])
        interior = home(rng).furnish(rng)
        grid = worlds.SHAPES[number % len(worlds.SHAPES)]
        return worlds.of_home(interior, scene_of(interior), given.pictures, grid, rng)

    def of_flat(name: str, number: int) -> World:
        rng = np.random.default_rng([given.seed, FLAT, number])
        interior = Flat.load(name).furnish(rng)
        grid = worlds.SHAPES[number % len(worlds.SHAPES)]
        return worlds.of_home(interior, scene_of(interior), 2 * given.pictures, grid, rng)

    def of_map(scene: SceneMap, number: int) -> World:
        rng = np.random.default_rng([given.seed, MAP, number])
        grid = worlds.SHAPES[number % len(worlds.SHAPES)]
        return worlds.of_map(scene, 2 * given.pictures, grid, rng)

    for number in range(given.homes):
        yield f"home_{number:04d}", partial(of_home, number)
    for name in given.flat:
        for number in range(4):
            yield f"flat_{name}_{number:04d}", partial(of_flat, name, number)
    for source in given.map:
        with tempfile.TemporaryDirectory() as folder:
            scene = build_scene(source, Path(folder) / "map.scene", detail="full")
        for number in range(given.map_worlds):
            yield f"map_{source.stem}_{number:04d}", partial(of_map, scene, number)


def render(given: argparse.Namespace) -> None:
    """Make the pictures that are not there yet."""
    given.worlds.mkdir(parents=True, exist_ok=True)
    for name, make in plans(given):
        path = given.worlds / f"{name}.npz"
        if not path.exists():
            make().save(path)
            print(name, flush=True)


def train(given: argparse.Namespace) -> None:
    """Train, or go on."""
    torch_or_what_installs_it()
    from placegraph_lab.train.compact.train import Plan, train_on

    plan = Plan(steps=given.steps, batch=given.batch, seed=given.seed)
    train_on(given.worlds, given.folder, given.output, plan, tell=lambda s: print(s, flush=True))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run; the exit code is that of the error, if there is one."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    commands = parser.add_subparsers(required=True)
    made = commands.add_parser("render", help="make pictures to learn from")
    made.add_argument("worlds", type=Path, help="folder for the pictures")
    made.add_argument("--homes", type=int, default=220, help="procedural homes")
    made.add_argument("--flat", action="append", default=[], help="a flat that ships")
    made.add_argument("--map", action="append", default=[], type=Path, help="a map's mesh")
    made.add_argument("--map-worlds", type=int, default=14, help="lightings of each map")
    made.add_argument("--pictures", type=int, default=10, help="of a home")
    made.set_defaults(run=render)
    taught = commands.add_parser("train", help="train on them")
    taught.add_argument("worlds", type=Path)
    taught.add_argument("folder", type=Path, help="folder for state and curves")
    taught.add_argument("-o", "--output", type=Path, required=True, help="weights file")
    taught.add_argument("--steps", type=int, default=6000)
    taught.add_argument("--batch", type=int, default=16, help="pictures of a step")
    taught.set_defaults(run=train)
    for command in (made, taught):
        command.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    try:
        given.run(given)
    except PlacegraphError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
