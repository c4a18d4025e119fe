"""The files that the demo starts from: drawn by `placegraph-lab demo-world`, shipped in `data/`."""

from __future__ import annotations

import io
import lzma
import zipfile
from importlib.resources import as_file, files
from pathlib import Path

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
