"""Are changes found? A map of the house, and walks through it after furniture was moved or taken away.

    placegraph-lab table scene_changes
    placegraph-lab table scene_changes --quick

Poses are those that localizing finds; what was changed is known to the evaluation alone. Prints a
Markdown table and writes every window as JSON. Every answer is written down at once: run it again
and it goes on where it was cut.
"""

from __future__ import annotations

from placegraph.indoor.build import build_scene
from placegraph_lab.tables.journal import INDOOR, fingerprint
from placegraph_lab.tables.run import Fresh, Quick, Run, Seed, table
from placegraph_lab.tables.scene.changes import Told, ask, figures, report

CODE = (*INDOOR, "placegraph_lab/tables/scene/changes.py")
"""Code that decides what the answers are."""
STARTS = {25: (0,), 10: (0, 8, 15)}
"""First frames of windows, by length."""


@table()
def scene_changes(run: Run, seed: Seed = 0, *, quick: Quick = False, fresh: Fresh = False) -> None:
    """Are changes found? A map of the house, and walks after furniture was moved or taken away."""
    journal, code = run.journal(fresh=fresh), fingerprint(CODE)
    scene = build_scene(run.data / "house/map/house.glb", None)
    folders = sorted((run.data / "house").glob("seq[0-9]*"))
    rows: list[tuple[str, list[Told]]] = []
    with run.progress() as tick:
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
    found = {name: figures(told) for name, told in rows}
    windows = [t.to_dict() for _, told in rows for t in told]
    run.save({"triangles": len(scene.mesh), "rows": found, "windows": windows})
