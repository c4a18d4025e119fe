"""Which object does a patch show? Encoders where poses are known: house, office, drawn homes.

    python benchmarks/patch_accuracy.py
    python benchmarks/patch_accuracy.py --encoders "appearance; labels" --every 5

An encoder is a name and options, such as `features weights="dinov2.safetensors"`. Prints a Markdown
table and writes every row as JSON.
"""

from __future__ import annotations

import ast
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import track

from placegraph.indoor.encode import bound, encoder
from placegraph_lab.tables.indoor.metrics import dumps
from placegraph_lab.tables.machine import machine
from placegraph_lab.tables.retrieval.patch_accuracy import Accuracy, accuracy, mean, report
from placegraph_lab.tables.retrieval.patch_places import HOMES, places

if TYPE_CHECKING:
    from placegraph.indoor.encode import Encoder

ROOT = Path(__file__).parents[1]
SHARED = ROOT.parent / "shared"
OUT = ROOT / "benchmarks/results/patch_accuracy.json"


def made(spec: str) -> Encoder:
    """Encoder of a name and options: `features size=224`."""
    name, *options = spec.split()
    chosen: dict[str, Any] = {}
    for option in options:
        key, _, value = option.partition("=")
        chosen[key] = ast.literal_eval(value)
    return encoder(name, **chosen)


def main(
    encoders: Annotated[str, typer.Option(help="Names and options.")] = "appearance; labels",
    every: Annotated[int, typer.Option(help="Of the recordings' frames, every so many.")] = 2,
    homes: Annotated[int, typer.Option(help="Drawn homes.")] = HOMES,
    data: Annotated[Path, typer.Option(help="House and office.")] = SHARED / "data",
    cache: Annotated[Path, typer.Option(help="Folder for maps.")] = ROOT / ".benchmark-cache",
    out: Annotated[Path, typer.Option(help="JSON file.")] = OUT,
) -> None:
    """Judge encoders patch by patch, and print Markdown."""
    asked = {spec.strip(): made(spec) for spec in encoders.split(";") if spec.strip()}
    rows: list[dict[str, Any]] = []
    found: dict[str, dict[str, list[Accuracy | None]]] = {}
    for place in track(
        places(data, cache, every, homes),
        total=3 + homes,
        console=Console(stderr=True),
        transient=True,
    ):
        for spec, one in asked.items():
            tied = bound(one, place.scene, place.captures)
            told = accuracy(tied, place.scene, place.frames, place.map_from_camera)
            found.setdefault(place.kind, {}).setdefault(spec, []).append(told)
            row = None if told is None else told.to_dict()
            rows.append({"place": place.name, "encoder": spec, "key": one.key, "accuracy": row})
    means = {
        kind: {spec: mean(told) for spec, told in by_encoder.items()}
        for kind, by_encoder in found.items()
    }
    print(report(means))
    record = {"machine": machine(), "every": every, "rows": rows}
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(dumps(record), encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
