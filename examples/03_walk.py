"""A walk: several sentences and the way between them tell two places apart."""

import sys
from pathlib import Path

import placegraph as pg

world = Path(sys.argv[1] if len(sys.argv) > 1 else "demo-out/world")  # left by `placegraph demo`
city = pg.open_map(world / "hafenstadt.city")  # made by 01_sentence_to_place.py

tracker = city.track()
for sentence in (
    "I am standing on a square. There is a fountain north of me and a café to my east.",
    "I walked about 100 metres south.",
    "There is a library to my east.",
):
    here = tracker.tell(sentence)
    print(f"{sentence}\n  {here.status}: {here.best.probability:.0%}, {here.reason}")

tracker.move(0.0, 30.0)  # 30 m to the north, as an odometer would measure it
here = tracker.estimate
print(f"now at {here.best.latitude:.5f} N, {here.best.longitude:.5f} E")
