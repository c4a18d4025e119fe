"""Captures that come as a ZIP."""

import zipfile

import pytest

from placegraph.errors import InputError, RequestError
from placegraph_serve.options import ServeOptions
from placegraph_serve.requests import capture_in


@pytest.fixture
def packed(tmp_path):
    def pack(*entries):
        with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in entries:
                archive.writestr(name, content)
        (tmp_path / "out").mkdir()
        return tmp_path / "a.zip", tmp_path / "out"

    return pack


def test_a_capture_below_one_folder_is_found(walk, tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        for path in walk.rglob("*"):
            archive.write(path, f"walk/{path.relative_to(walk)}")
        archive.writestr("__MACOSX/walk/._a", b"")
    (tmp_path / "out").mkdir()
    assert len(capture_in(tmp_path / "a.zip", tmp_path / "out", ServeOptions())) == 18
    with pytest.raises(RequestError, match="18 frames; send at most 17"):
        capture_in(tmp_path / "a.zip", tmp_path / "out", ServeOptions(images=17))


@pytest.mark.parametrize("name", ["../evil", "/etc/evil", "a/../../evil", "a\\..\\evil", "c:evil"])
def test_no_name_leads_out(packed, tmp_path, name):
    with pytest.raises(InputError, match="leads out of the ZIP"):
        capture_in(*packed((name, b"x")), ServeOptions())
    assert not list((tmp_path / "out").iterdir())
    assert not (tmp_path / "evil").exists()


def test_no_link_is_followed(packed):
    link = zipfile.ZipInfo("rgb")
    link.external_attr = 0o120777 << 16
    with pytest.raises(InputError, match="leads out"):
        capture_in(*packed((link, "/etc")), ServeOptions())


@pytest.mark.parametrize("kind", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_damaged_bytes(packed, kind):
    entry = zipfile.ZipInfo("rgb/0.png")
    entry.compress_type = kind
    file, out = packed((entry, bytes(range(256)) * 20))
    data = bytearray(file.read_bytes())
    data[60:100] = bytes(40)
    file.write_bytes(data)
    with pytest.raises(InputError, match="no whole ZIP"):
        capture_in(file, out, ServeOptions())


def test_half_a_zip(packed):
    file, out = packed(("rgb/0.png", b"x" * 5000))
    file.write_bytes(file.read_bytes()[:-40])
    with pytest.raises(InputError, match="no whole ZIP"):
        capture_in(file, out, ServeOptions())


def test_a_bomb_is_not_unpacked(packed, tmp_path):
    file, out = packed(*((f"rgb/{i}.png", bytes(1 << 20)) for i in range(4)))
    assert file.stat().st_size < 10_000
    with pytest.raises(RequestError, match="unpacked"):
        capture_in(file, out, ServeOptions(unpacked_bytes=3 << 20))
    assert not list((tmp_path / "out").iterdir())


def test_a_length_that_lies(packed):
    file, out = packed(("rgb/0.png", bytes(1 << 20)))
    data = file.read_bytes()
    told = (1 << 20).to_bytes(4, "little")
    file.write_bytes(data.replace(told, (1000).to_bytes(4, "little")))  # in both directories
    with pytest.raises(InputError, match="no whole ZIP"):
        capture_in(file, out, ServeOptions(unpacked_bytes=2000))


def test_too_many_files(packed):
    with pytest.raises(RequestError, match="207 files"):
        capture_in(*packed(*((f"{i}", b"") for i in range(207))), ServeOptions(images=10))


def test_no_capture(packed):
    with pytest.raises(InputError, match="holds no capture of a known recorder"):
        capture_in(*packed(("notes.txt", b"hello")), ServeOptions())
