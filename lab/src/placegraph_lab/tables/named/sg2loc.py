"""The fourteen tables of the SG2Loc paper: the same protocol and runs, looked at in other columns.

    placegraph-lab table sg2loc-1 --data DIR
    placegraph-lab table sg2loc-7 --sets homes --frames 40

DIR holds 3RScan and ScanNet as users have them, or is the shared folder. Prints Markdown, the
paper's rows first, and writes rows as JSON. Every answer is written down at once, for all tables.
`docs/benchmarks/sg2loc-tables.md` explains the protocol.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from placegraph.errors import InputError
from placegraph_lab.tables.pairs.scan3r import Split  # noqa: TC001  # Typer reads it
from placegraph_lab.tables.run import Device, Fresh, Quick, Run, Seed, Table, known, option, parts
from placegraph_lab.tables.sg2loc import at_hand, brought
from placegraph_lab.tables.sg2loc.ask import IMAGES, Asking, How
from placegraph_lab.tables.sg2loc.costs import retrieval, seconds, storage
from placegraph_lab.tables.sg2loc.poses import poses
from placegraph_lab.tables.sg2loc.sets import LAYOUT, Set
from placegraph_lab.tables.sg2loc.spec import SPECS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path


def there(run: Run, names: list[str], split: Split) -> Iterator[Set]:
    """The sets named, or all whose data there are; `InputError` where they are not."""
    data, cache = run.data, run.cache
    sources: dict[str, tuple[Path, Callable[[], Set]]] = {
        "3RScan": (run.shared / "3RScan", lambda: brought.of_3rscan(run, split)),
        "ScanNet": (run.shared / "ScanNet", lambda: brought.of_scannet(run)),
        "house": (data / "house", lambda: at_hand.of_house(data, cache)),
        "office": (data / "office", lambda: at_hand.of_office(data, cache)),
        "freiburg1_rpy": (data / "freiburg1_rpy", lambda: at_hand.of_freiburg(data, cache)),
        "homes": (data, lambda: at_hand.of_homes(cache)),
    }
    found = names or [name for name, (path, _) in sources.items() if path.is_dir()]
    for name in found:
        if name not in sources:
            raise InputError(f"sets: there is no {name!r}; there are {', '.join(sources)}.")
        if name != "homes" and not sources[name][0].is_dir():
            raise InputError(f"{sources[name][0]} is not there. {LAYOUT}")
    if not found:
        raise InputError(f"{run.shared} holds nothing to measure. {LAYOUT}")
    return (sources[name][1]() for name in found)


def numbered(table: int) -> Table:
    """Table of the paper by its number."""
    spec = SPECS[table]

    def measure(
        run: Run,
        *,
        sets: Annotated[str, option("Sets, with commas between; all that there are.")] = "",
        frames: Annotated[int, option("Most frames of a set, a state and a length; 0: all.")] = 0,
        lengths: Annotated[str, option("Sequence lengths; those of the table.")] = "",
        only: Annotated[str, option("Rows of the table, with semicolons between.")] = "",
        pace: Annotated[float, option("Seconds a frame (Table 6); 0: as measured.")] = 0.0,
        encoder: Annotated[str, option(f"Of images; {IMAGES}, where they bring no labels.")] = "",
        matcher: Annotated[str, option("Of the paper's final fit; theirs is roma.")] = "sift",
        split: Annotated[Split, option("Of 3RScan.")] = "test",
        seed: Seed = 0,
        device: Device = "auto",
        quick: Quick = False,
        fresh: Fresh = False,
    ) -> None:
        kept = known(parts(only, ";"), (name for name, *_ in spec.rows), "row")
        of = spec._replace(
            lengths=tuple(map(int, parts(lengths))) or spec.lengths,
            rows=tuple(row for row in spec.rows if row[0] in kept),
            pace=pace,
        )
        if quick:
            frames, of = 10, of._replace(lengths=of.lengths[:1])
        asking = Asking(run, How(frames, encoder, matcher, seed, device), fresh=fresh)
        chosen = list(there(run, parts(sets), split))
        costs = {3: storage, 4: seconds, 5: retrieval}.get(table)
        text, rows = costs(of, asking, chosen) if costs else poses(table, of, asking, chosen)
        print(f"Table {table}. {spec.asks}\n\n{text}")
        run.save({"rows": rows}, whole=not (sets or lengths or only))

    measure.__name__ = f"sg2loc-{table}"
    measure.__doc__ = f"{spec.asks}\n\n{LAYOUT}"
    return Table(measure, f"SG2Loc, Table {table}")


TABLES = {f"sg2loc-{table}": numbered(table) for table in SPECS}
