"""A real city, whole and in 12 shards, asked the test texts."""

import pytest

import placegraph as pg
from placegraph.outdoor.city import build_city
from placegraph_lab.tables.outdoor.queries import make_queries
from placegraph_lab.worlds.shards import write_shards

SETTINGS = ("none", "names", "speaker", "synonyms")


@pytest.fixture(scope="module")
def both(shared, tmp_path_factory):
    folder = tmp_path_factory.mktemp("vancouver")
    osm = shared / "data" / "osm" / "vancouver_2015.osm.pbf"
    whole = build_city(osm, folder / "v.city")
    write_shards(whole, folder / "WORLD", 12)
    return osm, whole, pg.open_world(folder / "WORLD")


@pytest.mark.all
@pytest.mark.parametrize("setting", SETTINGS)
def test_shards_answer_as_the_whole(setting, both):
    # of what weighs little both draw some, by chance not the same
    osm, whole, planet = both
    same = []
    for query in make_queries(osm, n=100, seed=1, setting=setting):
        one, many = whole.locate(query.text), planet.locate(query.text)
        pairs = list(zip(one.modes, many.modes, strict=False))
        off = [abs(b.probability - a.probability) for a, b in pairs]
        same.append(many.status is one.status and max(off) <= 0.01)
        assert max(off) <= 0.06  # where heavy ones are rarely drawn
        if one.best.probability > 0.1:
            assert many.best.longitude == pytest.approx(one.best.longitude, abs=2e-4)
            assert many.best.latitude == pytest.approx(one.best.latitude, abs=2e-4)
    assert sum(same) >= 96
