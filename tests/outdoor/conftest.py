"""Cities to be lost in: drawn in ASCII, given in metres, and real ones."""

from xml.sax.saxutils import quoteattr

import pytest

from placegraph.geometry import LocalPlane
from placegraph.maps import open_map
from placegraph.outdoor.build import build_city
from placegraph.synthetic.towns import Town

PLANE = LocalPlane(10.0, 50.0)


def _xml(kind, i, attributes, inner, tags):
    tag = "".join(f"<tag k={quoteattr(k)} v={quoteattr(v)}/>" for k, v in tags.items())
    return f'<{kind} id="{i}" version="1"{attributes}>{inner}{tag}</{kind}>'


def _write_world(path, nodes, ways=(), relations=()):
    """Nodes (east, north, tags), ways (rows of nodes, tags), relations (rows and roles, tags)."""
    lines = ['<osm version="0.6">']
    for i, (east, north, tags) in enumerate(nodes, 1):
        lon, lat = PLANE.to_lonlat((east, north))
        lines.append(_xml("node", i, f' lon="{lon:.7f}" lat="{lat:.7f}"', "", tags))
    for i, (rows, tags) in enumerate(ways, 1):
        inner = "".join(f'<nd ref="{row + 1}"/>' for row in rows)
        lines.append(_xml("way", i, "", inner, tags))
    for i, (members, tags) in enumerate(relations, 1):
        inner = "".join(
            f'<member type="way" ref="{row + 1}" role="{role}"/>' for row, role in members
        )
        lines.append(_xml("relation", i, "", inner, {"type": "multipolygon"} | tags))
    path.write_text("\n".join([*lines, "</osm>"]), encoding="utf-8")
    return path


@pytest.fixture
def write_world(tmp_path):
    """Write nodes (east, north, tags), ways and multipolygons around 10 E, 50 N as OSM XML."""
    return lambda *things, name="world.osm": _write_world(tmp_path / name, *things)


@pytest.fixture
def build_world(write_world, tmp_path):
    """City of nodes (east, north, tags), ways and multipolygons around 10 E, 50 N."""

    def build(*things, **options):
        return build_city(write_world(*things), tmp_path / "world.city", **options)

    return build


@pytest.fixture(scope="session")
def make_city(tmp_path_factory):
    """City of a town drawn in ASCII; the same drawing is built once."""
    known = {}

    def make(town, **options):
        town = Town.parse(town) if isinstance(town, str) else town
        key = (town.rows, town.metres, town.center, str(town.legend), tuple(options.items()))
        if key not in known:
            folder = tmp_path_factory.mktemp("town")
            osm = town.write_osm(folder / "town.osm")
            known[key] = build_city(osm, folder / "town.city", **options)
        return known[key]

    return make


@pytest.fixture(scope="session")
def hafenstadt():
    return Town.load("hafenstadt")


@pytest.fixture(scope="session")
def harbour(make_city, hafenstadt):
    """The shipped town as a city."""
    return make_city(hafenstadt)


@pytest.fixture(scope="session")
def harbour_file(harbour, tmp_path_factory):
    path = tmp_path_factory.mktemp("harbour") / "harbour.city"
    harbour.save(path)
    return path


@pytest.fixture(scope="session")
def monaco_file(shared, tmp_path_factory):
    path = tmp_path_factory.mktemp("monaco") / "monaco.city"
    build_city(shared / "data/osm/monaco_2025.osm.pbf", path)
    return path


@pytest.fixture(scope="session")
def monaco(monaco_file):
    return open_map(monaco_file)


@pytest.fixture(scope="session")
def toronto(shared, tmp_path_factory):
    path = tmp_path_factory.mktemp("toronto") / "toronto.city"
    build_city(shared / "data/osm/toronto_downtown_2020.osm.bz2", path)
    return open_map(path)


@pytest.fixture(params=["monaco", "toronto", "harbour"])
def real_city(request):
    """Each of the two small real cities, and the shipped town."""
    return request.getfixturevalue(request.param)
