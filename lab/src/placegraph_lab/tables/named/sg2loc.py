"""The fourteen tables of the SG2Loc paper: the same protocol and runs, looked at in other columns.

    placegraph-lab table sg2loc-1 --data DIR
    placegraph-lab table sg2loc-7 --sets homes --frames 40

DIR holds 3RScan and ScanNet as users have them, or is the shared folder. Prints Markdown, the
paper's rows first, and writes rows as JSON. Every answer is written down at once, for all tables.
`docs/benchmarks/sg2loc-tables.md` explains the protocol.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import typer

from placegraph.errors import InputError
from placegraph_lab.tables.pairs.scan3r import Split  # Typer reads it
from placegraph_lab.tables.runner import (
    Device,
    Fresh,
    Quick,
    Run,
    Seed,
    Table,
    known,
    option,
    parts,
)
from placegraph_lab.tables.sg2loc import at_hand, brought
from placegraph_lab.tables.sg2loc.ask import IMAGES, Asking, How
from placegraph_lab.tables.sg2loc.costs import retrieval, seconds, storage
from placegraph_lab.tables.sg2loc.poses import poses
from placegraph_lab.tables.sg2loc.sets import LAYOUT, Set
from placegraph_lab.tables.sg2loc.spec import SPECS, Spec

_OF_POSES = {"frames", "lengths", "only", "matcher", "seed", "device", "pace"}
UNUSED = {3: {*_OF_POSES, "encoder"}, 5: _OF_POSES, 6: set[str]()}
"""Options that a table does not have; of those not named here, the pace."""


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


def answerable(run: Run, of: Spec, sets: list[Set]) -> list[Set]:
    """Sets that the table can be measured in; says where it cannot, `InputError` if nowhere."""
    kept, why = [], []
    for its in sets:
        rooms = len(set(its.rooms.values()))
        if rooms < of.rooms:
            why.append(f"The table asks for {of.rooms} rooms or more; {its.name} shows {rooms}.")
            continue
        # of tables without rows, no windows are asked about
        missing = [length for length in of.lengths if of.rows and length > its.longest]
        why += [f"There is no window of {n} frames in {its.name}." for n in missing]
        if len(missing) < len(of.lengths):
            kept.append(its)
    if not kept:
        raise InputError(" ".join(why))
    for text in why:
        run.say(text)
    return kept


def asked(spec: Spec, lengths: str, only: str, pace: float) -> Spec:
    """The part of a table that was asked for; `typer.BadParameter` where it has no such part."""
    words = parts(lengths)
    if not all(word.isdecimal() and int(word) for word in words):
        raise typer.BadParameter(
            f"lengths are whole numbers of frames from 1 up, with commas between, not {lengths!r}."
        )
    if not 0.0 <= pace < math.inf:
        raise typer.BadParameter(f"pace is 0 or more seconds, not {pace}.")
    rows = known(parts(only, ";"), (name for name, *_ in spec.rows), "row")
    return spec._replace(
        lengths=tuple(map(int, words)) or spec.lengths,
        rows=tuple(row for row in spec.rows if row[0] in rows),
        pace=pace,
    )


def numbered(table: int) -> Table:
    """Table of the paper by its number."""
    spec = SPECS[table]

    def measure(
        run: Run,
        *,
        sets: Annotated[str, option("Sets, with commas between; all that there are.")] = "",
        frames: Annotated[
            int, typer.Option(min=0, help="Most frames of a set, a state and a length; 0: all.")
        ] = 0,
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
        of = asked(spec, lengths, only, pace)
        if quick:
            frames, of = 10, of._replace(lengths=of.lengths[:1])
        chosen = answerable(run, of, list(there(run, parts(sets), split)))
        asking = Asking(run, How(frames, encoder, matcher, seed, device), fresh=fresh)
        costs = {3: storage, 4: seconds, 5: retrieval}.get(table)
        text, rows = costs(of, asking, chosen) if costs else poses(table, of, asking, chosen)
        print(f"Table {table}. {spec.asks}\n\n{text}")
        run.save({"rows": rows}, whole=not (sets or lengths or only))

    its = inspect.signature(measure, eval_str=True)
    used = [p for p in its.parameters.values() if p.name not in UNUSED.get(table, {"pace"})]
    measure.__signature__ = its.replace(parameters=used)  # type: ignore[attr-defined]
    measure.__name__ = f"sg2loc-{table}"
    measure.__doc__ = f"{spec.asks}\n\n{LAYOUT}"
    return Table(measure, f"SG2Loc, Table {table}")


TABLES = {f"sg2loc-{table}": numbered(table) for table in SPECS}
