"""From a sentence to a place: build a map of a town, locate a sentence, say why."""

import sys
from pathlib import Path

import placegraph as pg

world = Path(sys.argv[1] if len(sys.argv) > 1 else "demo-out/world")  # left by `placegraph demo`
city = pg.build_city(world / "hafenstadt.osm", world / "hafenstadt.city")
print(city)

here = city.locate(
    "I'm on Lange Straße. A bakery is north of me, a tram stop is south of me, "
    "and the church is to the southeast."
)
print(f"{here.status}: {here.reason}")
for place in here.modes[:3]:
    print(f"{place.probability:6.1%} at {place.latitude:.5f} N, {place.longitude:.5f} E")
for e in here.evidence:
    things = ", ".join(thing.name or thing.label for thing in e.objects)
    print(f"{e.verdict:>8} {e.weight:+5.1f} nat  {e.statement}  ({things or e.note})")
