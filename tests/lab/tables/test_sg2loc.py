"""The tables of the SG2Loc paper on tiny 3RScan and ScanNet, in the layouts of their authors."""

import json
import re

import numpy as np
import pytest

from placegraph.geometry import Camera
from placegraph_lab.tables.run import load, names
from placegraph_lab.tables.sg2loc.ask import recipes
from placegraph_lab.tables.sg2loc.paper import PRINTED
from placegraph_lab.tables.sg2loc.sets import LAYOUT
from placegraph_lab.tables.sg2loc.spec import SPECS
from placegraph_lab.worlds.home.home import changed, home, record, scene_of, visit

TABLES = [f"sg2loc-{n}" for n in range(1, 15)]
CAMERA = Camera(96, 72, 69.0, 69.0, 48.0, 36.0)
FRAMES = 5


def room(seed):
    """A small home as it was and as it is later, with a walk each."""
    rng = np.random.default_rng(seed)
    flat = home(rng, style="hotel")
    first = flat.furnish(rng)
    for interior in (first, changed(first, rng)):
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


def test_one_table_of_a_users_3rscan(table):
    asked = ["SG2Loc (Coarse)", "placegraph's default"]
    options = ("--sets", "3RScan", "--lengths", "5", "--frames", "5", "--only", ";".join(asked))
    text, rows, told = table("sg2loc-13", *options)
    assert "3RScan, test: 6 pairs of 6 scans." in told
    assert "| paper: 3RScan: SG2Loc (Coarse)" in text
    ours = [row for row in rows if row["set"] == "3RScan"]
    assert [row["row"] for row in ours] == asked
    assert ours[-1]["25 cm / 2° / both"] == [1.0, 1.0, 1.0]


@pytest.mark.all
@pytest.mark.parametrize("name", TABLES)
def test_every_table_of_a_users_folder(table, name):
    options = ["--frames", "5"]
    if name in {"sg2loc-6", "sg2loc-11"}:
        options += ["--lengths", "5"]  # of 100 and 50 frames there is no time here
    text, rows, _ = table(name, *options)
    sets = {"ScanNet", "3RScan"} - ({"ScanNet"} if name in {"sg2loc-5", "sg2loc-11"} else set())
    for its in sets:
        assert its in text
        mine = [row for row in rows if its in row.get("set", row.get("row", ""))]
        assert [row for row in mine if row.get("windows") or row.get("scenes")], its


def test_what_is_missing_is_told(measure, tmp_path):
    told = measure("sg2loc-1", "--data", tmp_path, "--cache", tmp_path)
    assert "holds nothing to measure" in str(told.exception)
    assert "3RScan.json" in str(told.exception)
    told = measure("sg2loc-1", "--data", tmp_path, "--cache", tmp_path, "--sets", "ScanNet")
    assert "ScanNet is not there" in str(told.exception)
    told = measure("sg2loc-1", "--data", tmp_path, "--cache", tmp_path, "--sets", "Matterport")
    assert "there is no 'Matterport'" in str(told.exception)
    assert " ".join(LAYOUT.split())[:60] in " ".join(measure("sg2loc-3", "--help").output.split())


NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


def test_the_papers_figures_stand_in_the_paper(shared):
    """In one line of its text, in this order; Table 6 stands there by columns, shares in per cent."""
    text = (shared / "papers/sg2loc.txt").read_text()
    text = re.sub(r" ?(?:×|\\times) ?10\^\{?(\d+)\}?", r"e\1", text)
    told = [[float(n) for n in NUMBER.findall(line)] for line in text.splitlines()]
    lines, by_columns = [], []
    for line in PRINTED.strip().splitlines():
        table, name, figures = line.split(";")
        numbers = [float(n) for n in figures.replace("|", " ").split() if n != "-"]
        if int(table) == 11:
            numbers[0] = round(100 * numbers[0], 1)
        (by_columns if int(table) == 6 else lines).append((name, numbers))
    lines += [("Table 6", list(pair)) for pair in zip(*(n for _, n in by_columns), strict=True)]
    for name, numbers in lines:
        size = len(numbers)
        assert any(
            line[i : i + size] == numbers for line in told for i in range(len(line) - size + 1)
        ), (name, numbers)
