"""`placegraph scene encode`: vectors of an encoder for the objects of a map."""

import numpy as np
import pytest

from placegraph.cli import scene_options as encoders
from placegraph.indoor.encode import encode_objects, encoder
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.scene_map import SceneMap
from placegraph_lab.worlds.home.home import home, record, scene_of, visit


@pytest.fixture(scope="module")
def scene():
    return scene_of(home(np.random.default_rng(0)).furnish(np.random.default_rng(0)))


@pytest.fixture
def file(scene, tmp_path):
    scene.save(tmp_path / "home.scene")
    return tmp_path / "home.scene"


@pytest.mark.parametrize("name", ["labels", "appearance"])
def test_a_map_gets_vectors(run, scene, file, tmp_path, name):
    out = tmp_path / "encoded.scene"
    before = file.read_bytes()
    told = run("scene", "encode", file, "-o", out, "--encoder", name, "--json")
    assert (told.code, told.err) == (0, "")
    made = encoder(name)
    encoded = SceneMap.open(out)
    assert encoded.encoder == told.json["encoder"] == made.key
    right = made.objects(scene)
    assert encoded.graph.embeddings == pytest.approx(right, abs=0.01)  # 8 bits
    assert told.json["known"] == np.any(right != 0, axis=1).sum()
    assert told.json["objects"] == len(scene)
    assert told.json["bytes"] == out.stat().st_size
    assert file.read_bytes() == before
    assert encode_objects(made, encoded) == pytest.approx(right, abs=0.01)


def test_in_place_and_by_another_encoder(run, file):
    for name in ("appearance", "labels"):
        told = run("scene", "encode", file, "-o", file, "--encoder", name)
        assert told.code == 0
        assert told.out.startswith(f"{file}: ")
        assert SceneMap.open(file).encoder == encoder(name).key
    assert run("scene", "encode", file, "-o", file, "--encoder", "labels", "--quiet").out == ""
    assert sorted(p.name for p in file.parent.iterdir() if not p.name.startswith(".")) == [
        file.name
    ]


def test_what_contradicts_itself(run, file, tmp_path):
    to = ("scene", "encode", file, "-o", tmp_path / "o.scene")
    for asked, code, says in (
        (("--encoder", "votes"), 7, "labels"),
        (("--encoder", "features"), 7, "--captures FOLDER"),
        (("--encoder", "labels", "--captures", tmp_path), 7, "remove --captures"),
        (("--encoder", "labels", "--poses", "odometry"), 7, "--poses applies only"),
        (("--encoder", "labels", "--frames", "3:"), 7, "--frames applies only"),
        (("--encoder", "labels", "--weights", file), 7, "--weights applies"),
        (("--encoder", "features layer=1"), 7, "--captures FOLDER"),
    ):
        told = run(*to, *asked)
        assert (told.code, told.out) == (code, "")
        assert says in told.err
    assert run(*to).code == 2
    gone = run("scene", "encode", tmp_path / "gone.scene", "-o", file, "--encoder", "labels")
    assert gone.code == 3
    nowhere = run("scene", "encode", file, "-o", tmp_path / "no" / "o", "--encoder", "labels")
    assert nowhere.code == 4
    assert not (tmp_path / "o.scene").exists()


def test_an_encoder_that_knows_nothing_of_it_writes_nothing(run, tmp_path):
    mesh = Mesh.plain([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    SceneMap.create(mesh, ["1"], ["floor"], floor=0.0).save(tmp_path / "bare.scene")
    out = tmp_path / "o.scene"
    told = run("scene", "encode", tmp_path / "bare.scene", "-o", out, "--encoder", "appearance")
    assert (told.code, "coloured" in told.err) == (7, True)
    assert not out.exists()


class Pooled:
    name = key = "pooled"
    dimension, temperature = 3, 0.1

    def objects(self, scene, captures=()):
        colours = [frame.rgb().mean(axis=(0, 1)) for capture in captures for frame in capture]
        return np.tile(np.mean(colours, axis=0, dtype=np.float64), (len(scene), 1))

    def patches(self, image):
        return image.rgb()[:1, :1].astype(np.float32)

    def camera(self, image):
        return image.camera


@pytest.fixture
def pooled(monkeypatch):
    from placegraph.indoor import encode

    monkeypatch.setattr(
        encode, "encoder", lambda name, **_: Pooled() if name == "features" else None
    )
    assert "features" in encoders.WITH_CAPTURES


@pytest.fixture(scope="module")
def walked(scene, tmp_path_factory):
    from placegraph_lab.worlds.flat.walks import write_walk

    rng = np.random.default_rng(0)
    flat = home(rng)
    interior = flat.furnish(np.random.default_rng(0))
    assert len(scene_of(interior)) == len(scene)
    walk = visit(flat, interior, rng, frames=4)
    folder = write_walk(interior, walk, tmp_path_factory.mktemp("walks") / "walk", rng, labels=None)
    return folder, record(interior, walk, np.random.default_rng(1))


@pytest.mark.usefixtures("pooled")
def test_images_of_the_map(run, file, walked, tmp_path):
    folder, _ = walked
    encode = ("scene", "encode", file, "-o", tmp_path / "o.scene", "--encoder", "features")
    told = run(*encode, "--captures", folder, "--frames", ":3", "--json")
    assert told.code == 0, told.err
    assert told.json["images"] == 3
    twice = run(*encode, "--captures", folder, "--captures", folder, "--json")
    assert twice.json["images"] == 8
    assert SceneMap.open(tmp_path / "o.scene").encoder == "pooled"


@pytest.mark.usefixtures("pooled")
def test_images_of_elsewhere_are_refused(run, file, walked, tmp_path):
    folder, capture = walked
    from placegraph.io.capture.tum import write_tum

    far = capture.odometry.copy()
    far[:, :3, 3] += 500.0
    write_tum(tmp_path / "far.tum", capture.stamps, far)
    told = run("scene", "encode", file, "-o", tmp_path / "o.scene", "--encoder", "features",
               "--captures", folder, "--poses", tmp_path / "far.tum")  # fmt: skip
    assert (told.code, "none of its cameras lies in" in told.err) == (7, True)
    assert not (tmp_path / "o.scene").exists()
