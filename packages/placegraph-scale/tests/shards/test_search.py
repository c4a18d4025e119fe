from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import placegraph as pg
from placegraph.core.geo import tile_bounds
from placegraph_scale.shards import search
from placegraph_scale.shards.search import CandidatePool
from placegraph_scale.shards.steps import RareObject, Shard, add_objects
from shards_world import shards_of

SHARES = st.lists(st.floats(0.0, 1.0), min_size=1, max_size=30)


@given(SHARES, st.floats(0.0, 16.0), st.sampled_from(search._NORMS))
def test_a_norm_is_bounded_by_peak_and_mean(shares, log_gain, k):
    shares = np.array(shares)
    worth = search._gains([(np.exp(log_gain), 0, search.ME)], 1, 1.0)
    true = np.log(((1.0 + np.exp(log_gain) * shares) ** k).mean()) / k
    at = np.searchsorted(search._SHARES, shares.max())
    found = search._bound_norms(worth[None], np.array([[at]]), np.array([[shares.mean()]]), k)
    assert found[0, 0, 0] >= true - 1e-9


def test_no_shard_weighs_more_than_its_bound(sharded, monkeypatch):
    planet, seen = pg.open_world(sharded), []
    real = search.Search.run

    def run(self, asked, log_mass, cores):
        found = real(self, asked, log_mass, cores)
        for row in np.flatnonzero(~self._near_rare(asked, cores)).tolist():
            one = CandidatePool(asked)
            for _, proposed in self.run_step("propose", [(row, (asked, -np.inf, 512))]):
                one.add(row, proposed)
            one.drawn = 1 << 20
            self._compare(one, one.list_unscored(one.drawn))
            weights, _ = one._represented()
            seen.append((np.logaddexp.reduce([one.weight, *weights]), self.reach[row]))
        return found

    monkeypatch.setattr(search.Search, "run", run)
    for text in (
        "A bench is north of me. A tree is east of me. A bakery is south of me.",
        "The cafe is on the north of a bakery. A playground is on the west of the cafe.",
    ):
        planet.locate(text)
    weighs, bound = np.array(seen).T
    assert len(weighs) > len(shards_of(planet).sources)
    assert (weighs <= bound).all()


@pytest.fixture(scope="module")
def shard(sharded):
    return Shard.open(pg.open_world(sharded).planets["WORLD"].sources[0])


def thing_at(longitude, latitude, osm_id):
    at = np.array([longitude, latitude])
    return RareObject(1, osm_id, 0, "tourism=museum", f"Museum {osm_id}", (), (at[None],), at, 0.0)


def test_how_many_things_there_are_does_not_depend_on_the_shard(shard):
    # which of two mentions is looked for from the other is decided by how many things each may be
    city, core = shard.city, tile_bounds(shard.key)
    near = thing_at(core.west, core.north, -1)
    far = [thing_at(core.west + k, core.north, -1 - k) for k in (1, 2, 3)]
    made, rows = add_objects(shard, [near, *far], 300.0)
    assert rows.tolist() == list(range(len(city.objects), len(city.objects) + 4))
    assert made.objects.name(int(rows[2])) == "Museum -3"
    held = replace(near, osm_type=int(city.objects.osm_type[0]), osm_id=int(city.objects.osm_id[0]))
    _, rows = add_objects(shard, [held, *far], 300.0)
    assert rows[0] == 0
    assert (rows >= 0).all()
    made, rows = add_objects(shard, far, 300.0)
    assert made is shard.sight
    assert (rows == -1).all()
