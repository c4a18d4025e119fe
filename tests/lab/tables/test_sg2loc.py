import json
import re

import numpy as np
import pytest

from placegraph.core.geometry import Camera
from placegraph.errors import InputError
from placegraph.indoor.likelihood import visibility
from placegraph.indoor.scene_map import SceneMap
from placegraph_lab.tables.indoor.sg2loc import LAYOUT, How, Set, Walk, WindowRunner, recipes
from placegraph_lab.tables.named.sg2loc import SPECS
from placegraph_lab.tables.named.sg2loc import read_published as figures
from placegraph_lab.tables.runner import Run, load, names
from placegraph_lab.worlds.home.home import change_home, home, record, scene_of, visit

TABLES = [f"sg2loc-{n}" for n in range(1, 15)]
CAMERA = Camera(96, 72, 69.0, 69.0, 48.0, 36.0)
FRAMES = 5


def room(seed):
    """A small home as it was and as it is later, with a walk each."""
    rng = np.random.default_rng(seed)
    flat = home(rng, style="hotel")
    first = flat.furnish(rng)
    for interior in (first, change_home(first, rng)):
        way = visit(flat, interior, rng, frames=FRAMES)
        yield (
            scene_of(interior),
            record(interior, way, rng, camera=CAMERA, depth=True, labels=None),
            way.map_from_camera,
        )


@pytest.fixture(scope="module")
def users(tmp_path_factory, scan3r_world, scannet_world):
    """A user's folder: three rooms of 3RScan, and one of ScanNet, two scans each."""
    root = tmp_path_factory.mktemp("users")
    scans, rooms = root / "ScanNet/scans", [(f"{r}0-x", f"{r}1-x") for r in "abc"]
    for seed, both in enumerate(rooms):
        for number, (name, made) in enumerate(zip(both, room(seed), strict=True)):
            scan3r_world.write_scan(root / "3RScan", name, *made)
            if seed == 0:
                scene, capture, truth = made
                called = f"scene0000_0{number}"
                mesh = scannet_world.ObjectMesh(scene)
                palette = np.random.default_rng(0).integers(0, 256, (len(scene), 3))
                mesh.colours = palette[np.array(mesh.segments) - 100].astype(np.uint8)
                folder = scannet_world.Scan(scans / called, mesh, name=called).folder
                poses = scannet_world.SCAN_FROM_MAP @ truth
                scannet_world.Recording.of(capture, poses).export(folder)
                for file in sorted(folder.glob("*/[0-9]*.*"), key=lambda p: -int(p.stem)):
                    file.rename(file.with_stem(str(25 * int(file.stem))))  # one in 25 is asked
    scan3r_world.write_rooms(root / "3RScan", rooms)
    aligned = " ".join(str(v) for v in np.eye(4).ravel())
    (root / "ScanNet/pairs.txt").write_text(f"scene0000_00 scene0000_01 {aligned}\n")
    return root


@pytest.fixture(scope="module")
def table(measure, users, tmp_path_factory):
    cache = tmp_path_factory.mktemp("cache")

    def run(name, *options):
        out = cache / f"{name}.json"
        result = measure(name, "--data", users, "--cache", cache, "--out", out, *options)
        assert result.exit_code == 0, (result.output, result.exception)
        return result.stdout, json.loads(out.read_text())["rows"], result.stderr

    return run


def test_every_number_is_a_table():
    assert set(TABLES) <= set(names())
    assert [load(name).paper for name in TABLES] == [f"SG2Loc, Table {n}" for n in range(1, 15)]
    used = {recipe for spec in SPECS.values() for _, recipe, _ in spec.rows}
    assert used == set(recipes())


@pytest.mark.all
def test_one_table_of_a_users_3rscan(table):
    asked = ["SG2Loc (Coarse)", "placegraph's default"]
    options = ("--sets", "3RScan", "--lengths", "5", "--frames", "5", "--only", ";".join(asked))
    text, rows, told = table("sg2loc-13", *options)
    assert "3RScan, test: 6 pairs of 6 scans." in told
    assert "| paper: 3RScan: SG2Loc (Coarse)" in text
    ours = [row for row in rows if row["set"] == "3RScan"]
    assert [row["row"] for row in ours] == asked
    assert ours[-1]["25 cm / 2° / both"] == [1.0, 1.0, 1.0]


def test_what_is_missing_is_told(measure, tmp_path):
    told = measure("sg2loc-1", "--data", tmp_path, "--cache", tmp_path)
    assert "holds nothing to measure" in str(told.exception)
    assert "3RScan.json" in str(told.exception)
    told = measure("sg2loc-1", "--data", tmp_path, "--cache", tmp_path, "--sets", "ScanNet")
    assert "ScanNet is not there" in str(told.exception)
    told = measure("sg2loc-1", "--data", tmp_path, "--cache", tmp_path, "--sets", "Matterport")
    assert "there is no 'Matterport'" in str(told.exception)
    assert " ".join(LAYOUT.split())[:60] in " ".join(measure("sg2loc-3", "--help").output.split())


REFUSED = [
    ("sg2loc-1 --lengths abc", "lengths are whole numbers"),
    ("sg2loc-1 --lengths 5,0", "lengths are whole numbers"),
    ("sg2loc-1 --frames -3", "Invalid value for '--frames'"),
    ("sg2loc-6 --pace -1", "pace is 0 or more"),
    ("sg2loc-6 --pace nan", "pace is 0 or more"),
    ("sg2loc-1 --only x", "'x' is not a row"),
    ("sg2loc-1 --pace 1", "No such option"),
    ("sg2loc-3 --only x", "No such option"),
    ("sg2loc-3 --lengths 5", "No such option"),
    ("sg2loc-5 --frames 5", "No such option"),
    pytest.param(
        "sg2loc-1 --sets homes --lengths 200",
        "no window of 200 frames in homes",
        marks=pytest.mark.all,
    ),
    ("sg2loc-5 --sets house", "2 rooms or more; house shows 1"),
    ("sg2loc-11 --sets house", "3 rooms or more; house shows 1"),
]


@pytest.mark.parametrize(("given", "why"), REFUSED)
def test_what_a_table_cannot_do_is_refused(measure, tmp_path, given, why):
    name, *options = given.split()
    (tmp_path / "data/house").mkdir(parents=True)
    told = measure(name, "--data", tmp_path, "--cache", tmp_path, *options)
    assert told.exit_code in {1, 2}
    assert why in f"{told.output} {told.exception}"
    assert isinstance(told.exception, InputError | SystemExit)


@pytest.mark.parametrize(
    "name", ["ours", *(pytest.param(n, marks=pytest.mark.all) for n in ("paper", "published"))]
)
def test_a_map_is_made_ready_before_time_is_taken(name, tmp_path, monkeypatch):
    """What is visible from where is mapping (Table 4), of every recipe and of every scene."""
    (scene, capture, truth), _ = room(0)
    of = Set("one", (Walk("w", "m", lambda: (capture, truth)),), lambda _: scene, {"m": "m"}, 5.0)
    asking = WindowRunner(
        Run("sg2loc-4", tmp_path, tmp_path), How(5, "", "sift", 0, "cpu"), fresh=False
    )
    built, steps = visibility.build_table, []
    monkeypatch.setattr(visibility, "build_table", lambda *a: (steps.append("map"), built(*a))[1])
    monkeypatch.setattr(SceneMap, "localize", lambda *_, **__: 1 / 0)
    (_, window), *_ = of.windows(5, 5, 0)
    with pytest.raises(ZeroDivisionError):
        asking.ask(of, recipes()[name], scene, window, "m")
    assert set(steps) == {"map"}


NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


def test_the_papers_figures_stand_in_the_paper(shared):
    """In one line of its text, in this order; Table 6 stands there by columns, shares in per cent."""
    text = (shared / "papers/sg2loc.txt").read_text()
    text = re.sub(r" ?(?:×|\\times) ?10\^\{?(\d+)\}?", r"e\1", text)
    told = [[float(n) for n in NUMBER.findall(line)] for line in text.splitlines()]
    lines, by_columns = [], []
    for table, (name, by_length) in ((t, row) for t in SPECS for row in figures(t)):
        numbers = [n for part in by_length for n in part if n is not None]
        if table == 11:
            numbers[0] = round(100 * numbers[0], 1)
        (by_columns if table == 6 else lines).append((name, numbers))
    lines += [("Table 6", list(pair)) for pair in zip(*(n for _, n in by_columns), strict=True)]
    for name, numbers in lines:
        size = len(numbers)
        assert any(
            line[i : i + size] == numbers for line in told for i in range(len(line) - size + 1)
        ), (name, numbers)
