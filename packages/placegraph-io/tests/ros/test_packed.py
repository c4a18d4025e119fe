"""Compressed parts of bags, read in pieces."""

import bz2

import lz4.frame
import numpy as np
import pytest
from backports import zstd

from placegraph.errors import InputError
from placegraph_io import storage as packed
from placegraph_io.storage import LARGEST_MESSAGE, CompressedBytes

DATA = np.random.default_rng(0).integers(0, 40, 1_000_000).astype(np.uint8).tobytes()
PACK = {"zstd": zstd.compress, "lz4": lz4.frame.compress, "bz2": bz2.compress}


@pytest.mark.parametrize("kind", PACK)
def test_pieces(kind):
    """Any piece, in any order; nothing behind the end; of what is cut, what is there."""
    part = CompressedBytes(PACK[kind](DATA), kind, "x")
    for offset, count in (
        (0, 31),
        (700_000, 250_000),
        (10, 300_000),
        (999_990, 100),
        (2_000_000, 5),
    ):
        assert part.read(offset, count) == DATA[offset : offset + count]
    cut = CompressedBytes(PACK[kind](DATA)[:300_000], kind, "x").read(0, len(DATA))
    assert DATA.startswith(cut)
    assert len(cut) < len(DATA)


@pytest.mark.parametrize("kind", PACK)
def test_what_is_read_alone_is_unpacked(kind):
    """A bomb does no harm: what nobody reads stays packed, and nobody reads beyond what may be."""
    bomb = PACK[kind](bytes(50_000_000))
    part = CompressedBytes(bomb, kind, "x")
    assert part.read(0, 100) == bytes(100)
    assert len(part._content) <= packed._STEP
    with pytest.raises(InputError, match="x would unpack to more than"):
        part.read(LARGEST_MESSAGE, 1)


@pytest.mark.parametrize("kind", PACK)
def test_damaged(kind):
    with pytest.raises(InputError, match="x is damaged"):
        CompressedBytes(b"nothing that was packed" * 10, kind, "x").read(0, 10)


def test_unknown():
    with pytest.raises(InputError, match="x is compressed by 'xz'; write it with zstd or lz4"):
        CompressedBytes(b"", "xz", "x")
