"""Find changes since a map was made with a walk, and update the map."""

import sys
from pathlib import Path

import placegraph as pg

world = Path(sys.argv[1] if len(sys.argv) > 1 else "demo-out/world")  # left by `placegraph demo`
scene = pg.open_map(world / "altbau.scene")  # made by 04_build_from_glb.py
walk = pg.open_capture(world / "walk")

changes = scene.diff(walk, scene.localize(walk, seed=0))
for change in changes:
    print(f"{change.kind} {change.label}, {change.confidence:.0%} sure: {change.reason}")

newer = scene.updated(changes, take=[change.id for change in changes], when="2026-11-22")
newer.save(world / "altbau_now.scene")
print(f"{len(scene)} objects before, {len(newer)} now")
for change in changes.of("moved"):
    print(newer.attributes[newer.row_of(change.id)]["history"])
