"""Ways of cameras: TUM text, or the JSON of an estimate."""

import json

import numpy as np
import pytest

from placegraph.errors import InputError
from placegraph.io.capture.tum import read_camera_path, write_tum


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
        "",
        "[]",
        "{}",
        '{"trajectory": []}',
        '{"trajectory": [[1, 2], [3]]}',
        '{"trajectory": "no"}',
        '{"trajectory": [[[NaN, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]]}',
    ],
)
def test_what_is_no_estimate(tmp_path, text):
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"a\.json"):
        read_camera_path(path)


def test_a_missing_file(tmp_path):
    for name in ("a.json", "a.tum"):
        with pytest.raises(InputError, match="does not exist"):
            read_camera_path(tmp_path / name)
