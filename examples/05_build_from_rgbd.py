"""A map of a walk with a depth camera: frames are fused and cut into objects; no label is needed."""

import sys
from pathlib import Path

import placegraph as pg

world = Path(sys.argv[1] if len(sys.argv) > 1 else "demo-out/world")  # left by `placegraph demo`
notes = []
scene = pg.build_scene(world / "walk", world / "walk.scene", notes=notes)
print(scene, *notes, sep="\n")
labels = scene.graph.labels
print({label: labels.count(label) for label in sorted(set(labels))})

walk = pg.open_capture(world / "walk")
pose = scene.localize(walk[:4], seed=0)
print(f"{pose.status}: {pose.reason}")
