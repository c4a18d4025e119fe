"""Which home is it? A library of maps is asked by frames, by a sentence, and for the pose."""

import sys
from pathlib import Path

import placegraph as pg

world = Path(sys.argv[1] if len(sys.argv) > 1 else "demo-out/world")  # left by `placegraph demo`
library = pg.SceneLibrary()
for name in ("altbau", "home1", "home2", "home3"):
    library.add(name, world / f"{name}.scene")  # altbau: made by 04_build_from_glb.py
library.save(world / "homes.library")
print(library)

walk = pg.open_capture(world / "walk")
text = "a bedroom with a bookcase, and a plant next to the sofa"
for query in (walk[:8], text):
    found = library.search(query)
    ranked = ", ".join(f"{mode.scene} {mode.probability:.0%}" for mode in found.modes)
    print(f"{query}\n  {found.status}: {ranked}; none of them {found.elsewhere:.0%}")

pose = library.localize(walk[:8], seed=0)
print(pose.status, pose.best.scene, pose.best.map_from_camera[:3, 3].round(2))
