"""Capture folders: every file in its place, or one error that names the file."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from tests.io.damage import DAMAGE, damaged

import placegraph as pg
from placegraph.core.geometry import Camera
from placegraph.errors import InputError, OptionError
from placegraph.io.capture.capture import Capture, Frame, open_capture

DOWN = [0.0, 1.0, 0.0]  # of an upright camera


def test_frames_hold_what_the_files_hold(folder):
    capture = open_capture(folder.path)
    assert len(capture) == 3
    assert repr(capture).endswith("3 frames of 8 x 6, depth, instances)")
    for i, frame in enumerate(capture):
        assert frame.index == i
        assert frame.stamp == pytest.approx(0.2 * i)
        np.testing.assert_array_equal(frame.rgb(), folder.rgb[i])
        depth = frame.depth()
        assert depth.dtype == np.float32
        expected = np.where(folder.depth[i] == 0, np.nan, folder.depth[i] / 1000)
        np.testing.assert_allclose(depth, expected, rtol=1e-6)
        np.testing.assert_array_equal(frame.labels(), folder.instances[i].astype(int) - 1)
        assert frame.labels().dtype == np.int32
        np.testing.assert_allclose(frame.gravity, DOWN, atol=1e-12)
        np.testing.assert_allclose(frame.odometry[:3, 3], [0.1 * i, 0, 1.6])
    assert capture.label_kind == "instances"
    assert capture.label_names == {}
    assert capture.camera == Camera(8, 6, 10.0, 11.0, 4.0, 3.0)
    assert capture.depth_camera == Camera(4, 3, 5.0, 5.5, 2.0, 1.5)
    assert capture.label_camera == capture.depth_camera
    assert capture.odometry.shape == (3, 4, 4)
    np.testing.assert_allclose(capture.stamps, [0.0, 0.2, 0.4])
    np.testing.assert_allclose(capture.gravity, [DOWN] * 3, atol=1e-12)
    for array in (capture.stamps, capture.odometry, capture.gravity, capture[0].odometry):
        assert not array.flags.writeable
    folder.text("trajectory.tum", "not even numbers\n")  # the truth is never read
    np.testing.assert_array_equal(open_capture(folder.path).odometry, capture.odometry)


def test_slices(folder):
    capture = open_capture(folder.path)
    tail = capture[1:]
    assert isinstance(tail, Capture)
    assert [f.index for f in tail] == [1, 2]
    assert tail.stamps.tolist() == capture.stamps[1:].tolist()
    np.testing.assert_array_equal(tail.odometry, capture.odometry[1:])
    assert capture[-1].index == capture[np.int64(2)].index == 2
    assert len(capture[1:1]) == 0
    assert capture[1:1].odometry.shape == (0, 4, 4)
    assert len(capture[::2]) == 2
    assert [f.index for f in capture[5:10]] == []
    with pytest.raises(IndexError):
        capture[3]


def test_frames_may_lack_depth_and_labels(folder, new_folder):
    assert len(open_capture(new_folder(frames=1).path)) == 1
    folder.remove("depth/000001.png")
    folder.remove("instances/000002.png")
    folder.image("depth/000000.png", np.zeros((3, 4), np.uint16))
    capture = open_capture(folder.path)
    assert [f.depth() is None for f in capture] == [False, True, False]
    assert [f.labels() is None for f in capture] == [False, False, True]
    assert capture.depth_camera is not None
    assert np.isnan(capture[0].depth()).all(), "zeros are no reading at all"
    for name in ("depth", "instances"):
        folder.remove(name)
    capture = open_capture(folder.path)
    assert (capture.depth_camera, capture.label_camera, capture.label_kind) == (None, None, None)
    assert (capture[0].depth(), capture[0].labels()) == (None, None)


def test_jpeg_gray_and_transparent_images(folder):
    folder.remove("rgb/000000.png")
    folder.image("rgb/000000.JPG", np.full((6, 8, 3), 90, np.uint8), quality=95)
    folder.image("rgb/000001.png", np.full((6, 8), 7, np.uint8))
    folder.image("rgb/000002.png", np.full((6, 8, 4), 9, np.uint8))
    colours = [f.rgb() for f in open_capture(folder.path)]
    assert [c.shape for c in colours] == [(6, 8, 3)] * 3
    assert np.abs(colours[0].astype(int) - 90).max() <= 2
    assert (colours[1] == 7).all()
    assert (colours[2] == 9).all()


def test_images_come_in_natural_order_and_match_by_name(new_folder):
    folder = new_folder(frames=11)
    for kind in ("rgb", "depth", "instances"):
        for i in range(11):
            (folder.path / kind / f"{i:06d}.png").rename(folder.path / kind / f"f{i}.png")
    (folder.path / "rgb" / "Thumbs.db").touch()
    (folder.path / "rgb" / "._f3.png").touch()
    for i, frame in enumerate(open_capture(folder.path)):
        np.testing.assert_array_equal(frame.rgb(), folder.rgb[i])
        np.testing.assert_array_equal(frame.labels() + 1, folder.instances[i])


def test_gravity_from_its_file_is_normalised(folder):
    folder.text("gravity.txt", "# down\n0 0 1.005 0\n1 0.6 0.8 0\n2 0 0 1\n")
    gravity = open_capture(folder.path).gravity
    np.testing.assert_allclose(gravity, [[0, 1, 0], [0.6, 0.8, 0], [0, 0, 1]])


@pytest.mark.parametrize(
    ("rows", "says"),
    [
        ("0 0 1 0\n1 0 1 0\n", "2 rows, but rgb/ has 3 images"),
        ("0 0 1 0\n1 0 9.81 0\n2 0 1 0\n", "line 2: gravity has length 9.81"),
        ("0 0 1 0\n1 0 0 0\n2 0 1 0\n", "line 2: gravity has length 0"),
        ("0 0 1 0\n1 0 nan 0\n2 0 1 0\n", "line 2: gy is nan"),
        ("0 0 1\n1 0 1\n2 0 1\n", "line 1: 3 columns are given, expected 4"),
        ("", "is empty"),
    ],
)
def test_wrong_gravity(rows, says, folder):
    folder.text("gravity.txt", rows)
    with pytest.raises(InputError, match=says) as caught:
        open_capture(folder.path)
    assert "gravity.txt" in str(caught.value)


def test_odometry_of_another_length_or_none(folder):
    lines = (folder.path / "odometry.tum").read_text().splitlines(keepends=True)
    for rows in (lines[:2], [*lines, "1 0 0 0 0 0 0 1\n"]):
        folder.text("odometry.tum", "".join(rows))
        message = rf"odometry.tum has {len(rows)} rows, but rgb/ has 3 images"
        with pytest.raises(InputError, match=message):
            open_capture(folder.path)
    folder.remove("odometry.tum")
    with pytest.raises(InputError, match=r"it lacks odometry.tum\. `placegraph capture init"):
        open_capture(folder.path)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"fx": None}, "fx is missing"), ({"fx": "wide"}, "fx is 'wide'"),
        ({"fx": True}, "fx is 'True'"), ({"fx": 0}, "must be greater than 0"),
        ({"cy": float("nan")}, "must be finite numbers"),
        ({"width": 8.5}, "width is 8.5; it must be a whole number"),
        ({"width": 0}, "width and height are 0 and 6"), ({"height": 10**9}, "width and height"),
        ({"distortion": [0.1, 0.2]}, "2 distortion coefficients"),
        ({"distortion": 3}, "distortion must be a list"),
        ({"model": "fov"}, "model is 'fov'; choose one of opencv, fisheye"),
        ({"model": ["fisheye"]}, "model is"), ({"depth": []}, "depth must be an object"),
        ({"depth": {"scale": 0.001}}, "depth.scale is 0.001"),
        ({"depth": {"width": 4, "height": 3, "fx": 5}}, "depth.fy is missing"),
        ({"instances_offset": "1"}, "instances_offset is '1'"),
    ],
)  # fmt: skip
def test_wrong_cameras(change, says, folder):
    folder.json("camera.json", folder.camera | change)
    with pytest.raises(InputError, match=says) as caught:
        open_capture(folder.path)
    assert "camera.json" in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", "[]", '"camera"', "\udcff", "[" * 100_000])
def test_what_is_no_camera_file(text, folder):
    (folder.path / "camera.json").write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(InputError, match=r"camera\.json"):
        open_capture(folder.path)
    folder.remove("camera.json")
    with pytest.raises(InputError, match=r"lacks .*camera.json"):
        open_capture(folder.path)


def test_distortion(folder):
    folder.json("camera.json", folder.camera | {"distortion": [0.1, 0.01, 0, 0, 0]})
    assert open_capture(folder.path).camera.distortion == (0.1, 0.01, 0.0, 0.0, 0.0)
    folder.json("camera.json", folder.camera | {"distortion": [0.1] * 4, "model": "fisheye"})
    assert open_capture(folder.path).camera.model == "fisheye"


def test_entries_without_intrinsics_share_the_colour_cameras_view(folder):
    folder.json("camera.json", folder.camera | {"depth": {"width": 4, "height": 3}})
    capture = open_capture(folder.path)
    assert capture.depth_camera == Camera(4, 3, 5.0, 5.5, 2.0, 1.5)
    np.testing.assert_allclose(capture[0].depth()[1, 1], folder.depth[0, 1, 1] / 1000)


def test_depth_of_the_colour_images_size_needs_no_entry(folder):
    camera = {k: v for k, v in folder.camera.items() if k != "depth"}
    folder.json("camera.json", camera | {"instances": {"width": 4, "height": 3}})
    for i in range(3):
        folder.image(f"depth/{i:06d}.png", np.full((6, 8), 1500, np.uint16))
    capture = open_capture(folder.path)
    assert capture.depth_camera == capture.camera
    assert (capture[0].depth() == 1.5).all()
    assert capture.label_camera == Camera(4, 3, 5.0, 5.5, 2.0, 1.5)
    folder.json("camera.json", camera)
    folder.image("instances/000000.png", np.zeros((5, 5), np.uint8))
    with pytest.raises(InputError, match=r"no entry 'instances'.*5 x 5"):
        open_capture(folder.path)


@pytest.fixture
def labelled(folder):
    """Label ids 0 to 4 instead of instances."""
    (folder.path / "instances").rename(folder.path / "labels")
    folder.json("labels.json", {"0": "wall", "1": "chair", "2": "table", "3": "lamp", "4": None})
    return folder


def test_labels_have_names(labelled):
    capture = open_capture(labelled.path)
    assert capture.label_kind == "labels"
    assert capture.label_names == {0: "wall", 1: "chair", 2: "table", 3: "lamp"}
    assert capture[0].label_names == capture.label_names
    ids = labelled.instances[0].astype(int)
    np.testing.assert_array_equal(capture[0].labels(), np.where(ids == 4, -1, ids))


def test_labels_without_names(labelled):
    labelled.image("labels/000001.png", np.array([[1] * 4, [200] * 4, [7] * 4], np.uint8))
    capture = open_capture(labelled.path)
    capture[0].labels()
    with pytest.raises(InputError, match=r"add their names \(null for ids to ignore\)\.") as caught:
        capture[1].labels()
    assert str(labelled.path) in str(caught.value)
    labelled.remove("labels.json")
    capture = open_capture(labelled.path)
    with pytest.raises(InputError, match=r"without a name in .*labels.json"):
        capture[0].labels()
    labelled.image("labels/000000.png", np.zeros((3, 4), np.uint8))
    assert (capture[0].labels() == -1).all(), "0 says nothing where no name says otherwise"


def test_labels_of_16_bits_and_palettes(labelled):
    labelled.json("labels.json", {"1": "chair", "40000": "lamp"})
    labelled.image("labels/000000.png", np.full((3, 4), 40_000, np.uint16))
    capture = open_capture(labelled.path)
    assert (capture[0].labels() == 40_000).all()
    image = Image.new("P", (4, 3), 1)
    image.putpalette([0, 0, 0, 255, 0, 0])
    image.save(labelled.path / "labels" / "000001.png")
    assert (capture[1].labels() == 1).all()


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ([], "JSON object"), ({"chair": "1"}, "'chair' is not a label id"), ({"-1": "a"}, "not a label id"),
        ({"70000": "a"}, "not a label id"), ({"1": 5}, "name of label 1 is '5'"),
    ],
)  # fmt: skip
def test_wrong_label_names(content, says, labelled):
    labelled.json("labels.json", content)
    with pytest.raises(InputError, match=says):
        open_capture(labelled.path)


def test_which_labels(labelled):
    for i in range(3):
        labelled.image(f"instances/{i:06d}.png", np.full((3, 4), 9, np.uint8))
    assert open_capture(labelled.path).label_kind == "instances"
    assert (open_capture(labelled.path)[0].labels() == 8).all()
    assert open_capture(labelled.path, labels="labels").label_kind == "labels"
    nothing = open_capture(labelled.path, labels=None)
    assert (nothing.label_kind, nothing[0].labels()) == (None, None)
    labelled.remove("instances")
    with pytest.raises(InputError, match=r"instances does not exist.*asks for it"):
        open_capture(labelled.path, labels="instances")
    with pytest.raises(OptionError, match="labels is 'both'"):
        open_capture(labelled.path, labels="both")


def test_folders(folder, tmp_path_factory):
    with pytest.raises(InputError, match="does not exist"):
        open_capture(folder.path / "no")
    empty = tmp_path_factory.mktemp("empty")
    for nothing in (folder.path / "camera.json", empty):
        with pytest.raises(InputError, match=r"is not a capture of a known"):
            open_capture(nothing)
    map_file = empty / "flat.scene"
    map_file.write_bytes(b"")
    with pytest.raises(InputError, match=r"flat.scene is a map, not a capture"):
        open_capture(map_file)
    (empty / "rgb").mkdir()
    with pytest.raises(InputError, match=r"lacks .*camera.json"):
        open_capture(empty)
    folder.remove("rgb")
    with pytest.raises(InputError, match=r"lacks colour images in rgb/\."):
        open_capture(folder.path)


def test_images_that_belong_to_nothing_or_bear_one_name(folder):
    folder.image("depth/000009.png", folder.depth[0])
    with pytest.raises(InputError, match=r"name depth images like their colour images\."):
        open_capture(folder.path)
    folder.image("rgb/000001.jpg", folder.rgb[0])
    with pytest.raises(InputError, match="have the same name"):
        open_capture(folder.path)


def test_images_of_another_size_or_kind(folder):
    capture = open_capture(folder.path)
    folder.image("rgb/000000.png", folder.rgb[0][:, :7])
    with pytest.raises(InputError, match="has 7 x 6 pixels, but its camera has"):
        capture[0].rgb()
    folder.image("depth/000000.png", np.zeros((3, 4), np.uint8))
    with pytest.raises(InputError, match=r"mode 'L'.*16 bits"):
        capture[0].depth()
    folder.image("instances/000000.png", np.zeros((3, 4, 3), np.uint8))
    with pytest.raises(InputError, match=r"mode 'RGB'.*8 or 16 bits"):
        capture[0].labels()
    folder.remove("rgb/000001.png")
    with pytest.raises(InputError, match="does not exist; it was there"):
        capture[1].rgb()


@DAMAGE
@given(data=st.data())
def test_damaged_images_give_one_kind_of_error(data, folder):
    name, read, ending = data.draw(
        st.sampled_from([("rgb", "rgb", "jpg"), ("depth", "depth", "png"), ("rgb", "rgb", "png"),
                         ("instances", "labels", "png")])
    )  # fmt: skip
    for kind, images in (("depth", folder.depth), ("instances", folder.instances)):
        folder.image(f"{kind}/000000.png", images[0])  # mend what the last example damaged
    source = {"rgb": folder.rgb, "depth": folder.depth, "instances": folder.instances}[name][0]
    for old in (folder.path / name).glob("000000.*"):
        old.unlink()
    path = folder.image(f"{name}/000000.{ending}", source)
    path.write_bytes(data.draw(damaged(path.read_bytes())))
    try:
        got = getattr(open_capture(folder.path)[0], read)()
    except InputError as error:
        assert str(path) in str(error) or "camera.json" in str(error)  # noqa: PT017  # either is right
    else:
        assert got.shape[:2] == source.shape[:2]


CAMERA = Camera(8, 6, 10.0, 11.0, 4.0, 3.0)


def frame(**options):
    return Frame.from_arrays(np.zeros((6, 8, 3), np.uint8), CAMERA, **options)


def test_frames_of_arrays():
    got = frame(
        depth=[[1.0, 0.0, np.inf, -1.0]] * 3, labels=np.array([[1, -7, 3, 0]] * 3), stamp=2.5, index=4,
        label_kind="instances", gravity=[0, 2, 0],
    )  # fmt: skip
    np.testing.assert_array_equal(np.isnan(got.depth()), [[False, True, True, True]] * 3)
    np.testing.assert_array_equal(got.labels(), [[1, -1, 3, 0]] * 3)
    assert got.depth_camera == got.label_camera == Camera(4, 3, 5.0, 5.5, 2.0, 1.5)
    np.testing.assert_array_equal(got.gravity, DOWN)
    assert (got.stamp, got.index, got.label_kind) == (2.5, 4, "instances")
    bare = frame()
    assert (bare.depth(), bare.labels(), bare.label_kind) == (None, None, None)
    np.testing.assert_array_equal(bare.gravity, [0, 0, -1])
    rgb = np.zeros((6, 8, 3), np.uint8)
    got = Frame.from_arrays(rgb, CAMERA)
    rgb[0, 0, 0] = 5  # arrays are not locked for their owner
    assert got.rgb()[0, 0, 0] == 5
    assert not got.rgb().flags.writeable


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"depth": np.zeros((3, 6))}, "is not a scaled version of 8 x 6"),
        ({"depth": np.zeros(3)}, "depth: shape"), ({"depth": [["far"]]}, "it is not a numeric array of"),
        ({"depth": np.zeros((3, 4)), "depth_camera": CAMERA}, r"depth: shape is \(3, 4\)"),
        ({"labels": np.zeros((3, 4))}, "ids must be integers"), ({"stamp": np.nan}, "stamp"),
        ({"labels": np.zeros((3, 4), int), "label_kind": "words"}, "label_kind is 'words'"),
        ({"odometry": np.eye(3)}, "odometry: shape"), ({"gravity": [0, 0, 0]}, "no direction"),
        ({"odometry": np.full((4, 4), np.nan)}, "odometry"),
    ],
)  # fmt: skip
def test_arrays_that_do_not_fit(options, says):
    with pytest.raises(OptionError, match=says):
        frame(**options)
    with pytest.raises(OptionError, match=r"rgb: shape is \(8, 6, 3\)"):
        Frame.from_arrays(np.zeros((8, 6, 3), np.uint8), CAMERA)
    with pytest.raises(OptionError, match="colours must be uint8"):
        Frame.from_arrays(np.zeros((6, 8, 3)), CAMERA)


def test_captures_of_frames():
    capture = pg.Capture.from_frames([frame(stamp=0.0), frame(stamp=1.0)])
    assert len(capture) == 2
    assert capture.path is None
    assert repr(capture) == "Capture(in memory, 2 frames of 8 x 6)"
    other = frame(stamp=1.0, depth=np.ones((3, 4)))
    for frames, message in (
        ([], "one frame"), ([frame(), frame()], "do not increase"), ([frame(), other], "cameras differ"),
    ):  # fmt: skip
        with pytest.raises(OptionError, match=message):
            Capture.from_frames(frames)


def test_the_shared_house(shared):
    capture = pg.open_capture(shared / "data" / "house" / "seq05")
    assert len(capture) == 25
    assert capture.label_kind == "instances"
    assert capture.depth_camera == capture.label_camera == Camera(320, 180, 230, 230, 160, 90)
    frame = capture[12]
    assert frame.rgb().shape == (360, 640, 3)
    depth, ids = frame.depth(), frame.labels()
    assert depth.shape == ids.shape == (180, 320)
    assert 0.05 < np.isnan(depth).mean() < 0.3
    assert 0.2 < np.nanmin(depth) < np.nanmax(depth) < 10
    assert -1 <= ids.min() <= ids.max() <= 85
    aligned = -capture.odometry[:, 2, :3]
    np.testing.assert_allclose(aligned, capture.gravity, atol=1e-4)


def test_the_shared_office(shared):
    capture = pg.open_capture(shared / "data" / "office")
    assert len(capture) == 373
    assert capture.stamps.tolist() == list(range(373))
    assert (capture.label_kind, capture[0].labels()) == (None, None)
    frame = capture[200]
    assert frame.rgb().shape == (360, 540, 3)
    assert frame.depth().shape == (180, 270)
    assert 0.1 < np.isnan(frame.depth()).mean() < 0.7
    np.testing.assert_allclose(-capture.odometry[:, 2, :3], capture.gravity, atol=0.02)
