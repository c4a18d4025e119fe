import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.core.mapfile import read_map
from placegraph.errors import InputError, MapError
from placegraph_lab.datasets.kitti360pose import (
    DIRECTIONS,
    GRAIN,
    RELEASE,
    Kitti360Pose,
    convert_kitti360pose,
    nearest_colour,
)
from placegraph_lab.datasets.pickles import read_pickle, unwrap_array

SYNC = "2013_05_28_drive_{}_sync.pkl"


@pytest.fixture(scope="module")
def folder(kitti360pose_world, tmp_path_factory):
    return kitti360pose_world.write_set(tmp_path_factory.mktemp("k360") / "k360_tiny")


@pytest.fixture(scope="module")
def out(folder, tmp_path_factory):
    path = tmp_path_factory.mktemp("out") / "tiny.k360"
    convert_kitti360pose(folder, path)
    return path


@pytest.fixture(scope="module")
def data(out):
    return Kitti360Pose.open(out)


def test_every_field_is_that_of_the_pickles(folder, data):
    first = data.scenes.index("0003") * 8
    cells = read_pickle(folder / "cells" / SYNC.format("0003"), RELEASE)
    c, o = data.cells, data.objects
    for k, record in enumerate(cells):
        cell = record.fields
        row = first + k
        assert (c.ids[row], data.scenes[c.scene[row]]) == (cell["id"], "0003")
        box = unwrap_array(cell["bbox_w"])
        np.testing.assert_array_equal(c.boxes[row], box)
        assert c.sizes[row] == cell["cell_size"] == 30.0
        things = [thing.fields for thing in cell["objects"]]
        rows = range(*c.objects(row).indices(len(o.ids)))
        assert len(rows) == len(things)
        assert c.points[row] == sum(len(unwrap_array(t["xyz"])) for t in things)
        assert c.point_bytes[row] == sum(
            unwrap_array(t["xyz"]).nbytes + unwrap_array(t["rgb"]).nbytes for t in things
        )
        for i, thing in zip(rows, things, strict=True):
            xyz = box[:3] + 30.0 * unwrap_array(thing["xyz"])
            assert (o.ids[i], o.instances[i]) == (thing["id"], thing["instance_id"])
            assert data.labels[o.labels[i]] == thing["label"]
            rgb = 255.0 * unwrap_array(thing["rgb"]).mean(axis=0)
            np.testing.assert_allclose(o.rgb[i], rgb, atol=0.51)
            assert data.colours[o.colours[i]] == nearest_colour(rgb)
            np.testing.assert_allclose(o.centers[i], xyz.mean(axis=0), atol=GRAIN)
            np.testing.assert_allclose(o.low[i], xyz.min(axis=0), atol=GRAIN)
            np.testing.assert_allclose(o.high[i], xyz.max(axis=0), atol=2 * GRAIN)
            ground = o.footprint(i)
            apart = np.linalg.norm(ground[:, None] - xyz[None, :, :2], axis=2)
            assert apart.min(axis=1).max() < GRAIN, "each is one of the points"
            assert apart.min(axis=0).max() < np.sqrt(2) + GRAIN, "and none is far from all"


def test_poses_and_what_was_said(folder, data):
    poses = read_pickle(folder / "poses" / SYNC.format("0010"), RELEASE)
    first = data.scenes.index("0010") * 16
    p, h = data.poses, data.hints
    for k, record in enumerate(poses):
        pose, row = record.fields, first + k
        np.testing.assert_array_equal(p.positions[row], unwrap_array(pose["pose_w"]))
        assert data.cells.ids[p.cells[row]] == pose["cell_id"]
        for i, told in zip(
            range(*p.hints(row).indices(len(h.labels))), pose["descriptions"], strict=True
        ):
            hint = told.fields
            assert data.labels[h.labels[i]] == hint["object_label"]
            assert data.colours[h.colours[i]] == hint["object_color_text"]
            assert DIRECTIONS[h.directions[i]] == hint["direction"]
            assert h.objects[i] == hint.get("object_id", -1)
            for column, name in ((h.offsets, "offset_center"), (h.closest, "offset_closest")):
                np.testing.assert_allclose(column[i], 30.0 * unwrap_array(hint[name]), rtol=1e-6)


def spoil(where, **changes):
    def edit(module, cells, poses):
        things = {"cell": cells[0], "object": cells[0].objects[0], "pose": poses[0]}
        things["description"] = poses[0].descriptions[0]
        for name, value in changes.items():
            if value is None:
                delattr(things[where], name)
            else:
                setattr(things[where], name, value(module) if callable(value) else value)

    return edit


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (spoil("cell", id=None), ["cells/", "cell 0", "has no id"]),
        (spoil("cell", id=7), ["cell 0", "id is not text"]),
        (spoil("cell", id="0003_00001"), ["cell 1", "used before"]),
        (spoil("cell", bbox_w=np.zeros(6)), ["cell 0", "bbox_w is empty"]),
        (spoil("cell", bbox_w=np.full(6, np.nan)), ["bbox_w is not finite"]),
        (spoil("cell", bbox_w=np.zeros(5)), ["bbox_w is of shape (5,)"]),
        (spoil("cell", cell_size="30"), ["cell_size is not 0-dimensional"]),
        (spoil("cell", cell_size=-1.0), ["bbox_w is empty"]),
        (spoil("cell", objects=()), ["objects is not a list"]),
        (spoil("cell", objects=[3]), ["object 0 is not of type Object3d"]),
        (spoil("cell", objects=lambda m: [m.Pose()]), ["object 0 is not of type Object3d"]),
        (spoil("object", xyz=np.zeros((4, 2))), ["(0003_00000): object 0", "xyz"]),
        (spoil("object", xyz=np.zeros((0, 3))), ["object 0: xyz is of shape (0, 3)"]),
        (spoil("object", xyz=np.full((200, 3), np.inf)), ["xyz is not finite"]),
        (spoil("object", xyz=np.full((4, 3), 1e8), rgb=np.eye(4)[:, :3]), ["xyz is far away"]),
        (spoil("object", rgb=np.zeros((4, 3))), ["rgb is of 4 points"]),
        (spoil("object", label=None), ["has no label"]),
        (spoil("object", instance_id=1.5), ["instance_id is not a whole number"]),
        (spoil("pose", cell_id="0003_99999"), ["poses/", "pose 0", "no cell '0003_99999'"]),
        (spoil("pose", pose_w=np.zeros(2)), ["pose_w is of shape (2,)"]),
        (spoil("pose", descriptions=None), ["has no descriptions"]),
        (spoil("pose", descriptions=[None]), ["description 0 is not of type DescriptionBestCell"]),
        (spoil("description", direction="up"), ["direction is 'up', none of north"]),
        (spoil("description", object_label=3), ["description 0: object_label is not text"]),
        (spoil("description", offset_center=None), ["has no offset_center"]),
        (spoil("description", is_matched=None), ["has no is_matched"]),
    ],
)
def test_spoiled_fields_are_named(kitti360pose_world, tmp_path, edit, words):
    folder = kitti360pose_world.write_set(tmp_path / "k", drives=["0003"], edit=edit)
    with pytest.raises(InputError) as caught:
        convert_kitti360pose(folder, tmp_path / "a")
    for word in (*words, "0003_sync.pkl"):
        assert word in str(caught.value)
    assert not list(tmp_path.glob("*a*")), "nothing half is left behind"


def test_folders_that_are_none(kitti360pose_world, tmp_path, out):
    with pytest.raises(InputError, match="contains no cells"):
        convert_kitti360pose(tmp_path, tmp_path / "a")
    folder = kitti360pose_world.write_set(tmp_path / "k", drives=["0003", "0005"])
    lone = folder / "poses" / SYNC.format("0003")
    lone.rename(folder / "poses" / "0003.pkl")
    assert convert_kitti360pose(folder, tmp_path / "a").poses == 32, "a short name does"
    (folder / "poses" / "0003.pkl").unlink()
    with pytest.raises(InputError, match="poses/ has no file of drive 0003"):
        convert_kitti360pose(folder, tmp_path / "a")
    (folder / "poses" / "drive_0005_again.pkl").touch()
    with pytest.raises(InputError, match="same drive"):
        convert_kitti360pose(folder, tmp_path / "a")
    (folder / "poses" / "drive_0005_again.pkl").rename(folder / "poses" / "elsewhere.pkl")
    with pytest.raises(InputError, match="has no drive"):
        convert_kitti360pose(folder, tmp_path / "a")
    with pytest.raises(MapError, match="kitti360pose map"):
        read_map(out, "city", 1)


@pytest.fixture(scope="module")
def small(kitti360pose_world, tmp_path_factory):
    folder = kitti360pose_world.write_set(
        tmp_path_factory.mktemp("small"), drives=["0003"], n_cells=1
    )
    paths = [folder / kind / SYNC.format("0003") for kind in ("cells", "poses")]
    return folder, {path: path.read_bytes() for path in paths}


@given(st.data())
def test_damage_gives_a_file_or_a_sentence(small, data):
    folder, files = small
    path = data.draw(st.sampled_from(list(files)))
    raw = bytearray(files[path])
    for _ in range(data.draw(st.integers(1, 3))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(bytes(raw))
    try:
        convert_kitti360pose(folder, folder / "out.k360")
        assert len(Kitti360Pose.open(folder / "out.k360").cells.ids) == 1
    except InputError as error:
        assert SYNC.format("0003") in str(error)  # noqa: PT017
    finally:
        path.write_bytes(files[path])


def test_the_command(run, folder, tmp_path):
    out = tmp_path / "a.k360"
    told = run("city", "convert-kitti360pose", folder, "-o", out)
    assert (told.code, told.err) == (0, "")
    assert told.out.startswith(f"{out}: 40 cells with ")
    assert "80 poses of the drives 0000, 0003, 0005, 0009, 0010." in told.out
    as_json = run("city", "convert-kitti360pose", folder, "-o", out, "--json").json
    assert (as_json["cells"], as_json["bytes"]) == (40, out.stat().st_size)
    silent = run("city", "convert-kitti360pose", folder, "-o", out, "--quiet")
    assert (silent.code, silent.out, silent.err) == (0, "", "")
