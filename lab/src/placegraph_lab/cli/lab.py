"""Command line `placegraph-lab`: tables, and commands that make the files placegraph ships with."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from typer.core import TyperGroup

from placegraph.cli.common import bare, guard_streams, harmless
from placegraph.errors import PlacegraphError
from placegraph_lab.tables.runner import load, names

Folder = Annotated[Path, typer.Option("--out", "-o", help="Folder to write to.")]
ROOT = Path(__file__).parents[4]  # of the repository, where the lab is used from


class Tables(TyperGroup):
    """Commands that are imported when they are asked for."""

    def list_commands(self, ctx: Any) -> list[str]:  # noqa: ANN401, ARG002  # click's, as Typer holds it
        """Names of all tables."""
        return names()

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ANN401, ARG002
        """Command of a table."""
        if cmd_name not in names():
            return None
        return typer.main.get_command(load(cmd_name).app())


tables = typer.Typer(
    cls=Tables,
    help="Measure: print a table as Markdown, write its rows as JSON.",
    invoke_without_command=True,
)


@tables.callback()
def table(
    context: typer.Context,
    list_only: Annotated[bool, typer.Option("--list", help="What there is, and exit.")] = False,
    verify: Annotated[
        bool,
        typer.Option(
            "--verify", help="Run samples of the tables on benchmark pages, compare them, and exit."
        ),
    ] = False,
    page: Annotated[
        list[Path] | None, typer.Option(help="With --verify: a page; all of docs/benchmarks.")
    ] = None,
    only: Annotated[str, typer.Option(help="With --verify: the name of a table.")] = "",
    every: Annotated[
        bool, typer.Option("--every", help="With --verify: whole tables, which takes hours.")
    ] = False,
    data: Annotated[Path, typer.Option(help="With --verify: as of a table.")] = Path("../shared"),
    cache: Annotated[Path, typer.Option(help="With --verify: as of a table.")] = Path(
        ".benchmark-cache"
    ),
) -> None:
    """Measure: print a table as Markdown, write its rows as JSON.

    Example: placegraph-lab table outdoor_recall --quick
    """
    if verify:
        from placegraph_lab.tables.runner import render
        from placegraph_lab.tables.verify import COLUMNS
        from placegraph_lab.tables.verify import verify as rerun_and_compare

        pages = page or sorted((ROOT / "docs/benchmarks").glob("*.md"))
        found = list(rerun_and_compare(pages, data, cache, only=only, every=every))
        typer.echo(render(COLUMNS, found))
        raise typer.Exit(any(agreement.differences for agreement in found))
    if list_only or context.invoked_subcommand is None:
        for name in names():
            one = load(name)
            typer.echo(f"{name:22} {one.asks}{f' [{one.paper}]' if one.paper else ''}")
        raise typer.Exit


app = typer.Typer(
    name="placegraph-lab",
    help="Worlds, trainings, benchmarks and campaigns of placegraph.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
app.add_typer(tables, name="table")


def main() -> None:
    """Run the command line; placegraph's own errors end it with their exit code and one sentence."""
    with guard_streams():
        try:
            app()
        except PlacegraphError as error:
            Console(file=bare(sys.stderr), soft_wrap=True).print(
                harmless(f"placegraph-lab: {error}"), style="red", markup=False, highlight=False
            )
            sys.exit(error.exit_code)


@app.command("demo-world")
def demo_world(out: Folder = ROOT / "src/placegraph/demo/data") -> None:
    """Draw the town, the flat, the film and the homes of `placegraph demo`."""
    from placegraph_lab.make.shipped import write_demo_world

    write_demo_world(out)


@app.command("vocabulary", hidden=True)
def vocabulary(
    package: Annotated[
        Path, typer.Argument(help="Unpacked npm package @openstreetmap/id-tagging-schema.")
    ],
    out: Folder = ROOT / "src/placegraph/outdoor/language/vocabulary/data",
) -> None:
    """Make the lexicons of placegraph's vocabulary from the iD presets."""
    from placegraph_lab.make.vocabulary import write_lexicons

    write_lexicons(package, out, typer.echo)


@app.command("decoys", hidden=True)
def decoys(
    out: Annotated[Path, typer.Option("--out", "-o", help="Library file to write.")] = (
        ROOT / "src/placegraph/indoor/library/data/decoys.library"
    ),
) -> None:
    """Make the homes that stand beside every library."""
    from placegraph_lab.make.shipped import write_decoys

    write_decoys(out, typer.echo)


@app.command("kernels", hidden=True)
def kernels(
    data: Annotated[Path, typer.Option(help="Folder of the shared data.")] = ROOT
    / "../shared/data",
    out: Annotated[Path, typer.Option("--out", "-o", help="List to write.")] = (
        ROOT / "src/placegraph/kernels.txt"
    ),
) -> None:
    """List what each command compiles, by running them all."""
    from placegraph_lab.make.kernels import list_kernels

    out.write_text(list_kernels(data, typer.echo), encoding="utf-8")


@app.command("appearance", hidden=True)
def appearance(
    homes: Annotated[int, typer.Option(min=0, max=1000, help="Procedural homes.")] = 0,
    flat: Annotated[str, typer.Option(help="A drawn flat.")] = "altbau",
    times: Annotated[int, typer.Option(min=0, help="How often the flat is furnished.")] = 4,
) -> None:
    """Print what all surfaces have in common, for the encoder `appearance`."""
    from placegraph_lab.make.shipped import print_usual

    print_usual(homes, flat, times, typer.echo)


@app.command("train-kitti360pose")
def train_kitti360pose(  # options of a command
    dataset: Annotated[Path, typer.Argument(help="Published folder, or a converted file.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Weights to write.")],
    work: Annotated[Path, typer.Option(help="Folder for checkpoints and training curves.")],
    osm: Annotated[
        Path | None, typer.Option(help="Extract of Karlsruhe, to train on its cells and texts.")
    ] = None,
    reach: Annotated[float, typer.Option(help="On OSM: as of the table.")] = 15.0,
    sight: Annotated[float, typer.Option(help="On OSM: as of the table.")] = 15.0,
    readings: Annotated[str, typer.Option(help="paper, honest, or both with a comma.")] = "paper",
    edge_distance: Annotated[float, typer.Option(help="Objects nearer are joined [m].")] = 15.0,
    epochs: Annotated[int, typer.Option(min=1)] = 20,
    steps: Annotated[int, typer.Option(min=1, help="Batches an epoch.")] = 300,
    batch: Annotated[int, typer.Option(min=2, help="Texts a batch.")] = 32,
    rate: Annotated[float, typer.Option(help="Largest learning rate.")] = 2e-3,
    losses: Annotated[str, typer.Option(help="eq17, eq18, match, similarity, embedding.")] = (
        "eq17,eq18"
    ),
    seed: Annotated[int, typer.Option(help="The same seed gives the same weights.")] = 0,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
) -> None:
    """Train the network that GOTLoc prints on the training drives of KITTI360Pose.

    Needs the extra `learn`. Run the same command again to resume an interrupted training.

    Example: placegraph-lab train-kitti360pose kitti.k360 -o kitti.weights --work training
    """
    from placegraph_lab.tables.kitti.osm import Crop, on_osm
    from placegraph_lab.tables.kitti.train import PRINTED, train_on_drives
    from placegraph_lab.tables.named.outdoor_kitti360pose import open_dataset
    from placegraph_lab.tables.runner import Run, check_names, parts
    from placegraph_learn.city.train import TrainOptions
    from placegraph_learn.cli import show_training

    chosen = check_names(parts(readings), ("honest", "paper"), "reading")
    options = TrainOptions(
        epochs=epochs, steps=steps, batch=batch, rate=rate, seed=seed, shape=PRINTED,
        losses=tuple(parts(losses)),  # type: ignore[arg-type]
    )  # fmt: skip
    data = open_dataset(dataset, Run("train-kitti360pose", work, work))
    data = data if osm is None else on_osm(data, osm, Crop(reach, sight))
    with show_training(work, epochs, table=True) as progress:
        weights = train_on_drives(
            data, out, folder=work, options=options, readings=chosen,  # type: ignore[arg-type]
            edge_distance=edge_distance, device=device, progress=progress,
        )  # fmt: skip
    progress.report(out, {"fingerprint": weights.digest}, as_json=False, quiet=False)
