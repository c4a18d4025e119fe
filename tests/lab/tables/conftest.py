"""The shipped town as a file, and tables by their names."""

import pytest
from typer.testing import CliRunner

from placegraph_lab.tables.runner import load


@pytest.fixture(scope="session")
def town(hafenstadt, tmp_path_factory):
    """The shipped town as an OSM file."""
    return hafenstadt.write_osm(tmp_path_factory.mktemp("town") / "town.osm")


@pytest.fixture(scope="session")
def measure():
    """Run a table by its name and options, as on the command line."""

    def run(name, *options):
        return CliRunner().invoke(load(name).app(), list(map(str, options)))

    return run
