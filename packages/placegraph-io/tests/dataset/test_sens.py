import struct
import tracemalloc
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from tests.io.damage import DAMAGE, damaged, refusing

from placegraph.core.geometry import Camera
from placegraph.errors import InputError, OptionError
from placegraph_io.dataset.sens import is_scannet_export, is_sens, read_scannet_export, read_sens

HEADER = 4 + 8 + 15 + 4 * 64 + 8 + 16 + 4 + 8
COLOUR = Camera(8, 6, 10.0, 11.0, 4.0, 3.0)
DEPTH = Camera(4, 3, 5.0, 5.5, 2.0, 1.5)


@pytest.fixture
def recording(scannet_world):
    return scannet_world.Recording()


@pytest.fixture
def folder(scannet_world, tmp_path):
    return tmp_path / "scans" / scannet_world.NAME


@pytest.fixture
def sens(recording, folder):
    return lambda **options: recording.write_sens(folder / f"{folder.name}.sens", **options)


def check(capture, recording):
    kept = [i for i in range(len(recording.poses)) if i not in recording.lost]
    assert [frame.index for frame in capture] == kept
    assert capture.camera == COLOUR
    assert capture.depth_camera == DEPTH
    np.testing.assert_allclose(capture.odometry, recording.poses[kept], atol=1e-6)
    np.testing.assert_allclose(capture.gravity, [[0.0, 1.0, 0.0]] * len(kept), atol=1e-6)
    for frame, i in zip(capture, kept, strict=True):
        np.testing.assert_array_equal(frame.rgb(), recording.colour[i])
        expected = np.where(recording.depth[i] == 0, np.nan, recording.depth[i] / 1000)
        np.testing.assert_allclose(frame.depth(), expected, rtol=1e-6)
        assert frame.depth().dtype == np.float32
    assert capture.left_out == {"frames without a pose": len(recording.lost)}


@pytest.mark.parametrize(("colour", "depth"), [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_a_sens_file_holds_what_was_recorded(recording, sens, colour, depth):
    capture = read_sens(sens(colour=colour, depth=depth))
    check(capture, recording)
    np.testing.assert_allclose(capture.stamps, [5.0, 5.033333, 5.099999, 5.133332])
    assert capture.label_camera is None
    assert capture[0].labels() is None
    assert capture.notes == ()


def test_jpeg_is_what_scannet_has(recording, sens):
    capture = read_sens(sens(colour=2))
    error = capture[0].rgb().astype(int) - recording.colour[0]
    assert np.sqrt(np.mean(error**2)) < 80  # noise is the worst a JPEG can be given
    assert capture[0].rgb().shape == (6, 8, 3)


def test_a_folder_with_one_recording_is_one(recording, sens, folder):
    file = sens()
    assert is_sens(file)
    assert is_sens(folder)
    check(read_sens(folder), recording)
    file.rename(folder / "other.sens")
    assert is_sens(folder)
    (folder / "more.sens").write_bytes(b"")
    assert not is_sens(folder)
    for path in (folder.parent, folder / "none.sens", folder / "a\0b"):
        assert not is_sens(path)
        with pytest.raises(InputError, match=r"not a \.sens file"):
            read_sens(path)


def test_units_stamps_and_extrinsics_of_a_header(recording, sens):
    recording.stamps[3] = recording.stamps[1]
    recording.extrinsics[0][0, 3] = -0.038
    capture = read_sens(sens(shift=4000.0))
    assert capture[0].depth()[1, 1] == pytest.approx(recording.depth[0, 1, 1] / 4000)
    assert capture[0].images.unit.per_metre == 4000.0
    assert capture.stamps.tolist() == [0.0, 1.0, 3.0, 4.0]
    said = " ".join(capture.notes)
    assert "stamps do not increase" in said
    assert "extrinsics between colour and depth" in said
    np.testing.assert_allclose(capture[0].odometry, recording.poses[0], atol=1e-6)


def test_frames_without_depth_or_colour(recording, sens, monkeypatch):
    empty = {("coded_depth", 1), ("coded_colour", 3)}
    for name in ("coded_depth", "coded_colour"):
        whole = getattr(recording, name)
        monkeypatch.setattr(
            recording, name, lambda i, c, n=name, w=whole: b"" if (n, i) in empty else w(i, c)
        )
    capture = read_sens(sens())
    assert [frame.index for frame in capture] == [0, 1, 4]
    assert capture[1].depth() is None
    assert capture.left_out["frames without a colour image"] == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"version": 3}, r"not a \.sens file of version 4, but of 3"),
        ({"version": 0x474E5089}, r"not a \.sens file of version 4"),
        ({"colour": 3}, "the colour codec is 3"),
        ({"depth": 2}, r"the depth codec is 2, but only raw \(0\)"),
        ({"shift": 0.0}, r"0 depth units per metre are impossible \(ScanNet has"),
        ({"shift": float("nan")}, r"nan depth units per metre are impossible \(ScanNet has"),
        ({"sides": (8, 6, 0, 3)}, r"image sizes of \(8, 6\) and \(0, 3\) pixels are impossible"),
        ({"sides": (1 << 31, 6, 4, 3)}, "pixels are impossible"),
        ({"sides": (2, 2, 4, 3)}, r"\(colour\): the principal point lies outside"),
        ({"count": 0}, "contains no complete frame"),
    ],
)
def test_a_header_that_is_none_of_ours_is_refused(sens, recording, options, message):
    if options.get("colour") == 3:
        recording.coded_colour = lambda *_: b"."
    with pytest.raises(InputError, match=message):
        read_sens(sens(**options))


def test_absurd_counts_take_no_memory(sens):
    file = sens(count=(1 << 64) - 1, inertial=0)
    tracemalloc.start()
    with pytest.raises(InputError, match="ends within frame 5 of 18446744073709551615"):
        read_sens(file)
    capture = read_sens(file, partial=True)
    assert tracemalloc.get_traced_memory()[1] < 8 << 20
    tracemalloc.stop()
    assert len(capture) == 4
    assert capture.left_out["frames missing in the truncated file"] == (1 << 64) - 6


@pytest.mark.parametrize("field", [4, HEADER + 80, HEADER + 88])
def test_absurd_lengths_take_no_memory(sens, field):
    file = sens()
    data = bytearray(file.read_bytes())
    data[field : field + 8] = struct.pack("<Q", 1 << 62)
    file.write_bytes(data)
    tracemalloc.start()
    with pytest.raises(InputError, match=r"scene0000_00\.sens"):
        read_sens(file)
    assert tracemalloc.get_traced_memory()[1] < 8 << 20
    tracemalloc.stop()


def test_depth_that_unpacks_to_more_is_not_unpacked(recording, sens):
    bomb = zlib.compress(bytes(32 << 20))
    recording.coded_depth = lambda *_: bomb
    frame = read_sens(sens())[0]
    tracemalloc.start()
    with pytest.raises(InputError, match="depth of frame 0 has 25 bytes, but its size needs 24"):
        frame.depth()
    assert tracemalloc.get_traced_memory()[1] < 8 << 20
    tracemalloc.stop()


def test_poses_that_cannot_be_used_are_named(recording, sens, scannet_world, folder):
    recording.poses[3, 0, 0] = 7.0
    with pytest.raises(InputError, match=r"\.sens, frame 3: the pose is not a rigid transform"):
        read_sens(sens())
    lost = scannet_world.Recording(count=3, lost=(0, 1, 2)).write_sens(folder / "a.sens")
    with pytest.raises(InputError, match=r"no usable frame \(3 frames without a pose\)"):
        read_sens(lost)


def test_broken_images_are_named_when_they_are_asked_for(scannet_world, recording, sens):
    recording.coded_colour = lambda i, _: b"\xff\xd8 no JPEG" if i == 1 else b""
    recording.coded_depth = lambda *_: b"no zlib"
    frame = read_sens(sens())[0]
    with pytest.raises(InputError, match=r"\.sens, colour of frame 1 cannot be read"):
        frame.rgb()
    with pytest.raises(InputError, match=r"\.sens, depth of frame 1 is damaged"):
        frame.depth()
    other = scannet_world.Recording(count=1, lost=())
    other.colour = np.zeros((1, 5, 5, 3), np.uint8)
    recording.coded_colour = lambda _, coding: other.coded_colour(0, coding)
    with pytest.raises(InputError, match="colour of frame 0 has 5 x 5 pixels, but the header"):
        read_sens(sens())[0].rgb()


@DAMAGE
@given(st.data())
def test_truncated_anywhere_a_file_is_refused_or_used_so_far(recording, folder, data):
    whole = recording.sens()
    inertial = 8 + 2 * 128
    at = data.draw(st.integers(0, len(whole)))
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "cut.sens"
    file.write_bytes(whole[:at])
    if at >= len(whole) - inertial:
        assert len(read_sens(file)) == 4  # what follows the frames is not read
        return
    with pytest.raises(InputError, match=r"cut\.sens"):
        read_sens(file)
    with refusing("cut.sens"):
        capture = read_sens(file, partial=True)
        assert 1 <= len(capture) <= 4
        for frame in capture:
            np.testing.assert_array_equal(frame.rgb(), recording.colour[frame.index])
            assert frame.depth() is not None


@DAMAGE
@given(st.data())
def test_any_damage_is_an_input_error(recording, folder, data):
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "bad.sens"
    file.write_bytes(data.draw(damaged(recording.sens(colour=2)) | st.binary(max_size=700)))
    with refusing("bad.sens"):
        for frame in read_sens(file, partial=True):
            frame.rgb()
            frame.depth()


@pytest.mark.parametrize(
    ("intrinsics", "digits"), [("intrinsic/intrinsic_{}.txt", 1), ("intrinsics_{}.txt", 6)]
)
def test_an_exported_folder_holds_what_was_recorded(recording, folder, intrinsics, digits):
    recording.export(folder, intrinsics=intrinsics, digits=digits)
    assert is_scannet_export(folder)
    assert not is_scannet_export(folder.parent)
    capture = read_scannet_export(folder)
    check(capture, recording)
    assert capture.stamps.tolist() == [0.0, 1.0, 3.0, 4.0]


def test_frames_go_by_number_not_by_name(scannet_world, folder):
    recording = scannet_world.Recording(count=12, lost=())
    recording.export(folder)
    (folder / "pose" / "3.txt").unlink()
    (folder / "depth" / "5.png").unlink()
    (folder / "color" / "notes.txt").write_text("mine")
    capture = read_scannet_export(folder)
    assert [frame.index for frame in capture] == [0, 1, 2, *range(4, 12)]
    assert capture[4].depth() is None
    np.testing.assert_array_equal(capture[-1].rgb(), recording.colour[11])
    for file in (folder / "depth").iterdir():
        file.unlink()
    capture = read_scannet_export(folder)
    assert capture.depth_camera is None
    assert capture[0].depth() is None


def test_smaller_images_need_the_size_of_the_intrinsics(recording, folder):
    recording.export(folder)
    for file in (folder / "color").iterdir():
        Image.new("RGB", (4, 3)).save(file)
    meta = folder / f"{folder.name}.txt"
    meta.write_text("colorHeight = 6\ncolorWidth = 8\nfx_color = 10.0\n")
    assert read_scannet_export(folder).camera == COLOUR.resize(4, 3)
    inner = folder / "exported"
    recording.export(inner)
    assert read_scannet_export(inner).camera == COLOUR
    meta.unlink()
    matrix = folder / "intrinsic" / "intrinsic_color.txt"
    np.savetxt(matrix, [[1170, 0, 647.75, 0], [0, 1170, 483.75, 0], *np.eye(4)[2:]])
    with pytest.raises(InputError, match="principal point lies outside the images of 4 x 3"):
        read_scannet_export(folder)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("pose/1.txt", "1 0 0\n", "does not contain 4 x 4 numbers"),
        ("pose/1.txt", "one " * 16, "does not contain 4 x 4 numbers"),
        ("pose/1.txt", "1 " * 16, "the pose is not a rigid transform"),
        ("intrinsic/intrinsic_color.txt", "0 " * 16, "must be greater than 0"),
        ("intrinsic/intrinsic_depth.txt", "", "does not contain 4 x 4 numbers"),
        ("color/0.png", "", "cannot be read as an image"),
        ("color/00.png", "", "have the same frame number"),
        ("color/1234567890123.png", "", "is not a frame number"),
    ],
)
def test_a_wrong_file_is_named(recording, folder, name, text, message):
    recording.export(folder)
    (folder / name).write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_scannet_export(folder)
    assert str(folder / name) in str(caught.value)


def test_missing_intrinsics_and_images_are_named(recording, folder):
    recording.export(folder)
    (folder / "intrinsic" / "intrinsic_depth.txt").unlink()
    with pytest.raises(InputError, match=r"intrinsic_depth\.txt does not exist"):
        read_scannet_export(folder)
    for file in (folder / "color").iterdir():
        file.unlink()
    with pytest.raises(InputError, match="color contains no image"):
        read_scannet_export(folder)


@pytest.fixture
def labelled(scannet_world, recording, folder):
    scan = scannet_world.Scan(folder)
    recording.write_sens(folder / f"{folder.name}.sens")
    recording.export(folder)
    instances = np.zeros((5, 6, 8), np.uint8)
    instances[:, :3] = 1 + 4  # the table's objectId is 4
    labels = np.zeros((5, 6, 8), np.uint16)
    labels[:, :3] = 3
    recording.project(folder, "instance-filt", instances, np.uint8)
    recording.project(folder, "label-filt", labels, np.uint16)
    return scan


@pytest.mark.parametrize("read", [read_sens, read_scannet_export])
def test_instances_are_objects_of_the_annotation(labelled, read):
    capture = read(labelled.folder)
    assert (capture.label_kind, capture.label_camera) == ("instances", COLOUR)
    assert capture.label_names == {0: "floor", 4: "dining table", 2: "office chair"}
    marks = capture[0].labels()
    assert (marks[:3] == 4).all()
    assert (marks[3:] == -1).all()
    assert read(labelled.folder, labels=None)[0].labels() is None
    with pytest.raises(InputError, match=r"class numbers, which need ScanNet's scannetv2-labels"):
        read(labelled.folder, labels="labels")
    labelled.write_table()
    capture = read(labelled.folder, labels="labels", label_column="nyu40class")
    assert capture.label_kind == "labels"
    assert capture.label_names == {1: "floor", 2: "chair", 3: "table", 1163: "object"}
    assert np.unique(capture[0].labels()).tolist() == [-1, 3]
    assert read(labelled.folder, label_column="category").label_names[4] == "table"


def test_an_id_that_the_table_lacks_is_named(labelled):
    labelled.write_table(["1\tfloor\tfloor\t9\t2\tfloor"])
    frame = read_sens(labelled.folder, labels="labels")[0]
    with pytest.raises(InputError, match=r"without a name in .*scannetv2-labels.combined.tsv: 3"):
        frame.labels()


def test_labels_that_nobody_can_read_are_noted(labelled):
    for file in (labelled.folder / "instance-filt").iterdir():
        file.unlink()
    capture = read_sens(labelled.folder)
    assert capture.label_camera is None
    assert "label-filt is not used" in capture.notes[0]
    with pytest.raises(InputError, match="instance-filt contains no image"):
        read_sens(labelled.folder, labels="instances")
    with pytest.raises(OptionError, match="labels is 'all'"):
        read_sens(labelled.folder, labels="all")


def test_label_images_of_another_size_show_the_colour_camera_s_view(labelled, recording):
    recording.project(labelled.folder, "instance-filt", np.ones((5, 3, 4)), np.uint8)
    capture = read_sens(labelled.folder)
    assert capture.label_camera == COLOUR.resize(4, 3)
    assert (capture[0].labels() == 0).all()
