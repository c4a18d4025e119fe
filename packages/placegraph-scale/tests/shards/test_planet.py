import gc
import shutil
import weakref
from dataclasses import replace

import numpy as np
import pytest

import placegraph as pg
from placegraph.core.estimate import Status
from placegraph.errors import DescriptionError, InputError, MapError, OptionError
from placegraph.outdoor.city import build_city
from placegraph_lab.tables.outdoor.queries import make_queries
from placegraph_lab.worlds.shards import write_shards
from placegraph_scale.shards import search, steps, workers
from placegraph_scale.shards.search import Search
from shards_world import TEXTS, shards_of


@pytest.fixture(scope="module")
def planet(sharded):
    return pg.open_world(sharded)


# around what is seen from afar one map gives viewpoints a lower bound than a shard, which lists all
@pytest.mark.parametrize(
    ("row", "near"), [*((i, 1e-5) for i in (0, 2, 3, 4)), *((i, 1e-4) for i in (1, 5, 6))]
)
def test_shards_answer_as_one_map(row, near, whole, planet):
    one, many = (world.locate(TEXTS[row]) for world in (whole, planet))
    assert many.status is one.status
    assert many.best.longitude == pytest.approx(one.best.longitude, abs=near)
    assert many.best.latitude == pytest.approx(one.best.latitude, abs=near)
    assert [e.objects for e in many.evidence] == [e.objects for e in one.evidence]
    if near == 1e-5:
        chances = ([m.probability for m in found.modes] for found in (many, one))
        np.testing.assert_allclose(*chances, atol=0.01)
        assert [e.verdict for e in many.evidence] == [e.verdict for e in one.evidence]


@pytest.mark.parametrize("shift", [0.0, 0.004])
def test_a_fix_is_a_prior_over_all_shards(shift, whole, planet):
    near = (10.012 + shift, 50.006)
    text = "A bakery is north of me. A cafe is east of me."
    one, many = (world.locate(text, near=near, radius=200) for world in (whole, planet))
    assert many.best.longitude == pytest.approx(one.best.longitude, abs=1e-5)
    assert many.best.probability == pytest.approx(one.best.probability, abs=0.01)
    assert touched(many) < len(shards_of(planet).sources)


def touched(estimate):
    return int(estimate.reason.split("Searched ")[1].split()[0])


def test_a_rare_name_takes_few_shards_and_common_things_many(planet):
    name = planet.locate(
        "The Museum of Salt is on the north of a bench. A tree is on the east of it."
    )
    common = planet.locate("A bench is north of me. A tree is east of me.")
    assert touched(name) < touched(common)


def test_it_asks_back_within_the_best_shard(planet):
    found = planet.locate("A bench is north of me. A tree is east of me. A bakery is south of me.")
    assert found.status is Status.AMBIGUOUS
    question = found.next_question(planet)
    if question is not None:
        told = planet.locate(TEXTS[0], answers=[question.answer(question.options[0])])
        assert told.understood is not None


def test_what_is_not_there_is_lost(planet):
    assert planet.locate("Somebody sings.").status is Status.LOST
    off = planet.locate("A bench is north of me.", near=(-30.0, 10.0))
    assert off.status is Status.LOST
    assert "lies outside all maps" in off.reason
    swapped = planet.locate("A bench is north of me.", near=(50.006, 10.012))
    assert "longitude comes first, 10.012,50.006" in swapped.reason


def test_bad_questions_are_refused(planet, whole, tmp_path):
    with pytest.raises(OptionError, match="text"):
        planet.locate()
    for budget in (0.0, "5", True):
        with pytest.raises(OptionError, match="budget"):
            planet.locate("A bench.", budget=budget)
    with pytest.raises(DescriptionError):
        planet.locate("  ")
    with pytest.raises(OptionError, match="answers"):
        planet.locate("A bench is north of me.", answers=["yes"])
    whole.save(tmp_path / "a.city")
    with pytest.raises(OptionError, match="scheduler"):
        pg.open_world(tmp_path, scheduler="tcp://127.0.0.1:1")
    with pytest.raises(OptionError, match="budget"):
        pg.open_world(tmp_path).locate("A bench is north of me.", budget=1.0)


def holder_of(world, text):
    cell = pg.open_world(world).locate(text).best.place.cell
    return world / "shards" / f"{cell.partition('/')[0]}.city"


@pytest.mark.parametrize("harm", ["missing", "damaged", "another"])
def test_a_shard_that_does_not_answer_is_named_and_the_rest_answers(world, harm):
    text = TEXTS[0]
    whole = pg.open_world(world).locate(text)
    path = holder_of(world, text)
    if harm == "missing":
        path.unlink()
    elif harm == "damaged":
        blob = bytearray(path.read_bytes())
        blob[len(blob) // 2] ^= 255
        path.write_bytes(blob)
    else:
        shutil.copy(next(p for p in path.parent.iterdir() if p != path), path)
    found = pg.open_world(world).locate(text)
    assert found.status is not Status.OK
    assert any(path.name in note for note in found.notes)
    assert "did not answer" in found.reason
    assert "No place on the map" not in found.reason
    assert found.modes
    assert found.best.probability < whole.best.probability


def test_a_shard_that_cannot_matter_may_be_missing(world):
    text = "The Old Light is on the north of a bench. The Old Light is on the west of a tree."
    before = pg.open_world(world).locate(text)
    held = holder_of(world, text)
    for path in list(held.parent.iterdir()):
        if path != held:
            path.unlink()
            break
    after = pg.open_world(world).locate(text)
    assert after.best.probability == pytest.approx(before.best.probability, abs=0.01)


def test_a_search_ends_where_what_is_lost_alone_matters(whole, tmp_path, monkeypatch):
    write_shards(whole, tmp_path / "WORLD", 16)
    monkeypatch.setattr(search, "NEGLIGIBLE", 0.1)
    text = "I am at the Museum of Salt. A bench is north of me."
    rounds, enough = [], Search._enough

    def counted(self, found, order):
        rounds.append(order)
        assert len(rounds) < 50
        return enough(self, found, order)

    monkeypatch.setattr(Search, "_enough", counted)
    planet = pg.open_world(tmp_path / "WORLD")
    planet.locate(text)
    (town,) = planet.planets.values()
    for row in rounds[-1][:4].tolist():
        rounds.clear()
        path = town.sources[row].path
        kept = path.read_bytes()
        path.unlink()
        found = pg.open_world(tmp_path / "WORLD").locate(text)
        assert any(path.name in note for note in found.notes)
        path.write_bytes(kept)


@pytest.mark.parametrize("fix", [{}, {"near": (10.012, 50.006), "radius": 200.0}])
def test_what_was_not_searched_is_not_said_to_be_empty(planet, fix):
    assert planet.locate(TEXTS[0], budget=1e6).reason == planet.locate(TEXTS[0]).reason
    late = planet.locate(TEXTS[0], budget=1e-9, **fix)
    assert late.status is not Status.OK
    assert late.reason.startswith(
        "The time limit was reached: 100.0% of the world was not searched, and the place may be "
        "there. In the searched part, "
    )


@pytest.mark.parametrize("step", ["propose", "compare"])
def test_a_time_that_is_over_in_any_step_leaves_nothing_half_compared(planet, step, monkeypatch):
    every, whole = Search.run_steps, planet.locate(TEXTS[0])

    def late(search, told):
        given = list(told)
        if any(task[0] == step for task in given) and search.deadline is not None:
            search.deadline = 0.0
        return every(search, given)

    monkeypatch.setattr(Search, "run_steps", late)
    found = planet.locate(TEXTS[0], budget=1e6)
    if step == "compare":  # all was proposed, and what was proposed is compared
        assert found.best.probability == pytest.approx(whole.best.probability, rel=0.1)
    else:
        assert found.status is not Status.OK
        assert "The time limit was reached" in found.reason


def test_a_search_without_a_budget_ends_after_one_round(planet, monkeypatch):
    whole = planet.locate(TEXTS[0])
    for name in ("FIRST", "GROWTH"):
        monkeypatch.setattr(f"placegraph_scale.shards.search.{name}", 2)
    assert planet.locate(TEXTS[0]).reason == whole.reason
    monkeypatch.setattr("placegraph_scale.shards.search.BUDGET", 0.0)
    late = planet.locate(TEXTS[0])
    assert late.status is not Status.OK
    assert "The time limit was reached" in late.reason
    assert late.reason.endswith("Searched 2 of 16 shards.")


def test_memory_closes_shards(sharded):
    roomy, tight = (pg.open_world(sharded, memory=memory) for memory in ("1 GB", 1e4))
    small, large = (world.locate(TEXTS[4], budget=1e6).to_dict() for world in (tight, roomy))
    assert small == large
    cache = shards_of(roomy).pool
    assert len(cache._open) > 1
    assert all(1e4 < size < 1e7 for size in cache._sizes.values())
    assert len(shards_of(tight).pool._open) == 1
    cache.memory = cache._size / 2  # viewpoints are kept as long as they fit
    roomy.locate(TEXTS[3])
    assert cache._size == sum(shard.size for shard in cache._open.values())
    assert cache._size <= cache.memory
    assert any(shard.city_map is None for shard in cache._open.values())


@pytest.mark.parametrize("memory", ["", "four", "-1GB", "0", "1.2.3MB", "4 GiB"])
def test_a_memory_that_is_no_size_is_refused(sharded, memory):
    with pytest.raises(OptionError, match="memory"):
        pg.open_world(sharded, memory=memory)


def test_memory_goes_with_this_process_and_with_shards(sharded, tmp_path):
    with pytest.raises(OptionError, match="--memory-limit"):
        pg.open_world(sharded, memory="1GB", scheduler="tcp://127.0.0.1:1")
    (tmp_path / "none").mkdir()
    with pytest.raises(OptionError, match="memory: it applies only to worlds in shards"):
        pg.open_world([next(sharded.glob("shards/*.city"))], memory="1GB")


def test_a_table_of_another_world_is_refused(world):
    path = world / "words.table"
    path.write_bytes(path.read_bytes() + b"x")
    with pytest.raises(MapError, match=r"words\.table"):
        pg.open_world(world)
    path.unlink()
    with pytest.raises(InputError, match=r"words\.table"):
        pg.open_world(world)


def test_localizing_never_writes(world):
    before = {p: p.stat().st_mtime_ns for p in world.rglob("*")}
    pg.open_world(world).locate(TEXTS[0])
    assert {p: p.stat().st_mtime_ns for p in world.rglob("*")} == before


def test_shards_are_closed_again(sharded, monkeypatch):
    planet, opened, known = pg.open_world(sharded), [], workers.Shard.open
    shards_of(planet).pool.memory = 1e4

    def noted(source):
        found = known(source)
        opened.extend([weakref.ref(found.sight), weakref.ref(found.city_map)])
        return found

    monkeypatch.setattr(workers.Shard, "open", noted)
    found = planet.locate(TEXTS[4])
    assert np.isfinite(found.best.probability)
    gc.collect()
    assert sum(city() is not None for city in opened) <= 2 < len(opened)
    planet.close()
    assert not shards_of(planet).pool._open


def test_candidates_far_from_a_fix_are_compared_as_well(planet, monkeypatch):
    said = []

    def compare(*told, known=workers.STEPS["compare"]):
        said.append(told)
        return known(*told)

    monkeypatch.setitem(workers.STEPS, "compare", compare)
    at = planet.locate(TEXTS[0]).best
    planet.locate(TEXTS[0], near=(at.longitude, at.latitude), radius=1.0)
    shard, asked, chosen = said[-1]
    asked = replace(asked, fix=asked.fix._replace(longitude=at.longitude + 0.05))
    n = len(rows := np.flatnonzero(shard.inside).astype(np.int32))
    every = chosen._replace(
        rows=rows, bounds=np.ones(n), far=np.zeros((n, chosen.far.shape[1]), np.float32)
    )
    assert len(steps.compare(shard, asked, every).scores) == n


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
