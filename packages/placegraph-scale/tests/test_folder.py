import sys
from itertools import count

import pytest

import placegraph as pg
from placegraph.errors import InputError, MapError, MissingExtraError, OptionError
from placegraph_scale.build import build_world
from placegraph_scale.folder import bring, fetch
from placegraph_scale.options import BuildOptions

fsspec = pytest.importorskip("fsspec", reason="fsspec is not installed (extra scale)")
BENCH, TREE = {"amenity": "bench"}, {"natural": "tree"}
NUMBER = count()


@pytest.fixture
def extract(write_world):
    things = [(40.0 * i, 10.0 * (i % 3), BENCH if i % 2 else TREE) for i in range(40)]
    return write_world([*things, (500.0, 40.0, {"amenity": "theatre", "name": "Rex"})])


@pytest.fixture(params=["memory", "file"])
def url(request, tmp_path):
    where = f"/{next(NUMBER)}" if request.param == "memory" else tmp_path / "there"
    return f"{request.param}://{where}"


def options(tmp_path, **more):
    return BuildOptions(zoom=15, overlap=100.0, workers=1, work=tmp_path / "work", **more)


def test_built_there_and_asked_here(url, extract, tmp_path):
    made = build_world([extract], url, options(tmp_path))
    assert len(made.shards) >= 2
    here = pg.open_world(url, keep=tmp_path / "kept")
    found = here.locate("Rex is north of me. A bench is east of me.")
    whole = pg.open_world(tmp_path / "work").locate("Rex is north of me. A bench is east of me.")
    assert found.best.longitude == whole.best.longitude
    assert found.best.probability == whole.best.probability


def test_only_what_is_new_is_brought_and_fetched(url, extract, tmp_path, monkeypatch):
    made = build_world([extract], url, options(tmp_path))
    fetch(url, tmp_path / "kept")
    system = type(fsspec.core.url_to_fs(url)[0])
    moved = []
    for name in ("put_file", "get_file"):
        real = getattr(system, name)

        def noted(self, *given, real=real, **more):
            moved.append(given[0])
            return real(self, *given, **more)

        monkeypatch.setattr(system, name, noted)
    (tmp_path / "kept" / made.shards[0].file).write_bytes(b"damaged" * 9)
    fetch(url, tmp_path / "kept")
    assert len(moved) == 1
    assert moved.pop().endswith(made.shards[0].file)
    bring(made, url)
    assert not [path for path in moved if "shards" in path]


def test_what_is_not_there_is_named(url, extract, tmp_path):
    with pytest.raises(InputError, match="give the folder of a world in shards, build"):
        fetch(url, tmp_path / "kept")
    assert not (tmp_path / "kept").exists()
    made = build_world([extract], url, options(tmp_path))
    system, root = fsspec.core.url_to_fs(url)
    system.rm_file(f"{root}/{made.shards[0].file}")
    with pytest.raises(InputError, match=f"{made.shards[0].key}.city is missing"):
        fetch(url, tmp_path / "kept")


def test_what_cannot_be_brought_is_named(extract, tmp_path):
    (tmp_path / "there").write_bytes(b"a file")
    with pytest.raises(MapError, match="cannot be written"):
        build_world([extract], f"file://{tmp_path}/there", options(tmp_path))


def test_urls_take_a_folder_of_this_machine(extract, tmp_path, monkeypatch):
    with pytest.raises(OptionError, match="work"):
        build_world([extract], "memory:///w", BuildOptions(zoom=15))
    with pytest.raises(OptionError, match="keep"):
        pg.open_world("memory:///w")
    with pytest.raises(OptionError, match=r"this kind of URL is not supported \(Protocol not"):
        fetch("nowhere://w", tmp_path)
    for ask in (
        lambda: build_world([extract], tmp_path / "w", options(tmp_path)),
        lambda: pg.open_world(tmp_path, keep=tmp_path / "kept"),
    ):
        with pytest.raises(OptionError, match=r"(at|to) a URL"):
            ask()
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(MissingExtraError, match=r"placegraph\[scale\]"):
        fetch("memory:///w", tmp_path)


def test_a_list_of_places_may_hold_one_url(url, extract, tmp_path):
    build_world([extract], url, options(tmp_path))
    pg.build_city(extract, tmp_path / "town.city")
    world = pg.open_world([url, tmp_path / "town.city"], keep=tmp_path / "kept")
    assert set(world.towns) == {"kept", "town"}
    with pytest.raises(OptionError, match="keep"):
        pg.open_world([tmp_path / "town.city", url])
    with pytest.raises(OptionError, match="one folder can store only one world"):
        pg.open_world([url, "memory:///another"], keep=tmp_path / "kept")
