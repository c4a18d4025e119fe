"""The homes that stand beside every library (`indoor/library/signature_file.py`).

They are drawn from seeds that no table and no training uses.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from placegraph.indoor.library import SceneLibrary
from placegraph_lab.worlds.home.home import home, scene_of

COUNT = 32
FIRST_SEED = 700_000
ENCODERS = ("labels", "appearance")


def write_decoys(out: Path, say: Callable[[str], None]) -> None:
    """Draw, map and sign the homes, and write their library."""
    library = SceneLibrary(ENCODERS)
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent) as folder:
        for i in range(COUNT):
            rng = np.random.default_rng(FIRST_SEED + i)
            path = Path(folder) / f"home {i}.scene"
            scene_of(home(rng).furnish(rng), name=path.stem).save(path)
            library.add(path.stem, path)
            say(f"{path.stem} {len(library.entry(path.stem).signature)}")
        library.save(out)
    say(f"{out}: {out.stat().st_size:,} bytes")
