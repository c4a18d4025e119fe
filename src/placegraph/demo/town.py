"""The demo's town, three sentences and a way, and the files that the demo starts from (`data/`)."""

from __future__ import annotations

import io
import lzma
import zipfile
from collections.abc import Callable
from importlib.resources import as_file, files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from placegraph.core.estimate import Estimate

if TYPE_CHECKING:
    from placegraph.outdoor.city import CityMap

DATA = files("placegraph.demo") / "data"
TOWN = "hafenstadt"
"""An extract of OpenStreetMap's kind."""
TOWNS = (TOWN, "marktstadt")
"""The other has a library on Lange Straße as well."""
FLAT = "altbau"
"""A furnished flat as a .glb file; `walk/` was filmed there, later, and `window/` by a window of it."""


def unpack(folder: Path) -> Path:
    """Copy the demo's world into a folder, with .xz and .zip files unpacked; return the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    with as_file(DATA) as data:
        for path in sorted(data.iterdir()):
            content = path.read_bytes()
            if path.suffix == ".zip":
                with zipfile.ZipFile(io.BytesIO(content)) as archive:
                    archive.extractall(folder / path.stem)
            elif path.suffix == ".xz":
                (folder / path.stem).write_bytes(lzma.decompress(content))
            else:
                (folder / path.name).write_bytes(content)
    return folder


SENTENCES = {
    "clear": "I'm on Lange Straße. A bakery is north of me, a tram stop is south of me, "
    "and the church is to the southeast.",
    "ambiguous": "I am standing on a square. There is a fountain north of me and a café to my east.",
    "impossible": "A lighthouse is north of me and a zoo is to the south.",
}
ON_THE_WAY = (
    SENTENCES["ambiguous"],
    "I walked about 100 metres south.",
    "There is a library to my east.",
)
"""Said one after the other: the way tells the two squares apart."""


def locate_in_town(world: Path, out: Path, report: Callable[[str], None]) -> list[str]:
    """Build the town and locate what was said in it; return the commands that do the same."""
    from placegraph.outdoor.city import build_city
    from placegraph.view import draw_city, write_page, write_picture

    osm, file = world / f"{TOWN}.osm", out / f"{TOWN}.city"
    city = build_city(osm, file)
    draw_city(city, out / f"{TOWN}.png")
    report(f"Built {city} from a town drawn in ASCII.")
    for name, text in SENTENCES.items():
        estimate = city.locate(text)
        question = estimate.next_question(city) if estimate.status.name == "AMBIGUOUS" else None
        write_page(
            city,
            estimate,
            out / f"{name}.html",
            title=text,
            question=question.text if question else None,
        )
        write_picture(city, estimate, out / f"{name}.png")
        report(f"\n“{text}”\n{estimate.status.name}: {estimate.reason}")
        for mode in estimate.modes[:3]:
            report(f"  {mode.latitude:.5f}, {mode.longitude:.5f}  {mode.probability:.0%}")
        print_evidence(estimate, report)
        if question:
            report(f"  To be sure: {question.text}")
    _way(city, report)
    return [f"city build {osm} -o {file}", f'city locate {file} "{SENTENCES["clear"]}"']


def _way(city: CityMap, report: Callable[[str], None]) -> None:
    """Follow somebody who could be at either of two places, until their way tells which."""
    tracker = city.track()
    report("\nA person describes the place, walks on, and describes it again:")
    for text in ON_THE_WAY:
        estimate = tracker.tell(text)
        report(f"  “{text}”\n    {estimate.status.name}: {estimate.reason}")
    for mode in tracker.estimate.modes[:1]:
        report(f"    {mode.latitude:.5f}, {mode.longitude:.5f}  {mode.probability:.0%}")


def print_evidence(estimate: Estimate[Any], report: Callable[[str], None]) -> None:
    """Print every statement with the objects that support or contradict it."""
    for e in estimate.evidence:
        things = ", ".join(o.name or o.label for o in e.objects)
        report(f"    {e.verdict:7} {e.statement}  [{things or e.note}]")
