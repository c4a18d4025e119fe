"""Bad input to `build_scene`: errors name file and mend, or there is a note or a count."""

import json
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image
from tests.indoor.conftest import damage

from placegraph.errors import InputError, MapError, OptionError, PlacegraphError
from placegraph.indoor.build import build_scene, scene_of_model
from placegraph.indoor.map.relations import MAX_RELATED_OBJECTS
from placegraph.indoor.mapping.from_capture import FromCapture
from placegraph.io.mesh.ply import write_ply

IDS = np.repeat([0, 1, 2], 12)


@pytest.fixture
def room(boxes):
    return boxes(
        {
            "floor": ((0, 0, -0.1), (5, 4, 0)),
            "wall": ((0, 4, 0), (5, 4.1, 2.5)),
            "table": ((1, 1, 0), (2, 2, 0.7)),
        }
    )


@pytest.fixture
def ply(room, tmp_path):
    def write(vertices=room.vertices, triangles=room.triangles, objects=IDS):
        return write_ply(tmp_path / "room.ply", vertices, triangles, objects=objects)

    return write


def hall(boxes):
    n = 16
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    corner = (i[:-1, :-1] * n + j[:-1, :-1]).ravel()
    quads = (corner[:, None] + [[0, n, n + 1, 0, n + 1, 1]]).reshape(-1, 3)
    flat = np.stack([i, j, 0 * i], axis=2).reshape(-1, 3) / (n - 1)
    sheets = [flat * (5, 5, 1), flat[:, [0, 2, 1]] * (5, 1, 2.5), flat[:, [2, 0, 1]] * (1, 5, 2.5)]
    box = boxes({"": ((2, 2, 0), (3, 3, 1))})
    points = np.concatenate([*sheets, box.vertices])
    triangles = np.concatenate(
        [quads, quads[:, ::-1] + n * n, quads + 2 * n * n, box.triangles + 3 * n * n]
    )
    return points, triangles


@pytest.mark.parametrize(
    ("factor", "says"),
    [
        (1000.0, r"its unit seems to be millimetres. Pass scale=0.001 \(--scale 0.001"),
        (100.0, r"its unit seems to be centimetres. Pass scale=0.01 \(--scale 0.01"),
        (0.001, r"only 0.005 x .* large. Pass .* scale=1000 \(--scale 1000\)"),
    ],
)
def test_what_cannot_be_metres_is_refused_and_scaled(factor, says, ply, room):
    path = ply(room.vertices * factor)
    with pytest.raises(InputError, match=rf"room\.ply is .*{says}"):
        build_scene(path, None)
    scene = build_scene(path, None, scale=1.0 / factor)
    np.testing.assert_allclose(scene.bounds, [[0, 0, -0.1], [5, 4.1, 2.5]], atol=2e-3)


def test_a_nameless_mesh_in_millimetres_is_cut_as_one_in_metres(boxes, tmp_path):
    points, triangles = hall(boxes)
    told, seen = [], []
    for factor in (1.0, 1000.0):
        path = write_ply(tmp_path / "hall.ply", points * factor, triangles)
        scene = build_scene(path, None, scale=1.0 / factor, notes=told)
        seen.append((scene.graph.labels, scene.floors.tolist(), len(scene.mesh)))
    assert seen[0] == seen[1]
    assert len(seen[0][0]) >= 4
    assert "floor" in seen[0][0]
    assert told[0] == told[1]
    assert "by geometry and colour, because the file names none" in told[0]


def test_a_table_names_the_objects_that_were_found(boxes, tmp_path):
    points, triangles = hall(boxes)
    path = write_ply(tmp_path / "hall.ply", points, triangles)
    found = build_scene(path, None)
    row = found.graph.labels.index("floor")
    named = build_scene(path, None, labels={found.graph.ids[row]: "parquet floor"})
    assert named.graph.labels[row] == "parquet floor"
    with pytest.raises(InputError, match=r"none of the 1 ids \(chair 7\) is an object of"):
        build_scene(path, None, labels={"chair 7": "chair"})


def test_what_is_wide_or_far_is_told(ply, room):
    notes = []
    build_scene(ply(room.vertices * (100, 100, 1)), None, notes=notes)
    assert "500 x 410 x" in notes[0]
    assert "--scale" in notes[0]
    notes.clear()
    scene = build_scene(ply(room.vertices + np.array([8000, 0, 0])), None, notes=notes)
    assert scene.bounds[0, 0] == 8000
    assert "8,005 m from its origin" in notes[0]
    assert "only accurate to 2 mm" in notes[0]
    with pytest.raises(InputError, match=r"room\.ply reaches 5e\+05 m from its origin"):
        build_scene(ply(room.vertices + np.array([5e5, 0, 0])), None)


def test_numbers_that_are_none(ply, room):
    points = room.vertices.copy()
    points[9, 1] = np.nan
    for ids in (IDS, None):
        with pytest.raises(InputError, match=r"room\.ply: 1 vertices are not finite.*repair"):
            build_scene(ply(points, objects=ids), None)
    points[9, 1] = 1e30
    with pytest.raises(InputError, match=r"room\.ply reaches 1e\+30 m"):
        build_scene(ply(points), None)


def test_labels_of_another_mesh(ply):
    with pytest.raises(InputError, match=r"none of the 2 ids \(7, 8\).*room\.ply \(0, 1, 2\)"):
        build_scene(ply(), None, labels={"7": "lamp", "8": "chair"})
    with pytest.raises(InputError, match=r"none of the 0 ids \(none\).*\(0, 1, 2\)"):
        build_scene(ply(), None, labels={})
    left_out = Counter()
    scene = build_scene(ply(), None, labels={"0": "floor", "8": "chair"}, left_out=left_out)
    assert scene.graph.labels == ("floor", "unknown")
    assert left_out["labels of missing objects"] == 1


def test_an_id_for_every_triangle_is_told(boxes):
    n = MAX_RELATED_OBJECTS + 1
    at = np.column_stack([np.arange(n) % 150, np.arange(n) // 150, np.zeros(n)]) * 0.1
    model = boxes({"floor": ((0, 0, 0), (1, 1, 1))})
    things = tuple(replace(model.objects[0], id=str(i)) for i in range(n))
    corners = (at[:, None] + [[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]]).reshape(-1, 3)
    many = replace(
        model, objects=things, vertices=corners,
        triangles=np.arange(3 * n).reshape(-1, 3), object_of=np.arange(n),
        colours=np.full(corners.shape, 200, np.uint8), uv=np.zeros((3 * n, 2)),
        picture_of=np.zeros(n, int),
    )  # fmt: skip
    notes = []
    assert scene_of_model(many, notes=notes, detail="full").graph.relations == ()
    assert "20,001 objects" in notes[0]
    assert "--object-property" in notes[0]


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=12)
@given(seed=st.integers(0, 2**32 - 1), detail=st.sampled_from(["default", "tiny", "full"]))
def test_any_soup_of_triangles_is_built_or_refused(seed, detail, boxes):
    rng = np.random.default_rng(seed)
    n, t = int(rng.integers(3, 40)), int(rng.integers(1, 200))
    size = 10.0 ** rng.integers(-3, 0)
    lattice = rng.random() < 0.5
    points = size * (rng.integers(0, 4, (n, 3)) if lattice else rng.normal(size=(n, 3)))
    triangles = rng.integers(0, n, (t, 3))
    model = boxes({"floor": ((0, 0, 0), (1, 1, 1)), "chair": ((0, 0, 0), (1, 1, 1))})
    soup = replace(
        model, vertices=points, triangles=triangles,
        object_of=rng.integers(0, 2, t), colours=rng.integers(0, 256, (n, 3)).astype(np.uint8),
        uv=rng.normal(size=(n, 2)) * 10.0 ** rng.integers(-9, 8), picture_of=np.zeros(t, int),
    )  # fmt: skip
    scene = scene_of_model(soup, floor=0.0, scale=1.0, detail=detail)
    used = points[np.unique(triangles)]
    slack = 0.06 + 1e-6 * np.abs(used).max()
    assert (scene.bounds[0] >= used.min(axis=0) - slack).all()
    assert (scene.bounds[1] <= used.max(axis=0) + slack).all()
    assert len(scene) == len(set(soup.object_of.tolist()))


@pytest.mark.parametrize("ending", [".ply", ".obj", ".glb", ".json"])
def test_empty_files_and_folders(ending, tmp_path):
    path = tmp_path / f"a{ending}"
    path.touch()
    with pytest.raises(InputError, match=rf"a\{ending} (is empty|contains no vertex)"):
        build_scene(path, None)
    path.unlink()
    path.mkdir()
    with pytest.raises(InputError, match=rf"a\{ending} (cannot be read|contains no known)"):
        build_scene(path, None)


def test_other_endings(tmp_path):
    path = tmp_path / "a.fbx"
    path.write_bytes(b"Kaydara")
    with pytest.raises(InputError, match=r"a\.fbx has an unknown ending; .* as \.glb"):
        build_scene(path, None)
    path = tmp_path / "a.json"
    path.write_text("{}")
    with pytest.raises(InputError, match=r"a\.json contains no scene graph"):
        build_scene(path, None)
    with pytest.raises(InputError, match="does not exist"):
        build_scene(tmp_path / "no.glb", None)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=30)
@given(data=st.data())
def test_a_file_cut_or_damaged_anywhere(data, ply):
    path = ply()
    path.write_bytes(damage(data, path.read_bytes()))
    try:
        build_scene(path, None, floor=0.0)
    except PlacegraphError as error:
        assert isinstance(error, InputError)  # noqa: PT017  # either is right
        assert "room.ply" in str(error)  # noqa: PT017


def test_outputs_that_cannot_be(ply, tmp_path):
    path, table = ply(), tmp_path / "labels.json"
    table.write_text(json.dumps({"0": "floor"}))
    before = path.read_bytes()
    (tmp_path / "link.scene").symlink_to(path)
    for out in (path, tmp_path / "link.scene"):
        with pytest.raises(OptionError, match=r"room\.ply is the input and would be overwritten"):
            build_scene(path, out)
    with pytest.raises(OptionError, match=r"labels\.json is the input"):
        build_scene(path, table, labels=table)
    for out, says in (
        (tmp_path, "is not a regular file"),
        (tmp_path / "no" / "a.scene", "cannot be written: No such file"),
        (tmp_path / ("x" * 300), "cannot be written: File name too long"),
        ("a\0b", "is not a valid file name"),
    ):
        with pytest.raises(MapError, match=says):
            build_scene(path, out)
    assert path.read_bytes() == before
    assert json.loads(table.read_text()) == {"0": "floor"}


@pytest.mark.parametrize("error", [KeyboardInterrupt, MemoryError])
def test_interrupted_builds_leave_the_old_map(error, ply, tmp_path):
    path, out = ply(), tmp_path / "room.scene"
    build_scene(path, out)
    before = out.read_bytes()

    def stop(*_):
        raise error

    with pytest.raises(error):
        build_scene(path, out, floor=1.0, progress=stop)
    assert out.read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["room.ply", "room.scene"]
    build_scene(path, out, floor=1.0)
    assert out.read_bytes() != before, "the lock is free"


def test_captures_that_show_too_little(walk):
    with pytest.raises(OptionError, match=r"has no frame in 90:99"):
        build_scene(walk.path, None, capture=FromCapture(frames=slice(90, 99)))
    notes, left_out = [], Counter()
    how = FromCapture(frames=slice(0, 1), landmarks=True)
    scene = build_scene(walk.path, None, floor=0.0, capture=how, notes=notes, left_out=left_out)
    assert notes[0].startswith("1 frames fused")
    assert len(scene.landmarks)
    assert scene.floors.tolist() == [0.0]


@pytest.fixture
def copied(walk, tmp_path):
    folder = tmp_path / "walk"
    for part in ("rgb", "depth"):
        (folder / part).mkdir(parents=True)
        for file in sorted((walk.path / part).iterdir())[:3]:
            (folder / part / file.name).write_bytes(file.read_bytes())
    for name in ("odometry.tum", "gravity.txt"):
        rows = [r for r in (walk.path / name).read_text().splitlines() if r[:1] != "#"]
        (folder / name).write_text("\n".join(rows[:3]) + "\n")
    camera = json.loads((walk.path / "camera.json").read_text())
    camera.pop("instances", None)
    camera.pop("instances_offset", None)
    (folder / "camera.json").write_text(json.dumps(camera))
    return folder


def test_depth_that_says_nothing(copied):
    for file in (copied / "depth").iterdir():
        Image.fromarray(np.zeros_like(np.asarray(Image.open(file)))).save(file)
    with pytest.raises(InputError, match=r"walk: .*no depth to fuse \(3 frames without depth\)"):
        build_scene(copied, None, floor=0.0)
    for file in (copied / "depth").iterdir():
        file.unlink()
    with pytest.raises(InputError, match="walk has no depth images"):
        build_scene(copied, None)


def test_frames_that_all_see_a_wall(copied):
    for file in (copied / "depth").iterdir():
        Image.fromarray(np.zeros_like(np.asarray(Image.open(file))) + 2000).save(file)
    rows = (copied / "odometry.tum").read_text().splitlines()
    still = [f"{r.split()[0]} 0 0 1.5 -0.70710678 0 0 0.70710678" for r in rows]
    (copied / "odometry.tum").write_text("\n".join(still) + "\n")
    notes = []
    guessed = build_scene(copied, None, notes=notes)
    assert guessed.floors[0] == pytest.approx(guessed.bounds[0, 2], abs=0.05)
    assert any("no floor was found" in note and "--floor 0" in note for note in notes)
    scene = build_scene(copied, None, floor=0.0)
    assert scene.floors[0] == 0.0
    np.testing.assert_allclose(scene.bounds[:, 1], 2.0, atol=0.02)
    assert len(scene) == 1
