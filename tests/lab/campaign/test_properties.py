import numpy as np
import pytest

from placegraph_lab.campaign import platforms, properties, town_properties
from placegraph_lab.campaign.properties import Property, try_property
from placegraph_lab.campaign.row import Effort

WORLDS = (town_properties.TOWNS, properties.ROOMS, platforms.PROCESSES)
OUTDOORS, INDOORS, OVER_PROCESSES = (list(world[2].items()) for world in WORLDS)


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    return town_properties.draw_towns(tmp_path_factory.mktemp("town"))


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return properties.furnish_room(tmp_path_factory.mktemp("room"))


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    return platforms.Reference(tmp_path_factory.mktemp("processes"))


@pytest.mark.parametrize(("name", "trial"), OUTDOORS)
@pytest.mark.parametrize("seed", [1, 2])
def test_outdoors(name, trial, seed, town):
    assert trial(town, np.random.default_rng((7, seed))) == "", name


@pytest.mark.parametrize(("name", "trial"), INDOORS)
def test_indoors(name, trial, room):
    assert trial(room, np.random.default_rng((7, 1))) == "", name


@pytest.mark.all
@pytest.mark.parametrize(("name", "trial"), OVER_PROCESSES)
def test_over_processes(name, trial, reference):
    assert trial(reference, np.random.default_rng(7)) == "", name


def test_a_broken_property_is_counted_and_told():
    told = []
    broken = Property("never", lambda _: None, lambda *_: "it broke")
    row = try_property(broken, None, (3, 1), 0.0, told.append)
    assert (row.tried, row.untyped, row.faults, row.seed) == (1, 1, 1, 3)
    assert told == ["never, seed (3, 1, 0): it broke"]


def test_rows_are_one_a_property(tmp_path, monkeypatch):
    holds = Property("always", lambda folder: folder.is_dir(), lambda made, _: "" if made else "no")
    monkeypatch.setattr(properties, "PROPERTIES", (holds, holds))
    effort = Effort(0.0, 5, tmp_path / "room", tmp_path, lambda _: None)
    found = [(r.part, r.what, r.tried, r.accepted) for r in properties.rows(effort)]
    assert found == [("properties", "always", 1, 1)] * 2
