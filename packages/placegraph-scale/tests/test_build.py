import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import killers
from placegraph.core.geo import are_in_tile
from placegraph.errors import InputError, MapError, OptionError
from placegraph.outdoor.city import CityMap
from placegraph_scale import build as module
from placegraph_scale.build import build_world
from placegraph_scale.options import BuildOptions
from placegraph_scale.shards import WorldFile, words

BENCH, TREE = {"amenity": "bench"}, {"natural": "tree"}
SMALL = BuildOptions(zoom=15, overlap=100.0, workers=1)


@pytest.fixture
def extract(write_world):
    things = [(40.0 * i, 10.0 * (i % 3), BENCH if i % 2 else TREE) for i in range(60)]
    ends = [(-30_000.0, 20.0, {}), (30_000.0, 20.0, {})]
    path = (list(range(0, 60, 4)), {"highway": "path", "name": "Weg"})
    return write_world([*things, *ends], [path, ([60, 61], {"highway": "primary"})])


def contents(folder):
    return {p.name: p.read_bytes() for p in sorted((folder / "shards").iterdir())}


def test_shards_hold_their_core_and_what_is_around(extract, tmp_path):
    told = []
    made = build_world([extract], tmp_path / "w", SMALL, lambda *step: told.append(step))
    assert [shard.key for shard in made.shards] == sorted(p[:-5] for p in contents(tmp_path / "w"))
    assert len(made.shards) >= 3
    ids = set()
    for shard in made.shards:
        city = CityMap.open(made.path(shard))
        ids |= {city.objects.osm(i) for i in range(len(city.objects))}
    assert len(ids) == 62
    assert sum(shard.objects for shard in made.shards) >= 60
    assert ("building tiles", len(made.shards), len(made.shards)) in told
    assert not list((tmp_path / "w" / ".build").glob("*-0"))


@pytest.mark.parametrize("name", ["plan.json", "tiles.json"])
@pytest.mark.parametrize("content", [b"", b"[]", b"\xff"])
def test_what_a_build_noted_and_is_damaged_is_named(extract, tmp_path, name, content):
    folder = tmp_path / "w"
    build_world([extract], folder, SMALL)
    (folder / ".build" / name).write_bytes(content)
    with pytest.raises(MapError, match=rf"{name} is damaged; remove .*\.build"):
        build_world([extract], folder, SMALL)


def test_workers_do_not_matter(extract, tmp_path):
    build_world([extract], tmp_path / "one", SMALL)
    build_world([extract], tmp_path / "two", replace(SMALL, workers=2))
    assert contents(tmp_path / "one") == contents(tmp_path / "two")


def test_two_extracts_that_overlap_are_one_world(extract, write_world, tmp_path):
    whole = build_world([extract], tmp_path / "one", SMALL)
    again = write_world([(0, 0, TREE)], name="again.osm")
    both = build_world([again, extract], tmp_path / "two", SMALL)
    assert [s.objects for s in both.shards] == [s.objects for s in whole.shards]


@pytest.mark.parametrize("after", ["a split", "a tile", "a torn line"])
def test_killed_and_taken_up_again(after, extract, tmp_path, monkeypatch):
    build_world([extract], tmp_path / "whole", SMALL)
    code = (
        "import os, signal, sys\n"
        "from placegraph_scale import build\n"
        "def die(*_): os.kill(os.getpid(), signal.SIGKILL)\n"
        "def torn(self, made):\n"
        "    with self.path.open('ab') as file: file.write(b'{\"key\": \"01')\n"
        "    die()\n"
        "add = build.Journal.add\n"
        "def second(self, made): die() if self.done else add(self, made)\n"
        "if sys.argv[3] == 'a split': build._Build.tiles = die\n"
        "if sys.argv[3] == 'a tile': build.Journal.add = second\n"
        "if sys.argv[3] == 'a torn line': build.Journal.add = torn\n"
        "options = build.BuildOptions(zoom=15, overlap=100.0, workers=1)\n"
        "build.build_world([sys.argv[1]], sys.argv[2], options)\n"
    )
    target = tmp_path / "killed"
    died = subprocess.run(  # noqa: S603  # our own interpreter and code
        [sys.executable, "-c", code, extract, target, after], check=False, env=os.environ
    )
    assert died.returncode == -signal.SIGKILL
    assert not (target / "world.json").exists()
    splits, tiles = [], []
    monkeypatch.setattr(module, "split", lambda *g: splits.append(g))
    real = module.build_tile
    monkeypatch.setattr(module, "build_tile", lambda job: tiles.append(job.key) or real(job))
    build_world([extract], target, SMALL)
    assert not splits
    assert contents(target) == contents(tmp_path / "whole")
    assert len(tiles) == len(contents(target)) - (after == "a tile")


def test_a_shard_that_was_lost_is_built_again(extract, tmp_path):
    made = build_world([extract], tmp_path / "w", SMALL)
    before = contents(tmp_path / "w")
    made.path(made.shards[1]).unlink()
    build_world([extract], tmp_path / "w", SMALL)
    assert contents(tmp_path / "w") == before


@pytest.mark.parametrize("counts", [None, b"", b"counts", "another's"])
def test_words_that_were_kept_and_are_lost_are_counted_again(
    counts, extract, tmp_path, monkeypatch
):
    made = build_world([extract], tmp_path / "whole", SMALL)
    real, again = module.finish, []

    def losing(target, *given):
        kept = sorted((target / ".build" / "counts").iterdir())
        assert [path.name for path in kept] == [shard.key for shard in made.shards]
        if counts is None:
            kept[0].unlink()
        else:
            kept[0].write_bytes(kept[1].read_bytes() if counts == "another's" else counts)
        return real(target, *given)

    monkeypatch.setattr(module, "finish", losing)
    count = words.count_file
    monkeypatch.setattr(words, "count_file", lambda p: again.append(p.stem) or count(p))
    build_world([extract], tmp_path / "w", SMALL)
    assert again == [made.shards[0].key]
    for name in ("words.table", "world.json"):
        assert (tmp_path / "w" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_another_build_in_the_same_folder(extract, tmp_path):
    build_world([extract], tmp_path / "w", SMALL)
    with pytest.raises(OptionError, match="use the same, choose another folder, or remove"):
        build_world([extract], tmp_path / "w", replace(SMALL, zoom=14))
    extract.write_text(extract.read_text().replace("bench", "clock"))
    with pytest.raises(OptionError, match="use the same, choose another folder, or remove"):
        build_world([extract], tmp_path / "w", SMALL)


def test_a_world_of_elsewhere_is_left_alone(extract, tmp_path):
    folder = tmp_path / "w"
    build_world([extract], folder, SMALL)
    shutil.rmtree(folder / ".build")
    shards = sorted(folder.glob("shards/*"))
    with pytest.raises(OptionError, match="already contains a world; choose"):
        build_world([extract], folder, SMALL)
    assert sorted(folder.glob("shards/*")) == shards


def test_a_worker_that_is_killed_is_replaced(extract, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "build_tile", killers.once)
    options = replace(SMALL, workers=2)
    monkeypatch.setenv("KILLED_ONCE", str(tmp_path / "killed"))
    build_world([extract], tmp_path / "w", options)
    assert (tmp_path / "killed").exists()


@pytest.mark.all
def test_a_tile_that_kills_three_workers_ends_the_build(extract, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "build_tile", killers.always)
    with pytest.raises(MapError, match="killed 3 times"):
        build_world([extract], tmp_path / "w", replace(SMALL, workers=2))


def test_workers_end_with_who_started_them(extract, tmp_path):
    held = tmp_path / "held"
    os.mkfifo(held)
    code = (
        "import sys\n"
        "import killers\n"
        "from placegraph_scale import build\n"
        "build.build_tile = killers.orphaned\n"
        "options = build.BuildOptions(zoom=15, overlap=100.0, workers=2)\n"
        "if __name__ == '__main__': build.build_world([sys.argv[1]], sys.argv[2], options)\n"
    )
    here = f"{Path(__file__).parent}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
    env = os.environ | {"HELD": str(held), "PYTHONPATH": here}
    died = subprocess.Popen(  # noqa: S603  # our own interpreter and code
        [sys.executable, "-c", code, extract, tmp_path / "w"], env=env
    )
    with held.open("rb") as pipe:  # until all who hold its other end are gone
        assert set(pipe.read().split(b"killed")) == {b""}
    assert died.wait() == -signal.SIGKILL


def test_workers_are_let_go_where_the_journal_cannot_be_written(extract, tmp_path, monkeypatch):
    gone, real = [], module.run_tasks

    def done(*given):
        try:
            yield from real(*given)
        finally:
            gone.append(given[0])

    def full(*_):
        raise MapError("journal.jsonl cannot be written: No space left on device.")

    monkeypatch.setattr(module, "run_tasks", done)
    monkeypatch.setattr(module.Journal, "add", full)
    with pytest.raises(MapError, match="journal"):
        build_world([extract], tmp_path / "w", SMALL)
    assert gone[-1] is module.build_tile


def test_a_full_disk_says_so(extract, tmp_path, monkeypatch):
    def full(_path):
        raise MapError("x.city cannot be written: No space left on device. Choose another place.")

    monkeypatch.setattr("placegraph.outdoor.map.city.City.save", lambda *_, **__: full(_))
    with pytest.raises(MapError, match="No space left"):
        build_world([extract], tmp_path / "w", SMALL)
    monkeypatch.undo()
    build_world([extract], tmp_path / "w", SMALL)


@pytest.mark.parametrize(
    ("wrong", "name"),
    [({"zoom": 0}, "zoom"), ({"overlap": -1.0}, "overlap"), ({"workers": 0}, "workers"),
     ({"cell_size": 0.0}, "cell_size")],
)  # fmt: skip
def test_options_out_of_range(wrong, name, extract, tmp_path):
    with pytest.raises(OptionError, match=name):
        build_world([extract], tmp_path / "w", BuildOptions(**wrong))
    assert not (tmp_path / "w").exists()


def test_an_extract_that_is_missing(tmp_path):
    with pytest.raises(InputError, match=r"no\.osm\.pbf does not exist"):
        build_world([tmp_path / "no.osm.pbf"], tmp_path / "w", SMALL)
    with pytest.raises(InputError, match="cannot be read"):
        build_world([tmp_path / f"{'x' * 300}.osm.pbf"], tmp_path / "w", SMALL)
    with pytest.raises(OptionError, match="name at least one"):
        build_world([], tmp_path / "w", SMALL)
    assert not (tmp_path / "w").exists()


@pytest.fixture(scope="module")
def cluster():
    distributed = pytest.importorskip("distributed", reason="needs Dask (extra scale)")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None,
        protocol="tcp", host="127.0.0.1",
    ) as made:  # fmt: skip
        yield made.scheduler_address


def test_a_cluster_builds_the_same(cluster, extract, tmp_path):
    build_world([extract], tmp_path / "one", SMALL)
    build_world([extract], tmp_path / "two", replace(SMALL, scheduler=cluster))
    assert contents(tmp_path / "one") == contents(tmp_path / "two")


def test_city_build_of_a_large_extract_is_a_world_of_the_same_things(
    run, write_world, tmp_path, monkeypatch
):
    things = [(150.0 * i, 150.0 * (i % 9), BENCH if i % 2 else TREE) for i in range(80)]
    street = ([0, 1, 2], {"highway": "residential", "name": "Weg"})
    path = write_world(things, [street])
    done = run("city", "build", path, "-o", tmp_path / "one.city", "--json")
    one = CityMap.open(tmp_path / "one.city")
    monkeypatch.setattr("placegraph.io.osm.urls.SMALL", 0)
    made = run("city", "build", path, "-o", tmp_path / "many.city", "--json")
    assert made.code == 0
    assert made.json["objects"] == done.json["objects"] == 81
    world = WorldFile.read(tmp_path / "many.city")
    assert len(world.shards) >= 2
    seen = {}
    for shard in world.shards:
        city = CityMap.open(world.path(shard))
        at = city.plane.to_lonlat(city.objects.center.astype(np.float64))
        for i in np.flatnonzero(are_in_tile(at, shard.key)).tolist():
            o = city.objects
            seen[o.osm(i)] = (o.label(i), o.name(i), [len(p) for p in o.parts(i)], at[i])
    places = one.plane.to_lonlat(one.objects.center.astype(np.float64))
    for i, place in enumerate(places):
        label, name, sizes, at = seen.pop(one.objects.osm(i))
        assert (label, name) == (one.objects.label(i), one.objects.name(i))
        assert sizes == [len(p) for p in one.objects.parts(i)]
        assert np.abs(at - place).max() < 1e-5
    assert not seen


def test_the_command(run, extract, tmp_path):
    options = ("--zoom", "15", "--overlap", "100", "--workers", "1")
    done = run("world", "build", extract, "-o", tmp_path / "w", *options, "--json")
    assert done.code == 0
    assert done.json["shards"] == len(contents(tmp_path / "w"))
    again = run("world", "build", extract, "-o", tmp_path / "w", *options)
    assert f"in {done.json['shards']} shards" in again.out
    assert run("world", "build", extract, "-o", tmp_path / "w", "--zoom", "99").code == 7
