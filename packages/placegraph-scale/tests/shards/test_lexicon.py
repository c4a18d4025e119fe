from dataclasses import replace

import numpy as np
import pytest

import placegraph as pg
from placegraph.core.geo import bounds
from placegraph.outdoor.city import CityMap
from placegraph_scale.shards.steps import RareObject, add_objects


@pytest.fixture(scope="module")
def shard(sharded):
    source = pg.open_world(sharded).planets["WORLD"].sources[0]
    return source.key, CityMap.open(source.path)


def thing_at(longitude, latitude, osm_id):
    at = np.array([longitude, latitude])
    return RareObject(1, osm_id, 0, "tourism=museum", f"Museum {osm_id}", (), (at[None],), at, 0.0)


def test_how_many_things_there_are_does_not_depend_on_the_shard(shard):
    # which of two mentions is looked for from the other is decided by how many things each may be
    key, city = shard
    core = bounds(key)
    near = thing_at(core.west, core.north, -1)
    far = [thing_at(core.west + k, core.north, -1 - k) for k in (1, 2, 3)]
    made, rows = add_objects(city, [near, *far], key, 300.0)
    assert rows.tolist() == list(range(len(city.objects), len(city.objects) + 4))
    assert made.objects.name(int(rows[2])) == "Museum -3"
    held = replace(near, osm_type=int(city.objects.osm_type[0]), osm_id=int(city.objects.osm_id[0]))
    _, rows = add_objects(city, [held, *far], key, 300.0)
    assert rows[0] == 0
    assert (rows >= 0).all()
    made, rows = add_objects(city, far, key, 300.0)
    assert made is city
    assert (rows == -1).all()
