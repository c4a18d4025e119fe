import json
import re

import numpy as np
import pytest

from placegraph_lab.datasets.kitti360pose import WORLD, Kitti360Pose, convert_kitti360pose
from placegraph_lab.tables.kitti.graphs import description_of, scene_graph
from placegraph_lab.tables.kitti.osm import on_osm
from placegraph_lab.worlds.town.town import Town

DRIVES = ("0003", "0010")
SHIPPED = "GOTLoc as printed, trained on OpenStreetMap of other cities"


@pytest.fixture(scope="module")
def folder(kitti360pose_world, tmp_path_factory):
    return kitti360pose_world.write_set(tmp_path_factory.mktemp("k360") / "k360", drives=DRIVES)


@pytest.fixture(scope="module")
def data(folder):
    convert_kitti360pose(folder, folder / "tiny.k360")
    return Kitti360Pose.open(folder / "tiny.k360")


@pytest.fixture(scope="module")
def extract(kitti360pose_world, folder):
    town = Town.parse(kitti360pose_world.karlsruhe(WORLD, DRIVES))
    return town.write_osm(folder / "karlsruhe.osm")


@pytest.fixture(scope="module")
def osm(data, extract):
    return on_osm(data, extract)


@pytest.fixture(scope="module")
def nodes(extract):
    """Nodes (n, 2) of the extract that are things, in KITTI-360's frame, and their tags."""
    found, tags = [], []
    for node, inner in re.findall(
        r"<node ([^>]*[^/])>(.*?)</node>", extract.read_text(), re.DOTALL
    ):
        lon, lat = (float(re.search(rf'{k}="([^"]*)"', node)[1]) for k in ("lon", "lat"))
        found.append((lon, lat))
        tags.append(dict(re.findall(r'k="([^"]*)" v="([^"]*)"', inner)))
    return WORLD.to_plane(found), tags


def test_cells_hold_what_is_near_their_centre(data, osm, nodes):
    """Read from the file by another way: every node within 15 m, and no other."""
    at, tags = nodes
    assert (osm.cells.ids, len(osm.cells.boxes)) == (data.cells.ids, 16)
    for cell, center in enumerate(data.cells.centers):
        span = osm.cells.objects(cell)
        near = np.hypot(*(at - center).T) <= 15.0
        called = sorted(t.get("name", next(iter(t.values()))).replace(" ", "_")
                        for t, n in zip(tags, near, strict=True) if n)  # fmt: skip
        labels = [osm.labels[i] for i in osm.objects.labels[span]]
        assert sorted(x for x in labels if x != "Gartenweg") == [*called]
        assert labels.count("Gartenweg") == 1  # the street is one thing, at its middle
        points = osm.objects.centers[span, :2]
        for point in at[near]:
            assert np.hypot(*(points - point).T).min() < 0.02
        for row in range(span.start, span.stop):
            ground = osm.objects.footprint(row)
            assert np.abs(ground - center).max() <= 15.0
    assert osm.tags["Kern"] == "~kern"
    assert osm.tags["bench"] == "amenity=bench"
    assert osm.tags["street_lamp"] == "highway=street_lamp"


def test_both_sides_are_of_equation_6(osm):
    """The paper's reading: things of a text stand to each other as in the cell that holds them."""
    compared = 0
    for pose in range(len(osm.poses.cells)):
        cell = int(osm.poses.cells[pose])
        triples = set(scene_graph(osm, cell).triples())
        rows = range(*osm.poses.hints(pose).indices(10_000))
        inside = {n for n, i in enumerate(rows, 2) if osm.hints.objects[i] >= 0}
        labels = {n: osm.labels[osm.hints.labels[i]] for n, i in enumerate(rows, 2)}
        for s in description_of(osm, pose, reading="paper").statements:
            if {s.source, s.target} <= inside:
                wind = re.search("on the (\\w+) of", s.text)[1]
                assert (labels[s.source], wind, labels[s.target]) in triples
                compared += 1
    assert compared > 50


def test_the_table_has_rows_on_osm(measure, folder, extract, tmp_path):
    done = measure(
        "outdoor_kitti360pose", folder, "--osm", extract, "--out", tmp_path / "a.json",
        "--cache", tmp_path, "--slow", "2", "--queries", "6", "--readings", "paper",
        "--matchers", "triple bag,edit distance,transformer",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    assert "GOTLoc on OSM, transformer (published)" in done.stdout
    for row in ("triple bag", "edit distance", SHIPPED):
        for half in (" on OSM", ""):
            assert re.search(rf"\| {row}{half}, positions known +\|", done.stdout)
    assert re.search(r"On OSM, \d+ of 32 poses have 6 things within 15 m", done.stderr)
    told = json.loads((tmp_path / "a.json").read_text())
    assert told["data"].endswith("karlsruhe.osm")
    assert {r["on_osm"] for r in told["results"]} == {True, False}
    assert len(told["results"]) == 12
