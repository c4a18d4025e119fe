import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.errors import InputError, OptionError
from placegraph.indoor.encode.labels import Confusion
from placegraph.io.capture.capture import Capture

NAMES = ("desk", "table", "wall, white")
MATRIX = [[0.2, 0.8, 0.0], [0.0, 1.0, 0.0], [0.1, 0.1, 0.8]]


def test_what_a_said_label_may_truly_be():
    known = Confusion(NAMES, MATRIX)
    assert known.find_true_labels("Table") == pytest.approx(
        {"desk": 0.8 / 1.9, "table": 1 / 1.9, "wall, white": 0.1 / 1.9}
    )
    assert known.find_true_labels("desk") == pytest.approx({"desk": 2 / 3, "wall, white": 1 / 3})
    assert known.find_true_labels("sofa") == {}
    assert Confusion(("a", "b"), [[3, 1], [0, 0]]).matrix.tolist() == [[0.75, 0.25], [0, 0]]
    assert (
        Confusion(("a", "b"), [[1, 0], [0, 0]]).find_true_labels("b") == {}
    )  # said, of what is unknown
    assert Confusion(("a", "b"), [[0.999, 0.001], [0.0, 1.0]]).find_true_labels("b") == {"b": 1.0}


@pytest.mark.parametrize(
    ("names", "matrix", "says"),
    [
        (("a", "b"), [[1, 0]], "shape"), ((), [], "shape"), (("a",), [[np.nan]], "or not a number"),
        (("a",), [[-1]], "or not a number"), (("Sofa", "sofa"), np.eye(2), r"give each label once\."),
    ],
)  # fmt: skip
def test_matrices_that_are_none(names, matrix, says):
    with pytest.raises(OptionError, match=says):
        Confusion(names, matrix)


@pytest.mark.parametrize("name", ["known.csv", "known.json"])
def test_files(tmp_path, name):
    known = Confusion(NAMES, MATRIX)
    known.save(tmp_path / name)
    again = Confusion.open(tmp_path / name)
    assert again.names == NAMES
    assert again.matrix == pytest.approx(known.matrix, abs=1e-6)
    with pytest.raises(InputError, match="cannot be written"):
        known.save(tmp_path / "nowhere" / name)
    for missing in (f"none-{name}", "."):
        with pytest.raises(InputError):
            Confusion.open(tmp_path / missing)
    path = tmp_path / "counts.csv"  # its lines may stand in any order
    path.write_text("true,desk,table\ntable, 0, 7\n\ndesk,1,3\n", encoding="utf-8")
    got = Confusion.open(path)
    assert got.names == ("desk", "table")
    assert got.matrix.tolist() == [[0.25, 0.75], [0, 1]]


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.csv", "", "the header must list"), ("a.csv", ",a,b\na,1,0\n", "the header must list"),
        ("a.csv", ",a,b\na,1,0\nc,0,1\n", "the header must list"), ("a.csv", ",a\na,one\n", "same number"),
        ("a.csv", ",a,b\na,1\nb,0,1\n", "same number"), ("a.csv", ",a\na,-1\n", "or not a number"),
        ("a.csv", ",a\na,nan\n", "or not a number"), ("a.csv", b"\xff\xfe\x00", "cannot be read"),
        ("a.json", "{", "not JSON"),
        ("a.json", "[1]", "JSON object"), ("a.json", '{"names": "ab"}', "JSON object"),
        ("a.json", '{"names": ["a"], "matrix": [["x"]]}', "same number"),
        ("a.json", '{"names": ["a"], "matrix": [[1, 2]]}', "shape"),
        ("a.json", '{"names": ["a", "A"], "matrix": [[1, 2], [1, 2]]}', "twice"),
    ],
)  # fmt: skip
def test_files_that_are_none(tmp_path, name, content, says):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError, match=says) as caught:
        Confusion.open(path)
    assert str(path) in str(caught.value)


@given(st.text(max_size=80), st.sampled_from(["csv", "json"]))
def test_any_text_is_a_table_or_an_error(tmp_path_factory, text, kind):
    path = tmp_path_factory.getbasetemp() / f"any.{kind}"
    path.write_text(text, encoding="utf-8")
    try:
        got = Confusion.open(path)
    except InputError:
        return
    assert len(got.names) == len(got.matrix) > 0


def confused(capture, room, truth, said):
    names = {
        int(id_): said.get(label, label)
        for id_, label in zip(room.graph.ids, room.graph.labels, strict=True)
    }
    frames = [
        dataclasses.replace(f, label_kind="labels", label_names=names, odometry=pose)
        for f, pose in zip(capture, truth(capture), strict=True)
    ]
    return Capture.from_frames(frames)


def test_what_is_said_of_a_map_is_found_out(room, walk, truth):
    capture = confused(walk, room, truth, {"sideboard": "sofa", "chair": "stool"})
    known = Confusion.estimate(room, [capture[:5], capture[5:]], step=2)
    row = {name: i for i, name in enumerate(known.names)}
    assert known.matrix[row["sideboard"], row["sofa"]] > 0.8
    assert known.matrix[row["wall"], row["wall"]] > 0.95
    assert not known.matrix[row["sofa"]].any()  # never true in this map
    truly = known.find_true_labels("sofa")
    assert max(truly, key=truly.get) == "sideboard"
    assert truly["sideboard"] > 0.8
    assert known.matrix.sum(axis=1)[known.matrix.any(axis=1)] == pytest.approx(1)
    much = Confusion.estimate(room, [capture], smoothing=1e9).matrix
    assert (np.ptp(much[much.any(axis=1)], axis=0) < 1e-4).all()


def test_captures_that_show_nothing(room, walk, truth):
    with pytest.raises(OptionError, match="captures: no label image"):
        Confusion.estimate(room, [walk])  # of instances
    with pytest.raises(OptionError, match="captures: no label image"):
        Confusion.estimate(room, [])
    away = [
        dataclasses.replace(f, odometry=np.eye(4) + np.eye(4, k=3) * 1e4)
        for f in confused(walk, room, truth, {})
    ]
    with pytest.raises(OptionError, match="captures: no label image"):
        Confusion.estimate(room, [Capture.from_frames(away)])
    for options in ({"step": 0}, {"smoothing": -1.0}, {"smoothing": np.nan}):
        with pytest.raises(OptionError, match="smoothing"):
            Confusion.estimate(room, [walk], **options)
