"""OpenStreetMap data of any form as PBF, by osmium in a process that may die of it.

Run as a file, so it imports nothing of placegraph and starts in a sixth of a second.
"""

from __future__ import annotations

import sys


def convert(source: str, form: str, made: str) -> None:
    """Write a file of osmium's format `form` as PBF; `ValueError` or `RuntimeError` where it is none."""
    import osmium

    writer = osmium.WriteHandler(made)
    try:
        osmium.apply(osmium.io.Reader(osmium.io.File(source, form)), writer)
    except osmium.InvalidLocationError as error:  # is none of Python's own
        raise ValueError(str(error)) from error
    finally:
        writer.close()


if __name__ == "__main__":
    try:
        convert(*sys.argv[1:])
    except (OSError, RuntimeError, ValueError) as error:
        sys.exit(str(error))
