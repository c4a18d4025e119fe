"""Fetching a place, from servers on this machine that answer with what was recorded by hand."""

import json
import math
import re
import shutil
import socket
import subprocess
import sys
import threading
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qs, urlsplit
from xml.sax.saxutils import quoteattr

import osmium
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.errors import InputError, MissingExtraError, OptionError, ServiceError
from placegraph.io.osm import overpass
from placegraph.io.osm.osm import NODE, RELATION, WAY
from placegraph.io.osm.overpass import FetchSummary
from placegraph.outdoor.city import build_city
from placegraph.outdoor.language.vocabulary import Vocabulary
from placegraph.outdoor.map.extract import keys_read

DATA = Path(__file__).parent / "data"
PLACES = json.loads((DATA / "nominatim_muehlenend.json").read_text(encoding="utf-8"))
TOWN = (DATA / "overpass_muehlenend.osm").read_bytes()
HTML = b"""<?xml version="1.0" encoding="UTF-8"?>
<!DOCTYPE html><html lang="en"><head><title>OSM3S Response</title></head><body>
<p>The data included in this document is from www.openstreetmap.org.</p>
<p><strong style="color:#FF0000">Error</strong>: runtime error: open64: 0 Success
/osm3s_osm_base Dispatcher_Client::request_read_and_idx::timeout. </p></body></html>"""
HEAD = b'<?xml version="1.0" encoding="UTF-8"?>\n<osm version="0.6" generator="Overpass API">\n'
GAVE_UP = (
    b'<remark> runtime error: Query timed out in "query" at line 3 after 181 seconds. </remark>'
)


@dataclass
class Servers:
    """Nominatim and Overpass on 127.0.0.1; a test sets what they answer and reads what was asked."""

    url: str
    places: bytes = field(default_factory=lambda: json.dumps(PLACES).encode())
    nominatim_status: int = 200
    answers: list = field(default_factory=lambda: [(200, TOWN)])
    """Status and body of Overpass's answers, in order; the last one is repeated."""
    extra_length: int = 0
    """Bytes that are announced and never come."""
    asked: list = field(default_factory=list)
    pauses: list = field(default_factory=list)

    @property
    def query(self):
        return parse_qs(self.asked[-1][1])["data"][0]


@pytest.fixture
def servers(monkeypatch):
    import osmnx as ox

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            it.asked.append((self.path, "", dict(self.headers)))
            self.answer(it.nominatim_status, it.places, "application/json")

        def do_POST(self):
            body = self.rfile.read(int(self.headers["Content-Length"])).decode()
            it.asked.append((self.path, body, dict(self.headers)))
            status, answer = it.answers[0] if len(it.answers) == 1 else it.answers.pop(0)
            self.answer(status, answer, "application/osm3s+xml")

        def answer(self, status, body, kind):
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header(
                "Content-Length", str(len(body) + it.extra_length * bool(it.asked[1:]))
            )
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    it = Servers(f"http://127.0.0.1:{server.server_port}")
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setattr(ox.settings, "nominatim_url", it.url)
    monkeypatch.setattr(ox.settings, "overpass_url", f"{it.url}/api")
    monkeypatch.setattr("time.sleep", it.pauses.append)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield it
    server.shutdown()
    server.server_close()
    thread.join()


@pytest.fixture
def out(tmp_path):
    return tmp_path / "town.osm"


def closed_port():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def fetch_osm(place, out, **options):
    """Fetch what a city map is made of, or other `keys`."""
    return overpass.fetch_osm(place, out, **{"keys": keys_read()} | options)


def raw(path):
    """Everything in a file: type, id, tags, and what the element consists of."""
    found = {}
    for item in osmium.FileProcessor(path):
        if item.is_node():
            parts = (item.lon, item.lat)
        elif item.is_way():
            parts = tuple(node.ref for node in item.nodes)
        else:
            parts = tuple((member.type, member.ref, member.role) for member in item.members)
        found[item.type_str(), item.id] = (dict(item.tags), parts)
    return found


def failure(error, out, place="Mühlenend", **options):
    """Fetch in vain; return the message. What was there before is there still, and nothing else."""
    out.write_bytes(b"old")
    with pytest.raises(error) as caught:
        fetch_osm(place, out, **options)
    assert out.read_bytes() == b"old"
    assert list(out.parent.iterdir()) == [out]
    assert caught.type is error
    return str(caught.value)


@pytest.mark.parametrize("suffix", overpass.SUFFIXES)
@pytest.mark.usefixtures("servers")
def test_elements_arrive_unchanged(tmp_path, suffix):
    path = tmp_path / f"town{suffix}"
    summary = fetch_osm("Mühlenend", path)
    assert summary == FetchSummary(
        "Mühlenend, Bezirk Unterland, 9999, Nowhere", 24, 6, 1, path.stat().st_size
    )
    assert str(summary).startswith(f"{summary.place}: 24 nodes, 6 ways, 1 relations, ")
    assert raw(path) == raw(DATA / "overpass_muehlenend.osm")
    assert suffix == ".osm.pbf" or path.read_bytes() == TOWN
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.usefixtures("servers")
def test_from_a_name_to_a_city(tmp_path):
    osm, city_path = tmp_path / "town.osm.pbf", tmp_path / "town.city"
    fetch_osm("Mühlenend", osm)
    city = build_city(osm, city_path)
    assert not city.left_out
    objects = city.objects
    ids = set(zip(objects.osm_type.tolist(), objects.osm_id.tolist(), strict=True))
    assert {(NODE, 11403528190), (NODE, 11403528194), (WAY, 5034406), (RELATION, 7702288)} <= ids
    assert {"amenity=cafe", "natural=tree", "leisure=park"} <= set(objects.labels)
    assert {"St. Florin", "Mühlenstraße", "Alter Grenzstein"} <= set(objects.names)


def test_what_is_asked(servers, out):
    fetch_osm("Mühlenend, Nowhere", out)
    (search, _, nominatim), (path, _, headers) = servers.asked
    assert parse_qs(urlsplit(search).query)["q"] == ["Mühlenend, Nowhere"]
    assert path == "/api/interpreter"
    assert all("placegraph" in said["User-Agent"] for said in (nominatim, headers))
    query = servers.query
    assert query.startswith("[out:xml][timeout:180];\n(\n")
    assert query.endswith("\n);\n(._;>;);\nout body;\n")
    kinds = re.findall(r'^(\w+)\S*\[~"\^\((.*)\)\$"~"\."\]\(poly:"(.*)"\);$', query, re.MULTILINE)
    assert [kind for kind, _, _ in kinds] == ["node", "way", "relation"]
    assert all(set(keys.split("|")) == {*Vocabulary.default().keys, "name"} for _, keys, _ in kinds)
    assert re.search(r'^relation\["type"~"\^\(multipolygon\|boundary\)\$"\]', query, re.MULTILINE)


@pytest.mark.parametrize("islands", [1, 7, pytest.param(60, marks=pytest.mark.all)])
def test_query_surrounds_the_place_and_stays_short(servers, out, islands):
    from shapely import MultiPolygon, Point, Polygon
    from shapely.geometry import mapping

    centres = [(9.5 + 0.02 * (i % 8), 47.0 + 0.02 * (i // 8)) for i in range(islands)]
    place = MultiPolygon([Point(centre).buffer(0.004, quad_segs=500) for centre in centres])
    servers.places = json.dumps([PLACES[1] | {"geojson": mapping(place)}]).encode()
    fetch_osm("Mühlenend", out)
    rings = re.findall(r'^node.*poly:"([\d. -]+)"', servers.query, re.MULTILINE)
    assert len(servers.query) < 100_000  # Overpass reads 1 MiB
    polygons = []
    for ring in rings:
        numbers = [float(number) for number in ring.split()]
        polygons.append(Polygon(zip(numbers[1::2], numbers[::2], strict=True)))
    around = MultiPolygon(polygons) if len(polygons) > 1 else polygons[0]
    assert around.contains(place)
    if islands == 1:
        metres = overpass.METRES_A_DEGREE * math.cos(math.radians(47.0))
        assert around.boundary.hausdorff_distance(place.boundary) * metres < 120


def test_keys_and_server_can_be_chosen(servers, out):
    import osmnx as ox

    ox.settings.overpass_url = f"http://127.0.0.1:{closed_port()}"  # put back by the fixture
    before = dict(vars(ox.settings))
    fetch_osm("Mühlenend", out, keys=["shop", "addr:street", "a.b"],
              overpass_url=f"{servers.url}/mine/interpreter/")  # fmt: skip
    assert servers.asked[-1][0] == "/mine/interpreter"
    assert '[~"^(a[.]b|addr:street|shop)$"~"."]' in servers.query
    assert vars(ox.settings) == before


def test_settings_of_osmnx_are_used_and_kept(servers, out, monkeypatch, tmp_path):
    import osmnx as ox

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(ox.settings, "overpass_memory", 1 << 30)
    monkeypatch.setattr(ox.settings, "requests_timeout", 25)
    before, resolve = dict(vars(ox.settings)), socket.getaddrinfo
    fetch_osm("Mühlenend", out)
    assert servers.query.startswith("[out:xml][timeout:25][maxsize:1073741824];")
    servers.places = b"[]"
    with pytest.raises(InputError):
        fetch_osm("Mühlenend", out)
    assert vars(ox.settings) == before
    assert socket.getaddrinfo is resolve
    assert list(tmp_path.iterdir()) == [out]  # no cache is left lying about


def test_a_busy_server_is_asked_again_and_progress_reported(servers, out):
    out.write_bytes(b"old")
    servers.answers = [(429, HTML), (504, HTML), (200, TOWN)]
    fetch_osm("Mühlenend", out)
    assert [p for p in servers.pauses if p in overpass.PAUSES] == list(overpass.PAUSES)
    assert len(raw(out)) == 31
    steps = []
    servers.answers = [(429, b""), (200, TOWN)]
    fetch_osm("Mühlenend", out, progress=lambda *step: steps.append(step))
    assert steps == [("finding", 0), ("downloading", 0), ("waiting", overpass.PAUSES[0]),
                     ("downloading", 0), ("downloading", len(TOWN)), ("writing", 0)]  # fmt: skip


def test_a_server_that_stays_busy(servers, out):
    servers.answers = [(504, HTML)]
    said = failure(ServiceError, out)
    assert said.startswith("Overpass answered 504 Gateway Timeout (The data included")
    assert "Dispatcher_Client" in said
    assert "--overpass-url" in said
    assert "<" not in said
    assert len(servers.asked) == 2 + len(overpass.PAUSES)


ELSE = "returned an unexpected answer"


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ((500, b""), r"Overpass answered 500 Internal Server Error\. Try again"),
        ((400, HTML), r"Overpass answered 400 Bad Request \(.*runtime error"),
        ((200, HTML), rf"{ELSE}: .*runtime error: open64"), ((200, b""), f"{ELSE}: nothing"),
        ((200, b'{"version": 0.6, "elements": []}'), f"{ELSE}: .*elements"),
        ((200, TOWN[:2000]), ELSE), ((200, b"\x00\xff\xfe" * 100), ELSE),
        ((200, TOWN.replace(b'lat="', b'lat="x')), ELSE),
        ((200, HEAD + GAVE_UP + b"\n</osm>\n"), r"failed: runtime error: Query timed out.* smaller"),
        ((200, TOWN.replace(b"</osm>", GAVE_UP + b"</osm>")), "failed: runtime error"),
    ],
)  # fmt: skip
def test_overpass_fails(servers, out, answer, message):
    servers.answers = [answer]
    assert re.search(message, failure(ServiceError, out))


def test_a_download_that_breaks_off_or_holds_nothing(servers, out):
    servers.extra_length = 1000
    assert "Overpass cannot be reached, or closed the connection" in failure(ServiceError, out)
    servers.extra_length, servers.answers = 0, [(200, HEAD + b"</osm>\n")]
    said = failure(InputError, out, keys=["shop"])
    assert "has no data in 'Mühlenend, Bezirk Unterland" in said


@pytest.mark.parametrize("service", ["nominatim", "overpass"])
@pytest.mark.usefixtures("servers")
def test_server_is_not_there(out, service):
    import osmnx as ox

    setattr(ox.settings, f"{service}_url", f"http://127.0.0.1:{closed_port()}")
    said = failure(ServiceError, out)
    assert said.startswith(f"{service.capitalize()} cannot be reached")
    assert "Check the network" in said


@pytest.mark.parametrize("service", ["nominatim", "overpass"])
@pytest.mark.usefixtures("servers")
def test_server_does_not_answer(out, service, monkeypatch):
    import osmnx as ox

    monkeypatch.setattr(ox.settings, "requests_timeout", 0.2)
    monkeypatch.setattr(overpass, "SLOT", 0)
    with socket.create_server(("127.0.0.1", 0)) as mute:  # accepts, and says nothing
        setattr(ox.settings, f"{service}_url", f"http://127.0.0.1:{mute.getsockname()[1]}")
        said = failure(ServiceError, out)
    assert said.startswith(f"{service.capitalize()} cannot be reached")
    assert "timed out" in said


@pytest.mark.parametrize("url", ["nonsense", "ftp://127.0.0.1/api", "http://"])
@pytest.mark.usefixtures("servers")
def test_server_has_a_strange_address(out, url):
    assert "Check the network" in failure(ServiceError, out, overpass_url=url)


def test_place_is_unknown_or_has_no_outline(servers, out):
    servers.places = b"[]"
    said = failure(InputError, out, place="Atlantiß")
    assert said.startswith("No place named 'Atlantiß' was found; check the spelling")
    assert len(servers.asked) == 1
    servers.places = json.dumps(PLACES[:1]).encode()
    assert "point or line" in failure(InputError, out)


def test_place_is_too_large(servers, out):
    corners = [[9.0, 47.0], [10.0, 47.0], [10.0, 48.0], [9.0, 48.0], [9.0, 47.0]]
    large = PLACES[1] | {"geojson": {"type": "Polygon", "coordinates": [corners]}}
    servers.places = json.dumps([large]).encode()
    said = failure(InputError, out)
    assert (covers := re.search(r"covers ([\d,]+) km2, .* \(limit: 2,500 km2\)", said))
    assert float(covers[1].replace(",", "")) == pytest.approx(8450, rel=0.01)  # on the ellipsoid
    assert "extract" in said


@pytest.mark.parametrize("status", [403, 504])
def test_nominatim_refuses(servers, out, status):
    servers.nominatim_status, servers.places = status, b"<html><h1>No</h1></html>"
    assert f"Nominatim answered {status}" in failure(ServiceError, out)
    assert len(servers.asked) == 1


def spoilt(**changes):
    """Nominatim's answer with other fields."""
    return json.dumps([PLACES[1] | changes]).encode()


@pytest.mark.parametrize(
    "places",
    [
        HTML, b"", b'{"error": "unable"}', b"[{}]", b"[1]", b"null", b"[" * 9000,
        spoilt(boundingbox=["x"]), spoilt(lat="north"),
        spoilt(geojson={"type": "Polygon", "coordinates": []}),
        spoilt(geojson={"type": ["Polygon"], "coordinates": []}),
        spoilt(geojson={"type": "Polygon", "coordinates": [[[10**400, 1]] * 4]}),
        spoilt(geojson={"type": "Polygon", "coordinates": [[[1, 2]]]}),
        json.dumps([{k: v for k, v in PLACES[1].items() if k != "display_name"}]).encode(),
    ],
)  # fmt: skip
def test_nominatim_answers_nonsense(servers, out, places):
    servers.places = places
    said = failure(ServiceError, out)
    assert said.startswith("Nominatim returned an unexpected answer")
    assert len(servers.asked) == 1


def test_file_cannot_be_written(servers, tmp_path):
    (tmp_path / "folder.osm").mkdir()
    for name, message in (
        ("no/town.osm", "is not a folder; create it"), ("folder.osm", "is a folder; name a file"),
        ("town.city", "has an unknown ending; choose one of .osm, .osm.pbf"),
        ("town", "has an unknown ending"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=message):
            fetch_osm("Mühlenend", tmp_path / name)
    assert not servers.asked  # found out before anybody is troubled


@pytest.mark.usefixtures("servers")
def test_folder_is_locked(monkeypatch, out):
    def refuse(*_args, **_options):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(overpass, "TemporaryDirectory", refuse)
    assert "cannot be written: Permission denied" in failure(InputError, out)


@pytest.mark.usefixtures("servers")
@pytest.mark.parametrize("suffix", overpass.SUFFIXES)
def test_disk_is_full(monkeypatch, tmp_path, suffix):
    usage = type(shutil.disk_usage(tmp_path))
    monkeypatch.setattr("shutil.disk_usage", lambda _path: usage(1 << 40, 1 << 40, len(TOWN) - 1))
    said = failure(InputError, tmp_path / f"town{suffix}")
    assert "cannot be written: No space left on device; choose another folder or make room" in said


@pytest.mark.parametrize(
    ("given_", "error", "says"),
    [
        *(({"place": place}, InputError, "no name") for place in ("", " \n")),
        *(({"keys": keys}, OptionError, "keys") for keys in ([], [""], ['a"]; out;'], ["a|b"])),
        ({"keys": ["with space"]}, OptionError, "keys"),
    ],
)
def test_places_and_keys_that_are_none(servers, out, given_, error, says):
    assert says in failure(error, out, **given_)
    assert not servers.asked


def test_extra_is_missing(monkeypatch, out):
    monkeypatch.setitem(sys.modules, "osmnx", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'placegraph\[osmnx\]'"):
        fetch_osm("Mühlenend", out)


def test_import_is_light():
    code = "import sys, placegraph.io.osm.overpass; print(*sys.modules)"
    run = subprocess.run(  # noqa: S603  # our own interpreter and code
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert not {"osmnx", "requests", "geopandas", "osmium"} & set(run.stdout.split())


LETTERS = st.characters(codec="utf-8", categories=("L", "N", "P", "S", "Zs"))
TAGS = st.dictionaries(st.text(LETTERS, min_size=1, max_size=12), st.text(LETTERS, max_size=40))
IDS = st.integers(1, 2**40)


@given(st.dictionaries(IDS, TAGS, min_size=1, max_size=5), st.dictionaries(IDS, TAGS, max_size=5))
def test_any_tags_and_ids_survive(tmp_path_factory, nodes, ways):
    lines = []
    for number, tags in sorted(nodes.items()):
        place = 'lat="47.1234567" lon="-9.7654321"'
        lines += [f'<node id="{number}" {place}>', *tags_of(tags), "</node>"]
    for number, tags in sorted(ways.items()):
        vertices = (f'<nd ref="{node}"/>' for node in nodes)
        lines += [f'<way id="{number}">', *vertices, *tags_of(tags), "</way>"]
    folder = tmp_path_factory.mktemp("copy")
    answer, target = folder / "answer.osm", folder / "town.osm.pbf"
    answer.write_bytes(HEAD + "\n".join(lines).encode() + b"\n</osm>\n")
    counts = overpass.copy_file(answer, target, lambda _step, _n: None)
    assert dict(counts) == {k: len(v) for k, v in (("n", nodes), ("w", ways)) if v}
    assert raw(target) == {
        **{("n", n): (tags, (-9.7654321, 47.1234567)) for n, tags in nodes.items()},
        **{("w", n): (tags, tuple(nodes)) for n, tags in ways.items()},
    }


def tags_of(tags):
    return [f"<tag k={quoteattr(key)} v={quoteattr(value)}/>" for key, value in tags.items()]


@given(st.binary(max_size=300))
def test_gist_is_one_short_line(text):
    line = overpass.shorten(text)
    assert len(line) <= 200
    assert "\n" not in line
