import shutil
import subprocess
import tarfile
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread

import pytest
from tests.browser import opened

import placegraph as pg
from placegraph_serve.photon import Gazetteer, rows_of
from placegraph_serve.requests import Search

NODES = {1: (0, 0), 2: (0, 100), 3: (0, 150), 4: (0, 300), 5: (0, 4000), 6: (0, 4100), 7: (20, 50)}
WAYS = {1: (1, 2), 2: (3, 4), 3: (5, 6)}


@pytest.fixture(scope="module")
def gazetteer(tmp_path_factory):
    """A street of two ways with a gap of 50 m, another of its name 3.7 km away, and a café."""
    lines = ["<osm version='0.6'>"]
    for number, (north, east) in NODES.items():
        at = f"lat='{50.0 + north / 111_229.0}' lon='{8.0 + east / 71_696.0}'"
        tags = "<tag k='amenity' v='cafe'/><tag k='name' v='Moka'/>" if number == 7 else ""
        lines.append(f"<node id='{number}' {at}>{tags}</node>")
    for number, nodes in WAYS.items():
        refs = "".join(f"<nd ref='{node}'/>" for node in nodes)
        tags = "<tag k='highway' v='residential'/><tag k='name' v='High Street'/>"
        lines.append(f"<way id='{number}'>{refs}{tags}</way>")
    path = tmp_path_factory.mktemp("streets") / "streets.osm"
    path.write_text("\n".join([*lines, "</osm>"]))
    pg.build_city(path, path.with_suffix(".city"))
    return Gazetteer(pg.open_map(path.with_suffix(".city")))


@pytest.mark.parametrize(("dedupe", "count"), [(1, 2), (0, 3)])
def test_ways_that_touch_are_one_street(gazetteer, dedupe, count):
    query = Search(q="high street", dedupe=dedupe).model_dump()
    rows = rows_of(gazetteer, query)
    assert len(rows) == count
    west, north, east, south = gazetteer.feature(min(rows))["properties"]["extent"]
    assert (east - west) * 71_696.0 == pytest.approx(300.0, abs=2.0)
    assert north == pytest.approx(south, abs=1e-5)


def test_a_place_lies_on_its_street(gazetteer):
    (row,) = rows_of(gazetteer, Search(q="moka").model_dump())
    assert gazetteer.feature(row)["properties"]["street"] == "High Street"
    distances = gazetteer.measure_distances(
        gazetteer.city.objects.center[row], 60.0, gazetteer.streets
    )
    assert sorted(distances.values()) == pytest.approx([20.0], abs=1.0)


@pytest.mark.parametrize("text", ["High Street, Streets", "high street streets", "High Street"])
def test_the_town_may_follow_a_name(gazetteer, text):
    assert len(rows_of(Gazetteer(gazetteer.city, "streets"), Search(q=text).model_dump())) == 2


def test_a_sentence_in_a_search_box_is_of_all_towns(web):
    def names(text):
        found = web.get("/api", params={"q": text}).json()["features"]
        return [f["properties"] for f in found]

    for text, near in (
        ("a museum and a bench", "Museum"),
        ("near Bäckerei Kern and St. Marien", "St. Marien"),
    ):
        first, *_ = names(text)
        assert (first["osm_value"], first["probability"] >= 0.05) == ("described", True)
        assert near in first["name"]
    assert names("800 Robson Street") == []


PAGE = """<!doctype html><meta charset="utf-8"><link rel="icon" href="data:,">
<script src="leaflet/package/dist/leaflet.js"></script>
<script src="leaflet-control-geocoder/package/dist/Control.Geocoder.js"></script>
<script src="leaflet.photon/package/leaflet.photon.js"></script>
<div id="map" style="height: 300px"></div>
<script>
const api = "URL/api/", reverseUrl = "URL/reverse/", at = {lat: 53.55, lng: 9.993}
const map = L.map("map", {photonControl: true, photonControlOptions: {
  url: `${api}?`, resultsHandler: found => { window.typed = found.features }}}).setView(at, 15)
const photon = L.Control.Geocoder.photon({serviceUrl: api, reverseUrl})
</script>"""


@pytest.fixture
def boxes(tmp_path, running):
    """A page of another host with the search boxes of two packages from npm."""
    npm = shutil.which("npm") or pytest.skip("needs npm")
    for name in ("leaflet@1.9.4", "leaflet-control-geocoder@4.0.0", "leaflet.photon@0.9.2"):
        ask = [npm, "pack", "--silent", name]
        packed = subprocess.run(  # noqa: S603
            ask, check=False, cwd=tmp_path, capture_output=True, text=True
        )
        if packed.returncode:
            pytest.skip("needs packages of npm")
        folder = tmp_path / name.partition("@")[0]
        folder.mkdir()
        with tarfile.open(tmp_path / packed.stdout.split()[-1]) as archive:
            # Python before 3.11.4 has no filters
            safe = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}
            archive.extractall(folder, **safe)  # noqa: S202  # published archives of npm
    (tmp_path / "page.html").write_text(PAGE.replace("URL", running.url))
    handler = partial(SimpleHTTPRequestHandler, directory=tmp_path)
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        Thread(target=server.serve_forever).start()
        yield f"http://127.0.0.1:{server.server_port}/page.html"
        server.shutdown()


@pytest.mark.all
def test_published_search_boxes_work_unchanged(browser, boxes):
    with opened(browser, boxes) as page:
        (first, *_) = page.evaluate("photon.geocode('bakery', {map})")
        assert first["properties"]["osm_value"] == "bakery"
        near = page.evaluate("c => photon.reverse(c, 18)", first["center"])
        assert near[0]["properties"]["osm_id"] == first["properties"]["osm_id"]
        page.fill(".photon-input", "bakery")
        page.wait_for_function("window.typed && window.typed.length > 0")
        page.wait_for_selector(".photon-autocomplete li")
