"""Rows of the table `reliability`, which every part of the campaign yields.

A part is a module of its name in `placegraph_lab.campaign` with `rows(effort) -> Iterator[Row]`. It
yields each row as soon as it is done, so that nothing is lost where it is interrupted.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

PARTS = ("fuzz", "faults", "soak", "properties", "platforms")
"""Modules of this folder, in the order of the table."""
OUTCOMES = ("accepted", "typed", "untyped", "crash", "hang", "memory")
"""Outcomes of a trial; the last four are faults."""
FAULTS = OUTCOMES[2:]


@dataclass(frozen=True, slots=True)
class Effort:
    """Time, seed and folder of a part."""

    seconds: float  # Wall time in which the part should end
    seed: int
    folder: Path  # empty, the part's own; deleted when it has ended
    data: Path  # recordings, as in `Run.data`; may be missing
    report: Callable[[str], None]  # reports progress
    names: Collection[str] = ()  # rows to run; all if empty
    layouts: Path | None = None
    """Python file that writes seeds of more formats for fuzzing (`campaign.seeds.load_layouts`)."""

    def wants(self, name: str) -> bool:
        """Return whether a row of this name is to be run."""
        return not self.names or name in self.names


@dataclass(frozen=True, slots=True)
class Row:
    """Outcomes of all trials of one kind; they sum up to `tried`."""

    part: str  # one of `PARTS`
    what: str  # the reader, fault, load, property or platform, in a few words
    tried: int
    accepted: int = 0  # ended as it should, with an answer
    typed: int = 0  # ended as it should, with a `PlacegraphError`
    untyped: int = 0  # ended with another error, or with a wrong answer
    crash: int = 0  # the process died
    hang: int = 0  # it did not end in its time
    memory: int = 0  # it passed its bound of memory, or memory grew
    seed: int = 0
    seconds: float = 0.0  # wall time of all trials
    note: str = ""  # other measurements, in a few words
    mended: int = (
        0  # Faults that were fixed since, each kind with a test and its first input drawn again
    )

    @property
    def faults(self) -> int:
        """Number of faulty trials."""
        return sum(getattr(self, name) for name in FAULTS)

    @property
    def open(self) -> int:
        """Number of faults that are not fixed."""
        return self.faults - self.mended

    @classmethod
    def from_counts(
        cls,
        part: str,
        what: str,
        outcomes: Mapping[str, int],
        seed: int,
        seconds: float,
        note: str = "",
    ) -> Row:
        """Return the row of counts by outcome; `KeyError` for an unknown outcome."""
        counts = {name: outcomes.get(name, 0) for name in OUTCOMES}
        if strange := sorted(set(outcomes) - set(OUTCOMES)):
            raise KeyError(strange[0])
        return cls(
            part, what, sum(counts.values()), **counts, seed=seed, seconds=seconds, note=note
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the row as JSON holds it."""
        return asdict(self)

    @classmethod
    def from_dict(cls, record: Mapping[str, Any]) -> Row:
        """Return the row of a JSON object."""
        return cls(**{f.name: record[f.name] for f in fields(cls) if f.name in record})


def merge_rows(
    before: Iterable[Row], now: Iterable[Row], without: Collection[str] = ()
) -> list[Row]:
    """Merge rows: new ones replace those of the same name and seed; parts in `without` are dropped."""
    new = list(now)
    there = {(r.part, r.what, r.seed) for r in new}
    kept = [r for r in before if r.part not in without and (r.part, r.what, r.seed) not in there]
    return sorted([*kept, *new], key=lambda r: PARTS.index(r.part))


def mark_fixed(rows: Iterable[Row], names: Collection[str]) -> list[Row]:
    """Mark all faults of the rows named ``PART/WHAT/SEED`` as fixed.

    Raises `KeyError` with the first name that has no row with faults.
    """
    each = list(rows)
    broken = {f"{r.part}/{r.what}/{r.seed}" for r in each if r.faults}
    if strange := sorted(set(names) - broken):
        raise KeyError(strange[0])
    return [
        replace(r, mended=r.faults) if f"{r.part}/{r.what}/{r.seed}" in names else r for r in each
    ]


def total(rows: Iterable[Row], what: str = "all") -> Row:
    """Return the sum of rows; seed and part are those of the first."""
    each = list(rows)
    counts = {name: sum(getattr(r, name) for r in each) for name in ("tried", *OUTCOMES, "mended")}
    first = each[0] if each else Row("", what, 0)
    return Row(first.part, what, **counts, seed=first.seed, seconds=sum(r.seconds for r in each))
