"""Make `_USUAL` of placegraph.indoor.encode.appearance: what all surfaces have in common.

    python scripts/usual_appearance.py

It is the mean over places, each counting alike, of the mean vector of their objects. Places are for
development alone: a drawn flat that ships with placegraph, furnished some times over, and by --homes
procedural homes of the seeds 0, 1, ... below 1000, from which benchmarks begin. Neither the house nor
the office is looked at. By default the flat stands alone: homes share a few styles, whose mean is
further from that of other places. Prints the lines that belong into appearance.py, and how far they
are from those that are there.
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

import numpy as np

from placegraph.indoor.encode import appearance
from placegraph_lab.worlds.flat.flat import Flat
from placegraph_lab.worlds.home.home import home, scene_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from placegraph_lab.worlds.flat.interior import Interior

HELD_OUT = 1000
"""Seeds of homes from here on are for benchmarks."""
_A_LINE = 11  # numbers


def interiors(homes: int, flat: str, times: int) -> Iterator[Interior]:
    """Homes of the first seeds, then a flat furnished some times."""
    for seed in range(homes):
        rng = np.random.default_rng(seed)
        yield home(rng).furnish(rng)
    for seed in range(times):
        yield Flat.load(flat).furnish(np.random.default_rng(seed))


def usual(places: Iterator[Interior]) -> NDArray[np.float64]:
    """Mean vector (d,) of the objects that can be seen, a mean over places, not of unit length."""
    means = []
    for interior in places:
        vectors, cells = appearance.surfaces(scene_of(interior))
        if cells.any():
            means.append(vectors[cells > 0].mean(axis=0, dtype=np.float64))
    return np.asarray(np.mean(means, axis=0), np.float64)


def lines(numbers: NDArray[np.float64]) -> str:
    """Rows of an array as the module has them."""
    words = [f"{number:.3f}," for number in numbers.tolist()]
    rows = [words[i : i + _A_LINE] for i in range(0, len(words), _A_LINE)]
    return "\n".join("        " + " ".join(f"{word:>7}" for word in row).lstrip() for row in rows)


def main() -> None:
    """Print the numbers."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--homes", type=int, default=0, help="procedural homes, 0 to 1000")
    parser.add_argument("--flat", default="altbau", help="a drawn flat")
    parser.add_argument("--times", type=int, default=4, help="how often the flat is furnished")
    given = parser.parse_args()
    if not 0 <= given.homes <= HELD_OUT or given.times < 0 or not given.homes + given.times:
        parser.error(f"choose 0 to {HELD_OUT} homes (--homes), and a flat (--times) or a home.")
    found = usual(interiors(given.homes, given.flat, given.times))
    before = appearance._USUAL  # noqa: SLF001  # what is replaced
    print(lines(found))
    print(f"# off from those of appearance.py by {np.abs(found - before).max():.4f} at most")


if __name__ == "__main__":
    main()
