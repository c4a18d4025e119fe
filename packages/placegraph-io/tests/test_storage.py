import bz2
import zipfile

import lz4.frame
import numpy as np
import pytest
from backports import zstd
from hypothesis import given
from hypothesis import strategies as st
from tests.io.damage import DAMAGE, damaged, refusing

from placegraph.errors import InputError
from placegraph_io import storage as packed
from placegraph_io.storage import LARGEST_MESSAGE, Archive, CompressedBytes

FILES = {"a/one.txt": b"one" * 50, "b/two.bin": bytes(range(256)), "empty": b""}


def zipped(path, compression=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.mkdir("a")
        for name, data in FILES.items():
            archive.writestr(name, data)
    return path


@pytest.mark.parametrize("compression", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_files_by_name(compression, tmp_path):
    path = zipped(tmp_path / "a.zip", compression)
    archive = Archive(path)
    assert archive.names == FILES.keys()
    assert {name: archive.read(name) for name in archive.names} == FILES
    flat = Archive(path, flat=True)
    assert flat.names == {"one.txt", "two.bin", "empty"}
    assert flat.read("two.bin") == FILES["b/two.bin"]
    with pytest.raises(InputError, match=r"a\.zip contains no one\.txt"):
        archive.read("one.txt")


def test_what_is_too_large_is_refused(tmp_path, monkeypatch):
    archive = Archive(zipped(tmp_path / "a.zip"))
    monkeypatch.setattr("placegraph_io.storage.LARGEST_VALUE", 200)
    assert archive.read("a/one.txt") == FILES["a/one.txt"]
    with pytest.raises(InputError, match="has 256 bytes"):
        archive.read("b/two.bin")


@DAMAGE
@given(data=st.data())
def test_spoilt_archives(data, tmp_path):
    path = zipped(tmp_path / "a.zip")
    path.write_bytes(data.draw(damaged(path.read_bytes())))
    with refusing():
        archive = Archive(path)
        for name in archive.names & FILES.keys():
            assert archive.read(name) == FILES[name]


def test_a_file_without_a_name_or_of_an_unknown_kind_is_refused(tmp_path):
    path = zipped(tmp_path / "a.zip")
    path.write_bytes(path.read_bytes().replace(b"empty", b"\0mpty"))
    with pytest.raises(InputError, match="cannot be read as a ZIP"):
        Archive(path)
    with pytest.raises(InputError, match="x uses the compression 'xz'; write it with zstd or lz4"):
        CompressedBytes(b"", "xz", "x")


DATA = np.random.default_rng(0).integers(0, 40, 1_000_000).astype(np.uint8).tobytes()
PACK = {"zstd": zstd.compress, "lz4": lz4.frame.compress, "bz2": bz2.compress}


@pytest.mark.parametrize("kind", PACK)
def test_pieces(kind):
    part = CompressedBytes(PACK[kind](DATA), kind, "x")
    pieces = ((0, 31), (700_000, 250_000), (10, 300_000), (999_990, 100), (2_000_000, 5))
    for offset, count in pieces:
        assert part.read(offset, count) == DATA[offset : offset + count]
    cut = CompressedBytes(PACK[kind](DATA)[:300_000], kind, "x").read(0, len(DATA))
    assert DATA.startswith(cut)
    assert len(cut) < len(DATA)


@pytest.mark.parametrize("kind", PACK)
def test_what_is_read_alone_is_unpacked(kind):
    bomb = PACK[kind](bytes(50_000_000))
    part = CompressedBytes(bomb, kind, "x")
    assert part.read(0, 100) == bytes(100)
    assert len(part._content) <= packed._STEP
    with pytest.raises(InputError, match="x unpacks to more than"):
        part.read(LARGEST_MESSAGE, 1)
    with pytest.raises(InputError, match="x is damaged"):
        CompressedBytes(b"nothing that was packed" * 10, kind, "x").read(0, 10)
