"""Which of two identical flats? A sentence, frames, and a question, over a town and its rooms."""

import sys
from pathlib import Path

import placegraph as pg

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "demo-out/world")  # left by `placegraph demo`
town, home = folder / "hafenstadt.city", folder / "altbau.scene"  # made by the first and the fourth
if not (folder / "altbau_twin.scene").exists():
    flat = pg.open_map(home)
    places = {"Hotel Hansa": (9.99883, 53.55021), "Bücherhalle": (9.98872, 53.55199)}
    for path, (name, lonlat) in zip((home, folder / "altbau_twin.scene"), places.items()):
        there = pg.Anchor(*lonlat, 5.0, 0.0, building=name)
        flat.anchored(there).save(path)
world = pg.open_world([town, home, folder / "altbau_twin.scene"])

frames = pg.open_capture(folder / "window")  # three of them
alone = world.locate(capture=frames)
print(alone.status, alone.reason)

question = alone.next_question(world)
print(question.text)
told = world.locate(capture=frames, answers=[question.answer("no")])
print(told.status, told.best)

both = world.locate("I am in the library on Lange Straße, by the window", frames)
print(f"{both.status}: {both.best.building}, {both.best.room}, {both.geopose()['position']}")
