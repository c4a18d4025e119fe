"""TUM trajectories: read back as written, refused with file and line where they are wrong."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.io.damage import DAMAGE, damaged, refusing

from placegraph.core.geometry import rotation_from_quaternion, rotation_from_vector
from placegraph.errors import InputError, OptionError
from placegraph.io.capture.posed import interpolate_poses
from placegraph.io.capture.tum import read_camera_path, read_table, read_tum, write_tum

GOOD = "# stamp and pose\n\n0.0 1 2 3 0 0 0 1\n0.5 1 2 4 0 0 1 0  # turned\n"


@pytest.fixture
def write(tmp_path):
    def written(text):
        path = tmp_path / "a.tum"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return written


def test_poses_between_stamps(rng):
    stamps, start = np.array([0.0, 0.1, 0.4]), rotation_from_quaternion([0.5, 0.5, 0.5, 0.5])

    def poses(times):  # a steady turn and a steady way
        out = np.tile(np.eye(4), (len(times), 1, 1))
        out[:, :3, :3] = start @ rotation_from_vector(np.outer(times, [1.0, -2.0, 3.0]))
        out[:, :3, 3] = np.outer(times, [4.0, 5.0, 6.0])
        return out

    wanted = np.array([-1.0, 0.0, *rng.uniform(0, 0.4, 5), 0.4, 9.0])
    found = interpolate_poses(stamps, poses(stamps), wanted)
    np.testing.assert_allclose(found, poses(np.clip(wanted, 0, 0.4)), atol=1e-12)
    np.testing.assert_array_equal(interpolate_poses([1.0], np.eye(4)[None], [5.0]), [np.eye(4)])


def test_rows_become_stamps_and_poses(write):
    read = read_tum(write(GOOD))
    assert read.stamps.tolist() == [0.0, 0.5]
    assert len(read) == 2
    np.testing.assert_array_equal(
        read.poses[0], [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    )
    np.testing.assert_allclose(read.poses[1, :3, :3], np.diag([-1.0, -1.0, 1.0]))
    assert not read.poses.flags.writeable
    assert not read.stamps.flags.writeable
    turn = read_tum(write("0 0 0 0 0 0 0.7075 0.7075")).poses[0, :3, :3]  # of length 1.0005
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize(
    "text",
    [GOOD.replace("\n", "\r\n"), GOOD.replace(" ", "\t"), "﻿" + GOOD, GOOD.rstrip("\n")],
    ids=["windows", "tabs", "byte order mark", "no last newline"],
)
def test_the_same_text_in_other_clothes(text, write):
    np.testing.assert_array_equal(read_tum(write(text)).poses, read_tum(write(GOOD)).poses)


@pytest.mark.parametrize(
    ("row", "says"),
    [
        ("0.5 1 2 3 0 0 0", "line 4: 7 columns are given, expected 8"),
        ("0.5 1 2 3 0 0 0 1 9", "line 4: 9 columns"), ("0.5 1 2 x 0 0 0 1", "line 4.*'x'"),
        ("0.5 1 2 nan 0 0 0 1", "line 4: tz is nan"), ("0.5 inf 2 3 0 0 0 1", "line 4: tx is inf"),
        ("0.5 1 2 3 nan 0 0 1", "line 4: qx is nan"), ("nan 1 2 3 0 0 0 1", "line 4: stamp is nan"),
        ("0.0 1 2 3 0 0 0 1", "line 4: the stamp 0 is repeated"),
        ("-0.5 1 2 3 0 0 0 1", "line 4: the stamp -0.5 is earlier"),
        ("0.5 1 2 3 0 0 0 1.01", "line 4: the quaternion has length 1.01"),
        ("0.5 1 2 3 0 0 0 0", "line 4: the quaternion has length 0"),
        ("0.5 1 2 3 0 0 1e300 1", "line 4: the quaternion has length"),
    ],
)  # fmt: skip
def test_a_wrong_row_is_named(row, says, write):
    lines = GOOD.splitlines()
    path = write("\n".join([*lines[:3], row]))
    with pytest.raises(InputError, match=says) as caught:
        read_tum(path)
    assert str(path) in str(caught.value)


def test_what_cannot_be_read(tmp_path, write):
    for path, says in ((tmp_path / "no.tum", "does not exist"), (tmp_path, "cannot be read")):
        with pytest.raises(InputError, match=says):
            read_tum(path)
    for content in ("", "\n\n", "# only words\n", b"\xff\xfe\x00\x01"):
        with pytest.raises(InputError, match="not text" if content[:1] == b"\xff" else "is empty"):
            read_tum(write(content))


def test_tables_name_their_columns(write):
    path = write("0 1 2\n1 3 4\n")
    table = read_table(path, ("stamp", "gx", "gy"))
    assert table.values.tolist() == [[0, 1, 2], [1, 3, 4]]
    assert [at.rpartition(" ")[2] for at in table.locations] == ["1", "2"]
    with pytest.raises(InputError, match="`stamp gx`"):
        read_table(path, ("stamp", "gx"))


unit = st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1)


@given(
    stamps=st.lists(st.floats(-1e9, 2e9), min_size=1, max_size=4, unique=True),
    position=st.lists(st.floats(-1e4, 1e4), min_size=3, max_size=3),
    quaternion=unit,
)
def test_what_is_written_is_read_back(stamps, position, quaternion, tmp_path_factory):
    path = tmp_path_factory.mktemp("tum") / "a.tum"
    poses = np.tile(np.eye(4), (len(stamps), 1, 1))
    poses[:, :3, :3] = rotation_from_quaternion(quaternion)
    poses[:, :3, 3] = position
    write_tum(path, sorted(stamps), poses, comment="map_from_camera\nmetres")
    read = read_tum(path)
    assert read.stamps.tolist() == sorted(stamps)
    np.testing.assert_allclose(read.poses, poses, atol=2e-8)


def test_whole_stamps_stay_whole(tmp_path):
    write_tum(tmp_path / "a.tum", [7, 8], np.tile(np.eye(4), (2, 1, 1)), comment="frames")
    assert (tmp_path / "a.tum").read_text().splitlines()[:2] == [
        "# frames",
        "7 0.000000000 0.000000000 0.000000000 0.000000000 0.000000000 0.000000000 1.000000000",
    ]


@pytest.mark.parametrize(
    ("stamps", "poses", "says"),
    [
        ([0, 1], np.eye(4)[None], "shape"), ([[0]], np.eye(4)[None], "shape"),
        ([np.nan], np.eye(4)[None], "not finite"), ([0], np.full((1, 4, 4), np.inf), "not finite"),
        ([1, 1], np.tile(np.eye(4), (2, 1, 1)), "do not increase"),
    ],
)  # fmt: skip
def test_what_would_not_be_read_is_not_written(stamps, poses, says, tmp_path):
    with pytest.raises(OptionError, match=says):
        write_tum(tmp_path / "a.tum", stamps, poses)
    assert not (tmp_path / "a.tum").exists()


@DAMAGE
@given(content=damaged(GOOD.encode()))
def test_damaged_files_give_one_kind_of_error(content, write):
    path = write(content)
    with refusing(path):
        assert np.isfinite(read_tum(path).poses).all()


def test_shared_trajectories(shared):
    for name, rows in (("house/seq00/odometry.tum", 25), ("office/odometry.tum", 373)):
        assert len(read_tum(shared / "data" / name)) == rows


def test_both_kinds_of_file(tmp_path):
    poses = np.stack([np.eye(4)] * 3)
    poses[:, 0, 3] = [0, 1, 2]
    write_tum(tmp_path / "a.tum", np.arange(3), poses)
    (tmp_path / "b.json").write_text(json.dumps({"trajectory": poses.tolist(), "frames": [1]}))
    for name in ("a.tum", "b.json"):
        assert read_camera_path(tmp_path / name) == pytest.approx(poses)


@pytest.mark.parametrize(
    "text",
    [
        "", "[]", "{}", '{"trajectory": []}', '{"trajectory": [[1, 2], [3]]}', '{"trajectory": "no"}',
        '{"trajectory": [[[NaN, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]]}',
    ],
)  # fmt: skip
def test_what_is_no_estimate_or_missing(tmp_path, text):
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"a\.json"):
        read_camera_path(path)
    for name in ("no.json", "no.tum"):
        with pytest.raises(InputError, match="does not exist"):
            read_camera_path(tmp_path / name)
