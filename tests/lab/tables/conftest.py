"""Small worlds with known geometry."""

import osmium
import pytest
from osmium.osm.mutable import Node, Relation, Way
from typer.testing import CliRunner

from placegraph.core.geometry import LocalPlane
from placegraph_lab.tables.runner import load
from placegraph_lab.worlds.town.town import Town

PLANE = LocalPlane(10.0, 50.0)


@pytest.fixture
def write_world(tmp_path):
    """Write nodes (east, north, tags), ways (rows of nodes, tags) and multipolygons as OSM."""

    def write(nodes, ways=(), relations=(), *, name="world.osm"):
        path = tmp_path / name
        with osmium.SimpleWriter(str(path), overwrite=True) as writer:
            for i, (east, north, tags) in enumerate(nodes, 1):
                at = tuple(PLANE.to_lonlat((east, north)).tolist())
                writer.add_node(Node(id=i, version=1, location=at, tags=tags))
            for i, (rows, tags) in enumerate(ways, 1):
                writer.add_way(Way(id=i, version=1, nodes=[r + 1 for r in rows], tags=tags))
            for i, (members, tags) in enumerate(relations, 1):
                kept = [("w", row + 1, role) for row, role in members]
                writer.add_relation(Relation(id=i, version=1, members=kept, tags=tags))
        return path

    return write


@pytest.fixture(scope="session")
def town(tmp_path_factory):
    """The shipped town as an OSM file."""
    return Town.load("hafenstadt").write_osm(tmp_path_factory.mktemp("town") / "town.osm")


@pytest.fixture(scope="session")
def measure():
    """Run a table by its name and options, as on the command line."""

    def run(name, *options):
        return CliRunner().invoke(load(name).app(), list(map(str, options)))

    return run
