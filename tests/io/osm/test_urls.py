"""Extracts at URLs: fetched in pieces, taken up again, skipped where they are the same; typed errors."""

import http.server
import sys
import threading
from itertools import count

import pytest

import placegraph as pg
from placegraph.errors import InputError, MapError, MissingExtraError, OptionError, ServiceError
from placegraph.io.osm import urls
from placegraph.io.osm.urls import fetch_file, remote_size
from placegraph_scale.build import build_world
from placegraph_scale.options import BuildOptions

fsspec = pytest.importorskip("fsspec", reason="fsspec is not installed (extra scale)")
NUMBER = count()
BENCH, TREE = {"amenity": "bench"}, {"natural": "tree"}


class Handler(http.server.BaseHTTPRequestHandler):
    """Hands out `content`, by ranges or whole, and hangs up after `cut` bytes where that is set."""

    content, tag, ranges, cut, asked = b"", "1", True, None, ()

    def do_HEAD(self):
        self.answer(body=False)

    def do_GET(self):
        self.answer(body=True)

    def answer(self, *, body):
        kind = type(self)
        if "town" not in self.path:
            self.send_error(404 if "gone" in self.path else 403)
            return
        first, last, given = 0, len(kind.content), self.headers.get("Range")
        if given and kind.ranges:
            first, last = (int(x) for x in given.removeprefix("bytes=").split("-"))
            last = min(last + 1, len(kind.content))
        kind.asked += ((body, first),)
        self.send_response(206 if given and kind.ranges else 200)
        self.send_header("Content-Length", str(last - first))
        if kind.tag:
            self.send_header("ETag", f'"{kind.tag}"')
        if given and kind.ranges:
            self.send_header("Content-Range", f"bytes {first}-{last - 1}/{len(kind.content)}")
        self.end_headers()
        if body:
            end = last if kind.cut is None else min(last, kind.cut)
            self.wfile.write(kind.content[first:end])
            self.close_connection = end < last or self.close_connection

    def log_message(self, *_):
        pass


@pytest.fixture
def server():
    pytest.importorskip("aiohttp", reason="aiohttp is not installed (extra scale)")
    kind = type("Here", (Handler,), {})
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), kind) as found:
        thread = threading.Thread(target=found.serve_forever)
        thread.start()
        kind.url = f"http://127.0.0.1:{found.server_port}/town.osm?key=1"
        yield kind
        found.shutdown()
        thread.join()


@pytest.fixture
def extract(write_world):
    things = [(40.0 * i, 10.0 * (i % 3), BENCH if i % 2 else TREE) for i in range(40)]
    return write_world([*things, (500.0, 40.0, {"amenity": "theatre", "name": "Rex"})])


@pytest.fixture
def remote(extract):
    """The extract in memory, at a URL."""
    url = f"memory:///{next(NUMBER)}/town.osm"
    fsspec.filesystem("memory").pipe_file(url, extract.read_bytes())
    return url


def memory(url, content):
    fsspec.filesystem("memory").pipe_file(url, content)


def test_a_world_of_urls_is_that_of_files(extract, remote, tmp_path):
    told, options = [], BuildOptions(zoom=15, overlap=100.0, workers=1)
    made = build_world([remote], tmp_path / "W", options, lambda *step: told.append(step))
    file = build_world([f"file://{extract}"], tmp_path / "F", options)
    assert [s.objects for s in made.shards] == [s.objects for s in file.shards]
    size = extract.stat().st_size
    assert (f"fetching town.osm ({size / 1e6:,.1f} MB)", size, size) in told
    again = []
    build_world([remote], tmp_path / "W", options, lambda *step: again.append(step))
    assert not any("fetching" in step for step, *_ in again)


def test_a_city_of_a_url(extract, remote, tmp_path, run):
    told = []
    one = pg.build_city(remote, tmp_path / "a.city", progress=lambda *step: told.append(step))
    other = pg.build_city(extract, tmp_path / "b.city")
    assert one.digest == other.digest
    assert told[0][0].startswith("fetching")
    assert {p.name for p in tmp_path.iterdir()} == {extract.name, "a.city", "b.city"}
    assert run("city", "build", remote, "-o", tmp_path / "c.city").code == 0


def test_a_large_one_becomes_a_world(remote, tmp_path, run, monkeypatch):
    from placegraph_scale import cli as build

    made = []
    monkeypatch.setattr(build, "run_build", lambda files, out, *_, **__: made.append((files, out)))
    monkeypatch.setattr(urls, "SMALL", 10)
    assert run("city", "build", remote, "-o", tmp_path / "big").code == 0
    assert made == [([remote], str(tmp_path / "big"))]


def test_a_map_is_not_written_to_a_url(remote, run):
    told = run("city", "build", remote, "-o", "s3://bucket/big.city")
    assert told.code == OptionError.exit_code
    assert "world build" in told.err
    assert "--work" in told.err
    with pytest.raises(OptionError, match="is a URL"):
        pg.build_city(remote, "s3://bucket/big.city")


@pytest.mark.parametrize("ranges", [True, False])
def test_over_http(server, extract, tmp_path, ranges, monkeypatch):
    monkeypatch.setattr(urls, "CHUNK", 1000)
    server.content, server.ranges = extract.read_bytes(), ranges
    path = fetch_file(server.url, tmp_path)
    assert (path.name, path.read_bytes()) == ("town.osm", server.content)
    bodies = sum(body for body, _ in server.asked)
    assert fetch_file(server.url, tmp_path) == path
    assert sum(body for body, _ in server.asked) == bodies
    server.content, server.tag = server.content.replace(b"Rex", b"Max"), "2"
    assert b"Max" in fetch_file(server.url, tmp_path).read_bytes()


@pytest.mark.parametrize("ranges", [True, False])
def test_a_cut_connection_is_told_and_taken_up(server, tmp_path, ranges):
    server.content, server.ranges = bytes(range(256)) * 80_000, ranges  # 20 MB, of several pieces
    server.cut = 15_000_000
    with pytest.raises(ServiceError, match="the same command resumes"):
        fetch_file(server.url, tmp_path)
    (part,) = tmp_path.rglob("*.part")
    held = part.stat().st_size
    assert 0 < held < len(server.content)
    server.cut, server.asked = None, ()
    assert fetch_file(server.url, tmp_path).read_bytes() == server.content
    begun = [first for body, first in server.asked if body]
    assert begun[0] == held if ranges else 0 in begun


def test_what_has_no_version_is_not_taken_up(server, tmp_path, monkeypatch):
    monkeypatch.setattr(urls, "CHUNK", 1 << 19)
    server.content, server.tag = b"a" * 2_000_000, ""
    server.cut = 1_500_000
    with pytest.raises(ServiceError):
        fetch_file(server.url, tmp_path)
    server.content, server.cut = b"b" * 2_000_000, None
    assert set(fetch_file(server.url, tmp_path).read_bytes()) == set(b"b")


def test_a_small_part_of_what_is_only_read_whole(server, tmp_path):
    server.content, server.ranges, server.cut = b"<osm></osm>", False, 4
    with pytest.raises(ServiceError):
        fetch_file(server.url, tmp_path)
    (part,) = tmp_path.rglob("*.part")
    part.write_bytes(server.content[:4])
    server.cut = None
    assert fetch_file(server.url, tmp_path).read_bytes() == server.content


def test_a_city_is_taken_up_and_tells_no_key(server, extract, tmp_path, monkeypatch):
    monkeypatch.setattr(urls, "CHUNK", 1000)
    server.content, server.cut = extract.read_bytes(), 2500
    with pytest.raises(ServiceError, match="the same command resumes"):
        pg.build_city(server.url, tmp_path / "a.city")
    (part,) = tmp_path.rglob("*.part")
    held = part.stat().st_size
    server.cut, server.asked = None, ()
    city = pg.build_city(server.url, tmp_path / "a.city")
    assert next(first for body, first in server.asked if body) == held
    assert city.source == "town.osm"
    assert {p.name for p in tmp_path.iterdir()} == {extract.name, "a.city"}


def test_what_is_not_there_or_no_extract(server, tmp_path):
    base = server.url.partition("/town")[0]
    for url, error, message in (
        (f"{base}/gone.osm", InputError, "does not exist"),
        (f"{base}/secret.osm", ServiceError, "403"),
        (f"{base}/town.zip", InputError, "unknown ending"),
        ("http://127.0.0.1:9/town.osm", ServiceError, "cannot be read"),
        ("nonsense://a.osm", OptionError, "kind of URL is not supported"),
        ("zip://a.osm::file:///none.zip", OptionError, "cannot be opened"),
        ("github://a.osm", OptionError, "cannot be opened"),
    ):
        with pytest.raises(error, match=message):
            remote_size(url)
    memory("memory:///empty.osm", b"")
    memory("memory:///folder.osm/x", b"x")
    for name, message in (
        ("none/a", "does not exist"),
        ("empty", "is empty"),
        ("folder", "is a folder"),
    ):
        with pytest.raises(InputError, match=message):
            fetch_file(f"memory:///{name}.osm", tmp_path)


def test_a_city_of_a_damaged_extract_names_its_url(tmp_path):
    memory("memory:///page.osm", b"<html>log in</html>")
    with pytest.raises(InputError, match=r"^memory:///page.osm cannot be read as OpenStreetMap"):
        pg.build_city("memory:///page.osm", tmp_path / "a.city")


def test_nothing_is_fetched_where_another_is_missing(remote, tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        build_world([remote, tmp_path / "none.osm"], tmp_path / "W", BuildOptions(workers=1))
    with pytest.raises(InputError, match="does not exist"):
        build_world([remote, "memory:///none.osm"], tmp_path / "W", BuildOptions(workers=1))
    assert not list((tmp_path / "W").rglob("*.osm"))


def test_an_extract_that_changed_while_it_was_fetched_and_a_folder_that_is_none(remote, tmp_path):
    with pytest.raises(InputError, match="changed while"):
        fetch_file(remote, tmp_path, lambda *_: memory(remote, b"<osm>another one</osm>"))
    assert not list(tmp_path.rglob("*.part"))
    (tmp_path / "W").write_bytes(b"no folder")
    with pytest.raises(MapError, match="cannot be written"):
        fetch_file(remote, tmp_path / "W")


@pytest.mark.parametrize(
    ("gone", "url"), [("fsspec", "memory:///a.osm"), ("aiohttp", "https://a/b.osm")]
)
def test_what_is_not_installed(gone, url, monkeypatch):
    monkeypatch.setitem(sys.modules, gone, None)
    with pytest.raises(MissingExtraError, match=r"placegraph\[scale\]"):
        remote_size(url)
