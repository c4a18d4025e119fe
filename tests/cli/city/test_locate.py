"""`placegraph city locate`: what of an answer is printed."""

import pytest

from placegraph.outdoor.city import build_city
from placegraph_lab.worlds.town.town import Town

TEXT = "I am on Speicherweg. The museum is south of me."


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    folder = tmp_path_factory.mktemp("locate")
    build_city(Town.load("hafenstadt").write_osm(folder / "town.osm"), folder / "town.city")
    return folder / "town.city"


@pytest.mark.parametrize("preset", ["paper", "published"])
@pytest.mark.parametrize("candidates", [1, 10])
def test_ranks_are_printed_without_a_percentage(run, city, preset, candidates):
    asked = ("city", "locate", city, TEXT, "--preset", preset, "--candidates", candidates)
    told = run(*asked)
    assert told.code == 0, told.err
    assert told.out.startswith("AMBIGUOUS: The ")
    assert "1. " in told.out
    assert "%" not in told.out
    assert run(*asked, "--json").json["modes"][0]["probability"] < 0.1


def test_probabilities_are_printed(run, city):
    assert "%" in run("city", "locate", city, TEXT).out


@pytest.mark.parametrize("options", [(), ("--preset", "paper", "--matcher", "relational")])
def test_candidates_that_nothing_counts_are_refused(run, city, options):
    refused = run("city", "locate", city, TEXT, *options, "--candidates", 5)
    assert (refused.code, refused.out) == (7, "")
    assert "candidates is 5, but relational by sparse" in refused.err
