import json
import re

import numpy as np
import pytest

from placegraph.core.geometry import Camera, rotation_from_vector
from placegraph.errors import InputError
from placegraph.indoor.encode import encoder
from placegraph.indoor.likelihood import visibility
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.tum import write_tum
from placegraph_lab.tables.indoor import sg2loc as sources
from placegraph_lab.tables.indoor.sg2loc import LAYOUT, How, Set, Walk, WindowRunner, recipes
from placegraph_lab.tables.named.scene_retrieval import BASELINES, PAPER, STORAGE
from placegraph_lab.tables.named.sg2loc import SPECS, find_sets
from placegraph_lab.tables.named.sg2loc import read_published as figures
from placegraph_lab.tables.runner import Run, load, names
from placegraph_lab.worlds.flat.flat import Flat
from placegraph_lab.worlds.flat.walks import stroll
from placegraph_lab.worlds.home.home import change_home, home, record, scene_of, visit

TABLES = [f"sg2loc-{n}" for n in range(1, 15)]
CAMERA = Camera(96, 72, 69.0, 69.0, 48.0, 36.0)
FRAMES = 5


CELL = """
[flat]
name = Cell
height = 2.6
[drawing]
################
#              #
#              #
#    TTTT      #
#    TTTT      #
#              #
#         1    #
#              #
#              #
################
[legend]
1 room: label=study
T table: label=desk
"""


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


def cell(seed):
    """A room of seven objects, with one frame of it for a map, and two later."""
    rng, flat = np.random.default_rng(seed), Flat.parse(CELL)
    interior = flat.furnish(rng)
    for frames in (1, 2):
        way = stroll(flat, rng, frames=frames, through="1", height=1.6)
        yield (
            scene_of(interior),
            record(interior, way, rng, camera=CAMERA, depth=True, labels=None),
            way.map_from_camera,
        )


def write_scannet_scan(folder, world, made):
    scene, capture, truth = made
    mesh = world.ObjectMesh(scene)
    palette = np.random.default_rng(0).integers(0, 256, (len(scene), 3))
    mesh.colours = palette[np.array(mesh.segments) - 100].astype(np.uint8)
    world.Scan(folder, mesh, name=folder.name)
    world.Recording.of(capture, world.SCAN_FROM_MAP @ truth).export(folder)
    for file in sorted(folder.glob("*/[0-9]*.*"), key=lambda p: -int(p.stem)):
        file.rename(file.with_stem(str(25 * int(file.stem))))  # one in 25 is asked


def write_users(root, scan3r_world, scannet_world, rooms, of_scannet=1):
    """A user's folder: rooms of 3RScan, the first of them of ScanNet, too, two scans each."""
    names = [(f"{r}0-x", f"{r}1-x") for r, _ in zip("abc", rooms, strict=False)]
    aligned, pairs = " ".join(str(v) for v in np.eye(4).ravel()), []
    for number, (both, scans) in enumerate(zip(names, rooms, strict=True)):
        called = [f"scene{number:04d}_0{i}" for i in range(2)]
        for name, other, made in zip(both, called, scans, strict=True):
            scan3r_world.write_scan(root / "3RScan", name, *made)
            if number < of_scannet:
                write_scannet_scan(root / "ScanNet/scans" / other, scannet_world, made)
        if number < of_scannet:
            pairs.append(f"{' '.join(called)} {aligned}\n")
    scan3r_world.write_rooms(root / "3RScan", names)
    (root / "ScanNet/pairs.txt").write_text("".join(pairs))
    return root


@pytest.fixture(scope="module")
def users(tmp_path_factory, scan3r_world, scannet_world):
    """A user's folder: three rooms of 3RScan, and one of ScanNet, two scans each."""
    root, rooms = tmp_path_factory.mktemp("users"), [list(room(seed)) for seed in range(3)]
    return write_users(root, scan3r_world, scannet_world, rooms)


@pytest.fixture(scope="module")
def cells(tmp_path_factory, scan3r_world, scannet_world):
    """A user's folder of single rooms: three of 3RScan and of ScanNet, with lists of pairs."""
    root, rooms = tmp_path_factory.mktemp("cells"), [list(cell(seed)) for seed in range(3)]
    write_users(root, scan3r_world, scannet_world, rooms, of_scannet=3)
    (root / "3RScan/pairs.txt").write_text("".join(f"{r}0-x {r}1-x\n" for r in "abc"))
    (root / "slam").mkdir()
    tilted = np.eye(4)
    tilted[:3, :3] = rotation_from_vector(np.array([0.4, -0.2, 1.0]))
    for number, (_, (_, _, truth)) in enumerate(rooms):
        for scan in (f"{'abc'[number]}1-x", f"scene{number:04d}_01"):
            write_tum(root / f"slam/{scan}.tum", [0.0, 1.0], tilted @ truth)
    return root


@pytest.fixture(scope="module")
def asked(measure, tmp_path_factory):
    """Run a table on a user's folder: what it prints, its rows, and what it tells."""
    cache = tmp_path_factory.mktemp("cache")

    def run(data, name, *options):
        out = cache / f"{name}.json"
        result = measure(name, "--data", data, "--cache", cache, "--out", out, *options)
        assert result.exit_code == 0, (result.output, result.exception)
        return result.stdout, json.loads(out.read_text())["rows"], result.stderr

    return run


def test_every_number_is_a_table():
    assert set(TABLES) <= set(names())
    assert [load(name).paper for name in TABLES] == [f"SG2Loc, Table {n}" for n in range(1, 15)]
    used = {recipe for spec in SPECS.values() for _, recipe, _ in spec.rows}
    assert used == set(recipes())


@pytest.mark.all
def test_one_table_of_a_users_3rscan(asked, users):
    wanted = ["SG2Loc (Coarse)", "placegraph's default"]
    options = ("--sets", "3RScan", "--lengths", "5", "--frames", "5", "--only", ";".join(wanted))
    text, rows, told = asked(users, "sg2loc-13", *options)
    assert "3RScan, test: 6 pairs of 6 scans." in told
    assert "| paper: 3RScan: SG2Loc (Coarse)" in text
    ours = [row for row in rows if row["set"] == "3RScan"]
    assert [row["row"] for row in ours] == wanted
    assert ours[-1]["25 cm / 2° / both"] == [1.0, 1.0, 1.0]


@pytest.fixture(scope="module")
def small_network(tmp_path_factory):
    """SceneGraphLoc on features of colour, drawn at random."""
    torch = pytest.importorskip("torch", reason="needs PyTorch: pip install 'placegraph[learn]'")
    from placegraph_learn.scenegraphloc.features import ColourFeatures
    from placegraph_learn.scenegraphloc.network import SceneGraphLoc, Widths
    from placegraph_learn.scenegraphloc.weights import write_weights

    path = tmp_path_factory.mktemp("weights") / "small.safetensors"
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(11)
        network = SceneGraphLoc(Widths.small(ColourFeatures.dimension))
    write_weights(path, network, {"features": ColourFeatures.key})
    return f"scenegraphloc weights={path}"


SHORT = ("--lengths", 2, "--odometry", "exact")


def check_rows(rows, name, places=("3RScan", "ScanNet")):
    """Rows of both sets hold figures, of two frames of three scans each."""
    ours = [row for row in rows if row.get("set") in places]
    assert {row["set"] for row in ours} == set(places)
    if name == "sg2loc-5":
        counts = {(row["set"], row["method"], row["pool"]): row["queries"] for row in ours}
        assert set(counts.values()) == {3}
        assert {method for _, method, _ in counts} == {"paper", "ours"}
        return
    assert all(row["windows"] == 3 for row in ours)
    assert {row["row"] for row in ours if "particles" in row} >= {
        row for row, *_ in SPECS[int(name.partition("-")[2])].rows
    } or name in {"sg2loc-6", "sg2loc-11", "sg2loc-14"}  # whose rows say more


@pytest.mark.parametrize("name", ["sg2loc-1", "sg2loc-5"])
def test_scenegraphloc_gets_the_images_of_a_map(name, asked, cells, small_network):
    """Vectors of objects are those of their views in the recording of the map's own scan."""
    options = () if name == "sg2loc-5" else (*SHORT, "--only", "placegraph's default")
    _, rows, _ = asked(cells, name, "--encoder", small_network, *options)
    if name == "sg2loc-5":
        check_rows(rows, name)
    else:
        assert {row["windows"] for row in rows if row["set"] in {"3RScan", "ScanNet"}} == {3}
    run = Run(name, cells, cells)
    of = sources.of_3rscan(run, "test")
    its, scene = encoder(small_network), of.scene("a0-x")
    seen = its.objects(scene, of.pictures("a0-x"))
    blind = encoder(f"{small_network} views=False").objects(scene)
    assert np.abs(seen - blind).max() > 1e-3
    cached = sources.CachedEncoder(its, cells / "vectors")
    for _ in range(2):
        np.testing.assert_array_equal(cached.objects(scene, of.pictures("a0-x")), seen)
        (frame,) = of.pictures("a0-x")[0]
        np.testing.assert_array_equal(cached.patches(frame), its.patches(frame))
    assert cached.saved_seconds > 0


@pytest.mark.all
@pytest.mark.parametrize("name", TABLES)
def test_every_table_with_scenegraphloc(name, asked, cells, small_network):
    """Random weights know nothing: what counts is that every table of the paper can be run."""
    number = int(name.partition("-")[2])
    options = ["--encoder", small_network, *SHORT]
    if number in {3, 5}:
        options = options[:2] if number == 5 else []
    if number == 6:
        options += ["--pace", 0.1]
    if number == 14:
        options[-1] = cells / "slam"
    text, rows, _ = asked(cells, name, *options)
    assert "paper" in text
    if number in {3, 4}:
        own = [row for row in rows if row["row"].startswith(("3RScan", "ScanNet"))]
        assert len(own) == (2 if number == 3 else 2 * len(SPECS[4].rows))
        return
    check_rows(rows, name)
    if number == 14:
        assert [row["row"] for row in rows if row["set"] == "ScanNet"] == [
            f"{row}, {kind} odometry" for kind in ("exact", "SLAM") for row, *_ in SPECS[14].rows
        ]


def test_what_is_missing_is_told(measure, tmp_path):
    told = measure("sg2loc-1", "--data", tmp_path, "--cache", tmp_path)
    assert "holds nothing to measure" in str(told.exception)
    assert "3RScan.json" in str(told.exception)
    told = measure("sg2loc-1", "--data", tmp_path, "--cache", tmp_path, "--sets", "ScanNet")
    assert "ScanNet is not there" in str(told.exception)
    told = measure("sg2loc-1", "--data", tmp_path, "--cache", tmp_path, "--sets", "Matterport")
    assert "there is no 'Matterport'" in str(told.exception)
    assert " ".join(LAYOUT.split())[:60] in " ".join(measure("sg2loc-3", "--help").output.split())


def test_a_list_of_pairs_and_of_scenes(cells, tmp_path):
    run = Run("sg2loc-7", cells, tmp_path)
    names = [walk.recording for walk in sources.of_3rscan(run, "test").walks]
    assert names == ["a1-x", "b1-x", "c1-x"]
    (tmp_path / "list").write_text("b1-x b0-x\n")
    assert [w.recording for w in sources.of_3rscan(run, "test", tmp_path / "list").walks] == [
        "b0-x"
    ]
    (tmp_path / "list").write_text(
        f"scene0001_00 scene0001_01 {' '.join(map(str, np.eye(4).ravel()))}"
    )
    assert [w.recording for w in sources.of_scannet(run, tmp_path / "list").walks] == [
        "scene0001_01"
    ]
    for of in (sources.of_scannet, lambda *given: sources.of_3rscan(given[0], "test", given[1])):
        with pytest.raises(InputError, match="none"):
            of(run, tmp_path / "none")
    found = find_sets(run, ["3RScan"], "test", None, 2)
    assert [walk.recording for of in found for walk in of.walks] == names[:2]


REFUSED = [
    ("sg2loc-1 --sets house --pairs x", "pairs: a list is of one set"),
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
    for n, (ten, a, fifty, b) in PAPER.items():
        lines.append((f"Table 5, {n}", [*ten, a, *fifty, b, STORAGE]))
    for name, (ten, a, fifty, b, megabytes) in BASELINES.items():
        lines.append((name, [*ten, a, *fifty, b, megabytes]))
    lines += [("Table 6", list(pair)) for pair in zip(*(n for _, n in by_columns), strict=True)]
    for name, numbers in lines:
        size = len(numbers)
        assert any(
            line[i : i + size] == numbers for line in told for i in range(len(line) - size + 1)
        ), (name, numbers)
