import lzma
import re
import zipfile

import cv2
import numpy as np
import pytest

from placegraph.demo.town import DATA, unpack
from placegraph.indoor.scene_map import SceneMap
from placegraph_lab.make.shipped import HOMES, write_demo_world


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    write_demo_world(folder)
    return folder


def content(path):
    if path.name.endswith(".zip"):
        with zipfile.ZipFile(path) as archive:
            return {name: archive.read(name) for name in archive.namelist()}
    return lzma.decompress(path.read_bytes()) if path.name.endswith(".xz") else path.read_bytes()


def is_same_output(ours, theirs):
    if not isinstance(ours, dict):
        return ours == theirs
    images = [name for name in ours if name.endswith((".jpg", ".png"))]
    pairs = [[image(files[name]) for files in (ours, theirs)] for name in images]
    rest = ours.keys() - set(images)
    return (
        ours.keys() == theirs.keys()
        and all(a.shape == b.shape and np.abs(a.astype(float) - b).mean() < 1.0 for a, b in pairs)
        and all(text(ours[name]) == pytest.approx(text(theirs[name]), abs=1e-6) for name in rest)
    )


def image(data):
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)


def text(data):
    return [float(x) for x in re.findall(rb"-?\d+\.?\d*(?:e-?\d+)?", data)]


@pytest.mark.all
def test_the_same_files_ship(drawn):
    assert {p.name for p in DATA.iterdir()} == {p.name for p in drawn.iterdir()}
    for path in drawn.iterdir():
        if path.suffix != ".scene":
            assert is_same_output(content(DATA / path.name), content(path)), path.name


@pytest.mark.all
@pytest.mark.parametrize("number", range(1, HOMES + 1))
def test_the_same_homes_ship(drawn, number):
    ours, theirs = (SceneMap.open(folder / f"home{number}.scene") for folder in (DATA, drawn))
    assert ours.graph.labels == theirs.graph.labels
    assert np.array_equal(ours.mesh.vertices, theirs.mesh.vertices)
    assert np.array_equal(ours.mesh.triangles, theirs.mesh.triangles)
    assert all(map(np.array_equal, ours.mesh.textures, theirs.mesh.textures))


def test_what_ships_is_unpacked_to_ordinary_files(tmp_path):
    world = unpack(tmp_path / "world")
    assert len(list((world / "walk/rgb").glob("*.jpg"))) == 18
    assert len(list((world / "window/rgb").glob("*.jpg"))) == 3
    assert (world / "altbau.glb").read_bytes()[:4] == b"glTF"
    assert not list(world.glob("*.xz")) + list(world.glob("*.zip"))
