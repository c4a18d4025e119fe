"""A map of a mesh: build it, see what it holds, check it, write it for other programs."""

import sys
from pathlib import Path

import placegraph as pg

world = Path(sys.argv[1] if len(sys.argv) > 1 else "demo-out/world")  # left by `placegraph demo`
notes = []
scene = pg.build_scene(world / "altbau.glb", world / "altbau.scene", notes=notes)
print(scene, f"floor at {scene.floors[0]:.2f} m", *notes, sep="\n")

graph = scene.graph
for source, relation, target in list(zip(graph.sources, graph.relations, graph.targets))[:8]:
    print(f"{graph.labels[source]} {relation} {graph.labels[target]}")
for finding in scene.check():
    print(f"{finding.severity}: {finding.what} {finding.mend}")

small = pg.build_scene(world / "altbau.glb", world / "altbau_small.scene", detail="small")
for name in ("altbau", "altbau_small"):
    print(f"{name}.scene: {(world / name).with_suffix('.scene').stat().st_size / 1000:.0f} kB")
small.export(world / "altbau_small.glb")
