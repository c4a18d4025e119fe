import osmium
import pytest

from placegraph.errors import InputError
from placegraph_lab.worlds.drawing import list_shipped
from placegraph_lab.worlds.town.town import Town


def osm(text, tmp_path):
    path = Town.parse(text).write_osm(tmp_path / "town.osm")
    nodes, ways, relations = [], [], []
    for thing in osmium.FileProcessor(path).with_locations():
        tags = dict(thing.tags)
        if thing.is_node() and tags:
            nodes.append((tags, (thing.location.lon, thing.location.lat)))
        elif thing.is_way():
            ways.append((tags, [(n.location.lon, n.location.lat) for n in thing.nodes]))
        elif thing.is_relation():
            relations.append((tags, [(m.role, m.ref) for m in thing.members]))
    return nodes, ways, relations


def plane(text, lonlat):
    return Town.parse(text).plane.to_plane(lonlat)


CROSSING = """
[town]
name = Crossing
metres = 20
[drawing]
  B |
----+--1--
    |
≈≈≈≈|≈≈≈≈≈
    |
[legend]
B: shop=bakery name=Bäckerei "Kern" & <Söhne>
1 road: highway=primary name=Lange Straße
"""


def test_points_roads_and_bridge(tmp_path):
    nodes, ways, _ = osm(CROSSING, tmp_path)
    [(tags, lonlat)] = nodes
    assert tags == {"shop": "bakery", "name": 'Bäckerei "Kern" & <Söhne>'}
    town = Town.parse(CROSSING)
    assert town.position("B") == pytest.approx(lonlat, abs=1e-7)
    assert town.plane.to_plane(lonlat) == pytest.approx((-50.0, 40.0), abs=0.01)
    roads = [(tags, line) for tags, line in ways if "highway" in tags]
    names = [(t.get("name"), t["highway"], t.get("bridge")) for t, _ in roads]
    assert ("Lange Straße", "primary", None) in names
    assert names.count((None, "residential", "yes")) == 1
    [bridge] = [town.plane.to_plane(line) for tags, line in roads if "bridge" in tags]
    assert bridge[0] == pytest.approx((-10.0, 0.0), abs=0.02)
    assert bridge[-1] == pytest.approx((-10.0, -40.0), abs=0.02)


DOORS = """
[drawing]
-----1---
 ##e#  #e
 ####  ##
[legend]
1 road: highway=residential name=Hafenstraße
e: entrance=main
"""


def test_entrances_stand_in_walls_towards_the_road(tmp_path):
    nodes, ways, _ = osm(DOORS, tmp_path)
    doors = [at for tags, at in nodes if "entrance" in tags]
    outlines = [line for tags, line in ways if "building" in tags]
    assert [len(line) for line in outlines] == [6, 6]
    assert all(door in line for door, line in zip(doors, outlines, strict=True))
    assert plane(DOORS, doors)[:, 1] == pytest.approx(5.0, abs=0.02)
    with pytest.raises(InputError, match="line 3, column 11: 'e' is an entrance without a wall"):
        osm(DOORS.replace("-----1---", "-----1--- e"), tmp_path)


def test_same_town_same_bytes(tmp_path):
    one = Town.parse(CROSSING).write_osm(tmp_path / "one.osm").read_bytes()
    assert one == Town.parse(CROSSING).write_osm(tmp_path / "two.osm").read_bytes()


@pytest.mark.parametrize("name", list_shipped("towns"))
def test_shipped_towns_load(name, tmp_path):
    town = Town.load(name)
    nodes, ways, _ = osm_of(town, tmp_path)
    assert town.name
    assert nodes > 20
    assert ways > 15


def osm_of(town, tmp_path):
    counts = [0, 0, 0]
    for thing in osmium.FileProcessor(town.write_osm(tmp_path / "town.osm")):
        counts[0 if thing.is_node() else 1 if thing.is_way() else 2] += 1
    return counts


@pytest.mark.parametrize(
    ("text", "where", "mend"),
    [
        ("", "<text>", "add a line [drawing]"),
        ("B--\n", "line 1, column 1", "begin with a line [town]"),
        ("[drawing]\n\n--?--\n", "line 3, column 3", "'?: amenity=bench'"),
        ("[drawing]\n-- \t-\n", "line 2, column 4", "write blanks"),
        ("[drawing]\n -- + --\n", "line 2, column 5", "joins no road"),
        ("[drawing]\n--1--2--\n[legend]\n1 road: highway=path\n2 road: highway=path\n",
         "line 2, column 6", "leave one out"),
        ("[drawing]\n |\n-1-\n[legend]\n1 road: highway=path\n",
         "line 3, column 2", "put '+' here"),
        ("[drawing]\n--\n[legend]\nB amenity=bench\n", "line 4, column 1", "glyph kind"),
        ("[drawing]\n--\n[legend]\nB blob: amenity=bench\n", "line 4, column 3", "road, spot"),
        ("[drawing]\n--\n[legend]\nB: bench\n", "line 4, column 3", "key=value"),
        ("[drawing]\n--\n[legend]\nB: x bench=1\n", "line 4, column 3", "key=value"),
        ("[drawing]\n--\n[legend]\nB spot: a=1\n", "line 4, column 8", "nothing after"),
        ("[drawing]\n--\n[legend]\n- road: highway=path\n", "line 4, column 1", "by a label"),
        ("[town]\nsize = 3\n[drawing]\n--\n", "line 2, column 1", "name, center or metres"),
        ("[town]\ncenter = 9\n[drawing]\n--\n", "[town]", "two numbers"),
        ("[town]\ncenter = 9 91\n[drawing]\n--\n", "[town]", "85 north"),
        ("[town]\nmetres = nan\n[drawing]\n--\n", "[town]", "0.1 to 1000"),
    ],
)  # fmt: skip
def test_errors_name_the_place_and_the_mend(text, where, mend, tmp_path):
    with pytest.raises(InputError) as error:
        Town.parse(text).write_osm(tmp_path / "town.osm")
    assert where in str(error.value)
    assert mend in str(error.value)
