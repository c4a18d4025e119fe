"""Make the homes that stand beside every library (`indoor/library/signature_file.py`).

    python scripts/decoys.py

Homes are drawn from seeds that no benchmark and no training uses.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

import placegraph
from placegraph.indoor.library import SceneLibrary
from placegraph.indoor.library.signature_file import DECOYS
from placegraph_lab.worlds.home.home import home, scene_of

COUNT = 32
FIRST_SEED = 700_000
ENCODERS = ("labels", "appearance", "compact")


def main() -> None:
    """Draw, map and sign the homes."""
    library = SceneLibrary(ENCODERS)
    out = Path(placegraph.__file__).parent / "indoor/library" / DECOYS
    out.parent.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent) as folder:
        for i in range(COUNT):
            rng = np.random.default_rng(FIRST_SEED + i)
            path = Path(folder) / f"home {i}.scene"
            scene_of(home(rng).furnish(rng), name=path.stem).save(path)
            library.add(path.stem, path)
            print(path.stem, len(library.entry(path.stem).signature), flush=True)
        library.save(out)
    print(f"{out}: {out.stat().st_size:,} bytes")


if __name__ == "__main__":
    main()
