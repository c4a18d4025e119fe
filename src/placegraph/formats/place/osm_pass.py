"""Read an OpenStreetMap file once and keep nothing, in a process that may die of it.

osmium assembles areas in C++, and some damaged files end the process there. Run by
`osm.survived`, as a file: it imports nothing of placegraph and starts in a sixth of a second.
"""

from __future__ import annotations

import sys
from contextlib import suppress


def read_through(path: str, ending: str, storage: str, keys: list[str]) -> None:
    """Assemble all areas; what osmium itself finds wrong is for the reader to say."""
    import osmium

    with suppress(RuntimeError, OSError, ValueError):
        file = osmium.FileProcessor(osmium.io.File(path, ending)).with_locations(storage)
        areas = file.with_areas(osmium.filter.KeyFilter(*keys))
        for _ in areas.with_filter(osmium.filter.IdFilter([])):
            pass


if __name__ == "__main__":
    read_through(sys.argv[1], sys.argv[2], sys.argv[3], sys.argv[4:])
