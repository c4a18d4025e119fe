"""Are changes found? A map of the house, and walks through it after furniture was moved or taken away.

    python benchmarks/scene_changes.py
    python benchmarks/scene_changes.py --quick

Poses are those that localizing finds; what was changed is known to the evaluation alone. Prints a
Markdown table and writes every window as JSON. Every answer is written down at once: run it again
and it goes on where it was cut.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import Progress

from placegraph.indoor.build import build_scene
from placegraph_lab.tables.indoor.metrics import dumps
from placegraph_lab.tables.journal import Journal, fingerprint
from placegraph_lab.tables.machine import machine
from placegraph_lab.tables.scene.changes import Told, ask, figures, report

ROOT = Path(__file__).parents[1]
SHARED = ROOT.parent / "shared"
OUT = ROOT / "benchmarks/results/scene_changes.json"
CODE = (
    "indoor/change/*.py", "indoor/structure.py", "indoor/build.py", "indoor/simplify*.py",
    "indoor/localize.py",
    "evaluate/scene_changes.py",
)  # fmt: skip
"""Code that decides what the answers are."""
STARTS = {25: (0,), 10: (0, 8, 15)}
"""First frames of windows, by length."""


def main(
    seed: Annotated[int, typer.Option(help="Of localizing and comparing.")] = 0,
    *,
    quick: Annotated[bool, typer.Option(help="Whole sequences only.")] = False,
    fresh: Annotated[bool, typer.Option(help="Ask everything anew.")] = False,
    data: Annotated[Path, typer.Option(help="Folder with the house.")] = SHARED / "data",
    cache: Annotated[Path, typer.Option(help="Folder for answers.")] = ROOT / ".benchmark-cache",
    out: Annotated[Path, typer.Option(help="JSON file.")] = OUT,
) -> None:
    """Measure precision and recall of changes, and print Markdown."""
    cache.mkdir(parents=True, exist_ok=True)
    path = cache / "scene_changes.jsonl"
    if fresh:
        path.unlink(missing_ok=True)
    journal, code = Journal(path), fingerprint(CODE)
    scene = build_scene(data / "house/map/house.glb", None)
    folders = sorted((data / "house").glob("seq[0-9]*"))
    rows: list[tuple[str, list[Told]]] = []
    with Progress(console=Console(stderr=True), transient=True) as tick:
        for length in (25,) if quick else STARTS:
            task = tick.add_task(f"{length} frames", total=len(folders) * len(STARTS[length]))
            told = []
            for folder in folders:
                for first in STARTS[length]:
                    key = f"{code} {folder.name} {first} {length} {seed}"
                    if key not in journal:
                        journal.put(key, ask(scene, folder, first, length, seed=seed).to_dict())
                    told.append(Told(**journal[key]))
                    tick.advance(task)
            rows.append((f"{length} frames", told))
    print(report(rows))
    record = {
        "machine": machine(),
        "seed": seed,
        "triangles": len(scene.mesh),
        "rows": {name: figures(told) for name, told in rows},
        "windows": [t.to_dict() for _, told in rows for t in told],
    }
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(dumps(record), encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
