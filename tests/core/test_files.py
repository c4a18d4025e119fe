"""Files written whole or not at all."""

import os
from pathlib import Path

import pytest

from placegraph.core import files
from placegraph.core import files as locks
from placegraph.core.files import put, regular, write_file
from placegraph.errors import InputError, MapError, MapLockedError
from placegraph.indoor.encode.confusion import Confusion
from placegraph.indoor.encode.networks import ImageNetwork
from placegraph.indoor.library.library import digest_of
from placegraph_learn.scenegraphloc.features import read_attributes


def test_a_file_takes_the_place_of_the_old_one(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")
    assert write_file(path, [b"ne", memoryview(b"w")]) == path
    assert path.read_bytes() == b"new"
    assert [p.name for p in tmp_path.iterdir()] == ["a.bin"]


def test_a_link_stays_a_link(tmp_path):
    (tmp_path / "far").mkdir()
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "far" / "a.bin")
    write_file(link, [b"new"])
    assert link.is_symlink()
    assert (tmp_path / "far" / "a.bin").read_bytes() == b"new"


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")

    def chunks():
        yield b"half"
        raise OSError(28, "No space left on device")

    with pytest.raises(MapError, match="No space left"):
        write_file(path, chunks())
    monkeypatch.setattr(files, "_sync_folder", lambda _: Path("/does/not/exist").stat())
    with pytest.raises(MapError, match="cannot be written"):
        write_file(tmp_path / "b.bin", [b"new"])
    assert path.read_bytes() == b"old"
    assert not list(tmp_path.glob(".*"))


def test_what_cannot_be_written_is_said(tmp_path):
    with pytest.raises(MapError, match="not a plain file"):
        write_file(tmp_path, [b""])
    with pytest.raises(MapError, match="cannot be written"):
        write_file(tmp_path / "no" / "a.bin", [b""])
    with pytest.raises(MapError, match="not a file name"):
        write_file("a\0b", [b""])
    with locks.exclusive(tmp_path / "a.bin"), pytest.raises(MapLockedError, match=r"a\.bin"):
        write_file(tmp_path / "a.bin", [b""])


def test_a_link_where_the_temporary_file_stands_is_not_followed(tmp_path):
    """Somebody who may write to the folder could have any file of ours overwritten."""
    precious = tmp_path / "precious"
    precious.write_bytes(b"old")
    (tmp_path / ".a.bin.tmp").symlink_to(precious)
    write_file(tmp_path / "a.bin", [b"new"])
    assert precious.read_bytes() == b"old"
    assert (tmp_path / "a.bin").read_bytes() == b"new"
    assert not (tmp_path / "a.bin").is_symlink()


def test_what_may_never_end_is_not_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("/dev/zero")
    for name in ("pipe", "link"):
        with pytest.raises(InputError, match=f"{name} is not a plain file"):
            regular(tmp_path / name)
    assert regular(tmp_path) == tmp_path
    assert regular(tmp_path / "none") == tmp_path / "none"


def test_what_is_put_is_whole_or_not_there(tmp_path, monkeypatch):
    path = tmp_path / "a.png"
    assert put(path, b"old") == path
    monkeypatch.setattr(os, "fsync", lambda _: Path("/does/not/exist").stat())
    with pytest.raises(InputError, match=r"a\.png cannot be written: No such file"):
        put(path, b"new")
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]
    for wrong in (tmp_path / "no" / "a.png", tmp_path, "a\0b"):
        with pytest.raises(InputError, match="cannot be written"):
            put(wrong, b"new")


def test_what_is_no_file_is_written_straight(tmp_path):
    read, write = os.pipe()
    put(f"/dev/fd/{write}", b"through a pipe")
    assert os.read(read, 100) == b"through a pipe"
    os.close(read)
    os.close(write)
    with (tmp_path / "open").open("w") as file:
        put(f"/proc/self/fd/{file.fileno()}", b"into an open file")
    assert (tmp_path / "open").read_bytes() == b"into an open file"


def test_a_folder_that_is_lost_meanwhile_leaves_the_first_error(tmp_path, monkeypatch):
    path, removed = tmp_path / "a.bin", Path.unlink

    def refused(self, *given, **named):
        if self.name.startswith(".a.bin"):
            raise PermissionError(13, "Permission denied", str(self))
        removed(self, *given, **named)

    def chunks():
        monkeypatch.setattr(Path, "unlink", refused)
        yield b"half"
        raise OSError(28, "No space left on device")

    with pytest.raises(MapError, match="No space left"):
        write_file(path, chunks())
    monkeypatch.undo()
    write_file(path, [b"new"])
    assert [p.name for p in tmp_path.iterdir()] == ["a.bin"]


def test_no_reader_of_weights_words_or_maps_reads_a_device(tmp_path):
    for read, ending in (
        (read_attributes, ".txt"),
        (Confusion.open, ".csv"),
        (ImageNetwork, ".tflite"),
        (digest_of, ".scene"),
    ):
        (tmp_path / f"a{ending}").symlink_to("/dev/null")  # as /dev/zero, but it ends
        with pytest.raises(InputError, match="is not a plain file"):
            read(tmp_path / f"a{ending}")
